"""Sparse codes of measurements in a sensed dictionary: six solvers behind one interface.

`admm`, `lars`, `ista` and `fista` minimise 1/2 |A beta - I|^2 + eta |beta|_1 (eq. 8); `omp` and
`sl0` look for few atoms that explain the measurements. The penalty and the tolerance follow from
the noise unless the settings say otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction import bpdn_solvers as solvers
from emmc_rig.reconstruction.errors import ReconstructionError

Array32 = NDArray[np.float32]
Method = Literal["admm", "omp", "lars", "ista", "fista", "sl0"]
SL0_RIDGE = 0.03
"""Of A A^T, relative to its largest block: what readings hold beyond noise and atoms is not forced
into directions that they hardly see. On 48x64 middles of four scenes of group A, three shots, 1e-5
loses 2.5 to 17.6 dB, and is worse than one shot; 0.01 loses 1.1 dB in the mean, 0.1 gains 0.2 and
loses 0.4 with one shot."""
LARS_GAP = 0.05
"""A path that ends further from the minimiser went wrong by rounding: status not converged."""


class BPDNSettings(Settings):
    """Which solver, and when it stops; None lets noise and data choose."""

    method: Method = "admm"
    penalty: float | None = Field(
        default=None, gt=0, description="eta, in units of readings times a sensed atom's norm"
    )
    penalty_factor: float = Field(
        default=0.2, gt=0, description="of sigma |a| sqrt(2 log atoms), which sets eta"
    )
    smallest_penalty: float = Field(
        default=5e-4, gt=0, lt=1, description="eta against |data| |a|, where noise says less"
    )
    rtol: float = Field(
        default=1e-3, gt=0, description="relative duality gap; float32 certifies about 1e-5"
    )
    max_steps: int = Field(default=3000, ge=1)
    relaxation: float = Field(default=1.8, ge=1, lt=2, description="of ADMM")
    threshold: float = Field(
        default=0.04, gt=0, description="of ADMM: eta / rho, against the size of the data"
    )
    atoms: int = Field(default=20, ge=1, description="most atoms that omp takes")
    tolerance_factor: float = Field(
        default=1.0, ge=0, description="of the noise's norm, at which omp and sl0 rest"
    )
    sl0_shrink: float = Field(default=0.7, gt=0, lt=1, description="of the widths of sl0")
    sl0_inner_steps: int = Field(default=3, ge=1)
    sl0_narrowest: float = Field(default=0.005, gt=0, lt=1)


@dataclass(frozen=True, eq=False)
class Code:
    """weights: (atom,). penalty: eta (0 for omp and sl0). gap: relative, NaN for omp and sl0.

    residual: norm of what the atoms leave of the data (NaN where the solver does not know it).
    steps: passes over all atoms.
    """

    weights: Array32
    penalty: float
    gap: float
    residual: float
    steps: float
    converged: bool


EMPTY = Code(np.zeros(0, np.float32), 0.0, 0.0, 0.0, 0.0, True)


def penalty_of(
    size: float, count: int, data: Array32, noise_sigma: float, settings: BPDNSettings
) -> float:
    """Return eta: as set, or c sigma |a| sqrt(2 log n), the largest that noise alone reaches.

    size: |a|, the median norm of the sensed atoms; count: how many there are (Donoho and
    Johnstone 1994 for the form). Never below a small share of |data| |a|.
    """
    if settings.penalty is not None:
        return settings.penalty
    universal = noise_sigma * size * np.sqrt(2 * np.log(max(count, 2)))
    smallest = settings.smallest_penalty * size * float(np.linalg.norm(data))
    return max(settings.penalty_factor * universal, smallest)


def prepared(
    atoms: Array32, data: Array32, noise_sigma: float, settings: BPDNSettings
) -> Callable[[Array32, int], Code]:
    """Return what codes measurements in a sensed dictionary, its factors computed once.

    atoms: (atom, padded measurement), C-contiguous. data: (patch, padded measurement), all that
    will be coded, for the scale of ADMM's rho. The returned function takes one patch's data and
    how many of its measurements are usable.
    """
    size, count = float(np.median(solvers.norms(atoms))), len(atoms)
    scale = float(np.sqrt(np.mean(np.sum(np.square(data, dtype=np.float64), axis=1))))

    def penalty(patch: Array32) -> float:
        return penalty_of(size, count, patch, noise_sigma, settings)

    def greedy(patch: Array32, measured: int) -> Code:
        tolerance = settings.tolerance_factor * noise_sigma * np.sqrt(measured)
        if settings.method == "omp":
            most = min(settings.atoms, measured)
            weights, steps, residual = solvers.omp(atoms, patch, most, tolerance)
        else:
            widths = settings.sl0_shrink, settings.sl0_inner_steps, settings.sl0_narrowest
            weights, steps, residual = solvers.sl0(atoms, patch, tolerance, *widths, SL0_RIDGE)
        return Code(weights, 0.0, np.nan, residual, steps, True)

    if settings.method in ("omp", "sl0"):
        return greedy
    if not size * scale > 0:
        return lambda patch, measured: Code(np.zeros(count, np.float32), 0, 0, 0, 0, True)
    minimise = {
        "ista": partial(solvers.proximal_gradient, atoms, accelerate=False),
        "fista": partial(solvers.proximal_gradient, atoms, accelerate=True),
        "lars": partial(solvers.lars, atoms),
    }.get(settings.method)
    if minimise is None:
        # One factor serves all patches of a class, so their penalties share one rho.
        eta = float(np.median([penalty(patch) for patch in data]))
        rho = eta / (settings.threshold * scale / size)
        try:
            inverse = solvers.ridge_inverse(atoms, rho)
        except np.linalg.LinAlgError as fault:
            raise ReconstructionError(
                "a sensed dictionary is singular: raise the penalty"
            ) from fault
        minimise = partial(solvers.admm, atoms, inverse=inverse, rho=rho, relax=settings.relaxation)

    def convex(patch: Array32, measured: int) -> Code:
        eta = penalty(patch)
        weights, steps, gap = minimise(patch, eta, settings.rtol, settings.max_steps)
        ended = settings.method == "lars" and steps < settings.max_steps
        return Code(weights, eta, gap, np.nan, steps, gap <= (LARS_GAP if ended else settings.rtol))

    return convex
