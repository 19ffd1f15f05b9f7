"""The methods `adaptive...`: surfaces by evidence, and their texture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.settings import AdaptiveSettings, fast
from reconstruction.method import Given, Method, Sensitivity
from reconstruction.methods import tv_dict
from reconstruction.result import Reconstruction

if TYPE_CHECKING:
    from reconstruction.methods import MethodSettings


def _solve(
    name: str,
    chosen: Callable[[AdaptiveSettings], AdaptiveSettings],
    given: Given,
    settings: MethodSettings,
) -> Reconstruction:
    result = reconstruct_adaptive(
        given.psi, given.frames, given.noise_sigma, chosen(settings.adaptive), given.usable,
        given.on_step, given.clock,
    )  # fmt: skip
    return dataclasses.replace(result, method=name)


def _with_patches(given: Given, settings: MethodSettings) -> Reconstruction:
    """Return what `adaptive` finds when it averages with `tv-dict`, too."""
    given.needed_dictionary("adaptive-dict")

    def patched(usable: NDArray[np.bool_]) -> NDArray[np.float32]:
        fitted = dataclasses.replace(given, usable=usable, on_step=None)
        return tv_dict.METHODS[0].solve(fitted, settings).light_field

    result = reconstruct_adaptive(
        given.psi, given.frames, given.noise_sigma, settings.adaptive, given.usable,
        given.on_step, given.clock, other=patched,
    )  # fmt: skip
    return dataclasses.replace(result, method="adaptive-dict")


METHODS = (
    Method(
        "adaptive",
        "surfaces whose disparity the evidence of patches chooses, and their texture",
        "what is seen lies on surfaces, alike from all views but where one hides another",
        "p patches 81 m^2/2 (2 + l d) + l (d + 28) m^3/6 for d disparities, l texture lengths; "
        "2 x 8 x 12 x 32 N/6; twice 40 steps of tv",
        "one shot; nothing to train; disparity and standard deviation wanted",
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
    Method(
        "adaptive-dict",
        "as adaptive, averaged with tv-dict by held-out readings",
        "what `adaptive` and `tv-dict` assume, each where it holds",
        "that of both",
        "two and more shots, where the best is wanted",
        _with_patches,
        "adaptive",
        AdaptiveSettings,
        needs_dictionary=True,
        sensitivity=Sensitivity(one_shot=True),
    ),
)
