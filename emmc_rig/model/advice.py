"""What helps against an error, as data: each front end words it for its reader."""

from typing import Literal

Advice = Literal[
    "capture", "capture-edited", "list-cameras", "list-formats", "list-sessions", "name-frame",
    "name-rig", "new-plan", "other-devices", "plan-open-whiteboards", "plan-whiteboards",
    "reconstruct",
]  # fmt: skip


class AdvisedError(Exception):
    """An error with a line for the user, and advice for front ends.

    about: the folder to reconstruct, or of the session to capture.
    """

    def __init__(self, text: str = "", advice: Advice | None = None, about: object = "") -> None:
        super().__init__(text)
        self.advice = advice
        self.about = about
