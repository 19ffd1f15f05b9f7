"""Places of mask and pinhole that hands set in a capture, located by the mask's shadow.

A pinhole moved by du shows the shadow that the mask shows when it is moved by -rho du, rho = d / D
(see `calibration.placement`): what is fitted to a frame is where the mask seems to stand, and the
hole follows. Where it really stands the whole aperture shows; without such a whiteboard the first
pinhole counts as put right.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.hands import APERTURE, MASK, NoAttendant, hole_name
from emmc_rig.bench.hardware import Rig, RigType
from emmc_rig.calibration.boards import Board, channels_of
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.locator import Location, frame_board, locate, starting_placement
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.shadow import SEARCH_UM, ShadowMask, shadow_mask
from emmc_rig.captures.faults import FrameRefusedError
from emmc_rig.captures.plan import Plan
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, psi_layout
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.settings import validated
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

LONGEST_PX = 96
"""Of the middle of a frame, along either side: more tells a place hardly better."""
FARTHEST_MASK_UM = 30.0
"""That a hand may put the mask off its place before it is asked again."""


class WrongPlaceError(FrameRefusedError):
    """A hand put mask or pinhole, the axes named, elsewhere."""

    axes: tuple[str, ...] = APERTURE


class WrongMaskPlaceError(WrongPlaceError):
    """It was the mask."""

    axes = MASK


@dataclass(frozen=True)
class Place:
    """Where an axis that a hand moved stands in a frame, and the deviation of that, in um."""

    um: dict[str, float]
    deviation_um: float


def with_hands(rig: RigType, frames: Iterable[PlannedFrame]) -> RigType:
    """Return the rig with the missing axes that a person moves, see `Rig.hands`.

    frames: all of the plan. An axis with the same place in all frames stays where it is. Raises
    AppError where nobody moves an axis that the frames need.
    """
    places: dict[str, set[float]] = {}
    for frame in frames:
        for axis, um in frame.bench.offsets_um.items():
            places.setdefault(axis, set()).add(um)
    lacking = [axis for axis in places if axis not in rig.stage.axes]
    moved = [axis for axis in lacking if len(places[axis]) > 1]
    if moved and isinstance(rig.attendant, NoAttendant):
        known = ", ".join(rig.stage.axes) or "none"
        pinholes = {*moved} <= {*APERTURE}
        without = (
            "write `views: []` and `open:` boards under whiteboards in the plan, which need no "
            "pinhole"
            if pinholes
            else "plan shots at one place of the mask"
        )
        raise AppError(
            f"the plan moves {' and '.join(moved)}, the rig has the axes {known}, and nothing is "
            f"moved by hand (by_hand: false): write by_hand: true, or {without}",
            "plan-open-whiteboards" if pinholes else None,
        )
    return replace(rig, hands=frozenset(moved), left=frozenset(lacking) - frozenset(moved))


class HandPlaces:
    """Finds in whiteboards where hands put mask and pinhole; knows nothing of other frames.

    camera: as planned. shape: of its frames. For a camera with other than one mask between lens
    and sensor nothing is found.
    """

    def __init__(self, camera: Camera, shape: tuple[int, int], hands: frozenset[str]) -> None:
        self._camera, self._hands = camera, hands
        self._stands_um: NDArray[np.float64] | None = None
        self._first_um: NDArray[np.float64] | None = None
        self._unsure_um = 0.0
        self._set_to_um: dict[str, float] = {}
        self._mask: ShadowMask | None = None
        if not hands:
            return
        k = camera.sensor.binning
        # Cut by a whole number of tiles on either side, the middle stays the middle.
        self._cut = [max(0, (side - LONGEST_PX + 3) // 4 * 2) for side in shape]
        kept = [side - 2 * cut for side, cut in zip(shape, self._cut, strict=True)]
        size = (kept[0] * k, kept[1] * k)
        try:
            self._mask = shadow_mask(camera, size)
        except CalibrationError:
            return
        self._layout = psi_layout(camera, size)
        self._placement = starting_placement(camera, self._mask)
        self._ratio = self._mask.distance_um / self._mask.lens_um

    def shows(self, planned: PlannedFrame) -> bool:
        """Return whether a frame shows the mask's shadow."""
        bench = planned.bench
        lit = bench.target == "whiteboard" and bench.masks_in and bench.lamp == "white"
        return self._mask is not None and lit and planned.kind != "metering"

    def stand(self, planned: PlannedFrame, frame: RawFrame) -> None:
        """Learn from a whiteboard, the first that is given, how the mask stands."""
        if self._stands_um is not None or not self.shows(planned):
            return
        board = self._board(planned, frame)
        assert self._mask is not None
        with suppress(CalibrationError):
            if self._first_um is None:
                found = locate(board, self._mask, self._placement)
                self._placement, self._first_um = found.placement, np.array(found.offset_um)
            else:
                found = self._searched(board, self._first_um)
            self._stands_um = np.array(found.offset_um)
            self._unsure_um = found.offset_deviation_um

    def set_anew(self) -> None:
        """Take for unknown where the mask stands, if a hand moves it: it was set again."""
        if self._hands & {*MASK}:
            self._stands_um = None

    def found(self, planned: PlannedFrame, frame: RawFrame) -> Place | None:
        """Return where hands put what they moved; None where that cannot be told.

        Raises `WrongPlaceError` for the wrong hole, or a mask far from its place.
        """
        self._follow(planned)
        if not self.shows(planned):
            return None
        self.stand(planned, frame)
        if self._stands_um is None:
            return None
        if planned.view is not None and self._hands & {*APERTURE}:
            return self._hole(planned, frame, planned.view, self._stands_um)
        if planned.view is None and self._hands & {*MASK}:
            return self._mask_place(planned, self._stands_um)
        return None

    def _follow(self, planned: PlannedFrame) -> None:
        """Forget where the mask stands once a hand has set it anew."""
        offsets = planned.bench.offsets_um
        set_to = {axis: offsets[axis] for axis in MASK if axis in offsets and axis in self._hands}
        if set_to and self._set_to_um not in ({}, set_to):
            self.set_anew()
        self._set_to_um = set_to or self._set_to_um

    def _hole(
        self, planned: PlannedFrame, frame: RawFrame, asked: tuple[int, int],
        stands_um: NDArray[np.float64],
    ) -> Place | None:  # fmt: skip
        camera = self._camera
        cell_um = camera.lens.aperture_cell_um
        grid_y, grid_x = (centred_grid(count, cell_um) for count in camera.views)
        asked_um = np.array([grid_x[asked[1]], grid_y[asked[0]]])
        # A pinhole that much further in x and y shows the mask so much further back.
        reach_um = max(SEARCH_UM, self._ratio * 2 * max(grid_x[-1], grid_y[-1]))
        try:
            found = self._searched(self._board(planned, frame), stands_um, reach_um)
        except CalibrationError:
            return None
        x_um, y_um = map(float, asked_um - (found.offset_um - stands_um) / self._ratio)
        wanted = planned.bench.offsets_um
        off = np.array([x_um - wanted["aperture_x"], y_um - wanted["aperture_y"]])
        if np.abs(off).max() > cell_um / 2:
            view = int(np.abs(grid_y - y_um).argmin()), int(np.abs(grid_x - x_um).argmin())
            raise WrongPlaceError(
                planned.id,
                f"shows the shadow through {hole_name(view, camera.views)}",
                f"put the pinhole on {hole_name(asked, camera.views)}",
            )
        deviation_um = float(np.hypot(found.offset_deviation_um, self._unsure_um)) / self._ratio
        return self._place(dict(zip(APERTURE, (x_um, y_um), strict=True)), deviation_um)

    def _mask_place(self, planned: PlannedFrame, stands_um: NDArray[np.float64]) -> Place:
        """Return where a hand set the mask, beyond where it stood in the first whiteboard."""
        assert self._first_um is not None
        off_um = stands_um - self._first_um
        if np.abs(off_um).max() > FARTHEST_MASK_UM:
            x, y = off_um / 1e3
            self.set_anew()
            raise WrongMaskPlaceError(
                planned.id,
                f"shows the mask {x:+.3f} mm in x and {y:+.3f} mm in y off its place",
                "set it again, and check in which direction its micrometer counts",
            )
        wanted = planned.bench.offsets_um
        places = {axis: wanted[axis] + float(off) for axis, off in zip(MASK, off_um, strict=True)}
        return self._place(places, self._unsure_um)

    def _place(self, places_um: dict[str, float], deviation_um: float) -> Place:
        """Return what hands moved of it."""
        places_um = {axis: um for axis, um in places_um.items() if axis in self._hands}
        return Place(places_um, deviation_um)

    def _searched(
        self, board: Board, stands_um: NDArray[np.float64], reach_um: float = SEARCH_UM
    ) -> Location:
        """Return where the mask seems to stand; raises CalibrationError where it is not seen."""
        assert self._mask is not None
        x_um, y_um = map(float, stands_um)
        start = replace(self._placement, offset_x_um=x_um, offset_y_um=y_um)
        return locate(board, self._mask, start, reach_um)

    def _board(self, planned: PlannedFrame, frame: RawFrame) -> Board:
        """Return the middle of a whiteboard's frame."""
        assert self._mask is not None
        middle = tuple(
            slice(cut, side - cut) for cut, side in zip(self._cut, frame.mosaic.shape, strict=True)
        )
        bench, mosaic = planned.bench, frame.mosaic[middle]
        black_dn = frame.black_by_place()[middle]
        opened = views_open(self._camera.views, planned.view, planned.window)
        x_um, y_um = (bench.offsets_um.get(axis, 0.0) for axis in MASK)
        channels = channels_of(self._layout, bench.shot)
        opening = opened, (x_um, y_um), bench.shot
        return frame_board(mosaic, black_dn, frame.white_level_dn, channels, opening)


def places_in_session(session: Session, rig: Rig, plan: Plan) -> HandPlaces:
    """Return what finds the places of hands, knowing the mask from a stored whiteboard if any.

    Raises AppError where a frame of the session cannot be read.
    """
    hands = rig.hands if plan.checks.places_by_hand else frozenset()
    camera = validated(Camera, session.camera, str(session.folder), AppError)
    places = HandPlaces(camera, rig.camera.shape, hands)
    by_id = {frame.id: frame for frame in session.frames}
    for name, entry in session.stored.items() if hands else ():
        if name in by_id and places.shows(by_id[name]):
            places.stand(by_id[name], decode_frame(session.read(name), entry))
            places.set_anew()
            break
    return places
