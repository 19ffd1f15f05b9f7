"""Whiteboard frames as readings with variances, each with where mask, pinhole and lamp stood."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import (
    MeanFrame,
    SensorGain,
    bands,
    dark_at,
    hot_pixels,
    photon_transfer,
)
from emmc_rig.calibration.levels import Check, Levels
from emmc_rig.calibration.openings import CENTRED, Window, views_open
from emmc_rig.calibration.robust import deviation_of
from emmc_rig.model.sensing import PsiLayout

Array = NDArray[np.floating]
LAMP_COLOURS = ("red", "green", "blue")
DARKEST_REFERENCE_DN = 50.0
"""Above the dark: with rounding of 1 DN a ratio is known to 1 % of it and better."""


BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Rows and columns to the views beside a view."""
CLEARLY_CUT = 0.9
"""Of the brightest view's light: a pupil that shuts a view cuts those beside it. Views of a bench
differ by 5 %."""
Opening = tuple[NDArray[np.bool_], tuple[float, float], int]
"""Views open, (view_y, view_x); place of the mask in um, x and y; shot."""


@dataclass(frozen=True, eq=False)
class BoardFrame:
    """One whiteboard setting as captured: its mean frame, and how the bench stood.

    read: returns the mean frame; a session reads its files each time, so that memory holds a single
    whiteboard. count: frames taken. stage_um: where the mask stage stood, x and y, from
    where the design centres the mask; with the shot's own offset in it. pinhole: the one view (v,
    u) open, or None: those that the window leaves open, moved by so many cells (x, y). loose: a
    hand put the pinhole there, which may be a little off.
    """

    read: Callable[[], MeanFrame]
    count: int
    stage_um: tuple[float, float]
    shot: int = 0
    pinhole: tuple[int, int] | None = None
    lamp: str = "white"
    window: Window = CENTRED
    loose: bool = False

    @classmethod
    def held(cls, frame: MeanFrame, *how: Any, **named: Any) -> BoardFrame:
        """Return one whose mean frame is in memory; how, named: the fields from stage_um on."""
        return cls(lambda: frame, frame.count, *how, **named)

    @property
    def frame(self) -> MeanFrame:
        """Its mean frame, read now."""
        return self.read()

    @property
    def name(self) -> str:
        """What the messages call it."""
        through = "open aperture" if self.pinhole is None else f"view {self.pinhole}"
        if self.window != CENTRED:
            through = f"window moved by {self.window} cells"
        x, y = self.stage_um
        return f"shot {self.shot}, {through}, {self.lamp} lamp, mask at ({x:g}, {y:g}) um"


@dataclass(frozen=True, eq=False)
class BoardSet:
    """All that was captured at the whiteboard, whatever wrote it: a rig, a session, a simulation.

    darks: lamp off, at one exposure or more; between two the dark current is drawn as a line.
    references[shot, lamp]: aperture open, masks out. checks: boards seen again and again, which
    show what lamp and response do meanwhile.
    """

    darks: tuple[MeanFrame, ...]
    references: Mapping[tuple[int, str], MeanFrame]
    frames: tuple[BoardFrame, ...]
    checks: tuple[Check, ...] = ()

    def __post_init__(self) -> None:
        if not self.darks:
            raise CalibrationError("no dark frame: switch the lamp off and capture at least two")

    @property
    def dark(self) -> MeanFrame:
        """The dark frame of the shortest exposure."""
        return min(self.darks, key=lambda frame: frame.exposure_s)

    def dark_at(self, exposure_s: float) -> MeanFrame:
        """Return the dark frame of an exposure: black level and dark current of every pixel."""
        return dark_at(self.darks, exposure_s)

    def reference(self, shot: int, lamp: str) -> MeanFrame | None:
        """Return the reference of a shot under a lamp, by default that of the first shot."""
        return self.references.get((shot, lamp)) or self.references.get((0, lamp))

    @property
    def exposures(self) -> int:
        """How many frames were taken for it."""
        # One reference may serve several shots.
        references = {id(frame): frame for frame in self.references.values()}.values()
        return sum(frame.count for frame in (*self.darks, *references, *self.frames))

    def with_frames(self, frames: Sequence[BoardFrame]) -> BoardSet:
        """Return the same dark and reference frames with other whiteboards."""
        return replace(self, frames=tuple(frames))

    def levelled(
        self, levels: Levels, channels: NDArray[np.uint8], done: dict[int, MeanFrame]
    ) -> BoardSet:
        """Return the frames as under a steady lamp and a straight response.

        done: levelled references of other sets, by the identity of the frames before; those of this
        set are added. Sets share references, which of a large sensor fill memory.
        """

        def steady(frame: MeanFrame) -> MeanFrame:
            return levels.corrected(frame, self.dark_at(frame.exposure_s).mean_dn, channels)

        for reference in self.references.values():
            if id(reference) not in done:
                done[id(reference)] = steady(reference)
        return replace(
            self,
            references={key: done[id(reference)] for key, reference in self.references.items()},
            frames=tuple(
                replace(board, read=lambda board=board: steady(board.frame))
                for board in self.frames
            ),
        )


@dataclass(frozen=True, eq=False)
class Sample:
    """Pixels of a whiteboard, (n, 2), the colours they see, their readings and deviations, (n,)."""

    board: Board
    pixels: NDArray[np.int64]
    channels: NDArray[np.uint8]
    reading: NDArray[np.float64]
    deviation: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Board:
    """One whiteboard as readings: 1 is the same pixel with the aperture open and the masks out.

    reading, variance: (pixel_y, pixel_x); the variance of a pixel that is not to be used is
    infinite. channels: (pixel_y, pixel_x), the colour each pixel sees (3: all). repeats: frames
    averaged. unsteady2: relative variance of the brightness between these, see `MeanFrame`. loose:
    see `BoardFrame`. white2: (pixel_y, pixel_x), relative variance of the reference, which the
    variance includes; whiteboards of one reference share the array.
    """

    name: str
    reading: NDArray[np.float32]
    variance: NDArray[np.float32]
    channels: NDArray[np.uint8]
    views_open: NDArray[np.bool_]
    stage_um: tuple[float, float]
    shot: int
    taken_s: float = 0.0
    repeats: int = 1
    unsteady2: float = 0.0
    loose: bool = False
    white2: NDArray[np.float32] | None = None

    @property
    def opening(self) -> Opening:
        """Views open, place of the mask, shot: what `Shadow.readings` takes."""
        return self.views_open, self.stage_um, self.shot

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which pixels count, (pixel_y, pixel_x)."""
        return np.isfinite(self.variance)

    def without(self, pixels: NDArray[np.bool_]) -> Board:
        """Return the board, of which these pixels, (pixel_y, pixel_x), do not count."""
        return replace(self, variance=np.where(pixels, np.float32(np.inf), self.variance))

    def sampled(self, half_px: float, limit: int, rng: np.random.Generator) -> Sample:
        """Return at most `limit` usable pixels, drawn at random within `half_px` of the middle."""
        y, x = (np.arange(count) - (count - 1) / 2 for count in self.reading.shape)
        inside = (np.abs(y) <= half_px)[:, None] & (np.abs(x) <= half_px)
        chosen = np.flatnonzero(self.usable & inside)
        if len(chosen) > limit:
            chosen = np.sort(rng.choice(chosen, limit, replace=False))
        return Sample(
            self,
            np.stack(np.unravel_index(chosen, self.reading.shape), axis=1),
            self.channels.ravel()[chosen],
            self.reading.ravel()[chosen].astype(np.float64),
            np.sqrt(self.variance.ravel()[chosen].astype(np.float64)),
        )


def gain_of(boards: BoardSet) -> SensorGain:
    """Return the sensor's gain from the dark and the first reference frames."""
    if not boards.references:
        raise CalibrationError("no reference whiteboard: open the aperture, take the masks out")
    return photon_transfer(boards.dark, next(iter(boards.references.values())))


def as_readings(
    boards: BoardSet, layout: PsiLayout, usable: NDArray[np.bool_] | None = None
) -> list[Board]:
    """Return the whiteboards as readings.

    Whiteboards of views that the pupil shuts are left out.

    usable: (pixel_y, pixel_x), pixels known to be good; a pixel whose reference is not bright
    enough to divide by is left out as well. Raises CalibrationError for frames of another size,
    a reference that is missing, and whiteboards too dark to use.
    """
    gain = gain_of(boards)
    expected = layout.frames_shape[1:]
    good = np.ones(expected, dtype=bool) if usable is None else usable
    found, whites2 = [], dict[int, NDArray[np.float32]]()
    for board, taken in lit_boards(boards):
        reference = boards.reference(board.shot, board.lamp)
        if reference is None:
            raise CalibrationError(f"{board.name}: no reference whiteboard under that lamp")
        for frame, what in ((taken, board.name), (reference, "reference"), (boards.dark, "dark")):
            if frame.mean_dn.shape != expected:
                raise CalibrationError(
                    f"{what}: a frame of {frame.mean_dn.shape[0]} x {frame.mean_dn.shape[1]} "
                    f"pixels, the camera has {expected[0]} x {expected[1]}: are these frames of "
                    "another camera?"
                )
        if id(reference) not in whites2:
            whites2[id(reference)] = _white2(reference, boards, gain)
        white2 = whites2[id(reference)]
        found.append(_board(board, taken, reference, boards, gain, layout, good, white2))
    return found


def _white2(reference: MeanFrame, boards: BoardSet, gain: SensorGain) -> NDArray[np.float32]:
    """Return the relative variance of a reference, (pixel_y, pixel_x)."""
    dark, found = boards.dark_at(reference.exposure_s), np.empty_like(reference.mean_dn, np.float32)
    for rows in bands(found):
        white, variance = signal_of(reference, dark, gain, rows)
        found[rows] = variance / np.maximum(white, DARKEST_REFERENCE_DN / reference.exposure_s) ** 2
    return found


def lit_boards(boards: BoardSet) -> Iterator[tuple[BoardFrame, MeanFrame]]:
    """Yield the whiteboards that have light, with their frames.

    Raises CalibrationError at the end for dark ones, except of views that the lens's pupil shuts.
    """
    dark, rates = [], dict[tuple[int, int], float]()
    for board in boards.frames:
        frame = board.frame
        if frame.mean_dn.shape == boards.dark.mean_dn.shape:
            light_dn = frame.mean_dn - boards.dark_at(frame.exposure_s).mean_dn
            above_dn = float(np.median(light_dn))
            if above_dn < DARKEST_REFERENCE_DN / 10:
                dark.append(board)
                continue
            if board.pinhole is not None:
                rates[board.pinhole] = above_dn / frame.exposure_s
        yield board, frame
    shut = {board.pinhole for board in dark if board.pinhole is not None}
    for board in dark:
        if board.pinhole is None or not _is_shut(board.pinhole, shut, rates):
            raise CalibrationError(
                f"{board.name}: the whiteboard is dark; is the lamp on, and the aperture open?"
            )


def _is_shut(
    view: tuple[int, int], dark: set[tuple[int, int]], rates: Mapping[tuple[int, int], float]
) -> bool:
    """Return whether the pupil, not the lamp, may be why a view is dark.

    dark: all views that are. rates: light of the others, in DN/s. Then the views beside have
    clearly less light than the brightest; or, where none of these was taken, the opposite view is
    dark as well.
    """
    beside = [(view[0] + down, view[1] + right) for down, right in BESIDE]
    lit = [rates[near] for near in beside if near in rates]
    if lit:
        return max(lit) < CLEARLY_CUT * max(rates.values())
    views = np.array([*dark, *rates])
    v, u = (views.min(axis=0) + views.max(axis=0) - view).tolist()
    return bool(rates) and (v, u) != view and (v, u) in dark


def _board(
    board: BoardFrame,
    frame: MeanFrame,
    reference: MeanFrame,
    boards: BoardSet,
    gain: SensorGain,
    layout: PsiLayout,
    good: NDArray[np.bool_],
    white2: NDArray[np.float32],
) -> Board:
    dark, dark_of_white = (boards.dark_at(each.exposure_s) for each in (frame, reference))
    reading, variance = (np.empty(good.shape, dtype=np.float32) for _ in range(2))
    bright = 0
    for rows in bands(reading):
        reading[rows], spread, enough = ratio_of(frame, dark, reference, dark_of_white, gain, rows)
        bright += int(enough.sum())
        variance[rows] = np.where(enough & good[rows], spread, np.inf)
    if bright < 0.5 * reading.size:
        raise CalibrationError(
            f"the reference whiteboard under the {board.lamp} lamp is less than "
            f"{DARKEST_REFERENCE_DN:g} DN above the dark: brighten the lamp or expose longer"
        )
    channels = channels_of(layout, board.shot)
    if layout.colour is None and board.lamp in LAMP_COLOURS:
        channels[:] = LAMP_COLOURS.index(board.lamp)
    return Board(
        board.name,
        reading,
        variance,
        channels,
        views_open(layout.views, board.pinhole, board.window),
        board.stage_um,
        board.shot,
        frame.taken_s,
        frame.count,
        frame.unsteady2(dark.mean_dn),
        board.loose,
        white2,
    )


def unsteadiness2(boards: Sequence[Board], references: Sequence[tuple[int, float]] = ()) -> float:
    """Return the relative variance of brightness from frame to frame, as repeats show it.

    references: repeats of more, and what `MeanFrame.unsteady2` says of each.
    """
    every = [(board.repeats, board.unsteady2) for board in boards] + list(references)
    freedom = sum(count - 1 for count, _ in every)
    return max(sum((count - 1) * squares for count, squares in every) / max(freedom, 1), 0.0)


def signal_of(
    frame: MeanFrame, dark: MeanFrame, gain: SensorGain, rows: slice
) -> tuple[Array, Array]:
    """Return DN per second above the dark of some rows, and its variance."""
    signal = (frame.mean_dn[rows] - dark.mean_dn[rows]).astype(np.float64)
    own = gain.gain_dn_per_electron * np.maximum(signal, 0) + dark.variance_dn2
    of_dark = dark.variance_dn2 / dark.count + dark.extra_variance_dn2
    variance = own / frame.count + of_dark + frame.extra_variance_dn2
    return signal / frame.exposure_s, variance / frame.exposure_s**2


def ratio_of(
    frame: MeanFrame,
    dark: MeanFrame,
    reference: MeanFrame,
    dark_of_reference: MeanFrame,
    gain: SensorGain,
    rows: slice,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return readings of some rows, their variance, and where the reference is bright enough.

    A reference that is not counts as just bright enough: hot or dead pixels, which no route uses.
    """
    signal, variance = signal_of(frame, dark, gain, rows)
    white, white_variance = signal_of(reference, dark_of_reference, gain, rows)
    enough = white * reference.exposure_s > DARKEST_REFERENCE_DN
    white = np.maximum(white, DARKEST_REFERENCE_DN / reference.exposure_s)
    ratio = signal / white
    return ratio, (variance + ratio**2 * white_variance) / white**2, enough


def channels_of(layout: PsiLayout, shot: int = 0) -> NDArray[np.uint8]:
    """Return the colour that each pixel sees under white light, (pixel_y, pixel_x); 3: all."""
    if layout.colour is None:
        return np.full(layout.frames_shape[1:], 3, dtype=np.uint8)
    return np.ascontiguousarray(layout.colour[shot, :: layout.binning, :: layout.binning])


def sensor_blemishes(boards: BoardSet) -> NDArray[np.bool_]:
    """Return which pixels to use, (pixel_y, pixel_x): neither hot nor dead.

    Hot: see `hot_pixels`. A pixel is dead whose reference lies apart from its neighbours of the
    same colour by far more than pixels differ: ten robust deviations, and at least a fifth of its
    level.
    """
    dark = boards.dark.mean_dn.astype(np.float64)
    good = np.ones(dark.shape, dtype=bool)
    for frame in boards.darks:
        good &= ~hot_pixels(frame.mean_dn.astype(np.float64), frame.step_dn)
    for reference in boards.references.values():
        signal = reference.mean_dn - dark
        for y in range(2):
            for x in range(2):
                part = signal[y::2, x::2]
                level = float(np.median(part))
                off = np.abs(part - level)
                limit = max(10 * deviation_of(off), 0.2 * level)
                good[y::2, x::2] &= off <= limit
    return good
