"""Errors of the calibration: each message names a fault and its remedy in one line."""

from emmc_rig.model.errors import AdvisedError


class CalibrationError(AdvisedError, ValueError):
    """Root of the calibration's errors; shown to the user as one line."""
