"""Checks of the arguments of public functions; another type raises an error of one line."""

from __future__ import annotations

import os
from numbers import Integral, Real
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.errors import ModelError

Kinds = type | tuple[type, ...]
NAMES = (str, os.PathLike)


class ArgumentError(ModelError, TypeError):
    """An argument that a public function does not take."""


def refusal(value: object, name: str, takes: str) -> ArgumentError:
    """Return the error that says what the argument `name` takes instead of a value."""
    return ArgumentError(f"{name}: got {_described(value)}; it takes {takes}")


def required(value: object, kinds: Kinds, name: str, takes: str) -> None:
    """Raise ArgumentError, which says what the argument `name` takes, for another kind of value."""
    if not isinstance(value, kinds):
        raise refusal(value, name, takes)


def path_of(value: object, name: str, takes: str) -> Path:
    """Return a path given as text or Path; raises ArgumentError for anything else."""
    required(value, NAMES, name, takes)
    return Path(value)  # pyright: ignore[reportArgumentType]


def pair_of(value: object, name: str, takes: str) -> tuple[int, int]:
    """Return two whole numbers of at least 1, such as rows and columns; raises ArgumentError."""
    try:
        first, second = value  # pyright: ignore[reportGeneralTypeIssues]
        numbers = isinstance(first, Integral) and isinstance(second, Integral)
    except (TypeError, ValueError):
        numbers = False
    if not numbers or min(first, second) < 1:
        raise refusal(value, name, takes)
    return int(first), int(second)


def numbers_of(value: object, name: str, takes: str) -> NDArray:
    """Return an array of real numbers; raises ArgumentError for anything else."""
    masked = np.ma.count_masked(value) if isinstance(value, np.ma.MaskedArray) else 0
    if masked:
        raise ArgumentError(
            f"{name}: {masked} of its values are masked, so not valid; it takes {takes}: cut them "
            "off, or write what was measured there"
        )
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # lists whose rows differ in length
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        raise refusal(value, name, takes)
    return array


def light_field_remedy(given: NDArray) -> str:
    """Return how codes or grey make a light field, as the end of a line; "" for other arrays."""
    steps = []
    if given.ndim == 4 or given.shape[4:] == (1,):
        steps.append(f"scene{'[..., None]' * (given.ndim == 4)}.repeat(3, axis=-1) of grey")
    if given.dtype.kind in "iu":
        full = np.iinfo(given.dtype).max
        steps.append(f"scene / {full} of linear codes, (scene / {full}) ** 2.2 of a picture's")
    return f": {', and '.join(steps)}" if steps else ""


def _described(value: object) -> str:
    """Return what a value is, short enough for a line."""
    if value is None or isinstance(value, (str, Real, os.PathLike)):
        text = repr(value)
        return text if len(text) <= 60 else f"{text[:57]}..."
    shape = getattr(value, "shape", None)
    kind = type(value).__name__
    if isinstance(shape, tuple) and hasattr(value, "dtype"):
        return f"{kind} of shape {shape}, {value.dtype}"  # pyright: ignore[reportAttributeAccessIssue]
    return f"{kind} {value}" if isinstance(value, tuple) and len(value) <= 3 else kind
