"""Charts, tables, stability and designs, on one engine of points."""
