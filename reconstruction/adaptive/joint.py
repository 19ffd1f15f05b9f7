"""The texture of surfaces, and their disparity per pixel, from all frames at once.

Half-quadratic splitting with momentum: with the noise that is still presumed in the texture falling
from step to step, remove it (`shrinkage`), then fit the frames again (`refine.fitted`). Once the
texture is nearly known, planes are swept with it (`sweep`), and its residual of the frames sharpens
the disparity (`refine`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.refine import Seen, fitted, refined
from emmc_rig.reconstruction.adaptive.shrinkage import denoised
from emmc_rig.reconstruction.adaptive.visibility import carried

Array = NDArray[np.floating]


class TextureSettings(Settings):
    """Settings of the fit of texture and disparity."""

    steps: int = Field(default=16, ge=1)
    first_noise: float = Field(
        default=0.15, gt=0, description="deviation of the texture presumed at first"
    )
    last_noise: float = Field(default=0.01, gt=0, description="and at last")
    momentum: float = Field(default=0.5, ge=0, lt=1)
    threshold: float = Field(default=1.8, gt=0, description="of coefficients, in deviations")
    chroma: float = Field(default=1.4, gt=0, description="that of chrominance over luminance")
    block_step: int = Field(default=4, ge=1, le=8)
    reach: int = Field(default=9, ge=0, description="samples around within which blocks are alike")
    fit_steps: int = Field(default=6, ge=1, description="of conjugate gradients in each step")
    shared_steps: int = Field(
        default=5,
        ge=0,
        description="first steps, before the first sweep, which all fits of a scene share",
    )
    sweeps: tuple[int, ...] = Field(
        default=(5, 10), description="steps that search the disparity again first"
    )
    refine_steps: int = Field(
        default=8, ge=0, description="last steps, of which every second sharpens the disparity"
    )
    slope_px: float = Field(default=0.3, gt=0, description="see `refine`")
    room_px: float = Field(
        default=0.5, ge=0, description="by which sharpening may leave the disparity searched"
    )
    doubt: float = Field(
        default=0.025, gt=0, description="deviation of the texture when disparity is sharpened"
    )


@dataclass(frozen=True, eq=False)
class Begun:
    """The textures after some steps of a fit, all (c, y, x), padded.

    Attributes:
        now: the texture.
        before: the texture a step before.
        clean: the texture a step before, less its noise.
    """

    now: Array
    before: Array
    clean: Array


@dataclass(frozen=True, eq=False)
class FittedScene:
    """Surfaces and their texture.

    Attributes:
        surfaces: Psi of the surfaces.
        texture: (c, y, x), padded by the surfaces' margin.
        clean: the texture less its noise, (c, y, x), padded.
        centre: disparity of the centre view, (y, x), without margin.
        begun: textures after the shared steps, from which other fits of the scene continue.
    """

    surfaces: Surfaces
    texture: Array
    clean: Array
    centre: Array
    begun: Begun


def surfaces_of(psi: Psi, padded: Array, margin: int, nearer: int, colours: int = 3) -> Surfaces:
    """Return Psi of the surfaces of the centre view's disparity, padded by a margin (y, x)."""
    disparity, hidden = carried(padded, margin, nearer, psi.light_field_shape[:4])
    return Surfaces(psi, disparity, hidden, margin, colours)


def margin_of(psi: Psi, centre: Array, room_px: float) -> int:
    """Return by how many samples views of the centre view's disparity see beyond it, at most."""
    furthest = float(np.abs(centre).max()) + room_px
    return int(np.ceil(furthest * (max(psi.light_field_shape[:2]) // 2))) + 4


def solve(
    psi: Psi,
    centre: Array,
    nearer: int,
    frames: Array,
    precision: Array,
    picture: Array,
    settings: TextureSettings,
    on_step: Callable[[int], None] | None = None,
    again: Callable[[Array, Surfaces], Array] | None = None,
    begun: Begun | None = None,
    others: Callable[[Array, int, Array], Sequence[Seen]] = lambda *_: (),
    margin: int | None = None,
) -> FittedScene:
    """Return the scene that explains the frames (shot, pixel_y, pixel_x).

    The deviation sigma of the texture falls geometrically from first_noise to last_noise. A step:

        Y  = T + momentum (T - T_before)
        C  = Y less white noise of deviation sigma               (`shrinkage.denoised`)
        d  = swept with C at the steps `sweeps`                  (`again`)
        d  = sharpened in every second of the last refine_steps  (`refine.refined`)
        T' = argmin |S^-1/2 (Psi W_d T' - I)|^2 + |T' - C|^2 / sigma^2   (`refine.fitted`)

    Args:
        psi: of the capture.
        centre: disparity of the centre view to begin with, (y, x).
        nearer: 1 when points of larger disparity are in front, -1 when behind.
        frames: I, (shot, pixel_y, pixel_x).
        precision: inverse variance of the readings (1 / S), 0 where not usable, of this shape.
        picture: texture to begin with, (y, x, c), of one colour or three.
        settings: of the fit.
        on_step: called with the number of steps done.
        again: returns the disparity (y, x) of a padded texture C, given the present surfaces.
        begun: textures of another fit of the same centre, to continue from after the shared steps.
        others: returns what other times saw, given padded disparity, margin and texture.
        margin: samples by which textures are padded, instead of the least.
    """
    if margin is None:
        margin = margin_of(psi, centre, settings.room_px)
    around = ((margin, margin), (margin, margin))
    padded = searched = np.pad(centre, around, mode="edge")
    colours = picture.shape[-1]
    surfaces = surfaces_of(psi, padded, margin, nearer, colours)
    rows_squared = np.einsum("ssyx->syx", psi.gram)
    now = np.pad(np.moveaxis(picture, -1, 0), ((0, 0), *around), mode="edge").astype(np.float32)
    textures = kept = begun or Begun(now, now, now)
    sigmas = np.geomspace(settings.first_noise, settings.last_noise, settings.steps)
    shared = min(settings.shared_steps, settings.steps - 1)
    seen = others(padded, margin, textures.clean)
    for step in range(0 if begun is None else shared, settings.steps):
        if step == shared:
            kept = textures
        now, sigma = textures.now, float(sigmas[step])
        clean = _denoised(textures, sigma, step, settings) if step else textures.clean
        if again is not None and step in settings.sweeps:
            padded = searched = np.pad(again(clean, surfaces), around, "edge")
            surfaces = surfaces_of(psi, padded, margin, nearer, colours)
            seen = others(padded, margin, clean)
        left = settings.steps - 1 - step
        if step >= 2 and left < settings.refine_steps and left % 2 == 0:
            # A reading's variance: its noise, and that of a texture of deviation `doubt`.
            doubt = settings.doubt**2 * rows_squared
            doubted = (precision / (1 + precision * doubt)).astype(np.float32)
            residual = frames - surfaces.forward(now)
            padded = refined(surfaces, padded, now, residual, doubted, settings.slope_px)
            padded = np.clip(padded, searched - settings.room_px, searched + settings.room_px)
            surfaces = surfaces_of(psi, padded, margin, nearer, colours)
        fit = fitted(surfaces, frames, precision, clean, sigma, settings.fit_steps, seen)
        textures = Begun(fit, now, clean)
        if on_step is not None:
            on_step(step + 1)
    inner = np.s_[margin : margin + centre.shape[0], margin : margin + centre.shape[1]]
    found = np.ascontiguousarray(padded[inner])
    return FittedScene(surfaces, textures.now, textures.clean, found, kept)


def _denoised(textures: Begun, sigma: float, step: int, settings: TextureSettings) -> Array:
    """Return the texture, carried on by the momentum, less noise of deviation sigma, (c, y, x)."""
    ahead = textures.now + np.float32(settings.momentum) * (textures.now - textures.before)
    return denoised(
        ahead,
        guide=textures.clean if step > 1 else ahead,
        sigma=sigma,
        step=settings.block_step,
        first=step,
        threshold=settings.threshold,
        chroma=settings.chroma,
        reach=settings.reach,
    )
