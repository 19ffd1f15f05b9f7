"""The methods `dict-...`: patches that are few atoms of a dictionary, one method per solver."""

from __future__ import annotations

from functools import partial

from emmc_rig.reconstruction import bpdn
from emmc_rig.reconstruction.method import Given, Method, ShippedSettings, cost_words
from emmc_rig.reconstruction.result import Reconstruction
from emmc_rig.reconstruction.sparse import SparseSettings, reconstruct_sparse


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


def _by(solver: bpdn.Method, title: str, assumes: str, cost: str, when: str) -> Method:
    return Method(
        f"dict-{solver}", f"sparse patches by {title}", assumes, cost, when,
        solve=partial(_solve, solver), part="sparse", settings=SparseSettings,
        needs_dictionary=True,
    )  # fmt: skip


METHODS = (
    _by(
        "admm", title="ADMM with working sets (the paper's Dict-ADMM)",
        assumes="every patch is a sum of a few atoms of the dictionary",
        cost=cost_words(1.4, 4.3), when="one shot with a dictionary of similar scenes",
    ),
    _by(
        "lars", title="the Lasso path (LARS)",
        assumes="as dict-admm, and the same minimiser to rounding",
        cost="longer than dict-admm", when="the exact minimiser, or few atoms per patch",
    ),
    _by(
        "omp", title="orthogonal matching pursuit",
        assumes="every patch is a sum of at most `atoms` atoms",
        cost=cost_words(0.83, 1.6), when="coarse previews",
    ),
    _by(
        "ista", title="proximal gradient", assumes="as dict-admm",
        cost="longer than dict-fista", when="to compare solvers",
    ),
    _by(
        "fista", title="accelerated proximal gradient with restart", assumes="as dict-admm",
        cost="about 20 times as long as dict-admm", when="to compare solvers",
    ),
    _by(
        "sl0", title="smoothed l0 (as [18])",
        assumes="every patch is a sum of the fewest atoms that explain the frames",
        cost=cost_words(2.4, 4.4), when="little noise; to compare with [18]",
    ),
)  # fmt: skip
