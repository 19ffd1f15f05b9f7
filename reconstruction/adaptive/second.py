"""A second search of the disparities, only where they are too wide for the first to be sure.

At disparity d the rays of a pixel meet the texture over (views - 1) |d| samples. Where that is
wider than a patch they see more than the patch's own plane: slants, other surfaces, what these
hide. Such errors exceed the `misfit` that the search allows for, in all shots alike, and it is too
sure of wrong disparities, the more so the more shots there are and the less noise. A second search
allows for LOOSER times the misfit. On crops of dice it gains up to 3.6 dB, and elsewhere it costs
up to 1 dB, so neither is chosen: a texture is fitted to the disparities of each, and readings kept
from both weigh them place by place (`mixture`).

Near the picture's edges few views see what wide disparities show. Patches of a dictionary, which
need no surfaces, stand in there, if the readings kept from the fits say so (`surfaces_fail`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.reconstruction.adaptive import mixture, search
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import Survey

LOOSER = 4.0
"""Misfit of the second search over that of the first. Twice, alone, two crops of dice (64x80, three
shots) have 25.7 and 29.6 dB, four times 27.2 and 31.4; they had 25.3 and 27.8."""
WIDE_PX = 10.0
"""Pixels over which the rays of one pixel spread from where on a disparity is wide: a patch has
4 to 8. Of fish, up to 8, the second search gains nothing."""
WIDE_SHARE = 0.1
"""Of the patches with wide disparities, from which the second search is worth its time."""
BESIDE, MISSED = 0.15, 0.35
"""Sparse patches are worth their time where the rays of one pixel spread over BESIDE of the
picture's shorter side, and the residual of surfaces at held-out readings is MISSED of that of total
variation. One shot of dice, 64x80: patches gain 0.8 dB at shares of 0.4 to 0.5, nothing at 0.25 to
0.3 (two cameras)."""

Array = NDArray[np.floating]


def _spread_px(survey: Survey) -> NDArray[np.float64]:
    """Return over how many pixels the rays of a pixel spread, at each patch (row, column)."""
    volume, psi = survey.volume, survey.given.psi
    likeliest = volume.disparities[volume.probability.argmax(axis=-1)]
    return np.abs(likeliest) * (max(psi.light_field_shape[:2]) - 1) / psi.binning


def searched_again(survey: Survey, settings: AdaptiveSettings) -> search.Volume | None:
    """Return the beliefs of a second search; None where disparities are not wide."""
    if not settings.second or np.mean(_spread_px(survey) > WIDE_PX) < WIDE_SHARE:
        return None
    looser = survey.bright.variance(LOOSER * settings.misfit)
    return search.fine(
        replace(survey.data, residual=replace(survey.data.residual, noise=looser)),
        survey.prior,
        survey.rough,
        settings.stride,
        settings.step_px,
        settings.slope_px,
        settings.jump,
        settings.interleaved,
    )


def surfaces_fail(survey: Survey, residuals: Sequence[Array]) -> bool:
    """Return whether surfaces miss so much, beside wide disparities, that patches may do better.

    residuals: of the surfaces, frames less what each predicts, (shot, pixel_y, pixel_x).
    """
    given, held = survey.given, survey.held
    side = min(given.psi.frames_shape[1:])
    if np.mean(_spread_px(survey) > BESIDE * side) < WIDE_SHARE or not held.any():
        return False
    least = min(mixture.excess(residual, given.noise, held) for residual in residuals)
    return least > MISSED**2 * mixture.excess(survey.plain_residual, given.noise, held)
