"""Errors of the camera model: each message says what is wrong and what to do, in one line."""

import difflib
from collections.abc import Iterable

from emmc_rig.model.advice import AdvisedError


def nearest_of(name: str, known: Iterable[str]) -> str:
    """Return a hint for a name that is not known: the nearest one, if any is near, and all."""
    known = list(known)
    return f"{did_you_mean(name, known, 0.6)}known are {', '.join(known)}"


def did_you_mean(name: str, known: Iterable[str], likeness: float = 0.5) -> str:
    """Return a question that names the nearest of what is known, "" where none is that near."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=likeness)
    return f"did you mean '{near[0]}'? " if near else ""


class ModelError(AdvisedError):
    """Root of the model's errors; shown to the user as one line."""


class SceneError(ModelError):
    """A light field that cannot be read or is not one."""


class CameraError(ModelError):
    """A camera description that cannot be built."""


class SensingError(ModelError):
    """An imaging matrix, or data given to it, that does not fit."""


class ViewOrderWarning(UserWarning):
    """Views of a light field were stored in another order than their names say, and put right."""


class RemovedSettingWarning(UserWarning):
    """A file holds a setting that this version no longer has; it is ignored."""
