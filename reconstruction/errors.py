"""Errors of the reconstruction: each message says what is wrong and what to do, in one line."""


class ReconstructionError(Exception):
    """Root of the reconstruction's errors; shown to the user as one line."""
