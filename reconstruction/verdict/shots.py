"""Whether shots belong together: their brightness, their masks, and whether they saw one scene.

Texture missing from a light field leaves the same residual in all shots. Motion leaves a residual
in single shots: whole spots change their brightness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.reconstruction.verdict.shadow import Relief, shadow

Array = NDArray[np.floating]
SPOT_PX = 1.5
"""Deviation of the spots whose brightness is compared between shots: cells of masks are smaller."""
MOVED = {8: 30.0, 16: 10.0, 32: 6.0}
"""Side of the windows searched, and the ratio of squares from which on something moved in one: 1 is
expected without motion, and the smaller the window, the more it scatters. Of clean captures (group
A and built-in scenes at 96x96, two and three shots, noise 0.003, `adaptive`) the worst has 0.6 of
that; where an object of 30x30 pixels moved by 2 pixels in one shot the least has 1.9."""
AROUND, MARGIN_PX = 0.5, 4
"""Share of the ratio from which on windows beside belong to the place, and its margin."""
CLEARLY = 2.0
"""Ratio of a shot's squared residual to any other shot's, above which that shot alone differs."""
NEAR_PX, BAD = 5, 20.0
"""Side of the window, and times the median of what is left there, that make a bad pixel."""
UNSURE = 0.005
"""Share of the mean reading that no Psi and no solver is right to."""
LEAST_STRENGTH = 0.65
"""Least strength of the masks: below it Psi belongs to another camera and fits no shot."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The place where shots differ most in what they saw.

    ratio: difference between shots over its limit; above 1 something moved. place, size: middle and
    extent (y, x), pixels. shot: the number of a single differing shot, else None. moved: readings
    (shot, pixel_y, pixel_x) of all such places, where the shot is known.
    """

    ratio: float
    place: tuple[int, int]
    size: tuple[int, int]
    shot: int | None
    moved: NDArray[np.bool_]

    def figures(self) -> dict[str, Any]:
        """Return those of `Evidence`."""
        return {
            "motion": self.ratio,
            "moved_at": (self.shot, *self.place),
            "moved_px": self.size,
            "moved": float(self.moved.mean()),
        }


def brightness(relief: Relief) -> NDArray[np.float64]:
    """Return the brightness of every shot over their mean."""
    kept = np.flatnonzero(relief.good.any(axis=(1, 2)))
    common = relief.good[kept].all(axis=0)
    ratio = np.ones(len(relief.good))
    if common.any():
        for shot in kept:
            level = relief.level[shot][common].astype(np.float64)
            read = level * (1 + relief.read[shot][common])
            said = level * (1 + relief.masks[shot][common])
            ratio[shot] = read.sum() / max(said.sum(), 1e-12)
    return ratio / ratio[kept].mean() if len(kept) else ratio


def motion(relief: Relief, residual: Array, noise_sigma: float) -> Motion | None:
    """Return where shots differ in what they saw; None for a single shot, and where the masks do
    not show.

    residual: what a light field of all shots leaves of the readings, (shot, pixel_y, pixel_x).
    """
    shots = np.flatnonzero(relief.good.any(axis=(1, 2)))
    if len(shots) < 2 or not shadow(relief).strength[shots].min() > LEAST_STRENGTH:
        return None
    apart, expected, least = _differences(relief, residual, shots, noise_sigma)
    ratios = {
        side: _windows(apart, side) / np.maximum(_windows(expected, side), least) / limit
        for side, limit in MOVED.items()
    }
    # Small windows place best.
    worst = max(ratios, key=lambda side: float(ratios[side].max()))
    side = next((side for side, ratio in ratios.items() if ratio.max() > 1), worst)
    ratio = ratios[side]
    peak = np.unravel_index(int(ratio.argmax()), ratio.shape)
    reach = np.ones((side + 2 * MARGIN_PX,) * 2, np.uint8)
    over = np.asarray((ratio >= AROUND * min(1.0, ratio.max())).any(axis=0), np.uint8)
    _, areas, boxes, _ = cv2.connectedComponentsWithStats(cv2.dilate(over, reach))
    whole = _differing(apart[:, areas > 0].sum(axis=1), shots)
    differs: dict[int, int | None] = {}
    moved = np.zeros(residual.shape, bool)
    for area in range(1, len(boxes)):
        inside = areas == area
        own = _differing(apart[:, inside].sum(axis=1), shots)
        differs[area] = whole if own is None else own
        if differs[area] is not None and ratio[:, inside].max() > 1:
            moved[differs[area]] |= inside
    area = int(areas[peak[1:]])
    x, y, width, height = (int(n) for n in boxes[area][:4])
    return Motion(
        ratio=float(ratio.max()),
        place=(y + height // 2, x + width // 2),
        size=(max(height - len(reach) + 1, side), max(width - len(reach) + 1, side)),
        shot=differs[area],
        moved=moved,
    )


def _differences(
    relief: Relief, residual: Array, shots: NDArray[np.intp], noise_sigma: float
) -> tuple[Array, Array, float]:
    """Return squared differences between shots in spots: measured, expected, least expected.

    The first two are (shot, pixel_y, pixel_x); all in squared readings.
    Of readings m that are expected, the residual is a m + e, with `a` by least squares over a spot,

        a = sum(m residual) / sum(m^2),

    by how much the spot is brighter than the light field says. Where e is noise or texture that it
    lacks, m^2 a^2 differs between shots by e^2 / (4 pi SPOT_PX^2).
    """
    good = relief.good[shots]
    expected = np.where(good, relief.level[shots] * (1 + relief.masks[shots]), 0).astype(np.float32)
    left = np.where(good, residual[shots], 0).astype(np.float32)
    # A pixel that leaves far more than all about it is a bad one.
    around = np.stack([cv2.medianBlur(frame, NEAR_PX) for frame in np.abs(left)])
    left[np.abs(left) > BAD * np.maximum(around, noise_sigma)] = 0
    weight = np.maximum(_spots(np.square(expected)), 1e-12)
    brighter = _spots(expected * left) / weight
    # Flicker of the lamp is no motion, and motion covers less than half of the picture.
    lamp = [np.median(frame[of_shot]) for frame, of_shot in zip(brighter, good, strict=True)]
    brighter -= np.array(lamp, np.float32)[:, None, None]
    apart = weight * np.square(brighter - np.average(brighter, axis=0, weights=weight))
    alone = np.square(left - expected * brighter)
    # A light field of more unknowns than readings follows noise, too, and leaves less.
    noise = min(float(alone.mean()), noise_sigma**2)
    least = max(noise, (UNSURE * float(expected[good].mean())) ** 2, 1e-20)
    share = 1 / (4 * np.pi * SPOT_PX**2)
    return apart, share * alone, share * least


def _differing(squares: NDArray[np.floating], shots: NDArray[np.intp]) -> int | None:
    """Return the shot that differs from all others; None where several do, or there are two."""
    second, first = np.argsort(squares)[-2:]
    alone = len(shots) > 2 and squares[first] > CLEARLY * squares[second]
    return int(shots[first]) if alone else None


def _spots(values: Array) -> NDArray[np.float32]:
    return np.stack([cv2.GaussianBlur(frame, (0, 0), SPOT_PX) for frame in values])


def _windows(values: Array, side: int) -> NDArray[np.float32]:
    return np.stack([cv2.blur(frame, (side, side)) for frame in values])
