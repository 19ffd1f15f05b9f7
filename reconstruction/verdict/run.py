"""A reconstruction with its verdict: some readings are kept from the fit, and asked afterwards."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.result import Progress, Reconstruction
from reconstruction.screening import screened
from reconstruction.verdict.evidence import Read, gathered
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
    settings = settings or MethodSettings()
    fitted, usable = checked_inputs(psi, frames, noise_sigma, usable)
    told: tuple[str, ...] = ()
    left_out: tuple[int, ...] = ()
    saturated = ~usable
    if settings.screening:
        seen = screened(psi, fitted, usable)
        fitted, usable, told = seen.frames, seen.usable, seen.told
        left_out = tuple(sorted((*seen.dark, *seen.double)))
        settings = settings.model_copy(update={"screening": False})
    kept = kept_readings(usable)
    result = reconstruct(
        name, psi, fitted, noise_sigma, dictionary, settings, usable & ~kept, on_step
    )
    result = dataclasses.replace(result, screening=told)
    read = Read(fitted, usable, kept, np.where(saturated, frames, 0), left_out)
    return result, judged(gathered(psi, read, noise_sigma, result))
