"""The readings, and what is decided once for a whole scene: contrast, disparities and weights.

All of it needs the whole picture, or is better known from it; a part of the picture is fitted with
it as it stands (`fits`).

Disparities are searched a second time where they are too wide for the first search to be sure.
At disparity d the rays of a pixel meet the texture over (views - 1) |d| samples. Where that is
wider than a patch they see more than the patch's own plane: slants, other surfaces, what these
hide. Such errors exceed the `misfit` that the search allows for, in all shots alike, and it is too
sure of wrong disparities, the more so the more shots there are and the less noise. A second search
allows for LOOSER times the misfit. On crops of dice it gains up to 3.6 dB, and elsewhere it costs
up to 1 dB, so neither is chosen: a texture is fitted to the disparities of each, and readings kept
from both weigh them place by place (`mixture`). For one shot of a large picture, beside which wide
disparities are small, the first search is as good.

Near the picture's edges few views see what wide disparities show. Patches of a dictionary, which
need no surfaces, stand in there, if the readings kept from the fits say so (`surfaces_fail`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive import mixture, search
from emmc_rig.reconstruction.adaptive.evidence import TexturePrior
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.uncertainty import held_out
from emmc_rig.reconstruction.colour import unseen_colour
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.problem import choose_mu, contrast, smooth_guess
from emmc_rig.reconstruction.tv import few_steps

Array = NDArray[np.floating]
COARSE_PX = 8.0, 2.0
"""Correlation lengths of the textures of the coarse search. 2x +0.15, 0.5x -0.05 dB."""
CONTRAST = 0.15
"""Least deviation of a scene's values; a scene of less contrast is scaled up to it, because the
settings are shares of the contrast. Compared with scaling to a mean brightness of 0.25, on 96x96
crops of group A: buttercup and occlusions +0.1 dB. With 0.2 antinous gains 0.2 dB and the two gain
nothing. 2x -0.01, 0.5x 0.00 dB."""

LOOSER = 4.0
"""Misfit of the second search over that of the first. Twice, alone, two crops of dice (64x80, three
shots) have 25.7 and 29.6 dB, four times 27.2 and 31.4; they had 25.3 and 27.8."""
WIDE_PX = 10.0
"""Pixels over which the rays of one pixel spread from where on a disparity is wide: a patch has
4 to 8. Of fish, up to 8, the second search gains nothing."""
WIDE_BESIDE = 0.1
"""With one shot, rays must also spread over this share of the picture's shorter side. The whole of
dice (593x840, rays spread over 20 pixels) loses 0.2 dB by the second search, and two crops of
256x256 lose 0.15. Four crops of 160x160 and eight of 96x96 gain 0.0 and 0.25 dB, with a standard
error of 0.1 and 0.4. A crop of 256x256 with three shots gains 0.2 dB."""
WIDE_SHARE = 0.1
"""Of the patches with wide disparities, from which the second search is worth its time."""
BESIDE, MISSED = 0.15, 0.35
"""Sparse patches are worth their time where the rays of one pixel spread over BESIDE of the
picture's shorter side, and the residual of surfaces at held-out readings is MISSED of that of total
variation. One shot of dice, 64x80: patches gain 0.8 dB at shares of 0.4 to 0.5, nothing at 0.25 to
0.3 (two cameras)."""
PASSED = 0.5
"""Share of the light that masks pass for which the settings were chosen."""


def checked(psi: Psi, frames: Frames) -> Readings:
    """Return the readings of frames, scaled as if the masks passed half the light.

    Raises ReconstructionError for frames that do not fit Psi.
    """
    passed = max(psi.light_efficiency(), 1e-12)
    return Readings.of(psi, frames).over(passed / PASSED, of_psi=True)


def checked_disparity(disparity: Array, psi: Psi) -> Array:
    """Return a known disparity of the centre view as float32; raises ReconstructionError."""
    if disparity.shape != psi.size or not np.isfinite(disparity).all():
        raise ReconstructionError(
            f"a disparity of shape {disparity.shape} is given, Psi needs {psi.size}, all finite"
        )
    return np.asarray(disparity, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Plain:
    """The readings, and the light field without surfaces that theirs must beat.

    Attributes:
        given: the readings that are fitted.
        scale: of the scene's contrast.
        bright: `given` over the scale.
        held: readings kept from every fit, (shot, pixel_y, pixel_x).
        unseen: variance by colours that frames do not show, (y, x).
        plain: light field of total variation, as `mixture.stored`.
        plain_residual: frames less what `plain` predicts, (shot, pixel_y, pixel_x).
        picture: centre view of `plain`, over the scale, (y, x, c).
    """

    given: Readings
    scale: float
    bright: Readings
    held: NDArray[np.bool_]
    unseen: Array
    plain: NDArray[np.uint16]
    plain_residual: Array
    picture: Array


@dataclass(frozen=True, eq=False)
class Survey(Plain):
    """What is decided for a whole scene.

    Attributes:
        data: of the search, for a second one.
        prior: of textures, of the fine search.
        rough: the coarse search.
        volume: beliefs about disparities, of the fine search.
        centre: the centre view's disparity to begin with, (y, x).
    """

    data: search.SearchData
    prior: TexturePrior
    rough: search.Volume
    volume: search.Volume
    centre: Array


def unseen_by(given: Readings) -> Array:
    """Return the variance by colours that frames do not show, (y, x)."""
    if given.psi.colour is not None:
        return np.zeros(given.psi.size)
    picture = np.asarray(smooth_guess(given.psi, given.frames, given.usable), dtype=np.float32)
    return unseen_colour(given.psi, given.frames, given.usable, picture)


def plain_of(given: Readings, scale: float, unseen: Array, steps: int) -> Plain:
    """Return a few steps of total variation from all readings but the held-out ones."""
    held = held_out(given.usable)
    fitted = given.usable & ~held
    mu = choose_mu(given.psi, given.frames[fitted], given.typical)
    plain = few_steps(given.psi, given.frames, fitted, mu, steps)
    missed = given.frames - given.psi.forward(plain)
    picture = centre_view(plain) / np.float32(scale)
    return Plain(
        given, scale, given.over(scale), held, unseen, mixture.stored(plain), missed, picture
    )


def surveyed(
    given: Readings,
    settings: AdaptiveSettings,
    disparity: Array | None,
    on_searched: Callable[[int], None],
) -> Survey:
    """Return what is decided for the whole scene.

    disparity: of the centre view (y, x) where it is known. on_searched: called with 1 and 2 after
    the coarse and the fine search.
    """
    psi, k = given.psi, given.psi.binning
    picture = np.asarray(smooth_guess(psi, given.frames, given.usable), dtype=np.float32)
    unseen = unseen_colour(psi, given.frames, given.usable, picture)
    own = settings.contrast or contrast_of(psi, given.frames, picture, given.noise, given.usable)
    scale = min(1.0, own / CONTRAST)
    bright = given.over(scale)
    picture = picture / np.float32(scale)
    grey = picture.mean(axis=-1)
    residual = (bright.frames - psi.forward_picture(picture)).astype(np.float32)
    data = search.SearchData(
        replace(bright, frames=residual, noise=bright.variance(settings.misfit)),
        grey.reshape(grey.shape[0] // k, k, grey.shape[1] // k, k).mean(axis=(1, 3)),
    )
    coarse, fine = (
        TexturePrior(length, tuple(finer), freedom=settings.freedom)
        for length, *finer in (COARSE_PX, settings.lengths_px)
    )
    rough = search.coarse(data, coarse, settings)
    on_searched(1)
    volume = search.fine(data, fine, rough, settings)
    on_searched(2)
    centre = search.per_pixel(volume, psi.size, k) if disparity is None else disparity
    begun = plain_of(given, scale, unseen, settings.start_steps)
    return Survey(**vars(begun), data=data, prior=fine, rough=rough, volume=volume, centre=centre)


def contrast_of(
    psi: Psi, frames: Array, picture: Array, noise: Array, usable: NDArray[np.bool_]
) -> float:
    """Return the standard deviation of a scene's values, as far as frames (shot, y, x) show it.

    That of the smooth picture (y, x, c), and of the texture it lacks: the variance of the readings
    beyond their noise, over the squared sums of Psi's rows, as if the texture lay at disparity 0.
    """
    missed = np.square(frames - psi.forward_picture(picture))[usable].sum(dtype=np.float64)
    beyond = max(float(missed - noise[usable].sum(dtype=np.float64)), 0.0)
    rows = np.square(psi.forward_picture(np.ones_like(picture)))[usable].sum(dtype=np.float64)
    return float(np.hypot(contrast(picture), np.sqrt(beyond / max(float(rows), 1e-20))))


def _spread_px(survey: Survey) -> NDArray[np.float64]:
    """Return over how many pixels the rays of a pixel spread, at each patch (row, column)."""
    volume, psi = survey.volume, survey.given.psi
    likeliest = volume.disparities[volume.probability.argmax(axis=-1)]
    return np.abs(likeliest) * (max(psi.light_field_shape[:2]) - 1) / psi.binning


def searched_again(survey: Survey, settings: AdaptiveSettings) -> search.Volume | None:
    """Return the beliefs of a second search; None where disparities are not wide."""
    shots, *pixels = survey.given.psi.frames_shape
    wide = max(WIDE_PX, WIDE_BESIDE * min(pixels)) if shots == 1 else WIDE_PX
    if not settings.second or np.mean(_spread_px(survey) > wide) < WIDE_SHARE:
        return None
    looser = survey.bright.variance(LOOSER * settings.misfit)
    data = replace(survey.data, residual=replace(survey.data.residual, noise=looser))
    return search.fine(data, survey.prior, survey.rough, settings)


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
