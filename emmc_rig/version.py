"""The version of the program and that of its figures, in one place."""

__version__ = "0.4.0"
NUMERICS = 1
"""Raised when the same inputs give other results: what was stored before is computed again."""
