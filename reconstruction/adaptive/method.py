"""The adaptive method: disparities by evidence, then the texture of the surfaces they make.

1. A smooth picture is what all models start from.
2. Patches judge disparities by the likelihood of their readings (`evidence`, `search`), and agree
   with their neighbours (`labels`).
3. The centre view's disparity is carried to all views (`visibility`), so that the frames are
   linear in the surfaces' texture (`rays`).
4. The texture is fitted to all frames at once, with what repeats in the scene as prior, and the
   disparity is sharpened per pixel on the way (`joint`, `texture`, `shrinkage`, `refine`).

Nothing is trained: a mask, sensor or number of shots enters through Psi alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from reconstruction.adaptive import search
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.adaptive.free import freed, misfit
from reconstruction.adaptive.joint import TextureSettings, solve
from reconstruction.adaptive.models import MODELS, model_map, texture_map
from reconstruction.adaptive.uncertainty import deviation, held_out
from reconstruction.choices import smooth_guess
from reconstruction.inputs import checked_inputs
from reconstruction.result import Progress, Reconstruction
from reconstruction.verdict.shadow import Shadow, relief, shadow

Array = NDArray[np.floating]
UNDECIDED = 0.25
"""Share of deciding patches among the textured ones below which the evidence is called flat."""
COARSE_LENGTH_PX = 8.0
SHADOW = 0.7
"""Strength of the masks' shadow in the readings, as a share of what Psi says, below which Psi is
called another's: at least 0.93 on clean captures, 0 to 0.25 with masks 4 samples off."""


class AdaptiveSettings(Settings):
    """Settings of the adaptive method."""

    furthest_px: float = Field(
        default=24.0, gt=0, description="largest disparity searched, to both sides"
    )
    step_px: float = Field(default=0.125, gt=0, description="between disparities judged")
    stride: int = Field(default=4, ge=1, description="pixels between patches that judge")
    slope_px: float = Field(
        default=0.025, gt=0, description="mean change of the disparity per pixel on one surface"
    )
    jump: float = Field(
        default=0.02, gt=0, lt=1, description="probability that neighbouring patches differ freely"
    )
    freedom: float = Field(
        default=3.0, gt=0, description="of the Student t of the readings; large: Gaussian"
    )
    layers: bool = Field(
        default=True, description="give what the centre view does not see a texture of its own"
    )
    misfit: float = Field(
        default=0.0015, gt=0, description="deviation of readings that no model explains"
    )
    nearer: Literal["larger", "smaller"] = Field(
        default="larger", description="disparity of what is in front; pictures may be flipped"
    )
    texture: TextureSettings = Field(default_factory=TextureSettings)
    free: bool = Field(
        default=True, description="let total variation decide where no surface explains the frames"
    )


def fast(settings: AdaptiveSettings) -> AdaptiveSettings:
    """Return the settings of `adaptive-fast`: coarser patches, fewer steps."""
    quick = settings.texture.model_copy(update={"steps": 6, "refine_steps": 2, "block_step": 6})
    return settings.model_copy(update={"step_px": 0.25, "stride": 8, "texture": quick})


def reconstruct_adaptive(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float,
    settings: AdaptiveSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """Return the light field of the surfaces and textures that the frames speak for.

    frames: (shot, pixel_y, pixel_x) normalised readings. noise_sigma: their typical standard
    deviation. usable: pixels to fit (default all). Raises ReconstructionError for inputs that do
    not fit each other.
    """
    settings = settings or AdaptiveSettings()
    started = clock()
    frames, usable = checked_inputs(psi, frames, noise_sigma, usable)
    total = settings.texture.steps + 3

    def tell(step: int) -> None:
        if on_step is not None:
            on_step(Progress(step, None, None, total))

    picture = np.asarray(smooth_guess(psi, frames, usable), dtype=np.float32)
    variance = np.full(frames.shape, noise_sigma**2 + settings.misfit**2, dtype=np.float32)
    flat = np.ascontiguousarray(np.broadcast_to(picture, psi.light_field_shape))
    k = psi.binning
    grey = picture.mean(axis=-1)
    brightness = grey.reshape(grey.shape[0] // k, k, grey.shape[1] // k, k).mean(axis=(1, 3))
    data = search.Data(psi, frames - psi.forward(flat), variance, usable, brightness)
    rough = search.coarse(
        data,
        TexturePrior(length_px=COARSE_LENGTH_PX, freedom=settings.freedom),
        settings.furthest_px,
        settings.slope_px,
        settings.jump,
    )
    tell(1)
    volume = search.fine(
        data,
        TexturePrior(freedom=settings.freedom),
        rough,
        settings.stride,
        settings.step_px,
        settings.slope_px,
        settings.jump,
    )
    centre = search.per_pixel(volume, psi.size, k)
    searched_s = clock() - started
    tell(2)
    held = held_out(usable)
    found = solve(
        psi,
        centre,
        1 if settings.nearer == "larger" else -1,
        frames,
        np.where(usable & ~held, 1 / variance, 0).astype(np.float32),
        picture,
        settings.texture,
        settings.layers,
        on_step=lambda step: tell(2 + step),
    )
    light_field = np.clip(found.surfaces.light_field(found.texture), 0, 1)
    doubt = search.variance_per_pixel(volume, psi.size, k)
    sure = deviation(found, doubt, frames, noise_sigma, held)
    missed = frames - found.surfaces.forward(found.texture)
    unexplained = misfit(psi, missed, noise_sigma, usable)
    surface = light_field
    if settings.free:
        light_field = freed(psi, frames, noise_sigma, usable, surface, unexplained)
    tell(total)
    kinds = texture_map(volume, psi.size, k)
    maps = {
        "disparity": found.centre,
        "texture": kinds,
        "hidden": found.surfaces.hidden.mean(axis=(0, 1), dtype=np.float32),
        "model": model_map(kinds, found, unexplained, k),
    }
    if sure is not None:
        # What total variation moved is in doubt by as much.
        moved = np.square(light_field - surface).mean(axis=-1)
        maps["sigma"] = np.sqrt(np.square(sure.sigma) + moved)
    shares = np.bincount(maps["model"].ravel(), minlength=len(MODELS)) / maps["model"].size
    explained = _explained(missed, data.readings, noise_sigma, held)
    masks = shadow(relief(psi, frames, noise_sigma, usable))
    decided = _decided(volume)
    judged = _judgement(settings, volume, decided, masks)
    return Reconstruction(
        method="adaptive",
        light_field=light_field,
        status="doubtful" if judged else "converged",
        advice="; ".join(judged),
        steps=total,
        objective=(),
        seconds=clock() - started,
        parameters={
            "noise_sigma": noise_sigma,
            "lowest_px": float(found.centre.min()),
            "highest_px": float(found.centre.max()),
            "disparities": len(volume.disparities),
            "search_seconds": searched_s,
            "held_readings": int(held.sum()),
            "at_end": volume.at_end,
            **({} if decided is None else {"decided": decided}),
            **({} if explained is None else {"explained": explained}),
            **{
                f"share_{name.replace(' ', '_')}": float(v)
                for name, v in zip(MODELS, shares, strict=True)
            },
        },
        maps=maps,
    )


def _explained(
    missed: Array, plain: Array, noise_sigma: float, held: NDArray[np.bool_]
) -> float | None:
    """Return the share of the plain residual's variance that held-out readings no longer miss.

    missed, plain: residuals of the scene found and of the smooth picture. None where the smooth
    picture explains the readings as well as their noise allows.
    """
    before = float(np.mean(np.square(plain[held]))) - noise_sigma**2 if held.any() else 0.0
    if before <= 3 * noise_sigma**2:
        return None
    return 1 - (float(np.mean(np.square(missed[held]))) - noise_sigma**2) / before


def _decided(volume: search.Volume) -> float | None:
    """Return the share of the textured patches that prefer some disparity; None without any."""
    textured = volume.kind > 0
    return float(volume.decisive[textured].mean()) if textured.any() else None


def _judgement(
    settings: AdaptiveSettings, volume: search.Volume, decided: float | None, masks: Shadow
) -> list[str]:
    """Return what the user should know before trusting the result."""
    told = []
    if decided is not None and decided < UNDECIDED:
        told.append(
            f"the evidence is flat: {1 - decided:.0%} of the textured patches prefer no "
            "disparity; use a mask that differs from view to view, or more shots"
        )
    if volume.at_end > search.WANTED:
        told.append(
            f"disparities reach the end of the search, {settings.furthest_px:g} px: raise "
            "furthest_px"
        )
    strengths = masks.strength[np.isfinite(masks.strength)]
    if strengths.size and float(strengths.min()) < SHADOW:
        told.append(
            f"the masks show in the readings at {max(float(strengths.min()), 0):.0%} of the "
            "strength that Psi says: Psi may not be theirs"
        )
    return told
