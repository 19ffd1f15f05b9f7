"""Errors of the calibration: each message says what is wrong and what to do, in one line."""

from emmc_rig.model.advice import AdvisedError


class CalibrationError(AdvisedError):
    """Root of the calibration's errors; shown to the user as one line."""
