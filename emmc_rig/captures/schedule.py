"""The order of a capture's frames, how long they take, and how much they write.

The order has least work by hand first, then least travel. Frames that need no work by hand between
them stay together, in the order of the plan. Among these the stage visits each place once, always
the nearest next (2-opt saves another 0 to 12 % of the way with the shipped cameras). All axes move
at once: the distance of two places is that of the axis with the longest way. An axis that moves
down overshoots, and comes up again.

A metered exposure is known once its metering frame is taken. Until then it is a guess, and the
number of guessed exposures is stated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.hands import AskingAttendant
from emmc_rig.bench.hardware import Rig
from emmc_rig.captures.plan import METERING_EXPOSURE_S, Plan
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.stage import needs_approach
from emmc_rig.session.planned import PlannedFrame

APPROACH_UM = 10.0
Array = NDArray[np.float64]


def ordered(
    frames: Iterable[PlannedFrame], order: str, hands: Collection[str] = ()
) -> tuple[PlannedFrame, ...]:
    """Return the frames in the order of the capture.

    order: "as-planned" or "least-travel". hands: axes that somebody moves, see `Rig`.
    """
    frames = tuple(frames)
    if order == "as-planned":
        return frames
    # A film has its order in time.
    film = tuple(frame for frame in frames if frame.film is not None)
    groups: dict[object, list[PlannedFrame]] = {}
    for frame in (frame for frame in frames if frame.film is None):
        # The scene is metered, all of it, before the first shot and the darks of the shots.
        meters = frame.bench.target == "scene" and (
            frame.kind == "metering" or (frame.kind == "dark" and frame.is_exposed_as_shots)
        )
        key = (frame.part, frame.bench.lamp == "off", meters, *frame.bench.set_by_hand(hands))
        groups.setdefault(key, []).append(frame)
    found: list[PlannedFrame] = []
    at_um: dict[str, float] = {}
    for group in _open_before_holes(list(groups.values())) if hands else groups.values():
        places: dict[tuple[tuple[str, float], ...], list[PlannedFrame]] = {}
        checks = [frame for frame in group if frame.kind == "check" and frame.bench.masks_in]
        toured: list[PlannedFrame] = []
        for frame in group:
            if frame in checks:
                continue
            places.setdefault(tuple(sorted(frame.bench.offsets_um.items())), []).append(frame)
        for place in _tour(list(places), at_um):
            toured += places[place]
            at_um |= dict(place)
        found += spread(toured, checks)
    return (*found, *film)


def _open_before_holes(groups: list[list[PlannedFrame]]) -> list[list[PlannedFrame]]:
    """Return groups with open whiteboards before pinholes: they show where the mask stands."""
    boards = [
        place
        for place, group in enumerate(groups)
        if group[0].bench.target == "whiteboard" and group[0].bench.masks_in
    ]
    found = list(groups)
    for place, other in zip(
        boards, sorted(boards, key=lambda item: groups[item][0].view is not None), strict=True
    ):
        found[place] = groups[other]
    return found


def spread(frames: Sequence[PlannedFrame], checks: Sequence[PlannedFrame]) -> list[PlannedFrame]:
    """Return frames with the checks among them: the first before all, the last after all.

    Frames of one whiteboard, which are averaged, stay together.
    """
    found = list(frames)
    for place, check in reversed(list(enumerate(checks))):
        at = round(place * len(frames) / max(len(checks) - 1, 1))
        while 0 < at < len(frames) and frames[at].repeat:
            at += 1
        found.insert(at, check)
    return found


def _tour(
    places: list[tuple[tuple[str, float], ...]], start_um: dict[str, float]
) -> list[tuple[tuple[str, float], ...]]:
    """Return the places in a short order that begins near `start_um`."""
    if len(places) < 2:
        return places
    axes = sorted({axis for place in places for axis, _ in place})
    points = np.array(
        [[dict(place).get(axis, start_um.get(axis, 0.0)) for axis in axes] for place in places]
    )
    here = np.array([start_um.get(axis, np.nan) for axis in axes])
    if np.isnan(here).all():
        here = points.min(axis=0)
    left, tour = np.ones(len(points), dtype=bool), []
    while left.any():
        nearest = int(np.argmin(np.where(left, _ways_um(here[None], points), np.inf)))
        left[nearest], here = False, points[nearest]
        tour.append(places[nearest])
    return tour


def _ways_um(here: Array, there: Array) -> Array:
    """Return the way from places to places, (..., axis) -> (...); an axis not known costs none."""
    step = np.nan_to_num(there - here)
    return np.max(np.abs(step) + np.where(step < 0, 2 * APPROACH_UM, 0.0), axis=-1)


DOWNLOAD_BYTES_PER_S = 40e6
FILE_OVERHEAD_BYTES = 4096
JOURNAL_BYTES_PER_FRAME = 1500
EXCHANGES_S = 0.15
"""Commands to the camera and the stage that a frame needs, and what a camera takes to be ready."""
MOVE_S = 0.2
"""A move's acceleration, polling and settling."""
LEARNT_FROM = 9
"""The number of latest frames whose median cost counts: a single frame may have waited long."""


@dataclass(frozen=True)
class Estimate:
    """Seconds by kind of work, and bytes on the disk.

    by_hand: how often a person is asked to change something at the bench, which takes time of its
    own. guessed: frames whose exposure counts and is not metered yet. exposing_s: of a film's
    frames, their periods.
    """

    frames: int
    moving_s: float
    exposing_s: float
    downloading_s: float
    bytes: int
    by_hand: int
    guessed: int = 0

    @property
    def seconds(self) -> float:
        """Total seconds, without the work of hands."""
        return self.moving_s + self.exposing_s + self.downloading_s


class Pace:
    """The time that a frame costs, learnt from frames already taken.

    waits: whether moves and exposures take their time; those of most simulated rigs do not. hands:
    axes that a hand moves. asks: whether a person is that hand. period_s: of a film's frames.
    usual_s: what a frame takes beside moves and exposure, as long as nothing is learnt.
    """

    def __init__(
        self,
        speeds_um_s: Mapping[str, float],
        settle_s: float,
        frame_bytes: int,
        waits: bool = True,
        hands: Collection[str] = (),
        asks: bool = True,
        period_s: float = 0.0,
    ) -> None:
        self._speeds_um_s, self._settle_s, self._waits = speeds_um_s, settle_s, waits
        self._hands, self._asks, self._period_s = hands, asks, period_s
        self._bytes = frame_bytes + FILE_OVERHEAD_BYTES
        self.usual_s = EXCHANGES_S + self._bytes / DOWNLOAD_BYTES_PER_S
        self._learnt_s: deque[float] = deque(maxlen=LEARNT_FROM)

    def learn(self, seconds: float, exposure_s: float, moving_s: float) -> None:
        """Take note of what a frame took, by hand excepted, and of what was foreseen."""
        foreseen_s = exposure_s + moving_s if self._waits else 0.0
        self._learnt_s.append(max(0.0, seconds - foreseen_s))

    def moving_s(self, frame: PlannedFrame, at_um: Mapping[str, float]) -> float:
        """Return what it takes to bring the stage from where it stands to a frame's place."""
        moves_s = [
            _move_s(goal - at_um.get(axis, goal), self._speeds_um_s[axis])
            for axis, goal in frame.bench.offsets_um.items()
            if axis in self._speeds_um_s and at_um.get(axis) != goal
        ]
        return max(moves_s) + MOVE_S + self._settle_s if moves_s else 0.0

    def estimate(
        self,
        frames: Iterable[PlannedFrame],
        exposure_s: Callable[[PlannedFrame], float | None],
        at_um: Mapping[str, float] | None = None,
    ) -> Estimate:
        """Return what frames in this order will take; at_um: where the stage stands before."""
        here_um = dict(at_um or {})
        stood: tuple | None = None
        count = filmed = by_hand = guessed = 0
        moving_s = exposing_s = 0.0
        for frame in frames:
            count += 1
            if frame.film is not None and self._waits:
                filmed += 1
                exposing_s += self._period_s
                continue
            moving_s += self.moving_s(frame, here_um)
            here_um |= frame.bench.offsets_um
            if frame.bench.lamp != "off":
                wanted = frame.bench.set_by_hand(self._hands)
                by_hand += self._asks and stood not in (None, wanted)
                stood = wanted
            known_s = exposure_s(frame)
            guessed += known_s is None
            exposing_s += METERING_EXPOSURE_S * frame.light if known_s is None else known_s
        if not self._waits:
            moving_s, exposing_s, guessed = 0.0, 0.0, 0
        size = count * (self._bytes + JOURNAL_BYTES_PER_FRAME)
        frame_s = median(self._learnt_s) if self._learnt_s else self.usual_s
        downloading_s = (count - filmed) * frame_s
        return Estimate(count, moving_s, exposing_s, downloading_s, size, by_hand, guessed)


def pace_of(rig: Rig, plan: Plan) -> Pace:
    """Return what frames cost on a rig before any is taken: no wait by a simulated clock."""
    rows, columns = rig.camera.shape
    speeds_um_s = {axis: rig.stage.speed_um_s(axis) for axis in rig.stage.axes}
    asks = isinstance(rig.attendant, AskingAttendant)
    period_s = 0.0 if plan.film is None else 1 / plan.film.rate
    size = 2 * rows * columns
    waits = rig.clock is SYSTEM_CLOCK
    return Pace(speeds_um_s, plan.settle_s, size, waits, rig.hands, asks, period_s)


def _move_s(step_um: float, speed_um_s: float) -> float:
    back_um = 2 * APPROACH_UM if needs_approach(0.0, step_um, APPROACH_UM) else 0.0
    return (abs(step_um) + back_um) / speed_um_s
