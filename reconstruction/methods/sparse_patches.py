"""The methods `dict-...`: patches that are few atoms of a dictionary, one method per solver."""

from __future__ import annotations

from functools import partial

from reconstruction import bpdn
from reconstruction.method import Given, Method, cost_words
from reconstruction.result import Reconstruction
from reconstruction.settings import ShippedSettings
from reconstruction.sparse import SparseSettings, reconstruct_sparse


def _solve(solver: bpdn.Method, given: Given, settings: ShippedSettings) -> Reconstruction:
    chosen = settings.sparse.solver.model_copy(update={"method": solver})
    return reconstruct_sparse(
        given.psi,
        given.frames,
        given.needed_dictionary(f"dict-{solver}"),
        settings.sparse.model_copy(update={"solver": chosen}),
        given.on_step,
        given.estimates,
    )


def _method(solver: bpdn.Method, title: str, assumes: str, cost: str, when: str) -> Method:
    solve = partial(_solve, solver)
    return Method(
        f"dict-{solver}", title, assumes, cost, when, solve, "sparse", SparseSettings, True
    )


METHODS = (
    _method(
        "admm",
        "sparse patches by ADMM with working sets (the paper's Dict-ADMM)",
        "every patch is a sum of a few atoms of the dictionary",
        cost_words(1.4, 4.3),
        "one shot with a dictionary of similar scenes",
    ),
    _method(
        "lars",
        "sparse patches by the Lasso path (LARS)",
        "as dict-admm, and the same minimiser to rounding",
        "longer than dict-admm",
        "the exact minimiser, or few atoms per patch",
    ),
    _method(
        "omp",
        "sparse patches by orthogonal matching pursuit",
        "every patch is a sum of at most `atoms` atoms",
        cost_words(0.83, 1.6),
        "coarse previews",
    ),
    _method(
        "ista",
        "sparse patches by proximal gradient",
        "as dict-admm",
        "longer than dict-fista",
        "to compare solvers",
    ),
    _method(
        "fista",
        "sparse patches by accelerated proximal gradient with restart",
        "as dict-admm",
        "about 20 times as long as dict-admm",
        "to compare solvers",
    ),
    _method(
        "sl0",
        "sparse patches by smoothed l0 (as [18])",
        "every patch is a sum of the fewest atoms that explain the frames",
        cost_words(2.4, 4.4),
        "little noise; to compare with [18]",
    ),
)
