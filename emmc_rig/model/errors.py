"""Errors of the camera model; a message is one line, with the fault and its remedy."""

import difflib
from collections.abc import Iterable
from typing import Literal

Advice = Literal[
    "capture", "capture-edited", "list-cameras", "list-formats", "list-sessions", "name-frame",
    "name-rig", "new-plan", "other-devices", "plan-open-whiteboards", "plan-whiteboards",
    "reconstruct",
]  # fmt: skip
"""What helps against an error, as data: each front end words it for its reader."""


def nearest_of(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the nearest known name, if any is near, and all names."""
    known = list(known)
    return f"{did_you_mean(name, known, 0.6)}known are {', '.join(known)}"


def did_you_mean(name: str, known: Iterable[str], likeness: float = 0.5) -> str:
    """Return "did you mean", with the known name that is nearest; "" where no name is near."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=likeness)
    return f"did you mean '{near[0]}'? " if near else ""


class AdvisedError(Exception):
    """An error with a line for the user, and advice for front ends.

    about: the folder to reconstruct, or of the session to capture.
    """

    def __init__(self, text: str = "", advice: Advice | None = None, about: object = "") -> None:
        super().__init__(text)
        self.advice = advice
        self.about = about


class ModelError(AdvisedError):
    """Root of the model's errors; shown to the user as one line."""


class SceneError(ModelError, ValueError):
    """A light field that cannot be read or is not one."""


class CameraError(ModelError, ValueError):
    """A camera description that cannot be built."""


class SensingError(ModelError, ValueError):
    """An imaging matrix, or data given to it, that does not fit."""


class ViewOrderWarning(UserWarning):
    """Views of a light field were stored in another order than their names say, and put right."""


class RemovedSettingWarning(UserWarning):
    """A file holds a setting that this version no longer has; it is ignored."""
