"""Files read and written by name: cameras, scenes, captures, results."""
