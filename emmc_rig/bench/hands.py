"""What a person does at the bench: lamp, board and masks, and what no axis of the rig moves."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np

from emmc_rig.model.camera import Camera
from emmc_rig.model.geometry import centred_grid

Ask = Callable[[str], None]
MASK, APERTURE = ("mask_x", "mask_y"), ("aperture_x", "aperture_y")
ON_A_HOLE = 0.25
"""Of an aperture cell: as far from a hole's middle a place still means that hole."""


class Attendant:
    """What a person, or a relay, does at the bench between exposures."""

    def set_lamp(self, colour: str) -> None:
        """Light the scene or the board: off, white, red, green or blue."""

    def place(self, target: str, turn_deg: float = 0.0) -> None:
        """Put the "scene" or the "whiteboard" before the camera; the board turned in its plane."""

    def fit_masks(self, shot: int, fitted: bool = True) -> None:
        """Fit the masks and the filter of a shot; or only its filter, the masks taken out."""

    def move(self, offsets_um: Mapping[str, float]) -> None:
        """Bring axes that the stage has not to their places, from where each is centred."""

    def again(self, axes: Collection[str]) -> None:
        """Take what `move` did with these axes for undone: the frame shows something else."""


class NoAttendant(Attendant):
    """An `Attendant` of a bench on which nothing ever changes."""


class AskingAttendant(Attendant):
    """An `Attendant` who is a person: asked, and asked again only when something changes.

    zero_um, window_um: as of `Rig`.
    """

    def __init__(
        self,
        camera: Camera,
        ask: Ask,
        zero_um: Mapping[str, float] | None = None,
        window_um: float = 0.0,
    ) -> None:
        self._camera, self._ask = camera, ask
        self._zero_um, self._window_um = zero_um or {}, window_um
        self._done: dict[str, str] = {}

    def set_lamp(self, colour: str) -> None:
        """Ask for the lamp."""
        off = "switch the lamp off"
        self._want("lamp", off if colour == "off" else f"switch the {colour} lamp on")

    def place(self, target: str, turn_deg: float = 0.0) -> None:
        """Ask for the scene or the board."""
        turned = ""
        if turn_deg:
            turned = f", turned in its plane by {turn_deg:g} degrees from how it first stood"
            turned += ", every time the same way round"
        self._want("target", f"put the {target} before the camera{turned}")

    def fit_masks(self, shot: int, fitted: bool = True) -> None:
        """Ask for masks and filter."""
        names = ", ".join(self._camera.shot_masks(shot)) if fitted else ""
        chosen = self._camera.shots[shot].filter
        masks = f"put in the masks {names}" if names else "take all masks out"
        colour = "take any filter out" if chosen == "none" else f"put in the {chosen} filter"
        self._want("masks", masks)
        if any(other.filter != "none" for other in self._camera.shots):
            self._want("filter", colour)

    def move(self, offsets_um: Mapping[str, float]) -> None:
        """Ask for the pinhole or the open aperture, and for the mask's place."""
        aperture = {axis: offsets_um[axis] for axis in APERTURE if axis in offsets_um}
        if aperture:
            self._want("aperture", self._aperture(aperture))
        mask = {axis: offsets_um[axis] for axis in MASK if axis in offsets_um}
        if mask:
            places = ", ".join(
                f"{axis} to {(self._zero_um.get(axis, 0.0) + um) / 1e3:.3f} mm"
                for axis, um in mask.items()
            )
            self._want("mask", f"set the mask's micrometer, {places}")

    def again(self, axes: Collection[str]) -> None:
        """Ask for the pinhole, or the mask, once more when it is next wanted."""
        for what, own in (("aperture", APERTURE), ("mask", MASK)):
            if {*own} & {*axes}:
                self._done.pop(what, None)

    def _aperture(self, offsets_um: Mapping[str, float]) -> str:
        hole = hole_at(self._camera, offsets_um)
        if hole is not None and len(offsets_um) == len(APERTURE):
            rows, columns = self._camera.views
            return f"put the pinhole on {hole_name(hole, (rows, columns))}"
        if offsets_um == {"aperture_x": self._window_um, "aperture_y": 0.0}:
            return "open the whole aperture, no pinhole before it"
        places = ", ".join(f"{axis} to {um / 1e3:+.3f} mm" for axis, um in offsets_um.items())
        return f"move the pinhole plate from the middle of the aperture, {places}"

    def _want(self, what: str, wish: str) -> None:
        if self._done.get(what) != wish:
            self._ask(wish)
            self._done[what] = wish


def hole_at(camera: Camera, offsets_um: Mapping[str, float]) -> tuple[int, int] | None:
    """Return the view (v, u) before which a pinhole stands; None elsewhere."""
    cell_um = camera.lens.aperture_cell_um
    place = []
    for axis, count in zip(reversed(APERTURE), camera.views, strict=True):
        off = np.abs(centred_grid(count, cell_um) - offsets_um.get(axis, 0.0))
        if off.min() > ON_A_HOLE * cell_um:
            return None
        place.append(int(off.argmin()))
    return place[0], place[1]


def hole_name(view: tuple[int, int], views: tuple[int, int]) -> str:
    """Return what a person calls the hole of a view: counted from 1, row by row."""
    (v, u), (rows, columns) = view, views
    return f"hole {v * columns + u + 1} of {rows * columns} (row {v + 1}, column {u + 1})"
