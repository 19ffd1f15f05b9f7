"""Exposures of whiteboards and shots of the scene, from metering frames.

A shot aims the brightest of its readings at a level. Where most of a scene is far darker than its
brightest parts, longer exposures follow, each BRACKET_STEP times as long as the one before it,
until the median reading is brighter than 1 / LARGEST_RANGE of that level.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from emmc_rig.captures.plan import Metering
from emmc_rig.drivers.camera import Limits
from emmc_rig.drivers.errors import CameraSettingError
from emmc_rig.session.brightness import exposure_for_s
from emmc_rig.session.journal import Figures, FrameEntry, MeteredEntry, of_kind
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

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


def metered_exposure_s(metered: FrameEntry, level: float, light: float, limits_s: Limits) -> float:
    """Return the exposure at which `light` times less light reads `level` of white.

    metered: the journal line of the metering frame. Clipped to the camera's limits. Raises
    `CameraSettingError` where the board was dark.
    """
    if metered.figures.bright_dn < 1:
        raise CameraSettingError(
            "exposure", "cannot be metered, the board is dark: switch the lamp on"
        )
    low_s, high_s = limits_s
    exposure_s = light * exposure_for_s(level, metered.exposure_s, metered.level)
    return min(max(exposure_s, low_s), high_s)


def first_meterings(session: Session) -> dict[str, FrameEntry]:
    """Return the first journal line of every metering frame.

    The first counts even where its file is damaged by now: frames that follow are exposed like the
    frames before.
    """
    ids = {frame.id for frame in session.frames if frame.kind == "metering"}
    found: dict[str, FrameEntry] = {}
    for entry in of_kind(session.journal.entries, FrameEntry):
        if entry.id in ids:
            found.setdefault(entry.id, entry)
    return found


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
