"""The method `dict-admm`: patches that are few atoms of a dictionary."""

from __future__ import annotations

from emmc_rig.reconstruction.method import Given, Method, ShippedSettings, cost_words
from emmc_rig.reconstruction.result import Reconstruction
from emmc_rig.reconstruction.sparse import SparseSettings, reconstruct_sparse


def _solve(given: Given, settings: ShippedSettings) -> Reconstruction:
    return reconstruct_sparse(
        given.psi,
        given.frames,
        given.needed_dictionary("dict-admm"),
        settings.sparse,
        given.on_step,
        given.estimates,
    )


METHODS = (
    Method(
        "dict-admm",
        "sparse patches by ADMM with working sets (the paper's Dict-ADMM)",
        "every patch is a sum of a few atoms of the dictionary",
        cost_words(0.59, 1.9),
        "one shot with a dictionary of similar scenes",
        _solve,
        "sparse",
        SparseSettings,
        needs_dictionary=True,
    ),
)
