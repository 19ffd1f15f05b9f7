"""What a session's exposures cost its light field, for the verdict of `emmc-rig reconstruct`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emmc_rig.processing.result import Result
from emmc_rig.session.exposure import UNDEREXPOSED, exposure_reasons, shot_exposures
from emmc_rig.session.session import Session
from reconstruction.adaptive.planning import expected_errors
from reconstruction.errors import ReconstructionError
from reconstruction.result import Reconstruction
from reconstruction.verdict.rules import Verdict

NEEDED = ("disparity", "disparity_sigma", "texture", "sigma")


def with_exposure(result: Result, session: Session) -> Result:
    """Return the result with what speaks against the exposures of its shots in the verdict."""
    shots = shot_exposures(session)
    dark = [one for one in shots if one.level < UNDEREXPOSED]
    gain_db = None
    if dark:
        factor = float(np.exp(np.mean([np.log(one.factor) for one in shots])))
        gain_db = expected_gain_db(result, factor)
    reasons = exposure_reasons(shots, gain_db)
    return replace(result, verdict=result.verdict.with_reasons(reasons))


def verdict_with_exposure(verdict: Verdict, session: Session) -> Verdict:
    """Return the verdict with what speaks against the exposures, without what better ones gain."""
    return verdict.with_reasons(exposure_reasons(shot_exposures(session), None))


def expected_gain_db(result: Result, factor: float) -> float | None:
    """Return what an exposure `factor` times as long is expected to add to the PSNR.

    The method's own deviation says how large the error is. By how much less shot noise lessens it
    follows from Psi and what the scene was estimated to be made of. None where the method does not
    estimate that.
    """
    solved: Reconstruction = result.solved
    if any(name not in solved.maps for name in NEEDED):
        return None
    views_v, views_u = solved.light_field.shape[:2]
    every = [tuple(range(result.psi.shots))]
    variance = result.frames.noise_sigma**2
    try:
        now, then = (
            expected_errors(
                result.psi,
                every,
                solved.maps["disparity"],
                solved.maps["disparity_sigma"],
                solved.maps["texture"],
                solved.light_field[views_v // 2, views_u // 2],
                one,
            )[0]
            for one in (variance, variance / factor)
        )
    except ReconstructionError:
        return None
    stated = float(np.mean(np.square(solved.maps["sigma"], dtype=np.float64)))
    # The expectation may lie above what is stated; more light makes nothing worse.
    remaining = max(stated - (now - then), min(then, stated))
    return float(10 * np.log10(stated / remaining))
