"""What is read and written by name: cameras, scenes, captures, results."""
