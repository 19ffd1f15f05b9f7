"""Exposures of whiteboards and shots of the scene, from metering frames.

A shot aims the brightest of its readings at a level. Where most of a scene is far darker than its
brightest parts, longer exposures follow, each BRACKET_STEP times as long as the one before it,
until the median reading is brighter than 1 / LARGEST_RANGE of that level.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from emmc_rig.captures.plan import Boards, Metering, Plan
from emmc_rig.drivers.camera import Limits
from emmc_rig.drivers.errors import CameraSettingError
from emmc_rig.session.brightness import exposure_for_s
from emmc_rig.session.journal import Figures, FrameEntry, MeteredEntry, metered, of_kind
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

ANY_LIMITS: Limits = (0.0, float("inf"))
METERING_TRIES = 8
METERABLE_LEVELS = (0.02, 0.95)
"""Of white, of a frame from which other exposures follow."""
BRACKET_STEP = 4.0
"""Two stops: the longer frame's shot noise is half, and still most of its readings are below white
where the shorter one is too dark."""
MOST_STEPS = 2
LARGEST_RANGE = 8.0
"""Of the brightest reading over the median, which one exposure is for. A reading sums many views
through masks, so that most scenes stay below 4."""


def metered_exposure_s(entry: FrameEntry, level: float, light: float, limits_s: Limits) -> float:
    """Return the exposure at which `light` times less light reads `level` of white.

    entry: the journal line of the metering frame. Clipped to the camera's limits. Raises
    `CameraSettingError` where the board was dark.
    """
    if entry.figures.bright_dn < 1:
        raise CameraSettingError(
            "exposure", "cannot be metered, the board is dark: switch the lamp on"
        )
    low_s, high_s = limits_s
    exposure_s = light * exposure_for_s(level, entry.exposure_s, entry.level)
    return min(max(exposure_s, low_s), high_s)


class Exposures:
    """The exposures of a plan's frames, as far as its session's metering frames determine them.

    session: None where none was begun: then only exposures that the plan states are known.
    """

    def __init__(self, plan: Plan, session: Session | None = None) -> None:
        self._plan, self._session = plan, session
        frames = () if session is None else session.frames
        self._saturating = _may_saturate(frames)
        # The first line of each metering frame counts, even where its file is damaged by now:
        # frames that follow are exposed like the frames before.
        self._meterings: dict[str, FrameEntry] = {}
        planned = {frame.id: frame for frame in frames}
        entries = () if session is None else of_kind(session.journal.entries, FrameEntry)
        for entry in entries:
            if entry.id in planned:
                self.learn(planned[entry.id], entry)

    def learn(self, planned: PlannedFrame, entry: FrameEntry) -> None:
        """Remember the journal line of a frame if it is a metering frame."""
        if planned.kind == "metering":
            self._meterings.setdefault(planned.id, entry)

    @property
    def decided(self) -> MeteredEntry | None:
        """What metering of the scene asks for; None while that is open."""
        return None if self._session is None else metered(self._session.journal.entries)

    def exposure_s(self, planned: PlannedFrame, limits_s: Limits = ANY_LIMITS) -> float | None:
        """Return a frame's exposure; None where nothing determines it yet.

        limits_s: of the camera. Raises `CameraSettingError` where the metered board was dark.
        """
        if planned.exposure_s is not None:
            return planned.exposure_s
        if planned.is_exposed_as_shots:
            decided, shot = self.decided, planned.bench.shot
            if decided is None or shot not in decided.exposures_s:
                return None
            return decided.exposures_s[shot] * planned.light
        entry = self._meterings.get(planned.metered_by or "")
        if entry is None:
            return None
        level = (self._plan.whiteboards or Boards()).level
        return metered_exposure_s(entry, level, planned.light, limits_s)

    def known_s(self, planned: PlannedFrame) -> float | None:
        """Return a frame's exposure for an estimate; None as long as its metering is open."""
        try:
            return self.exposure_s(planned)
        except CameraSettingError:
            return None

    def decide(self, limits_s: Limits) -> MeteredEntry:
        """Return what metering of the scene asks for; raises `CameraSettingError` if it is dark."""
        assert self._session is not None
        limits_s = limits_s[0], min(limits_s[1], self._plan.longest_s)
        return asked_of_scene(self._session.frames, self._meterings, self._plan.metering, limits_s)

    def may_saturate(self, planned: PlannedFrame) -> bool:
        """Whether saturated pixels of a frame are no fault."""
        return planned.id in self._saturating


def _may_saturate(frames: Iterable[PlannedFrame]) -> set[str]:
    """Return the ids of metering frames, and of those with a shorter exposure in their bracket."""

    def exposed(frame: PlannedFrame) -> float:
        return frame.light if frame.exposure_s is None else frame.exposure_s

    shots = [frame for frame in frames if frame.kind == "shot"]
    shortest: dict[int, float] = {}
    for frame in shots:
        shot = frame.bench.shot
        shortest[shot] = min(exposed(frame), shortest.get(shot, exposed(frame)))
    longer = {frame.id for frame in shots if exposed(frame) != shortest[frame.bench.shot]}
    return longer.union(frame.id for frame in frames if frame.kind == "metering")


def asked_of_scene(
    frames: Iterable[PlannedFrame],
    entries: Mapping[str, FrameEntry],
    metering: Metering,
    limits_s: Limits,
) -> MeteredEntry:
    """Return by what each metered shot is exposed, and which longer frames are asked for.

    frames: the session's. entries: of its metering frames, by id. limits_s: of the camera. Raises
    `CameraSettingError` where the scene is dark.
    """
    shots = [frame for frame in frames if frame.is_metered_shot]
    limits_s = (limits_s[0], min(limits_s[1], metering.longest_s))
    group_of = {}
    for frame in shots:
        light = (frame.bench.lamp, frame.gain)
        group_of[frame.bench.shot] = light if metering.alike else frame.bench.shot
    chosen_s: dict[object, float] = {}
    steps: dict[object, int] = {}
    for frame in shots:
        entry = entries[frame.metered_by or ""]
        group = group_of[frame.bench.shot]
        exposure_s = metered_exposure_s(entry, metering.level, 1.0, limits_s)
        chosen_s[group] = min(exposure_s, chosen_s.get(group, exposure_s))
        steps[group] = max(_steps(entry.figures), steps.get(group, 0))
    asked = [
        frame.id
        for frame in shots
        if frame.is_optional
        and frame.light <= BRACKET_STEP ** steps[group_of[frame.bench.shot]]
        and frame.light * chosen_s[group_of[frame.bench.shot]] <= limits_s[1]
    ]
    exposures_s = {shot: chosen_s[group] for shot, group in group_of.items()}
    return MeteredEntry(exposures_s=exposures_s, asked=asked)


def _steps(figures: Figures) -> int:
    """Return how many longer exposures a scene of these figures asks for."""
    ratio = figures.bright_dn / max(figures.median_dn, 1.0)
    wanted = np.log(max(ratio / LARGEST_RANGE, 1.0)) / np.log(BRACKET_STEP)
    return min(MOST_STEPS, int(np.ceil(wanted)))
