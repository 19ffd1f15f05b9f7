"""The method `tv`: least total variation over space and angle that explains the frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from reconstruction.method import Given, Method, Sensitivity
from reconstruction.result import Reconstruction
from reconstruction.tv import TVSettings, reconstruct_tv

if TYPE_CHECKING:
    from reconstruction.methods import MethodSettings


def _solve(given: Given, settings: MethodSettings) -> Reconstruction:
    return reconstruct_tv(
        given.psi, given.frames, given.typical_noise, settings.tv, given.usable, given.on_step,
        clock=given.clock,
    )  # fmt: skip


METHODS = (
    Method(
        "tv",
        "4D total variation DV_1 (opponent colours), exact data step",
        "surfaces of even colour; edges rare in space and angle",
        "per step 2 x 4N + 2 x 16N + s 4N/3 bytes, 60-150 steps",
        "first look; two and more shots; no dictionary at hand",
        _solve,
        "tv",
        TVSettings,
        sensitivity=Sensitivity(psi=1.0, bad_pixels=2.0),
    ),
)
