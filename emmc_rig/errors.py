"""Errors for the user: each message is a line with the fault and its remedy."""

from __future__ import annotations

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.drivers.errors import DriverError
from emmc_rig.model.errors import AdvisedError, ModelError
from emmc_rig.reconstruction.errors import ReconstructionError


class AppError(AdvisedError):
    """Root of the application's errors; shown to the user as one line."""


class WrongUsageError(AppError, ValueError):
    """An option's value that cannot be read: the command was typed wrongly."""


class StoppedError(AppError):
    """Somebody stopped the program; the message says what is kept and how to go on."""


class StopCapture(Exception):  # noqa: N818
    """A hook of a plan raises it to end the capture: `raise StopCapture("the lamp is off")`.

    The frames captured so far are kept, and the same command or call resumes the capture.
    """


ERRORS = (AppError, ModelError, DriverError, CalibrationError, ReconstructionError)
"""The base class of each package's errors: `except emmc_rig.ERRORS` catches every error that is not
a bug of the program."""
