"""A stage with a protocol of its own, and a camera that is a program: a plug-in to copy."""
