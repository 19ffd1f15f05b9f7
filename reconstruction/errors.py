"""Errors of the reconstruction: each message states the fault and its remedy in one line."""

from emmc_rig.model.errors import AdvisedError


class ReconstructionError(AdvisedError, ValueError):
    """Root of the reconstruction's errors; shown to the user as one line."""


class DictionaryError(ReconstructionError):
    """A dictionary that cannot be made, read or written, or does not fit the patches."""
