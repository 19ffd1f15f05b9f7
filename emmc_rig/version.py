"""The version of the program, and the revision of its numerical results."""

__version__ = "0.5.0"
NUMERICS = 1
"""Raised when equal inputs give other results: products stored before are computed again."""
