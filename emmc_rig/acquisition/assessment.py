"""Assessment of the shots so far: the PSNR that they are stated to give, and the shot to take next.

The method's own deviation, calibrated on readings that it kept from the fit, says how far off the
light field is. For every shot that could follow, the error is predicted from its Psi and from the
surfaces and textures that were estimated (`reconstruction.adaptive.planning`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.planning import expected_errors
from reconstruction.result import Reconstruction

METHOD = "adaptive-fast"
LEAST_GAIN_DB = 0.1
"""A shot that is expected to bring less is not worth taking."""


@dataclass(frozen=True)
class Assessment:
    """What is known after some shots.

    expected_db: the stated PSNR to expect with each further shot. next: the one to take; None: no
    more, and `why` says whether the target is reached.
    """

    stated_db: float
    expected_db: Mapping[int, float]
    next: int | None
    why: str
    advice: str
    seconds: float


def stated_psnr_db(result: Reconstruction) -> float:
    """Return the PSNR that a result's own deviation stands for.

    Raises AppError when the method states none.
    """
    if "sigma" not in result.maps:
        raise AppError(
            f"'{result.method}' states no deviation of this light field: it needs more readings"
        )
    return float(-10 * np.log10(np.mean(np.square(result.maps["sigma"], dtype=np.float64))))


def assessed(
    psi: ImagingMatrix,
    result: Reconstruction,
    shots: Sequence[int],
    noise_sigma: float,
    target_db: float,
    clock: Callable[[], float] = time.perf_counter,
) -> Assessment:
    """Return whether some shots are enough, and which should follow.

    psi: of every planned shot. result: the light field that `shots` gave, with maps of its sigma,
    disparity and texture. Raises AppError or ReconstructionError where it is too small.
    """
    began = clock()
    stated_db = stated_psnr_db(result)
    free = [shot for shot in range(psi.shots) if shot not in shots]

    def assessment(why: str, expected: Mapping[int, float] | None = None, next: int | None = None):
        seconds = result.seconds + clock() - began
        return Assessment(stated_db, expected or {}, next, why, result.advice, seconds)

    if stated_db >= target_db:
        return assessment("the target is reached")
    if not free:
        return assessment("every planned shot is taken")
    views_v, views_u = result.light_field.shape[:2]
    errors = expected_errors(
        psi,
        [tuple(shots), *((*shots, shot) for shot in free)],
        result.maps["disparity"],
        result.maps["disparity_sigma"],
        result.maps["texture"],
        result.light_field[views_v // 2, views_u // 2],
        noise_sigma**2,
    )
    gains_db = 10 * np.log10(errors[0] / errors[1:])
    expected = {shot: stated_db + float(gain) for shot, gain in zip(free, gains_db, strict=True)}
    best = free[int(gains_db.argmax())]
    if expected[best] - stated_db < LEAST_GAIN_DB:
        why = f"no further shot is expected to gain {LEAST_GAIN_DB:g} dB"
        return assessment(why, expected)
    return assessment(f"expected to give {expected[best]:.2f} dB", expected, best)
