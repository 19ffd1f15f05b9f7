"""Files from outside as arrays: one reader, that every door which takes a file calls."""
