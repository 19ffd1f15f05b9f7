"""Errors of the calibration: each message says what is wrong and what to do, in one line."""


class CalibrationError(Exception):
    """Root of the calibration's errors; shown to the user as one line."""
