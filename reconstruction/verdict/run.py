"""A reconstruction with its verdict: some readings are kept from the fit, and asked afterwards."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.result import Progress, Reconstruction
from reconstruction.verdict.evidence import gathered
from reconstruction.verdict.kept import kept_readings
from reconstruction.verdict.rules import Verdict, judged

Array = NDArray[np.floating]


def reconstruct_judged(
    name: str,
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
) -> tuple[Reconstruction, Verdict]:
    """Return what `reconstruct` finds, given the same, and whether to trust it.

    The light field is that of all readings but the few kept, which costs it next to nothing.
    """
    _, usable = checked_inputs(psi, frames, noise_sigma, usable)
    kept = kept_readings(usable)
    result = reconstruct(
        name, psi, frames, noise_sigma, dictionary, settings, usable & ~kept, on_step
    )
    return result, judged(gathered(psi, frames, noise_sigma, usable, kept, result))
