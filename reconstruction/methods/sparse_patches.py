"""The methods `dict-...`: patches that are few atoms of a dictionary, one method per solver."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from reconstruction import bpdn
from reconstruction.method import Given, Method
from reconstruction.result import Reconstruction
from reconstruction.sparse import SparseSettings, reconstruct_sparse

if TYPE_CHECKING:
    from reconstruction.methods import MethodSettings

_BUILDING = "Psi D, then "


def _solve(solver: bpdn.Method, given: Given, settings: MethodSettings) -> Reconstruction:
    chosen = settings.sparse.solver.model_copy(update={"method": solver})
    return reconstruct_sparse(
        given.psi,
        given.frames,
        given.typical_noise,
        given.needed_dictionary(f"dict-{solver}"),
        settings.sparse.model_copy(update={"solver": chosen}),
        given.usable,
        given.on_step,
        given.estimates,
    )


def _method(solver: bpdn.Method, title: str, assumes: str, operations: str, when: str) -> Method:
    cost = f"{_BUILDING}{operations}"
    solve = partial(_solve, solver)
    return Method(
        f"dict-{solver}", title, assumes, cost, when, solve, "sparse", SparseSettings, True
    )


METHODS = (
    _method(
        "admm",
        "sparse patches by ADMM with working sets (the paper's Dict-ADMM)",
        "patches are a few atoms of the dictionary",
        "p (n m^2 + 4 n m x 30-100 passes) operations",
        "one shot with a dictionary of similar scenes",
    ),
    _method(
        "lars",
        "sparse patches by the Lasso path (LARS)",
        "as dict-admm, and the same minimiser to rounding",
        "p 2 n m operations a step, 1-3 steps an atom used",
        "exact minimiser wanted, or few atoms per patch",
    ),
    _method(
        "omp",
        "sparse patches by orthogonal matching pursuit",
        "patches are at most `atoms` atoms",
        "p 2 n m operations an atom",
        "quickest; coarse previews",
    ),
    _method(
        "ista",
        "sparse patches by proximal gradient",
        "as dict-admm",
        "p (n m^2 + 4 n m x thousands of steps) operations",
        "only to compare",
    ),
    _method(
        "fista",
        "sparse patches by accelerated proximal gradient with restart",
        "as dict-admm",
        "p (n m^2 + 4 n m x 500-5,000 steps) operations",
        "only to compare",
    ),
    _method(
        "sl0",
        "sparse patches by smoothed l0 (as [18])",
        "patches are the fewest atoms that explain the frames",
        "p (n m^2 + 4 n m x 50 passes) operations",
        "little noise; to compare with [18]",
    ),
)
