"""Several models of one scene, fitted to the frames, and their mean by held-out readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_views
from emmc_rig.reconstruction.adaptive import mixture, search
from emmc_rig.reconstruction.adaptive.joint import FittedScene, solve
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.refine import Seen
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import Plain, Survey, surfaces_fail
from emmc_rig.reconstruction.adaptive.sweep import swept
from emmc_rig.reconstruction.adaptive.times import OtherTime
from emmc_rig.reconstruction.adaptive.uncertainty import (
    blur_views,
    features,
    stated,
    variance_of_mean,
)

Array = NDArray[np.floating]
Patches = Callable[[NDArray[np.bool_], Array], Array]
"""Returns a light field (v, u, y, x, c) of sparse patches to average with in place of total
variation's, given which readings to fit, (shot, pixel_y, pixel_x), and the centre view's disparity,
(y, x)."""


@dataclass(frozen=True, eq=False)
class Fits:
    """The models of surfaces, and last one without: sparse patches or total variation.

    Attributes:
        light_fields: of each model, (v, u, y, x, c), as `mixture.stored`.
        residuals: of each model, frames less what it predicts, (shot, pixel_y, pixel_x).
        scene: the last fit of surfaces and texture, at the survey's scale.
        with_patches: whether the last model is patches.
        understated: ratio of the variance of these models' mean to what their spread says of it,
            over that ratio for a capture's models.
        centres: disparity of each model of surfaces, (y, x); empty if one serves for all.
    """

    light_fields: list[NDArray[np.uint16]]
    residuals: list[Array]
    scene: FittedScene
    with_patches: bool
    understated: float = 1.0
    centres: list[Array] = field(default_factory=list)


class PlannedFit(NamedTuple):
    """A fit of surfaces to make.

    Attributes:
        beliefs: about disparities, of a search.
        centre: disparity of the centre view to begin with, (y, x).
        misfit: deviation of readings that no texture explains.
        sweeps: whether the disparity is searched again with the texture.
    """

    beliefs: search.Volume
    centre: Array
    misfit: float
    sweeps: bool


def _planned(
    survey: Survey, settings: AdaptiveSettings, second: search.Volume | None
) -> list[PlannedFit]:
    """Return the fits of surfaces: a fit for each misfit, or a fit for each of two searches.

    All but the last sweep the disparity (`sweep`); where the sweep goes wrong, the last fit, which
    keeps the patches' disparities, predicts held-out readings better. Of two searches both fits
    sweep and have the first misfit: closer fits follow the errors of wide disparities (0.01 dB
    worse on 12 crops).
    """
    first = settings.misfits[0]
    if second is not None:
        psi = survey.given.psi
        centre = search.per_pixel(second, psi.size, psi.binning)
        return [
            PlannedFit(second, centre, first, True),
            PlannedFit(survey.volume, survey.centre, first, True),
        ]
    last = len(settings.misfits) - 1
    return [
        PlannedFit(survey.volume, survey.centre, misfit, number < last)
        for number, misfit in enumerate(settings.misfits)
    ]


def fitted_models(
    survey: Survey,
    settings: AdaptiveSettings,
    on_step: Callable[[int], None],
    patches: Patches | None = None,
    second: search.Volume | None = None,
    others: Sequence[OtherTime] = (),
    carried: Array | None = None,
) -> Fits:
    """Return the fits of surfaces that are planned (`_planned`), and a model without surfaces.

    Fits of the same disparities share the first steps: there the texture presumed is so uncertain
    that the misfit matters little. The scene returned is of the first search: of a disperser
    (smem/fern_root, a capture by others) the second predicts readings better with bands 0.9 px
    apart, which the prism puts 2 px apart.

    on_step: called with the number of steps done. second: beliefs of a second search. others:
    frames of other times. carried: disparity of the frame before, which the last fit begins with.
    """
    given, bright, held = survey.given, survey.bright, survey.held
    scale, first = np.float32(survey.scale), settings.misfits[0]
    used = replace(bright, usable=given.usable & ~held)
    nearer = 1 if settings.nearer == "larger" else -1
    light_fields, residuals, scene, begun = [], [], None, None
    plan = _planned(survey, settings, second)
    if carried is not None:
        plan[-1] = plan[-1]._replace(centre=carried, sweeps=False)
    centres = []
    for number, planned in enumerate(plan):
        # One layout of rays at a time: it is as large as the light field.
        scene = None
        done, misfit = number * settings.texture.steps, planned.misfit

        def again(texture: Array, surfaces: Surfaces, beliefs: search.Volume) -> Array:
            found = swept(beliefs, used, texture, surfaces, settings)
            return search.per_pixel(found, given.psi.size, given.psi.binning)

        def seen_by_others(
            padded: Array, margin: int, texture: Array, misfit: float = misfit
        ) -> list[Seen]:
            at = padded, margin, texture, nearer, misfit, misfit / first
            return [other.seen(*at) for other in others]

        scene = solve(
            given.psi,
            planned.centre,
            nearer,
            bright.frames,
            bright.precision(held, misfit),
            survey.picture,
            settings.texture,
            on_step=lambda step, done=done: on_step(done + step),
            again=partial(again, beliefs=planned.beliefs) if planned.sweeps else None,
            begun=begun,
            others=seen_by_others,
        )
        begun = scene.begun if second is None and carried is None else None
        centres.append(scene.centre)
        residuals.append(scale * (bright.frames - scene.surfaces.forward(scene.texture)))
        scene.surfaces.release()
        seen = scene.surfaces.light_field(scale * scene.texture)
        light_fields.append(mixture.stored(np.clip(seen, 0, 1, out=seen)))
    assert scene is not None
    enough = settings.uses_patches(given.psi.shots)
    patched = patches is not None and (enough or surfaces_fail(survey, residuals))
    if patches is not None and patched:
        seen = patches(given.usable & ~held, scene.centre)
        light_fields.append(mixture.stored(seen))
        residuals.append(given.frames - given.psi.forward(seen))
    else:
        light_fields.append(survey.plain)
        residuals.append(survey.plain_residual)
    return Fits(
        light_fields, residuals, scene, patched, centres=centres if carried is not None else []
    )


@dataclass(frozen=True, eq=False)
class Mean:
    """The mean of models.

    Attributes:
        light_field: (v, u, y, x, c).
        shares: weights of the models, (model, pixel_y, pixel_x).
        sigma: standard deviation, (v, u, y, x); None with too few held-out readings.
        over_plain: mean square residual of the held-out readings beyond their noise, over total
            variation's; None without any.
        reported: figures that the result reports.
    """

    light_field: Array
    shares: NDArray[np.float32]
    sigma: Array | None
    over_plain: float | None = None
    reported: dict[str, float] = field(default_factory=dict)


def averaged(survey: Plain, fits: Fits, disparity_sigma: Array) -> Mean:
    """Return the mean of the models, by the held-out readings; the first model without any.

    disparity_sigma: deviation of the centre view's disparity, (y, x).

    Their light fields are given back: the following steps need as much memory, but no model.
    """
    given, held = survey.given, survey.held
    if held.any():
        rule = mixture.beside_patches if fits.with_patches else mixture.shares_of
        shares = rule(fits.residuals, given.noise, held)
    else:
        shares = np.zeros((len(fits.residuals), *held.shape[1:]), dtype=np.float32)
        shares[0] = 1
    models = fits.light_fields, shares, given.psi.binning, survey.plain
    light_field, spread_by_sample, apart = mixture.averaged(*models)
    fits.light_fields.clear()
    spread = float(spread_by_sample.mean(dtype=np.float64))
    if not held.any():
        return Mean(light_field, shares, None)
    residual = np.asarray(sum(s * missed for s, missed in zip(shares, fits.residuals, strict=True)))
    excess, its_own = (
        mixture.excess(missed, given.noise, held) for missed in (residual, survey.plain_residual)
    )
    over_plain = excess / max(its_own, 1e-20)
    variance = variance_of_mean(
        fits.scene, survey.scale, spread_by_sample, residual, given.noise, held
    )
    if variance is None:
        return Mean(light_field, shares, None, over_plain)
    blur_views(apart)
    # The residuals, on which it is calibrated, show neither.
    _add(variance, survey.unseen, over_plain / (1 + over_plain), apart)
    of_samples = float(variance.mean(dtype=np.float64))
    between = float(apart.mean(dtype=np.float64))
    of = features(of_samples, between, spread, disparity_sigma, light_field)
    times, reported = stated(of)
    variance *= times * fits.understated
    return Mean(light_field, shares, np.sqrt(variance, out=variance), over_plain, reported)


def _add(variance: Array, unseen: Array, part: float, apart: Array) -> None:
    """Add to a variance (v, u, y, x) the variance `unseen` (y, x) and part * apart (v, u, y, x)."""
    unseen, share = unseen.astype(np.float32), np.float32(part)

    def work(at: tuple[int, int]) -> None:
        variance[at] += unseen + share * apart[at]

    in_views(work, variance.shape[:2])
