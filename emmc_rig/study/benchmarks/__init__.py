"""Speed, as ratios to a bound or to a library measured in the same run; commands show them."""
