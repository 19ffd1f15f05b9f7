"""The adaptive method: disparities by evidence, then the texture of the surfaces they make.

Edges that views do not reach are told from the scene first (`edges`).

1. Patches judge disparities by the likelihood of their readings (`evidence`, `search`), and agree
   with their neighbours (`labels`).
2. If the whole scene needs no more than one plane, or no colour, it gets no more (`parsimony`).
3. The centre view's disparity is carried to all views (`visibility`), so that the frames are
   linear in the surfaces' texture (`rays`).
4. The texture is fitted to all frames at once, from total variation's centre view, with what
   repeats in the scene as prior, and the disparity is sharpened per pixel on the way (`joint`,
   `texture`, `shrinkage`, `refine`). All fits but the last sweep planes with their texture for a
   new disparity (`sweep`): where that leads astray the last one, which keeps what the patches
   agreed on, predicts held-out readings better.
5. Textures that follow the readings more or less closely, and total variation, are averaged by
   how well they predict readings kept from all of them (`mixture`).
6. What is still missed is a light field of its own, if those readings speak for it (`rest`).

Nothing is trained: a mask, sensor or number of shots enters through Psi alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from reconstruction.adaptive import search
from reconstruction.adaptive.edges import dark_edges, faded
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.adaptive.joint import TextureSettings, solve
from reconstruction.adaptive.mixture import mean_deviation, mean_light_field, weighted
from reconstruction.adaptive.models import MODELS, model_map, texture_map
from reconstruction.adaptive.parsimony import (
    Plane,
    colour_is_needed,
    grey_bound_db,
    grey_psi,
    may_be_grey,
    one_plane,
    plane_bound_db,
)
from reconstruction.adaptive.rest import UNEXPLAINED, misfit_of, rest
from reconstruction.adaptive.sweep import swept
from reconstruction.adaptive.uncertainty import deviation, held_out, plain_deviation
from reconstruction.choices import darkness, smooth_guess
from reconstruction.errors import ReconstructionError
from reconstruction.flat import FlatPsi, flat_psi
from reconstruction.inputs import checked_inputs, checked_noise
from reconstruction.result import Progress, Reconstruction, Status
from reconstruction.tv import TVSettings, reconstruct_tv
from reconstruction.verdict.shadow import Shadow, relief, shadow

Array = NDArray[np.floating]
UNDECIDED = 0.25
"""Share of deciding patches among the textured ones below which the evidence is called flat."""
COARSE_PX = 8.0, 2.0
"""Correlation lengths of the textures that the coarse search judges."""
DIM, TINY = 0.25, 1e-12
"""Mean brightness below which a scene is reconstructed as if it were so bright: what the settings
call noise and doubt are shares of a picture of order 1. 0.1 costs 0.03 dB on buttercup and 0.13 on
occlusions (160x160, one shot, means of 0.13 and 0.17). And the least that is told from none."""
MOSTLY = 0.5
"""Share of the picture beyond which what surfaces do not explain is told."""
TRIAL_STEPS = 4
"""Of the fits, with colour and without, that tell whether the scene has any."""
FAR_OFF = 8.0
"""Times their noise that readings are missed by beyond which the result is doubted. Without noise
one shot of the fish is missed by 4 times it, eight of deep-occlusions without a rest by 7."""
SHADOW = 0.7
"""Strength of the masks' shadow in the readings, as a share of what Psi says, below which Psi is
called another's: at least 0.93 on clean captures, 0 to 0.25 with masks 4 samples off."""


Length = Annotated[float, Field(gt=0)]


class AdaptiveSettings(Settings):
    """Settings of the adaptive method."""

    furthest_px: float = Field(
        default=24.0, gt=0, description="largest disparity searched, to both sides"
    )
    step_px: float = Field(default=0.125, gt=0, description="between disparities judged")
    stride: int = Field(default=4, ge=1, description="pixels between patches that judge")
    lengths_px: tuple[Length, ...] = Field(
        default=(3.0, 1.5), min_length=1, description="over which textures may be alike, to judge"
    )
    slope_px: float = Field(
        default=0.04, gt=0, description="mean change of the disparity per pixel on one surface"
    )
    jump: float = Field(
        default=0.05, gt=0, lt=1, description="probability that neighbouring patches differ freely"
    )
    freedom: float = Field(
        default=3.0, gt=0, description="of the Student t of the readings; large: Gaussian"
    )
    layers: bool = Field(
        default=True, description="give what the centre view does not see a texture of its own"
    )
    misfit: float = Field(
        default=0.004, gt=0, description="deviation of readings that no disparity explains"
    )
    misfits: tuple[Length, ...] = Field(
        default=(0.004, 0.0015), min_length=1, description="and no texture, of each one fitted"
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
        default=True, description="average with total variation where it explains the frames"
    )
    rest: bool = Field(
        default=True, description="add what is missed, where readings kept from all speak for it"
    )
    edges: tuple[Literal["top", "bottom", "left", "right"], ...] = Field(
        default=("top", "bottom", "left", "right"),
        description="sides that may be dark because views do not reach them",
    )
    brightness: float | None = Field(
        default=None, gt=0, description="mean of the scene that this is a part of; None: its own"
    )
    plane: tuple[float, float, float] | None = Field(
        default=None,
        description="disparity, where parsimony is asked for and it is known to be one plane: in "
        "the middle, px, and its change per pixel down and right",
    )


def fast(settings: AdaptiveSettings) -> AdaptiveSettings:
    """Return the settings of `adaptive-fast`: coarser patches of one texture, fewer steps."""
    quick = settings.texture.model_copy(
        update={"steps": 6, "refine_steps": 2, "block_step": 6, "sweeps": ()}
    )
    coarser = {"step_px": 0.25, "stride": 8, "lengths_px": (2.0,)}
    fewer = {"start_steps": settings.start_steps // 3 or 1, "texture": quick}
    return settings.model_copy(update=coarser | fewer)


def reconstruct_adaptive(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float | Array,
    settings: AdaptiveSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    disparity: Array | None = None,
) -> Reconstruction:
    """Return the light field of the surfaces and textures that the frames speak for.

    frames: (shot, pixel_y, pixel_x) normalised readings. noise_sigma: their standard deviation,
    one or of each. usable: pixels to fit (default all). disparity: of the centre view (y, x), where
    it is known, in place of the one searched. Raises ReconstructionError for inputs that do not
    fit each other.
    """
    settings = settings or AdaptiveSettings()
    started = clock()
    typical, noise = checked_noise(psi, noise_sigma, usable)
    frames, usable = checked_inputs(psi, frames, typical, usable)
    disparity = None if disparity is None else _known(disparity, psi)
    total = len(settings.misfits) * settings.texture.steps + 3

    def tell(step: int) -> None:
        if on_step is not None:
            on_step(Progress(step, None, None, total))

    given = Given(psi, frames, typical, noise, usable).over(darkness(psi), of_psi=True)
    flat = flat_psi(given.psi)
    edges = dark_edges(flat, given.frames, usable, settings.edges)
    if edges is not None:
        all_usable, usable = usable, usable & ~edges.within
        given = replace(given, usable=usable)
    picture = np.asarray(smooth_guess(flat, given.frames, usable), dtype=np.float32)
    brightness = settings.brightness or float(picture.mean())
    scale = min(1.0, max(brightness, TINY) / DIM)
    bright = given.over(scale)
    data = _unexplained_by(picture / np.float32(scale), flat, bright, settings)
    volume = _searched(data, settings, lambda: tell(1))
    k = psi.binning
    centre = search.per_pixel(volume, psi.size, k) if disparity is None else disparity
    searched_s = clock() - started
    tell(2)
    held = held_out(usable)
    # Total variation is what surfaces must beat on the readings kept from both, and their begin.
    start = TVSettings(max_steps=settings.start_steps, objective_every=settings.start_steps + 1)
    plain = reconstruct_tv(given.psi, given.frames, given.typical, start, usable & ~held)
    precision = _precision(bright, held, settings.misfits[-1])
    nearer = 1 if settings.nearer == "larger" else -1
    begun = centre_view(plain.light_field) / np.float32(scale)
    needed = Needed(given.psi, centre, begun, settings.texture)
    left_out = [] if edges is None else [edges.told]
    if settings.parsimony:
        needed, spared = _needed(needed, volume, bright.frames, precision, held, nearer, settings)
        left_out += spared

    def again(texture: Array, missed: Array, margin: int) -> Array:
        beliefs = swept(
            volume,
            needed.psi,
            bright.frames,
            bright.noise,
            usable & ~held,
            texture,
            missed,
            margin,
            settings.slope_px,
            settings.jump,
        )
        return search.per_pixel(beliefs, psi.size, k)

    light_fields, misses = [], []
    for fit, misfit in enumerate(settings.misfits):
        # One layout of rays at a time: it is as large as the light field.
        found = None
        done = 2 + fit * settings.texture.steps
        found = solve(
            needed.psi,
            needed.centre,
            nearer,
            bright.frames,
            _precision(bright, held, misfit),
            needed.picture,
            needed.texture,
            settings.layers,
            on_step=lambda step, done=done: tell(done + step),
            again=again if fit < len(settings.misfits) - 1 else None,
        )
        seen = found.surfaces.light_field(found.texture) * np.float32(scale)
        light_fields.append(np.broadcast_to(np.clip(seen, 0, 1), psi.light_field_shape))
        misses.append(bright.frames - found.surfaces.forward(found.texture))
    assert found is not None
    missed = misses[-1]
    kinds = texture_map(volume, psi.size, k)
    doubt = search.variance_per_pixel(volume, psi.size, k)
    maps = {
        "disparity": found.centre,
        "disparity_sigma": np.sqrt(doubt),
        "texture": kinds,
        "hidden": found.surfaces.hidden.mean(axis=(0, 1), dtype=np.float32),
        "model": model_map(kinds, found),
    }
    explained = _explained(missed, data.readings, bright.noise, held)
    masks = shadow(relief(given.psi, given.frames, given.typical, usable))
    decided = _decided(volume)
    judged = _judgement(settings, volume, decided, masks)
    sure = deviation(found, doubt, bright.frames, bright.noise, held)
    sigmas: list[Array | float] = (
        [] if sure is None else [sure.sigma * np.float32(scale)] * len(misses)
    )
    if settings.free:
        plain_missed = given.frames - given.psi.forward(plain.light_field)
        light_fields.append(plain.light_field)
        misses.append(plain_missed / np.float32(scale))
    light_field = light_fields[0]
    if held.any():
        share = weighted(misses, bright.noise, held)
        light_field = mean_light_field(light_fields, share.shares, k)
        if settings.free:
            free = share.shares[-1]
            sigmas.append(plain_deviation(given.psi, plain_missed, given.noise, held, free))
            maps["model"][free.repeat(k, axis=0).repeat(k, axis=1) > MOSTLY] = MODELS.index("free")
            if np.mean(free > MOSTLY) > MOSTLY:
                judged.append(
                    "readings kept from the fit speak against surfaces in "
                    f"{np.mean(free > MOSTLY):.0%} of the picture, where total variation is "
                    "returned: take more shots"
                )
        if sure is not None:
            sigma = mean_deviation(sigmas, share, misses, k)
    fitted = usable & ~held
    left = (given.frames - given.psi.forward(light_field)).astype(np.float32)
    unexplained = misfit_of(left, given.noise, fitted)
    if settings.rest and unexplained.times > UNEXPLAINED:
        more = rest(
            given.psi,
            bright.frames,
            left / np.float32(scale),
            bright.typical,
            fitted,
            held,
            settings.start_steps,
        )
        if more is not None:
            light_field = np.clip(light_field + np.float32(scale) * more, 0, 1)
            left = (given.frames - given.psi.forward(light_field)).astype(np.float32)
            unexplained = misfit_of(left, given.noise, fitted)
    if unexplained.times > FAR_OFF:
        judged.append(
            f"readings are missed by {unexplained.times:.1f} times their noise, most about row "
            f"{unexplained.row}, column {unexplained.column}: take more shots, or see whether "
            "noise and Psi are right"
        )
    if edges is not None:
        light_field = faded(edges, given.psi, light_field, given.frames, all_usable)
    if sure is not None:
        maps["sigma"] = sigma
    tell(total)
    shares = np.bincount(maps["model"].ravel(), minlength=len(MODELS)) / maps["model"].size
    return Reconstruction(
        method="adaptive",
        light_field=light_field,
        status=Status.DOUBTFUL if judged else Status.CONVERGED,
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
            "at_end": volume.at_end,
            "misfit": unexplained.times,
            "misfit_row": float(unexplained.row),
            "misfit_column": float(unexplained.column),
            **({} if decided is None else {"decided": decided}),
            **({} if explained is None else {"explained": explained}),
            **{
                f"share_{name.replace(' ', '_')}": float(v)
                for name, v in zip(MODELS, shares, strict=True)
            },
        },
        maps=maps,
        left_out=tuple(left_out),
    )


@dataclass(frozen=True, eq=False)
class Given:
    """Psi, the frames, their typical deviation, the variance `noise` of each reading, and which are
    usable, all but Psi (shot, pixel_y, pixel_x)."""

    psi: ImagingMatrix
    frames: Array
    typical: float
    noise: Array
    usable: NDArray[np.bool_]

    def over(self, scale: float, of_psi: bool = False) -> Given:
        """Return the same with readings divided by a scale: of a scene, or of Psi, so much dimmer.

        Psi, frames and noise so many times larger are the same problem.
        """
        if scale == 1:
            return self
        part = self.frames.dtype.type(scale)
        psi = replace(self.psi, weights=self.psi.weights / part) if of_psi else self.psi
        noise = (self.noise / scale**2).astype(np.float32)
        return Given(psi, self.frames / part, self.typical / scale, noise, self.usable)


def _precision(given: Given, held: NDArray[np.bool_], misfit: float) -> Array:
    """Return the inverse variance of the readings fitted, 0 of the others."""
    variance = given.noise + np.float32(misfit**2)
    return np.where(given.usable & ~held, 1 / variance, 0).astype(np.float32)


def _known(disparity: Array, psi: ImagingMatrix) -> Array:
    """Return a disparity that is given, checked; raises ReconstructionError."""
    if disparity.shape != psi.size or not np.isfinite(disparity).all():
        raise ReconstructionError(
            f"a disparity of shape {disparity.shape} is given, Psi needs {psi.size}, all finite"
        )
    return np.asarray(disparity, dtype=np.float32)


def _unexplained_by(
    picture: Array, flat: FlatPsi, given: Given, settings: AdaptiveSettings
) -> search.Data:
    """Return what a smooth picture (y, x, c), the same in all views, leaves to be explained."""
    k = flat.binning
    grey = picture.mean(axis=-1)
    brightness = grey.reshape(grey.shape[0] // k, k, grey.shape[1] // k, k).mean(axis=(1, 3))
    variance = given.noise + np.float32(settings.misfit**2)
    left = (given.frames - flat.forward(picture)).astype(np.float32)
    return search.Data(given.psi, left, variance, given.usable, brightness)


def _searched(
    data: search.Data, settings: AdaptiveSettings, on_rough: Callable[[], None]
) -> search.Volume:
    """Return the disparities that patches and their neighbours agree on, coarse to fine."""
    coarse, fine = (
        TexturePrior(length, tuple(finer), freedom=settings.freedom)
        for length, *finer in (COARSE_PX, settings.lengths_px)
    )
    smooth = settings.slope_px, settings.jump
    rough = search.coarse(data, coarse, settings.furthest_px, *smooth)
    on_rough()
    return search.fine(data, fine, rough, settings.stride, settings.step_px, *smooth)


@dataclass(frozen=True, eq=False)
class Needed:
    """What is modelled: Psi, the centre view's disparity (y, x), the picture to begin with
    (y, x, c), and the steps of the fit."""

    psi: ImagingMatrix
    centre: Array
    picture: Array
    texture: TextureSettings


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
    psi, centre, picture, texture = asked.psi, asked.centre, asked.picture, asked.texture
    left_out = []
    pixels = psi.frames_shape[1:]
    plane = one_plane(volume, pixels) if settings.plane is None else Plane(*settings.plane)
    if plane is not None:
        bound = plane_bound_db(plane, volume, pixels, picture)
        kept = "one picture for all views" if plane.is_static else "one plane for the whole scene"
        left_out.append(f"relief: {kept} (at best {bound:.0f} dB)")
        centre = plane.over(psi.size, psi.binning)
        texture = texture.model_copy(update={"refine_steps": 0, "sweeps": ()})
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
    return Needed(psi, centre, picture, texture), left_out


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
