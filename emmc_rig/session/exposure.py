"""How well a session's shots are exposed, from the figures in its journal: no frame is read."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from emmc_rig.calibration.frames import DARK_ELECTRONS_PER_S, dark_current_known
from emmc_rig.reconstruction.verdict.rules import Reason
from emmc_rig.session.brightness import (
    GOOD_LEVELS,
    OVEREXPOSED,
    UNDEREXPOSED,
    exposure_for_s,
)
from emmc_rig.session.journal import FrameEntry
from emmc_rig.session.session import Session

DARK_SHARE = 0.005
"""Of the brightest reading: twice what a good calibration is off by."""


@dataclass(frozen=True)
class ShotExposure:
    """Of one shot: how bright its brightest readings are, and the share that no exposure holds.

    level: 1 at white, by its longest exposure. saturated: by its shortest. dark_share: of its
    brightest readings, what a dark current of DARK_ELECTRONS_PER_S adds that no dark frame shows.
    """

    shot: int
    level: float
    saturated: float
    dark_share: float = 0.0

    @property
    def factor(self) -> float:
        """By how much longer it could have been exposed; 1 or more."""
        return max(1.0, exposure_for_s(GOOD_LEVELS[0], 1.0, self.level))


def shot_exposures(session: Session) -> list[ShotExposure]:
    """Return how each shot of the scene is exposed whose frames are taken, by its place."""
    frames: dict[int, list[FrameEntry]] = defaultdict(list)
    for frame in session.needed:
        entry = session.stored.get(frame.id)
        if frame.kind == "shot" and entry is not None:
            frames[frame.bench.shot].append(entry)
    darks_s = [
        session.stored[frame.id].exposure_s
        for frame in session.frames
        if frame.kind == "dark" and frame.id in session.stored
    ]
    gain = session.camera["sensor"]["noise"]["gain_dn_per_electron"]
    return [
        ShotExposure(
            shot,
            max(entry.level for entry in entries),
            min(entry.figures.saturated for entry in entries),
            _dark_share(entries, darks_s, gain),
        )
        for shot, entries in sorted(frames.items())
    ]


def _dark_share(entries: Sequence[FrameEntry], darks_s: Sequence[float], gain: float) -> float:
    """Return `ShotExposure.dark_share`; gain: DN per electron. 0 without any dark."""
    longest = max(entries, key=lambda entry: entry.exposure_s)
    exposure_s = longest.exposure_s
    if not darks_s or dark_current_known(darks_s, exposure_s):
        return 0.0
    unknown_dn = gain * DARK_ELECTRONS_PER_S * abs(exposure_s - darks_s[0])
    return unknown_dn / max(longest.figures.bright_dn, 1.0)


def exposure_reasons(shots: Sequence[ShotExposure]) -> list[Reason]:
    """Return what speaks against the exposures of shots; nothing for good ones."""
    found = []
    dark = [shot for shot in shots if shot.level < UNDEREXPOSED]
    if dark:
        worst = min(dark, key=lambda shot: shot.level)
        quieter_db = 10 * math.log10(worst.factor)
        found.append(
            Reason(
                f"the brightest reading of {_shots(worst, dark)} is {worst.level:.1%} of white: "
                f"{quieter_db:.1f} dB or more of signal-to-noise ratio are lost",
                worst.level,
                f"expose {worst.factor:.2g} times as long, or write exposure_s: auto",
                "doubt",
            )
        )
    bright = [shot for shot in shots if shot.saturated > OVEREXPOSED]
    if bright:
        worst = max(bright, key=lambda shot: shot.saturated)
        found.append(
            Reason(
                f"{worst.saturated:.1%} of the readings of {_shots(worst, bright)} are saturated "
                "by every exposure",
                worst.saturated,
                "add a shorter exposure, or write exposure_s: auto",
                "doubt",
            )
        )
    unknown = [shot for shot in shots if shot.dark_share > DARK_SHARE]
    if unknown:
        worst = max(unknown, key=lambda shot: shot.dark_share)
        found.append(
            Reason(
                f"no dark frame is exposed as long as {_shots(worst, unknown)}: an unseen dark "
                f"current of {DARK_ELECTRONS_PER_S:g} electrons/s would be "
                f"{worst.dark_share:.1%} of the brightest reading",
                worst.dark_share,
                "capture darks of the same exposure: `darks: {of_shots: 4}` in the plan",
                "doubt",
            )
        )
    return found


def _shots(worst: ShotExposure, alike: Sequence[ShotExposure]) -> str:
    others = "" if len(alike) == 1 else f" (the worst of {len(alike)} shots)"
    return f"shot {worst.shot + 1}{others}"
