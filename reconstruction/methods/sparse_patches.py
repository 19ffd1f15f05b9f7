"""The methods `dict-...`: patches that are few atoms of a dictionary, one method per solver."""

from __future__ import annotations

from functools import partial

from emmc_rig.reconstruction.method import Given, Method, ShippedSettings, cost_words
from emmc_rig.reconstruction.result import Reconstruction
from emmc_rig.reconstruction.sparse import SparseSettings, reconstruct_sparse


def _solve(solver: str, given: Given, settings: ShippedSettings) -> Reconstruction:
    chosen = settings.sparse.solver.model_copy(update={"method": solver})
    return reconstruct_sparse(
        given.psi,
        given.frames,
        given.needed_dictionary(f"dict-{solver}"),
        settings.sparse.model_copy(update={"solver": chosen}),
        given.on_step,
        given.estimates,
    )


METHODS = tuple(
    Method(
        f"dict-{solver}", f"sparse patches by {title}", assumes, cost, when,
        partial(_solve, solver), "sparse", SparseSettings, True,
    )
    for solver, title, assumes, cost, when in (
        (
            "admm", "ADMM with working sets (the paper's Dict-ADMM)",
            "every patch is a sum of a few atoms of the dictionary",
            cost_words(1.4, 4.3), "one shot with a dictionary of similar scenes",
        ),
        (
            "lars", "the Lasso path (LARS)", "as dict-admm, and the same minimiser to rounding",
            "longer than dict-admm", "the exact minimiser, or few atoms per patch",
        ),
        (
            "omp", "orthogonal matching pursuit",
            "every patch is a sum of at most `atoms` atoms",
            cost_words(0.83, 1.6), "coarse previews",
        ),
        (
            "ista", "proximal gradient", "as dict-admm", "longer than dict-fista",
            "to compare solvers",
        ),
        (
            "fista", "accelerated proximal gradient with restart", "as dict-admm",
            "about 20 times as long as dict-admm", "to compare solvers",
        ),
        (
            "sl0", "smoothed l0 (as [18])",
            "every patch is a sum of the fewest atoms that explain the frames",
            cost_words(2.4, 4.4), "little noise; to compare with [18]",
        ),
    )
)  # fmt: skip
