"""Several models of one scene, fitted to the frames, and their mean by held-out readings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from reconstruction.adaptive import mixture, search
from reconstruction.adaptive.joint import FittedScene, solve
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.adaptive.survey import Survey
from reconstruction.adaptive.sweep import swept
from reconstruction.adaptive.uncertainty import apart, deviation, features, stated

Array = NDArray[np.floating]
Patches = Callable[[NDArray[np.bool_]], Array]
"""Returns a light field (v, u, y, x, c) of sparse patches to average with in place of total
variation's, given which readings to fit and the order in which its views lie."""


@dataclass(frozen=True, eq=False)
class Fits:
    """The models of surfaces, and last one without: sparse patches or total variation.

    light_fields: (v, u, y, x, c) of each; residuals: frames less what each predicts, (shot,
    pixel_y, pixel_x). scene: the last of surfaces and texture, at the survey's scale. patched:
    whether the last are patches.
    """

    light_fields: list[Array]
    residuals: list[Array]
    scene: FittedScene
    patched: bool


def fitted_models(
    survey: Survey,
    settings: AdaptiveSettings,
    on_step: Callable[[int], None],
    patches: Patches | None = None,
) -> Fits:
    """Return a fit of surfaces for each of `settings.misfits`, and one without any.

    All fits of surfaces but the last search the disparity again with their texture (`sweep`); where
    that leads astray the last one, which keeps what the patches agreed on, predicts held-out
    readings better. The first steps are those of the first fit: there the texture presumed is so
    uncertain that the misfit matters little. on_step: called with the number of steps done.
    """
    given, bright, held = survey.given, survey.bright, survey.held
    scale = np.float32(survey.scale)

    def again(texture: Array, residual: Array, margin: int) -> Array:
        beliefs = swept(
            survey.volume,
            given.psi,
            bright.frames,
            bright.noise,
            given.usable & ~held,
            texture,
            residual,
            margin,
            settings.slope_px,
            settings.jump,
        )
        return search.per_pixel(beliefs, given.psi.size, given.psi.binning)

    light_fields, residuals, scene, begun = [], [], None, None
    for fit, misfit in enumerate(settings.misfits):
        # One layout of rays at a time: it is as large as the light field.
        scene = None
        done = fit * settings.texture.steps
        scene = solve(
            given.psi,
            survey.centre,
            1 if settings.nearer == "larger" else -1,
            bright.frames,
            bright.precision(held, misfit),
            survey.picture,
            settings.texture,
            on_step=lambda step, done=done: on_step(done + step),
            again=again if fit < len(settings.misfits) - 1 else None,
            begun=begun,
        )
        begun = scene.begun
        residuals.append(scale * (bright.frames - scene.surfaces.forward(scene.texture)))
        scene.surfaces.release()
        seen = scene.surfaces.light_field(scale * scene.texture)
        light_fields.append(np.clip(seen, 0, 1, out=seen))
    assert scene is not None
    if patches is not None:
        light_fields.append(patches(given.usable & ~held))
    else:
        light_fields.append(survey.plain)
    residuals.append(given.frames - given.psi.forward(light_fields[-1]))
    return Fits(light_fields, residuals, scene, patches is not None)


@dataclass(frozen=True, eq=False)
class Mean:
    """light_field: (v, u, y, x, c). shares: of the models, (model, pixel_y, pixel_x). sigma: its
    standard deviation, None with too few held-out readings. over_plain: its mean square residual of
    these beyond their noise, over total variation's; None without any. reported: parameters of what
    is stated."""

    light_field: Array
    shares: NDArray[np.float32]
    sigma: Array | None
    over_plain: float | None = None
    reported: dict[str, float] = field(default_factory=dict)


def averaged(survey: Survey, fits: Fits, disparity_sigma: Array) -> Mean:
    """Return the mean of the models, by the held-out readings; the first model without any.

    disparity_sigma: deviation of the centre view's disparity, (y, x).

    Their light fields are given back: what follows needs as much memory, and none of them.
    """
    given, held = survey.given, survey.held
    if not held.any():
        shares = np.zeros((len(fits.residuals), *held.shape[1:]), dtype=np.float32)
        shares[0] = 1
        return Mean(fits.light_fields[0], shares, None)
    k = given.psi.binning
    rule = mixture.beside_patches if fits.patched else mixture.shares_of
    shares = rule(fits.residuals, given.noise, held)
    light_field = mixture.mean_light_field(fits.light_fields, shares, k)
    spread = mixture.spread(fits.light_fields, light_field, shares, k)
    fits.light_fields.clear()
    residual = np.asarray(sum(s * one for s, one in zip(shares, fits.residuals, strict=True)))
    sigma = deviation(fits.scene, survey.scale, spread, residual, given.noise, held)
    plain = (given.frames - given.psi.forward(survey.plain)).astype(np.float32)
    excess, its_own = (mixture.excess(one, given.noise, held) for one in (residual, plain))
    over_plain = excess / max(its_own, 1e-20)
    if sigma is None:
        return Mean(light_field, shares, None, over_plain)
    # The residuals, on which it is calibrated, show neither.
    variance = np.square(sigma) + survey.unseen.astype(np.float32)
    difference = apart(light_field, survey.plain)
    variance += np.float32(over_plain / (1 + over_plain)) * difference
    times, reported = stated(features(variance, difference, spread, disparity_sigma, light_field))
    variance *= times
    return Mean(light_field, shares, np.sqrt(variance, out=variance), over_plain, reported)
