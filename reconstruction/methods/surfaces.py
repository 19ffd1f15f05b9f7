"""The methods `adaptive...`: surfaces by evidence, and their texture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.method import (
    reconstruct_adaptive,
    reconstruct_moving,
    reconstruct_next,
)
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings, fast
from emmc_rig.reconstruction.dictionary import lambertian_dictionary, planes_of_scene, usual_patch
from emmc_rig.reconstruction.method import Given, Method, ShippedSettings, cost_words
from emmc_rig.reconstruction.methods.variational import solve_tv_dict
from emmc_rig.reconstruction.result import Reconstruction
from emmc_rig.reconstruction.sparse import SparseSettings

Array = NDArray[np.floating]
PATCH_RTOL, PATCH_STEPS = 1e-2, 100
"""Of the patches beside surfaces. On 64x80 middles with three shots those of `tv-dict` itself cost
buttercup 1.1 times the time for 0.00 dB, begonia several times for less than 0.1 dB; 30 steps cost
begonia 0.3 dB. A stride of 5 for patches of 6 costs buttercup 0.5 dB, three shots."""
PATCH_TV_RTOL = 1e-3
"""Of total variation drawn towards them. 3e-4 gains 0.00 dB (antinous -0.07), group A, three shots;
3e-3 costs 0.01 dB, and antinous 0.1."""


def patch_of(psi: Psi) -> tuple[int, int]:
    """Return rows and columns of the patches that `adaptive` averages with."""
    return usual_patch(psi.binning, psi.shots, psi.views)


def sparse_patches(settings: SparseSettings, psi: Psi) -> SparseSettings:
    """Return the settings of the patches that `adaptive` averages with.

    Patches lie at most two thirds of their width apart, cut no pixel, and are less exact.
    """
    binning, side = psi.binning, patch_of(psi)[0]
    stride = max(min(settings.stride, -(-2 * side // 3)) // binning * binning, binning)
    exact = {"rtol": PATCH_RTOL, "max_steps": PATCH_STEPS}
    solver = settings.solver.model_copy(update=exact)
    return settings.model_copy(update={"stride": stride, "solver": solver})


def patches_fit(psi: Psi, settings: AdaptiveSettings) -> bool:
    """Return whether `adaptive` may average with sparse patches: if one fits."""
    return settings.patches is not None and min(psi.size) >= max(
        usual_patch(psi.binning, psi.shots)
    )


def _patches(psi: Psi, settings: ShippedSettings) -> SparseSettings | None:
    """Return the patches that `adaptive` averages with whatever the scene: from so many shots."""
    adaptive = settings.adaptive
    if not (patches_fit(psi, adaptive) and adaptive.uses_patches(psi.shots)):
        return None
    return sparse_patches(settings.sparse, psi)


_dictionary = lru_cache(maxsize=1)(lambertian_dictionary)


def _solve(
    name: str,
    chosen: Callable[[AdaptiveSettings], AdaptiveSettings],
    given: Given,
    settings: ShippedSettings,
) -> Reconstruction:
    """Return the light field of a capture, or of a film's next frame.

    chosen: makes the method's settings from those of `adaptive`. From two shots on, or where
    surfaces fail, `adaptive` averages with sparse patches, fitted on demand.
    """
    adaptive, psi = chosen(settings.adaptive), given.psi
    present = given.of_first_shot() if given.moving else given

    def patches(usable: NDArray[np.bool_], disparity: Array) -> NDArray[np.float32]:
        """Return the light field of `tv-dict`, less exact, from some of the readings."""
        shape = psi.light_field_shape[:2], patch_of(present.psi)
        atoms = _dictionary(*shape, planes_of_scene(*shape, disparity))
        frames = dataclasses.replace(present.frames, usable=usable)
        fitted = dataclasses.replace(present, frames=frames, dictionary=atoms, on_step=None)
        sparse = sparse_patches(settings.sparse, present.psi)
        tv: dict[str, float] = {"objective_every": settings.tv.max_steps + 1}
        if "rtol" not in settings.tv.model_fields_set:  # Blocks set it, to take equal steps.
            tv["rtol"] = PATCH_TV_RTOL
        coarse = settings.tv.model_copy(update=tv)
        quick = settings.model_copy(update={"sparse": sparse, "tv": coarse})
        return solve_tv_dict(fitted, quick).light_field

    film, solved = given.film, None
    fitting = patches if patches_fit(present.psi, adaptive) else None
    if given.moving:
        solved = reconstruct_moving(psi, given.frames, adaptive, given.on_step, fitting)
    elif film is not None and film.known is not None:
        solved = reconstruct_next(psi, given.frames, film, adaptive, given.on_step)
    if not isinstance(solved, Reconstruction):  # the first frame, or a cut of the film
        solved = reconstruct_adaptive(
            psi,
            given.frames,
            adaptive,
            given.on_step,
            patches=fitting,
            film=film if solved is None else solved,
        )
    return dataclasses.replace(solved, method=name)


METHODS = (
    Method(
        "adaptive",
        "surfaces: disparity by comparing patches, then texture; averaged with TV + dictionary "
        "from two shots on",
        "the scene consists of opaque surfaces that look the same from all views; from two shots "
        "on, that or what `tv-dict` assumes, each where it holds",
        cost_words(0.48, 1.2),
        "any scene and number of shots; gives disparity and standard deviation; the default",
        partial(_solve, "adaptive", lambda settings: settings),
        "adaptive",
        AdaptiveSettings,
        films=True,
        factor=3.5,
        scout="adaptive-fast",
        patches=_patches,
    ),
    Method(
        "adaptive-fast",
        "as adaptive, with fewer patches, disparities and steps",
        "as adaptive",
        cost_words(0.26, 0.53),
        "previews; from one shot still more accurate than tv",
        partial(_solve, "adaptive-fast", fast),
        "adaptive",
        AdaptiveSettings,
        films=True,
        factor=1.0,
        scout="adaptive-fast",
    ),
)
