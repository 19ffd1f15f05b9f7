"""The methods by name: what each assumes, what it costs, when to use it; and one call for all."""

from __future__ import annotations

import dataclasses
import difflib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from reconstruction import bpdn
from reconstruction.adaptive.method import AdaptiveSettings, fast, reconstruct_adaptive
from reconstruction.choices import choose_mu
from reconstruction.dictionary import Dictionary
from reconstruction.errors import ReconstructionError
from reconstruction.inputs import checked_inputs, checked_noise
from reconstruction.patch_term import PatchTerm
from reconstruction.result import Progress, Reconstruction
from reconstruction.screening import screened
from reconstruction.sparse import (
    PatchEstimates,
    SparseSettings,
    estimate_patches,
    reconstruct_sparse,
)
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]


class MethodSettings(Settings):
    """Settings of every method; each takes its own part.

    screening: whether frames are screened first, see `reconstruction.screening`.
    """

    screening: bool = True
    tv: TVSettings = Field(default_factory=TVSettings)
    sparse: SparseSettings = Field(default_factory=SparseSettings)
    adaptive: AdaptiveSettings = Field(default_factory=AdaptiveSettings)


PATCHED_MU, PATCHED_RHO = 3.0, 18.0
PATCH_AREA = 81
"""Of the patches for which the weights were fitted: 9 x 9."""


@dataclass(frozen=True)
class Method:
    """One way to reconstruct; `cost` in the letters of COSTS."""

    name: str
    title: str
    assumes: str
    cost: str
    when: str
    needs_dictionary: bool = False


COSTS = (
    "N values of the light field, s shots; p patches of q values and m readings, n atoms: "
    "building Psi D takes 2/3 p n q operations where pixels see one colour, 2 p n q else"
)
_BUILDING = "Psi D, then "
METHODS = {
    method.name: method
    for method in (
        Method(
            "tv",
            "4D total variation DV_1 (opponent colours), exact data step",
            "surfaces of even colour; edges rare in space and angle",
            "per step 2 x 4N + 2 x 16N + s 4N/3 bytes, 60-150 steps",
            "first look; two and more shots; no dictionary at hand",
        ),
        Method(
            "dict-admm",
            "sparse patches by ADMM with working sets (the paper's Dict-ADMM)",
            "patches are a few atoms of the dictionary",
            _BUILDING + "p (n m^2 + 4 n m x 30-100 passes) operations",
            "one shot with a dictionary of similar scenes",
            True,
        ),
        Method(
            "dict-lars",
            "sparse patches by the Lasso path (LARS)",
            "as dict-admm, and the same minimiser to rounding",
            _BUILDING + "p 2 n m operations a step, 1-3 steps an atom used",
            "exact minimiser wanted, or few atoms per patch",
            True,
        ),
        Method(
            "dict-omp",
            "sparse patches by orthogonal matching pursuit",
            "patches are at most `atoms` atoms",
            _BUILDING + "p 2 n m operations an atom",
            "quickest; coarse previews",
            True,
        ),
        Method(
            "dict-ista",
            "sparse patches by proximal gradient",
            "as dict-admm",
            _BUILDING + "p (n m^2 + 4 n m x thousands of steps) operations",
            "only to compare",
            True,
        ),
        Method(
            "dict-fista",
            "sparse patches by accelerated proximal gradient with restart",
            "as dict-admm",
            _BUILDING + "p (n m^2 + 4 n m x 500-5,000 steps) operations",
            "only to compare",
            True,
        ),
        Method(
            "dict-sl0",
            "sparse patches by smoothed l0 (as [18])",
            "patches are the fewest atoms that explain the frames",
            _BUILDING + "p (n m^2 + 4 n m x 50 passes) operations",
            "little noise; to compare with [18]",
            True,
        ),
        Method(
            "tv-dict",
            "DV_K drawn towards sparse patches (the paper's TV-Dict)",
            "what `tv` and `dict-admm` assume, each where it holds",
            "that of dict-admm, then that of tv with 4N bytes more a step",
            "the best of the paper's, from any number of shots",
            True,
        ),
        Method(
            "adaptive",
            "surfaces whose disparity the evidence of patches chooses, and their texture",
            "what is seen lies on surfaces, alike from all views but where one hides another",
            "p patches 81 m^2/2 (2 + l d) + l (d + 28) m^3/6 for d disparities, l texture lengths; "
            "2 x 8 x 12 x 32 N/6; twice 40 steps of tv",
            "one shot; nothing to train; disparity and standard deviation wanted",
        ),
        Method(
            "adaptive-fast",
            "as adaptive: fewer patches and disparities, fewer steps",
            "as adaptive",
            "about a quarter of adaptive",
            "previews; still ahead of tv from one shot",
        ),
    )
}


DEFAULT_METHOD = "adaptive"
"""Of every command: from one shot and without training ahead of the others on every scene measured
with it (`emmc-rig chart --guard`)."""


def find_method(name: str) -> Method:
    """Return a method by name; raises ReconstructionError naming the nearest."""
    if name in METHODS:
        return METHODS[name]
    near = difflib.get_close_matches(name, METHODS, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise ReconstructionError(f"no method '{name}': {hint}known are {', '.join(METHODS)}")


def reconstruct(
    name: str,
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float | Array,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    estimates: PatchEstimates | None = None,
) -> Reconstruction:
    """Return the light field that the method called `name` finds.

    frames: (shot, pixel_y, pixel_x) normalised readings. noise_sigma: their standard deviation,
    one or of each (known: estimated from a reading it would favour those that noise made small);
    methods that take one take the root mean square. usable: pixels to fit (default all).
    estimates: what `estimate_patches` found from the same inputs, for `dict-admm` and `tv-dict` to
    go on from. Raises ReconstructionError for a method that is not known, a dictionary
    that is missing, and inputs that do not fit each other.
    """
    method = find_method(name)
    settings = settings or MethodSettings()
    if settings.screening:
        started = clock()
        typical, _ = checked_noise(psi, noise_sigma, usable)
        frames, usable = checked_inputs(psi, frames, typical, usable)
        seen = screened(psi, frames, usable)
        took = clock() - started
        result = _solved(
            method, psi, seen.frames, noise_sigma, dictionary, settings, seen.usable, on_step,
            clock, estimates,
        )  # fmt: skip
        return dataclasses.replace(result, seconds=result.seconds + took, screening=seen.told)
    return _solved(
        method, psi, frames, noise_sigma, dictionary, settings, usable, on_step, clock, estimates
    )


def _solved(
    method: Method,
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float | Array,
    dictionary: Dictionary | None,
    settings: MethodSettings,
    usable: NDArray[np.bool_] | None,
    on_step: Callable[[Progress], None] | None,
    clock: Callable[[], float],
    estimates: PatchEstimates | None,
) -> Reconstruction:
    name = method.name
    if name.startswith("adaptive"):
        chosen = fast(settings.adaptive) if name == "adaptive-fast" else settings.adaptive
        result = reconstruct_adaptive(psi, frames, noise_sigma, chosen, usable, on_step, clock)
        return dataclasses.replace(result, method=name)
    noise_sigma, _ = checked_noise(psi, noise_sigma, usable)
    if not method.needs_dictionary:
        return reconstruct_tv(psi, frames, noise_sigma, settings.tv, usable, on_step, clock=clock)
    if dictionary is None:
        raise ReconstructionError(
            f"'{name}' needs a dictionary: `emmc-rig train` makes one, --dictionary names it"
        )
    if name == "tv-dict":
        return _tv_dict(
            psi, frames, noise_sigma, dictionary, settings, usable, on_step, clock, estimates
        )
    solver = name.removeprefix("dict-")
    assert solver in get_args(bpdn.Method)
    chosen = settings.sparse.solver.model_copy(update={"method": solver})
    sparse = settings.sparse.model_copy(update={"solver": chosen})
    return reconstruct_sparse(
        psi, frames, noise_sigma, dictionary, sparse, usable, on_step, clock, estimates
    )


def patched_weights(
    tv: TVSettings, sparse: SparseSettings, psi: ImagingMatrix, readings: Array, noise_sigma: float
) -> TVSettings:
    """Return the settings with mu and rho chosen for a patch term, where they are not set.

    readings: the usable ones. mu is 3 times that of total variation alone, rho 18 mu / (brightness
    cover), the cover being the number of patches on a sample. The factors were fitted on two full
    real light fields and six crops (Bayer, monochrome and RGB, one and three shots): 6 is better
    by 0.2 to 0.9 dB where total variation alone beats the patches, 18 by 0.3 to 0.6 dB elsewhere.
    """
    mu = tv.mu or PATCHED_MU * choose_mu(psi, readings, noise_sigma, tv.order)
    brightness = max(float(np.mean(readings)) / max(psi.light_efficiency(), 1e-12), 1e-12)
    cover = PATCH_AREA / sparse.stride**2
    rho = tv.rho if "rho" in tv.model_fields_set else PATCHED_RHO * mu / (brightness * cover)
    return tv.model_copy(update={"mu": mu, "rho": rho})


def _tv_dict(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float,
    dictionary: Dictionary,
    settings: MethodSettings,
    usable: NDArray[np.bool_] | None,
    on_step: Callable[[Progress], None] | None,
    clock: Callable[[], float],
    found: PatchEstimates | None,
) -> Reconstruction:
    started = clock()
    frames, usable = checked_inputs(psi, frames, noise_sigma, usable)
    if found is None:
        found = estimate_patches(
            psi, frames, noise_sigma, dictionary, settings.sparse, usable, on_step
        )
    first_s = clock() - started
    term = PatchTerm(found.light_field, found.weight)
    tv = patched_weights(settings.tv, settings.sparse, psi, frames[usable], noise_sigma)
    result = reconstruct_tv(
        psi, frames, noise_sigma, tv, usable, on_step, patch_term=term, clock=clock
    )
    return dataclasses.replace(
        result,
        method="tv-dict",
        seconds=clock() - started,
        parameters={
            **result.parameters,
            "patches": len(found.atoms),
            "atoms_per_patch": float(found.atoms.mean()),
            "first_stage_seconds": first_s,
        },
    )
