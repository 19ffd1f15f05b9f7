"""The methods `adaptive...`: surfaces by evidence, and their texture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.settings import AdaptiveSettings, fast
from reconstruction.dictionary import Dictionary, lambertian_dictionary, usual_patch
from reconstruction.method import Given, Method, Sensitivity
from reconstruction.methods.variational import solve_tv_dict
from reconstruction.result import Reconstruction
from reconstruction.sparse import SparseSettings

if TYPE_CHECKING:
    from reconstruction.methods import MethodSettings

PATCH_RTOL, PATCH_STEPS = 1e-2, 100
"""Of the patches beside surfaces. On 64x80 middles with three shots those of `tv-dict` itself cost
buttercup 1.1 times the time for 0.00 dB, begonia several times for less than 0.1 dB; 30 steps cost
begonia 0.3 dB. A stride of 6 or 7, for 5, costs buttercup 0.7 and 0.4 dB, two shots."""


def sparse_patches(settings: SparseSettings, binning: int) -> SparseSettings:
    """Return the settings of the patches that `adaptive` averages with: they cut no pixel, and are
    less exact."""
    stride = max(settings.stride // binning * binning, binning)
    exact = {"rtol": PATCH_RTOL, "max_steps": PATCH_STEPS}
    solver = settings.solver.model_copy(update=exact)
    return settings.model_copy(update={"stride": stride, "solver": solver})


def may_take_patches(psi: ImagingMatrix, settings: AdaptiveSettings) -> bool:
    """Return whether `adaptive` may average with sparse patches: if one fits."""
    return settings.patches is not None and min(psi.size) >= max(usual_patch(psi.binning))


def takes_patches(psi: ImagingMatrix, settings: AdaptiveSettings) -> bool:
    """Return whether `adaptive` averages with sparse patches whatever the scene: from so many
    shots."""
    return may_take_patches(psi, settings) and settings.patched(psi.shots)


@lru_cache(maxsize=1)
def _dictionary(views: tuple[int, int], binning: int) -> Dictionary:
    return lambertian_dictionary(views, usual_patch(binning))


def _solve(
    name: str,
    chosen: Callable[[AdaptiveSettings], AdaptiveSettings],
    given: Given,
    settings: MethodSettings,
) -> Reconstruction:
    adaptive, psi = chosen(settings.adaptive), given.psi

    def patches(usable: NDArray[np.bool_]) -> NDArray[np.float32]:
        atoms = _dictionary(psi.light_field_shape[:2], psi.binning)
        fitted = dataclasses.replace(given, usable=usable, dictionary=atoms, on_step=None)
        sparse = sparse_patches(settings.sparse, psi.binning)
        unseen = settings.tv.model_copy(update={"objective_every": settings.tv.max_steps + 1})
        quick = settings.model_copy(update={"sparse": sparse, "tv": unseen})
        return solve_tv_dict(fitted, quick).light_field

    result = reconstruct_adaptive(
        psi, given.frames, given.noise_sigma, adaptive, given.usable, given.on_step,
        patches=patches if may_take_patches(psi, adaptive) else None,
    )  # fmt: skip
    return dataclasses.replace(result, method=name)


METHODS = (
    Method(
        "adaptive",
        "surfaces whose disparity the evidence of patches chooses, and their texture; averaged "
        "with sparse patches from two shots on",
        "what is seen lies on surfaces, alike from all views but where one hides another; from two "
        "shots on that or what `tv-dict` assumes, each where it holds",
        "p patches 81 m^2/2 (2 + l d) + l (d + 28) m^3/6 for d disparities, l texture lengths; "
        "2 x 8 x 12 x 32 N/6; 13 steps of tv; from two shots on that of tv-dict",
        "any number of shots; nothing to train; disparity and standard deviation wanted",
        partial(_solve, "adaptive", lambda settings: settings),
        "adaptive",
        AdaptiveSettings,
        sensitivity=Sensitivity(one_shot=True),
    ),
    Method(
        "adaptive-fast",
        "as adaptive: fewer patches and disparities, fewer steps",
        "as adaptive",
        "about a quarter of adaptive",
        "previews; still ahead of tv from one shot",
        partial(_solve, "adaptive-fast", fast),
        "adaptive",
        AdaptiveSettings,
        sensitivity=Sensitivity(one_shot=True),
    ),
)
