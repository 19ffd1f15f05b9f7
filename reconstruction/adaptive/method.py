"""The adaptive method: disparities by evidence, then the texture of the surfaces they make.

1. Patches judge disparities by the likelihood of their readings (`evidence`, `search`), and agree
   with their neighbours (`labels`).
2. If the whole scene needs no more than one plane, or no colour, it gets no more (`parsimony`).
3. The centre view's disparity is carried to all views (`visibility`), so that the frames are
   linear in the surfaces' texture (`rays`).
4. The texture is fitted to all frames at once, from total variation's centre view, with what
   repeats in the scene as prior, and the disparity is sharpened per pixel on the way (`joint`,
   `texture`, `shrinkage`, `refine`).
5. Where no surface explains the frames total variation decides (`free`), and everywhere when it
   explains readings that were kept from the fit better than surfaces do.

Nothing is trained: a mask, sensor or number of shots enters through Psi alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from reconstruction.adaptive import search
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.adaptive.free import freed, misfit, missed_variance
from reconstruction.adaptive.joint import TextureSettings, solve
from reconstruction.adaptive.models import MODELS, model_map, texture_map
from reconstruction.adaptive.parsimony import (
    colour_is_needed,
    grey_bound_db,
    grey_psi,
    may_be_grey,
    one_plane,
    plane_bound_db,
)
from reconstruction.adaptive.uncertainty import FEWEST, deviation, held_out
from reconstruction.choices import smooth_guess
from reconstruction.inputs import checked_inputs, checked_noise
from reconstruction.result import Progress, Reconstruction
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
UNDECIDED = 0.25
"""Share of deciding patches among the textured ones below which the evidence is called flat."""
COARSE_LENGTH_PX = 8.0
TRIAL_STEPS = 4
"""Of the fits, with colour and without, that tell whether the scene has any."""
EXPLAINED = 0.7
"""Share of what held-out readings differ by from the smooth picture's that must be explained: 0.92
to 0.96 on four real scenes, 0.53 to 0.66 with a Psi whose masks were 5 samples off."""


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
    parsimony: bool = Field(
        default=True, description="one plane, or no colour, where the whole scene needs no more"
    )
    start_steps: int = Field(
        default=40, ge=1, description="of total variation, from which textures begin"
    )
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
    noise_sigma: float | Array,
    settings: AdaptiveSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """Return the light field of the surfaces and textures that the frames speak for.

    frames: (shot, pixel_y, pixel_x) normalised readings. noise_sigma: their standard deviation,
    one or of each. usable: pixels to fit (default all). Raises ReconstructionError for inputs that
    do not fit each other.
    """
    settings = settings or AdaptiveSettings()
    started = clock()
    typical, noise = checked_noise(psi, noise_sigma, usable)
    frames, usable = checked_inputs(psi, frames, typical, usable)
    total = settings.texture.steps + 3

    def tell(step: int) -> None:
        if on_step is not None:
            on_step(Progress(step, None, None, total))

    picture = np.asarray(smooth_guess(psi, frames, usable), dtype=np.float32)
    variance = noise + np.float32(settings.misfit**2)
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
    # Total variation is what surfaces must beat on the readings kept from both, and their begin.
    plain = reconstruct_tv(
        psi, frames, typical, TVSettings(max_steps=settings.start_steps), usable & ~held
    ).light_field
    precision = np.where(usable & ~held, 1 / variance, 0).astype(np.float32)
    nearer = 1 if settings.nearer == "larger" else -1
    needed = psi, centre, centre_view(plain), settings.texture
    left_out: list[str] = []
    if settings.parsimony:
        needed, left_out = _needed(needed, volume, frames, precision, held, nearer, settings)
    found = solve(
        needed[0],
        needed[1],
        nearer,
        frames,
        precision,
        needed[2],
        needed[3],
        settings.layers,
        on_step=lambda step: tell(2 + step),
    )
    light_field = found.surfaces.light_field(found.texture)
    light_field = np.broadcast_to(np.clip(light_field, 0, 1), psi.light_field_shape)
    missed = frames - found.surfaces.forward(found.texture)
    unexplained = misfit(psi, missed, noise, usable)
    kinds = texture_map(volume, psi.size, k)
    doubt = search.variance_per_pixel(volume, psi.size, k)
    maps = {
        "disparity": found.centre,
        "disparity_sigma": np.sqrt(doubt),
        "texture": kinds,
        "hidden": found.surfaces.hidden.mean(axis=(0, 1), dtype=np.float32),
        "model": model_map(kinds, found, unexplained, k),
    }
    explained = _explained(missed, data.readings, noise, held)
    judged = _judgement(settings, volume, explained)
    plainly = (frames - psi.forward(plain))[held]
    if held.sum() >= FEWEST and np.square(plainly).mean() < np.square(missed[held]).mean():
        judged.append(
            "readings kept from the fit speak against surfaces: total variation is returned"
        )
        settled = reconstruct_tv(psi, frames, typical, TVSettings(), usable, start=plain)
        light_field = settled.light_field
        maps["model"][:] = MODELS.index("free")
        spread = missed_variance(psi, plainly, noise, held)
        maps["sigma"] = np.full(light_field.shape[:4], np.sqrt(spread), dtype=np.float32)
    else:
        surface = light_field
        if settings.free:
            light_field = freed(psi, frames, typical, usable, surface, unexplained)
        sure = deviation(found, doubt, frames, noise, held)
        if sure is not None:
            # What total variation moved is in doubt by as much.
            moved = np.square(light_field - surface).mean(axis=-1)
            maps["sigma"] = np.sqrt(np.square(sure.sigma) + moved)
    tell(total)
    shares = np.bincount(maps["model"].ravel(), minlength=len(MODELS)) / maps["model"].size
    return Reconstruction(
        method="adaptive",
        light_field=light_field,
        status="doubtful" if judged else "converged",
        advice="; ".join(judged),
        steps=total,
        objective=(),
        seconds=clock() - started,
        parameters={
            "noise_sigma": typical,
            "lowest_px": float(found.centre.min()),
            "highest_px": float(found.centre.max()),
            "disparities": len(volume.disparities),
            "search_seconds": searched_s,
            "held_readings": int(held.sum()),
            **({} if explained is None else {"explained": explained}),
            **{
                f"share_{name.replace(' ', '_')}": float(v)
                for name, v in zip(MODELS, shares, strict=True)
            },
        },
        maps=maps,
        left_out=tuple(left_out),
    )


Needed = tuple[ImagingMatrix, Array, Array, TextureSettings]


def _needed(
    asked: Needed,
    volume: search.Volume,
    frames: Array,
    precision: Array,
    held: NDArray[np.bool_],
    nearer: int,
    settings: AdaptiveSettings,
) -> tuple[Needed, list[str]]:
    """Return what the whole scene needs of Psi, disparity, picture and steps, and what it does not.

    asked: what is taken if the scene needs all.
    """
    psi, centre, picture, texture = asked
    left_out = []
    pixels = psi.frames_shape[1:]
    plane = one_plane(volume, pixels)
    if plane is not None:
        bound = plane_bound_db(plane, volume, pixels, picture)
        kept = "one picture for all views" if plane.is_static else "one plane for the whole scene"
        left_out.append(f"relief: {kept} (at best {bound:.0f} dB)")
        centre = plane.over(psi.size, psi.binning)
        texture = texture.model_copy(update={"refine_steps": 0})
    if may_be_grey(picture):
        quick = texture.model_copy(update={"steps": TRIAL_STEPS, "refine_steps": 0})
        both = (psi, picture), (grey_psi(psi), picture.mean(axis=-1, keepdims=True))
        missed = []
        for seen, begun in both:
            found = solve(seen, centre, nearer, frames, precision, begun, quick, settings.layers)
            missed.append((frames - found.surfaces.forward(found.texture))[held])
        if not colour_is_needed(*missed):
            left_out.append(f"colour: one for all (at best {grey_bound_db(picture):.0f} dB)")
            psi, picture = both[1]
    return (psi, centre, picture, texture), left_out


def _explained(missed: Array, plain: Array, noise: Array, held: NDArray[np.bool_]) -> float | None:
    """Return the share of the plain residual's variance that held-out readings no longer miss.

    missed, plain: residuals of the scene found and of the smooth picture; noise: the readings'
    variance. None where the smooth picture explains the readings as well as their noise allows.
    """
    if not held.any():
        return None
    allowed = float(np.mean(noise[held]))
    before = float(np.mean(np.square(plain[held]))) - allowed
    if before <= 3 * allowed:
        return None
    return 1 - (float(np.mean(np.square(missed[held]))) - allowed) / before


def _judgement(
    settings: AdaptiveSettings, volume: search.Volume, explained: float | None
) -> list[str]:
    """Return what the user should know before trusting the result."""
    told = []
    textured = volume.kind > 0
    if textured.any():
        decided = float(volume.decisive[textured].mean())
        if decided < UNDECIDED:
            told.append(
                f"the evidence is flat: {1 - decided:.0%} of the textured patches prefer no "
                "disparity; use a mask that differs from view to view, or more shots"
            )
    if volume.at_end > search.WANTED:
        told.append(
            f"disparities reach the end of the search, {settings.furthest_px:g} px: raise "
            "furthest_px"
        )
    if explained is not None and explained < EXPLAINED:
        told.append(
            f"only {explained:.0%} of what readings kept from the fit show is explained: Psi may "
            "not be theirs, or the scene is hardly made of surfaces"
        )
    return told
