"""Dictionaries found by name: a file, or one made by formula."""

from __future__ import annotations

from emmc_rig.reconstruction.dictionary import (
    Dictionary,
    dct_dictionary,
    lambertian_dictionary,
    usual_patch,
)


def open_dictionary(spec: str | None, views: tuple[int, int], binning: int) -> Dictionary:
    """Return a dictionary by file, or by the name of one that needs no training.

    None takes `lambertian`. Those made here have patches of `usual_patch`. Raises DictionaryError
    for a file that is none.
    """
    if spec in (None, "lambertian", "dct"):
        make = dct_dictionary if spec == "dct" else lambertian_dictionary
        return make(views, usual_patch(binning))
    return Dictionary.load(spec)
