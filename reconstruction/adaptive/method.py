"""The adaptive method: disparities by evidence, then the texture of the surfaces they make.

Edges that views do not reach are separated from the scene first (`edges`).

1. The disparity of a patch has a likelihood, given its readings (`evidence`, `search`), and
   patches agree with their neighbours (`labels`).
2. If the whole scene needs no more than one plane, or no colour, it gets no more (`parsimony`).
   These, and other decisions for the whole picture, are a `survey`.
3. The centre view's disparity is carried to all views (`visibility`), so that the frames are
   linear in the surfaces' texture (`rays`).
4. The texture is fitted to all frames at once, from total variation's centre view, with what
   repeats in the scene as prior, and the disparity is sharpened per pixel on the way (`joint`,
   `texture`, `shrinkage`, `refine`, `sweep`).
5. Textures that follow the readings more or less closely, and total variation or, from two shots
   on, sparse patches, are averaged by how well they predict readings kept from all of them (`fits`,
   `mixture`), which also calibrate the standard deviation of the result (`uncertainty`).
6. The residual is explained by a light field of its own, if those readings speak for it (`rest`).

Nothing is trained: a mask, sensor or number of shots enters through Psi alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.view_order import ViewOrder
from reconstruction.adaptive import search
from reconstruction.adaptive.edges import dark_edges, faded
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.adaptive.fits import Fits, Mean, Patches, averaged, fitted_models, with_rest
from reconstruction.adaptive.given import checked, checked_disparity
from reconstruction.adaptive.models import MODELS, model_map, texture_map
from reconstruction.adaptive.rest import Misfit, misfit_of
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.adaptive.survey import Survey, surveyed
from reconstruction.flat import flat_psi
from reconstruction.result import Progress, Reconstruction, Status
from reconstruction.verdict.shadow import relief, shadow

Array = NDArray[np.floating]
UNDECIDED = 0.25
"""Share of deciding patches among the textured ones below which the evidence is called flat."""
TEXTURED = 0.01
"""Variance of a patch's texture, over its squared brightness, from which it counts as textured. On
middles of group A (96x96, one CFA shot) 11 to 100 % of such patches decide, of weaker ones 0 to
25 %, whatever the mask: with them antinous was doubted."""
MOSTLY = 0.5
"""Share of the picture that total variation must explain better for a warning."""
FAR_OFF = 8.0
"""Root mean square residual over the noise beyond which the result is doubtful. Without noise one
shot of the fish reaches 4, eight of deep-occlusions without a rest 7."""
SHADOW = 0.7
"""Strength of the masks' shadow in the readings, as a share of what Psi says, below which Psi is
called another's: at least 0.93 on clean captures, 0 to 0.25 with masks 4 samples off."""


def reconstruct_adaptive(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float | Array,
    settings: AdaptiveSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    disparity: Array | None = None,
    patches: Patches | None = None,
) -> Reconstruction:
    """Return the light field of the surfaces and textures that the frames speak for.

    frames: (shot, pixel_y, pixel_x) normalised readings. noise_sigma: their standard deviation,
    one or of each. usable: pixels to fit (default all). disparity: of the centre view (y, x), where
    it is known, in place of the one searched. patches: see `Patches`.
    Raises ReconstructionError for inputs that do not fit each other.
    """
    settings = settings or AdaptiveSettings()
    started = clock()
    total = len(settings.misfits) * settings.texture.steps + 3
    searched_s = 0.0

    def report(step: int) -> None:
        nonlocal searched_s
        if step == 2:
            searched_s = clock() - started
        if on_step is not None:
            on_step(Progress(step, None, None, total))

    whole = given = checked(psi, frames, noise_sigma, usable)
    known = None if disparity is None else checked_disparity(disparity, psi)
    edges = dark_edges(flat_psi(given.psi), given.frames, given.usable, settings.edges)
    if edges is not None:
        given = replace(given, usable=given.usable & ~edges.within)
    survey = surveyed(given, settings, known, report)
    given = survey.given
    fits = fitted_models(survey, settings, lambda step: report(2 + step), patches)
    mean = averaged(survey, fits)
    light_field = (
        with_rest(survey, mean.light_field, settings) if settings.rest else (mean.light_field)
    )
    residual = (given.frames - given.psi.forward(light_field)).astype(np.float32)
    misfit = misfit_of(residual, given.noise, given.usable & ~survey.held)
    if edges is not None:
        light_field = faded(edges, given.psi, light_field, whole.frames, whole.usable)
    light_field = survey.order.named(light_field)
    maps = _maps(survey, fits, mean, settings)
    warnings = _warnings(survey, fits, mean, misfit, settings)
    report(total)
    shares = np.bincount(maps["model"].ravel(), minlength=len(MODELS)) / maps["model"].size
    decided, explained = _decided(survey.volume), _explained(survey, fits, settings)
    return Reconstruction(
        method="adaptive",
        light_field=light_field,
        status=Status.DOUBTFUL if warnings else Status.CONVERGED,
        advice="; ".join(warnings),
        steps=total,
        objective=(),
        seconds=clock() - started,
        parameters={
            "noise_sigma": whole.typical,
            "lowest_px": float(fits.scene.centre.min()),
            "highest_px": float(fits.scene.centre.max()),
            "disparities": len(survey.volume.disparities),
            "search_seconds": searched_s,
            "held_readings": int(survey.held.sum()),
            "at_end": survey.volume.at_end,
            "view_order": survey.order.number,
            "misfit": misfit.times,
            "misfit_row": float(misfit.row),
            "misfit_column": float(misfit.column),
            **({} if decided is None else {"decided": decided}),
            **({} if mean.over_plain is None else {"over_plain": mean.over_plain}),
            **({} if explained is None else {"explained": explained}),
            **{
                f"share_{name.replace(' ', '_')}": float(v)
                for name, v in zip(MODELS, shares, strict=True)
            },
        },
        maps=maps,
        left_out=(*([] if edges is None else [edges.description]), *survey.left_out),
    )


def _maps(survey: Survey, fits: Fits, mean: Mean, settings: AdaptiveSettings) -> dict[str, NDArray]:
    """Return the maps of a result, see `Reconstruction.maps`."""
    size, k = survey.given.psi.size, survey.given.psi.binning
    kinds = texture_map(survey.volume, size, k)
    models = model_map(kinds, fits.scene)
    if settings.free or fits.patched:
        models[_free(mean).repeat(k, axis=0).repeat(k, axis=1)] = MODELS.index("free")
    maps = {
        "disparity": fits.scene.centre,
        "disparity_sigma": np.sqrt(search.variance_per_pixel(survey.volume, size, k)),
        "texture": kinds,
        "hidden": fits.scene.surfaces.hidden.mean(axis=(0, 1), dtype=np.float32),
        "model": models,
    }
    if mean.sure is None:
        return maps
    return {**maps, "sigma": survey.order.named(mean.sure.sigma)}


def _free(mean: Mean) -> NDArray[np.bool_]:
    """Return the pixels (y, x) that are mostly no surfaces', the last of the models."""
    return mean.shares[-1] > MOSTLY


def _explained(survey: Survey, fits: Fits, settings: AdaptiveSettings) -> float | None:
    """Return the share of the smooth picture's residual that the last fit explains, in variance.

    Of the held-out readings, without their noise. None where the smooth picture explains them as
    well as their noise allows.
    """
    held = survey.held
    if not held.any():
        return None
    residual = fits.residuals[len(settings.misfits) - 1] / np.float32(survey.scale)
    allowed = float(np.mean(survey.bright.noise[held]))
    before = float(np.mean(np.square(survey.unexplained[held]))) - allowed
    if before <= 3 * allowed:
        return None
    return 1 - (float(np.mean(np.square(residual[held]))) - allowed) / before


def _decided(volume: search.Volume) -> float | None:
    """Return the share of the textured patches that prefer some disparity; None without any."""
    textured = np.array([size >= TEXTURED for size, _ in TexturePrior().kinds])[volume.kind]
    return float(volume.decisive[textured].mean()) if textured.any() else None


def _warnings(
    survey: Survey, fits: Fits, mean: Mean, misfit: Misfit, settings: AdaptiveSettings
) -> list[str]:
    """Return what the user should know before trusting the result."""
    given, volume, decided = survey.given, survey.volume, _decided(survey.volume)
    warnings = []
    if survey.order != ViewOrder.AS_NAMED:
        warnings.append(
            f"{survey.order.words}, says the parallax in the readings: see whether Psi names them "
            "right"
        )
    if decided is not None and decided < UNDECIDED:
        warnings.append(
            f"the evidence is flat: {1 - decided:.0%} of the textured patches prefer no "
            "disparity; use a mask that differs from view to view, or more shots"
        )
    if volume.at_end > search.WANTED:
        warnings.append(
            f"disparities reach the end of the search, {settings.furthest_px:g} px: raise "
            "furthest_px"
        )
    masks = shadow(relief(given.psi, given.frames, given.typical, given.usable))
    strengths = masks.strength[np.isfinite(masks.strength)]
    if strengths.size and float(strengths.min()) < SHADOW:
        warnings.append(
            f"the masks show in the readings at {max(float(strengths.min()), 0):.0%} of the "
            "strength that Psi says: Psi may not be theirs"
        )
    free = float(np.mean(_free(mean))) if settings.free and not fits.patched else 0.0
    if free > MOSTLY:
        warnings.append(
            f"held-out readings speak against surfaces in {free:.0%} of the picture, where total "
            "variation is returned: take more shots"
        )
    if misfit.times > FAR_OFF:
        warnings.append(
            f"the residual of the readings is {misfit.times:.1f} times their noise, most about row "
            f"{misfit.row}, column {misfit.column}: take more shots, or see whether noise and Psi "
            "are right"
        )
    return warnings
