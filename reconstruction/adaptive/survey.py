"""The readings, and what is decided once for a whole scene: contrast, disparities and weights.

All of it needs the whole picture, or is better known from it; a part of the picture is fitted with
it as it stands (`fits`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.reconstruction.adaptive import search
from emmc_rig.reconstruction.adaptive.evidence import TexturePrior
from emmc_rig.reconstruction.adaptive.mixture import stored
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

PASSED = 0.5
"""Share of the light that masks pass for which the settings were chosen."""


def checked(psi: ImagingMatrix, frames: Frames) -> Readings:
    """Return the readings of frames, scaled as if the masks passed half the light.

    Raises ReconstructionError for frames that do not fit Psi.
    """
    passed = max(psi.light_efficiency(), 1e-12)
    return Readings.of(psi, frames).over(passed / PASSED, of_psi=True)


def checked_disparity(disparity: Array, psi: ImagingMatrix) -> Array:
    """Return a known disparity of the centre view as float32; raises ReconstructionError."""
    if disparity.shape != psi.size or not np.isfinite(disparity).all():
        raise ReconstructionError(
            f"a disparity of shape {disparity.shape} is given, Psi needs {psi.size}, all finite"
        )
    return np.asarray(disparity, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Plain:
    """The readings, and the light field without surfaces that theirs must beat.

    given: what is fitted. scale: of the scene's contrast; bright: `given` over it. held: the
    readings kept from every fit. unseen: variance by colours that frames do not show, (y, x).
    plain: light field of total variation, as `mixture.stored`; plain_residual: frames less what it
    predicts; picture: its centre view (y, x, c), over the scale.
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
    """data, prior, rough: inputs of the fine search, for a second search. volume: beliefs about
    disparities. centre: the centre view's disparity (y, x), to begin with.
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
    return Plain(given, scale, given.over(scale), held, unseen, stored(plain), missed, picture)


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
    smooth = settings.slope_px, settings.jump
    rough = search.coarse(data, coarse, settings.furthest_px, *smooth)
    on_searched(1)
    volume = search.fine(
        data, fine, rough, settings.stride, settings.step_px, *smooth, settings.interleaved
    )
    on_searched(2)
    centre = search.per_pixel(volume, psi.size, k) if disparity is None else disparity
    begun = plain_of(given, scale, unseen, settings.start_steps)
    return Survey(**vars(begun), data=data, prior=fine, rough=rough, volume=volume, centre=centre)


def contrast_of(
    psi: ImagingMatrix, frames: Array, picture: Array, noise: Array, usable: NDArray[np.bool_]
) -> float:
    """Return the standard deviation of a scene's values, as far as frames (shot, y, x) show it.

    That of the smooth picture (y, x, c), and of the texture it lacks: the variance of the readings
    beyond their noise, over the squared sums of Psi's rows, as if the texture lay at disparity 0.
    """
    missed = np.square(frames - psi.forward_picture(picture))[usable].sum(dtype=np.float64)
    beyond = max(float(missed - noise[usable].sum(dtype=np.float64)), 0.0)
    rows = np.square(psi.forward_picture(np.ones_like(picture)))[usable].sum(dtype=np.float64)
    return float(np.hypot(contrast(picture), np.sqrt(beyond / max(float(rows), 1e-20))))
