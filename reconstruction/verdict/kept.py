"""How well a light field predicts readings: validation readings kept from its fit, and all
readings, place by place."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.problem import choose_mu
from emmc_rig.reconstruction.tv import few_steps
from emmc_rig.reconstruction.verdict.shadow import Relief

Array = NDArray[np.floating]
FEWEST = 30
SHARE = 0.003
"""Of the usable readings that are kept from every fit; more of few, so that WANTED are."""
WANTED, MOST_SHARE = 150, 0.04
SEED = 1
"""Differs from the seed by which `adaptive` keeps readings for its standard deviation."""

FLAT_STEPS = 60
"""Steps of total variation for a single picture in all views: `tv` ends after about 50 for
buttercup and 70 for dragons, full frames."""
WINDOW_PX = 9
"""Side of the square that a place is judged by: 81 readings a shot distinguish 1 from 1.25."""


def kept_readings(psi: Psi, usable: NDArray[np.bool_], seed: int = SEED) -> NDArray[np.bool_]:
    """Return a random selection of usable readings (shot, pixel_y, pixel_x) to keep from the fit.

    A reading is selected by its pixel and by the weights of its shot: the order of the shots in Psi
    changes nothing.
    """
    v, u = (views // 2 for views in psi.views)
    order = sorted(range(psi.shots), key=lambda shot: psi.weights[shot, v, u].tobytes())
    share = min(max(SHARE, WANTED / max(int(usable.sum()), 1)), MOST_SHARE)
    kept = usable.copy()
    kept[order] &= np.random.default_rng(seed).random(usable.shape) < share
    return kept


def compare_held_out(
    frames: Array, residual: Array, noise_sigma: float, kept: NDArray[np.bool_], relief: Relief
) -> dict[str, Any]:
    """Return figures of `Evidence`: how well a light field predicts readings kept from its fit.

    frames, residual (frames less what it predicts), kept: (shot, pixel_y, pixel_x). None with too
    few readings.
    """
    kept = kept & np.isfinite(frames)
    if kept.sum() < FEWEST:
        return {"kept": 0, "explained": None, "noise_share": None}
    smooth = relief.level * (1 + relief.masks)
    square, before = (
        float(np.mean(np.square(missed[kept], dtype=np.float64)))
        for missed in (residual, frames - smooth)
    )
    noise = noise_sigma**2
    removed = 1 - (square - noise) / max(before - noise, 1e-30) if before > 2 * noise else 0.0
    share = min(noise / max(square, 1e-30), 1.0)
    return {"kept": int(kept.sum()), "explained": removed, "noise_share": share}


def missed_readings(
    psi: Psi,
    light_field: Array,
    readings: Array,
    deviation: Array | float,
    usable: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return how far readings are missed around each place, (y, x) of the samples.

    The root mean square of (reading - Psi light field) / deviation, over shots and a window: about
    1 where the light field explains the readings. 1 where no reading is usable, or has no noise.

    readings, usable: (shot, pixel_y, pixel_x). deviation: of each, or of all.
    """
    noise = np.broadcast_to(np.asarray(deviation, np.float32), readings.shape)
    counts = usable & np.isfinite(noise) & (noise > 0)
    times = np.zeros(readings.shape, np.float32)
    np.divide(readings - psi.forward(light_field), noise, out=times, where=counts)
    window = (WINDOW_PX, WINDOW_PX)
    squares = cv2.blur(np.square(times).mean(axis=0), window)
    shares = cv2.blur(counts.mean(axis=0, dtype=np.float32), window)
    missed = np.ones_like(squares)
    np.divide(squares, shares, out=missed, where=shares > 0)
    rows, columns = psi.size
    return cv2.resize(np.sqrt(missed), (columns, rows), interpolation=cv2.INTER_NEAREST)


def over_baselines(
    psi: Psi,
    frames: Array,
    residual: Array,
    noise_sigma: float,
    usable: NDArray[np.bool_],
    kept: NDArray[np.bool_],
) -> dict[str, Any]:
    """Return by how much a light field misses readings kept from its fit, over what anybody would.

    over_flat: one picture for all views, by total variation. over_neighbours: the mean of the
    readings beside, of the same colour. Root mean squares, at the lower end of three deviations:
    above 1 the light field is surely the worse. None with too few readings.

    frames, residual (frames less what the light field predicts), usable, kept: (shot, y, x).
    """
    kept = kept & usable
    if kept.sum() < FEWEST:
        return {"over_flat": None, "over_neighbours": None}
    fitted, flat = usable & ~kept, psi.of_one_view()
    mu = choose_mu(flat, frames[fitted], noise_sigma)
    of_flat = frames - flat.forward(few_steps(flat, frames, fitted, mu, FLAT_STEPS))
    return {
        "over_flat": _surely_over(residual[kept], of_flat[kept]),
        "over_neighbours": _surely_over(residual[kept], _off_neighbours(psi, frames, fitted)[kept]),
    }


def _off_neighbours(psi: Psi, frames: Array, good: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return what readings differ by from the mean of the good ones of the eight beside.

    Of a Bayer colour the next pixel is two further. (shot, pixel_y, pixel_x) each.
    """
    step = 1 if psi.colour is None or psi.binning > 1 else 2
    beside = np.zeros((2 * step + 1, 2 * step + 1))
    beside[::step, ::step] = 1
    beside[step, step] = 0
    off = []
    for frame, of_shot in zip(frames, good, strict=True):
        light = np.where(of_shot, frame, 0).astype(np.float64)
        total, count = (cv2.filter2D(a, -1, beside) for a in (light, of_shot.astype(np.float64)))
        off.append(frame - total / np.maximum(count, 1))
    return np.asarray(off, dtype=np.float32)


def _surely_over(mine: Array, theirs: Array) -> float:
    """Return the ratio of root mean squares, three deviations of their difference lower."""
    mine2, theirs2 = (np.square(missed, dtype=np.float64) for missed in (mine, theirs))
    deviation = float(np.std(mine2 - theirs2)) / np.sqrt(len(mine2))
    least = max(float(mine2.mean()) - 3 * deviation, 0.0)
    return float(np.sqrt(least / max(float(theirs2.mean()), 1e-30)))
