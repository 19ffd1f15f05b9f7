"""What hands move in a capture, and where the mask's shadow in a frame says that they put it.

A pinhole moved by du shows the shadow that the mask shows when it is moved by -rho du, rho = d / D
(see `calibration.placement`): what is fitted to a frame is where the mask seems to stand, and the
hole follows. Where it really stands the whole aperture shows; without such a whiteboard the first
pinhole counts as put right.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import channels_of
from calibration.errors import CalibrationError
from calibration.openings import views_open
from calibration.placement import SCALARS, designed_placement
from calibration.shadow import Shadow, ShadowMask, shadow_mask
from drivers.raw import RawFrame
from emmc_rig.acquisition.checks import FrameRefusedError
from emmc_rig.bench.hands import APERTURE, MASK, NoAttendant, hole_name
from emmc_rig.bench.hardware import RigType
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, psi_layout
from emmc_rig.model.geometry import centred_grid
from emmc_rig.session.planned import PlannedFrame

LONGEST_PX = 96
"""Of the middle of a frame, along either side: more tells a place hardly better."""
SEARCHED_UM, SEARCH_STEPS = 60.0, 21
"""How far the mask is looked for to either side, and in how many steps."""
FITTED = ("offset_x_um", "offset_y_um", "rotation_rad", "scale", "blur_um")
ROUNDS, ENOUGH_UM = 12, 1e-3
FEW_PIXELS = 1500
"""To choose among places by."""
LEAST_EXPLAINED = 0.2
"""Of a frame's pattern, by the shadow: less is no sight of it."""
MISSED_ALIKE = 2.0
"""By how much more than its pixels say a fit of the shadow is off: what it misses of neighbours is
alike."""
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
    """Return the rig with the axes that it lacks and that its person moves, see `Rig.hands`.

    frames: all of the plan. An axis that all of them want at one place is left where it is. Raises
    AppError where nobody moves what the frames need.
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
        self._pixels = np.indices(kept).reshape(2, -1).T.astype(np.int64)
        self._layout = psi_layout(camera, size)
        self._shadow = Shadow(self._mask, designed_placement(camera))
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
        fitted = FITTED if self._first_um is None else FITTED[:2]
        start_um = np.zeros(2) if self._first_um is None else self._first_um
        found = self._found(planned, frame, planned.view, _around(start_um), fitted)
        if found is not None:
            self._stands_um, self._unsure_um = found
            self._first_um = found[0] if self._first_um is None else self._first_um

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
        # A pinhole that much further in x and y shows the mask so much further back.
        grid_y, grid_x = (centred_grid(count, cell_um) for count in camera.views)
        asked_um = np.array([grid_x[asked[1]], grid_y[asked[0]]])
        holes_um = [np.array([x, y]) for y in grid_y for x in grid_x]
        starts = [stands_um - self._ratio * (hole_um - asked_um) for hole_um in holes_um]
        found = self._found(planned, frame, asked, starts)
        if found is None:
            return None
        seems_um, deviation_um = found
        x_um, y_um = map(float, asked_um - (seems_um - stands_um) / self._ratio)
        wanted = planned.bench.offsets_um
        off = np.array([x_um - wanted["aperture_x"], y_um - wanted["aperture_y"]])
        if np.abs(off).max() > cell_um / 2:
            view = int(np.abs(grid_y - y_um).argmin()), int(np.abs(grid_x - x_um).argmin())
            raise WrongPlaceError(
                planned.id,
                f"shows the shadow through {hole_name(view, camera.views)}",
                f"put the pinhole on {hole_name(asked, camera.views)}",
            )
        deviation_um = float(np.hypot(deviation_um, self._unsure_um)) / self._ratio
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

    def _found(
        self, planned: PlannedFrame, frame: RawFrame, view: tuple[int, int] | None,
        starts_um: Sequence[NDArray[np.float64]], fitted: Sequence[str] = FITTED[:2],
    ) -> tuple[NDArray[np.float64], float] | None:  # fmt: skip
        """Return where the mask seems to stand, beyond where it should, and the deviation of that.

        view: the one that is open. starts_um: places, about one of which it stands. fitted: of the
        mask's placement; what is found of it, but for the place, holds from then on.
        """
        assert self._mask is not None
        mask, shot = self._mask, planned.bench.shot
        cut_y, cut_x = self._cut
        rows, columns = frame.mosaic.shape
        frame = frame.with_one_black()
        black = float(frame.black_level_dn.mean())
        seen = frame.mosaic[cut_y : rows - cut_y, cut_x : columns - cut_x].ravel() - black
        usable = (seen < (frame.white_level_dn - black)) & (seen > 0)
        pixels, read = self._pixels[usable], seen[usable]
        channels = channels_of(self._layout, shot).ravel()[usable]
        offsets = planned.bench.offsets_um
        centre_um = np.array([offsets.get(axis, 0.0) for axis in MASK])
        how = views_open(self._camera.views, view, planned.window)

        def stands(at_um: NDArray[np.float64]) -> tuple[tuple[float, float], int]:
            x, y = centre_um + at_um
            return (float(x), float(y)), shot % len(mask.cells)

        def explained(at_um: NDArray[np.float64], every: int = 1) -> float:
            some, seen_by = pixels[::every], channels[::every]
            shown = self._shadow.readings(some, seen_by, how, *stands(at_um))
            return _explained(read[::every], shown, seen_by)

        few = max(1, len(read) // FEW_PIXELS)
        at_um = max(starts_um, key=lambda one: explained(one, few))
        chosen = [SCALARS.index(name) for name in fitted]
        deviation_um = np.inf
        for _ in range(ROUNDS):
            now, slopes = self._shadow.with_slopes(pixels, channels, how, *stands(at_um))
            step, deviation_um = _step(read, now, slopes[:, chosen], channels)
            longest = float(np.abs(step[:2]).max())
            step *= min(1.0, mask.cell_um / 4 / max(longest, 1e-12))
            at_um = at_um + step[:2]
            if len(chosen) > 2:
                rest = np.zeros(slopes.shape[1])
                rest[chosen[2:]] = step[2:]
                self._shadow = Shadow(mask, self._shadow.placement.moved(rest))
            if longest < ENOUGH_UM:
                break
        return (at_um, deviation_um) if explained(at_um) > LEAST_EXPLAINED else None


def _around(place_um: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return places around one."""
    steps = np.linspace(-SEARCHED_UM, SEARCHED_UM, SEARCH_STEPS)
    return [place_um + np.array([x, y]) for x in steps for y in steps]


def _by_channel(channels: NDArray[np.uint8], values: NDArray) -> NDArray[np.float64]:
    """Return a column of values for each colour, 0 where a pixel sees another."""
    return np.where(channels[:, None] == np.unique(channels), values[:, None], 0.0)


def _explained(read: NDArray, modelled: NDArray, channels: NDArray[np.uint8]) -> float:
    """Return the share of the pattern, brightness by colour taken out, that a model explains."""
    flat = _by_channel(channels, np.ones(len(read)))
    left = []
    for columns in (flat, np.hstack([flat, _by_channel(channels, modelled)])):
        fit = np.linalg.lstsq(columns, read, rcond=None)[0]
        left.append(float(np.square(read - columns @ fit).sum()))
    return 1 - left[1] / max(left[0], 1e-12)


def _step(
    read: NDArray, modelled: NDArray, slopes: NDArray, channels: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], float]:
    """Return a step, and the deviation of its first two, the brightness of colours being free."""
    bright = _by_channel(channels, modelled)
    scale = np.linalg.lstsq(bright, read, rcond=None)[0]
    columns = np.hstack([bright, ((bright > 0) @ scale)[:, None] * slopes])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    fit = np.linalg.lstsq(columns / size, read, rcond=None)[0] / size
    left = read - columns @ fit
    covariance = np.linalg.pinv((columns / size).T @ (columns / size)) * left.var()
    first = bright.shape[1]
    deviations = (np.sqrt(covariance.diagonal()) / size)[first : first + 2]
    return np.asarray(fit[first:], np.float64), MISSED_ALIKE * float(deviations.max())
