"""Errors of the camera model; a message is one line, with the fault and its remedy."""

import difflib
from collections.abc import Iterable

from emmc_rig.model.advice import AdvisedError


def nearest_of(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the nearest known name, if any is near, and all names."""
    known = list(known)
    return f"{did_you_mean(name, known, 0.6)}known are {', '.join(known)}"


def did_you_mean(name: str, known: Iterable[str], likeness: float = 0.5) -> str:
    """Return "did you mean", with the known name that is nearest; "" where no name is near."""
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
