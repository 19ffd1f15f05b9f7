"""The texture of surfaces, and their disparity per pixel, from all frames at once.

Half-quadratic splitting with momentum: with the noise that is still presumed in the texture falling
from step to step, remove it (`shrinkage`), then fit the frames again (`refine.fitted`). Once the
texture is nearly known, planes are swept with it (`sweep`), and its residual of the frames sharpens
the disparity (`refine`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.refine import Seen, fitted, refined
from emmc_rig.reconstruction.adaptive.shrinkage import denoised
from emmc_rig.reconstruction.adaptive.visibility import carried

Array = NDArray[np.floating]


class TextureSettings(Settings):
    """Settings of the fit of texture and disparity."""

    removed: ClassVar[tuple[str, ...]] = ("doubt",)

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


@dataclass(frozen=True, eq=False)
class Begun:
    """The textures (c, y, x) after some steps: now, a step before, and that less its noise."""

    now: Array
    before: Array
    clean: Array


@dataclass(frozen=True, eq=False)
class FittedScene:
    """Surfaces, their texture (c, y, x), the same less its noise (`clean`), and the centre view's
    disparity (y, x), without the margin that the textures have. begun: after the shared steps."""

    surfaces: Surfaces
    texture: Array
    clean: Array
    centre: Array
    begun: Begun


def surfaces_of(
    psi: ImagingMatrix, padded: Array, margin: int, nearer: int, colours: int = 3
) -> Surfaces:
    """Return Psi of the surfaces of the centre view's disparity, padded by a margin (y, x)."""
    disparity, hidden = carried(padded, margin, nearer, psi.light_field_shape[:4])
    return Surfaces(psi, disparity, hidden, margin, colours)


def margin_of(psi: ImagingMatrix, centre: Array, room_px: float) -> int:
    """Return by how many samples views of the centre view's disparity see beyond it, at most."""
    furthest = float(np.abs(centre).max()) + room_px
    return int(np.ceil(furthest * (max(psi.light_field_shape[:2]) // 2))) + 4


def solve(
    psi: ImagingMatrix,
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

    centre: disparity of the centre view (y, x) to begin with. nearer: 1 when points of larger
    disparity are in front, -1 when behind. precision: inverse variance of the readings, 0 where not
    usable. picture: (y, x, c) to begin with, of one colour or three. again: returns the disparity
    (y, x) of a texture (c, y, x) without noise, padded by a margin, given the present surfaces.
    begun: textures of another fit of the same centre, to continue from. others: returns what other
    times saw of a disparity (y, x) and its texture, padded by the margin between the two. margin:
    instead of the least.
    """
    if margin is None:
        margin = margin_of(psi, centre, settings.room_px)
    around = ((margin, margin), (margin, margin))
    padded = searched = np.pad(centre, around, mode="edge")
    colours = picture.shape[-1]
    surfaces = surfaces_of(psi, padded, margin, nearer, colours)
    rows_squared = np.einsum("ssyx->syx", psi.gram)
    now = np.pad(np.moveaxis(picture, -1, 0), ((0, 0), *around), mode="edge").astype(np.float32)
    at = kept = begun or Begun(now, now, now)
    sigmas = np.geomspace(settings.first_noise, settings.last_noise, settings.steps)
    shared = min(settings.shared_steps, settings.steps - 1)
    seen = others(padded, margin, at.clean)
    for step in range(0 if begun is None else shared, settings.steps):
        if step == shared:
            kept = at
        now, clean, sigma = at.now, at.clean, float(sigmas[step])
        if step:
            ahead = now + np.float32(settings.momentum) * (now - at.before)
            clean = denoised(
                ahead,
                clean if step > 1 else ahead,
                sigma,
                settings.block_step,
                step,
                settings.threshold,
                settings.chroma,
                settings.reach,
            )
        if again is not None and step in settings.sweeps:
            padded = searched = np.pad(again(clean, surfaces), around, "edge")
            surfaces = surfaces_of(psi, padded, margin, nearer, colours)
            seen = others(padded, margin, clean)
        left = settings.steps - 1 - step
        if step >= 2 and left < settings.refine_steps and left % 2 == 0:
            doubted = precision / (1 + precision * sigma**2 * rows_squared)
            residual = frames - surfaces.forward(now)
            padded = refined(
                surfaces, padded, now, residual, doubted.astype(np.float32), settings.slope_px
            )
            padded = np.clip(padded, searched - settings.room_px, searched + settings.room_px)
            surfaces = surfaces_of(psi, padded, margin, nearer, colours)
        fit = fitted(surfaces, frames, precision, clean, sigma, settings.fit_steps, seen)
        at = Begun(fit, now, clean)
        if on_step is not None:
            on_step(step + 1)
    inner = np.s_[margin : margin + centre.shape[0], margin : margin + centre.shape[1]]
    return FittedScene(surfaces, at.now, at.clean, np.ascontiguousarray(padded[inner]), kept)
