"""A reconstruction with its verdict: some readings are kept from the fit, and asked afterwards."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs, checked_noise
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.result import Progress, Reconstruction
from reconstruction.screening import screened
from reconstruction.verdict.evidence import Read, gathered
from reconstruction.verdict.kept import kept_readings
from reconstruction.verdict.rules import Verdict, verdict_from

Array = NDArray[np.floating]


def reconstruct_judged(
    name: str,
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float | Array,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
) -> tuple[Reconstruction, Verdict]:
    """Return what `reconstruct` finds, given the same, and whether to trust it.

    The light field is that of all readings but the few kept, which costs it next to nothing.
    """
    settings = settings or MethodSettings()
    typical, _ = checked_noise(psi, noise_sigma, usable)
    read, notes = _as_fitted(psi, frames, typical, usable, settings.screening)
    result = reconstruct(
        name,
        psi,
        read.frames,
        noise_sigma,
        dictionary,
        settings.model_copy(update={"screening": False}),
        read.usable & ~read.kept,
        on_step,
    )
    result = dataclasses.replace(result, screening=notes)
    return result, verdict_from(gathered(psi, read, typical, result))


def _as_fitted(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float,
    usable: NDArray[np.bool_] | None,
    screening: bool,
) -> tuple[Read, tuple[str, ...]]:
    """Return the frames as a method gets them, and what was done to them before, in words."""
    fitted, usable = checked_inputs(psi, frames, noise_sigma, usable)
    excluded = np.where(usable, 0, frames)
    if not screening:
        return Read(fitted, usable, kept_readings(usable), excluded), ()
    seen = screened(psi, fitted, usable)
    left_out = tuple(sorted((*seen.dark, *seen.double)))
    kept, bad = kept_readings(seen.usable), float(seen.bad.mean())
    return Read(seen.frames, seen.usable, kept, excluded, left_out, bad), seen.notes
