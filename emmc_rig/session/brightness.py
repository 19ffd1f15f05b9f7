"""How bright a frame is, what exposure to try next, and how well a session's shots are exposed.

Capture, import and live page meter by the same figures. They come from some ten thousand pixels,
and so take about a millisecond. Exposures of a session come from the figures in its journal: no
frame is read.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.frames import DARK_ELECTRONS_PER_S, dark_current_known
from emmc_rig.drivers.camera import Limits
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.reconstruction.verdict.rules import Reason
from emmc_rig.session.journal import Figures, FrameEntry
from emmc_rig.session.session import Session

SAMPLED_PIXELS = 1 << 16
BRIGHT_PERCENTILE = 99.9
HOT_RATIO = 2.0
"""Of a pixel over all eight of its colour around it. Where light is brighter than half of white, a
hot pixel is not found by it: metering then exposes less and looks again."""
GOOD_LEVELS = (0.7, 0.9)
"""Of white, where the brightest readings of a good exposure lie."""
UNDEREXPOSED = 0.25
"""Of white: 4.5 dB of the readings' noise are given away below it. A camera of full stops comes to
half of what metering aims at."""
OVEREXPOSED = 0.001
"""Share of the readings that are saturated: the rest of BRIGHT_PERCENTILE."""
DARK_SHARE, DARK_PERCENTILE = 0.002, 99
"""Share of the range from black to white, and the percentile below it in a dark frame: noise of a
dark frame reaches this share at BRIGHT_PERCENTILE."""
LARGEST_STEP = 16.0
"""Between exposures that are tried: a saturated frame does not tell by how much, and in a dark one
noise is brighter than light."""
SAME_EXPOSURE = 0.01


def figures(frame: RawFrame) -> Figures:
    """Return a frame's figures, from `thinned` pixels."""
    frame = frame.with_one_black()
    black = frame.black_dn
    few = thinned(frame.mosaic)
    counts = np.bincount(few.ravel())
    total = counts.sum()
    mean = float(counts @ np.arange(counts.size) / total)
    median, likely_bright = np.searchsorted(np.cumsum(counts), np.array([0.5, 0.99]) * total)
    lit = counts - np.bincount(_hot(frame.mosaic, few, likely_bright, black), minlength=counts.size)
    bright = np.searchsorted(np.cumsum(lit), BRIGHT_PERCENTILE / 100 * lit.sum())
    saturated = lit[frame.white_level_dn :].sum() / lit.sum()
    return Figures(float(saturated), mean - black, float(bright) - black, float(median) - black)


def _hot(
    mosaic: NDArray[np.uint16], few: NDArray[np.uint16], least_dn: int, black: float
) -> NDArray[np.uint16]:
    """Return the values of hot pixels among a few: far brighter than all their neighbours.

    few: see `thinned`. Neighbours are two pixels away, where most mosaics have the same colour, on
    the diagonals all. Pixels below least_dn are not looked at.
    """
    step = thinning_step(mosaic)
    places = np.argwhere(few >= least_dn)
    values = few[tuple(places.T)]
    around = []
    for shift in product((-2, 0, 2), repeat=2):
        if any(shift):
            at = np.abs(places // 2 * 2 * step + places % 2 + shift)
            at = np.minimum(at, 2 * (np.array(mosaic.shape) - 1) - at)  # mirrored at the edges
            around.append(mosaic[tuple(at.T)])
    return values[values - black > HOT_RATIO * np.maximum(np.max(around, axis=0) - black, 1.0)]


def level_of(frame: RawFrame, found: Figures) -> float:
    """Return the level of a frame's brightest readings, 1 at white."""
    return found.bright_dn / frame.span_dn


def is_dark(frame: RawFrame) -> bool:
    """Return whether a frame shows nothing but black."""
    frame = frame.with_one_black()
    bright = float(np.percentile(thinned(frame.mosaic), DARK_PERCENTILE)) - frame.black_dn
    return bright < DARK_SHARE * frame.span_dn


def is_well_exposed(level: float, saturated: float) -> bool:
    """Return whether an exposure will do, by its brightest readings and the share saturated."""
    return level >= UNDEREXPOSED and saturated <= OVEREXPOSED


def exposure_for_s(wanted: float, exposure_s: float, level: float) -> float:
    """Return the exposure at which a scene reads `wanted`, which at exposure_s reads `level`."""
    return exposure_s * wanted / max(level, 1e-6)


def next_exposure_s(
    exposure_s: float,
    level: float,
    limits_s: Limits,
    good: tuple[float, float] = GOOD_LEVELS,
) -> float | None:
    """Return the exposure to try next; None where the level is good, or the limits allow no better.

    level: of the brightest readings, 1 at white. good: levels that will do; the next exposure aims
    at their middle.
    """
    if good[0] <= level <= good[1]:
        return None
    longest_s = exposure_s * LARGEST_STEP
    next_s = exposure_s / LARGEST_STEP
    if level < 1:
        next_s = max(next_s, min(exposure_for_s(sum(good) / 2, exposure_s, level), longest_s))
    next_s = min(max(next_s, limits_s[0]), limits_s[1])
    return next_s if abs(next_s / exposure_s - 1) >= SAME_EXPOSURE else None


def thinning_step(mosaic: NDArray[np.uint16], pixels: int = SAMPLED_PIXELS) -> int:
    """Return how many 2x2 tiles apart those are that `thinned` takes."""
    return max(1, int(np.sqrt(mosaic.size / pixels)))


def thinned(mosaic: NDArray[np.uint16], pixels: int = SAMPLED_PIXELS) -> NDArray[np.uint16]:
    """Return a subset of a mosaic's pixels: whole 2x2 tiles, evenly spread."""
    step = thinning_step(mosaic, pixels)
    if step == 1:
        return mosaic
    rows, columns = mosaic.shape[0] // 2 * 2, mosaic.shape[1] // 2 * 2
    tiles = mosaic[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2)[::step, :, ::step]
    return tiles.reshape(2 * tiles.shape[0], 2 * tiles.shape[2])


DARK_CURRENT_SHARE = 0.005
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
    unknown = [shot for shot in shots if shot.dark_share > DARK_CURRENT_SHARE]
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
