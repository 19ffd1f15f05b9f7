"""Dictionaries found by name: a file, or one made by formula."""

from __future__ import annotations

from reconstruction.dictionary import Dictionary, dct_dictionary, lambertian_dictionary


def open_dictionary(spec: str | None, views: tuple[int, int], binning: int) -> Dictionary:
    """Return a dictionary by file, or by the name of one that needs no training.

    None takes `lambertian`. Those made here have patches of 9 x 9 samples, or the nearest
    multiple of the pixels' k below. Raises DictionaryError for a file that is none.
    """
    if spec in (None, "lambertian", "dct"):
        side = 9 // binning * binning or binning
        make = dct_dictionary if spec == "dct" else lambertian_dictionary
        return make(views, (side, side))
    return Dictionary.load(spec)
