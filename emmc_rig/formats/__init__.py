"""Formats of other programs; cameras, scenes and frames found by name."""
