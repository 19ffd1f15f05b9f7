"""Dataclasses to plain data and arrays, which can be stored, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import Settings

KIND = "class"
PLAIN = bool, int, float, str, type(None)


def to_arrays(value: Any, arrays: dict[str, NDArray]) -> Any:
    """Return a value as JSON has it; its arrays, in rows, are added to `arrays` under numbers.

    value: dataclasses, settings, tuples, arrays, numbers of Python and NumPy, and Psi, of which
    only the place is kept.
    """
    if type(value) in PLAIN:
        return value
    if isinstance(value, tuple):
        return [to_arrays(item, arrays) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        name = str(len(arrays))
        arrays[name] = np.asarray(value, order="C")
        return {KIND: "array", "name": name}
    kind = {KIND: type(value).__name__}
    if isinstance(value, Psi):
        return kind
    if isinstance(value, Settings):
        return kind | {"settings": value.model_dump(mode="json")}
    return kind | {
        field.name: to_arrays(getattr(value, field.name), arrays) for field in fields(value)
    }


def from_arrays(
    plain: Any,
    arrays: Mapping[str, NDArray],
    kinds: Iterable[type],
    next_psi: Callable[[], Psi],
) -> Any:
    """Return the value that `to_arrays` was given.

    kinds: classes of the dataclasses and settings in it. next_psi: returns its Psi, one after the
    other in the order of the fields.
    """
    known = {kind.__name__: kind for kind in kinds}

    def whole(part: Any) -> Any:
        if isinstance(part, list):
            return tuple(whole(item) for item in part)
        if not isinstance(part, dict):
            return part
        kind = part[KIND]
        if kind == "array":
            return arrays[part["name"]][()]
        if kind == Psi.__name__:
            return next_psi()
        if "settings" in part and issubclass(known[kind], Settings):
            return known[kind].model_validate(part["settings"])
        return known[kind](**{name: whole(item) for name, item in part.items() if name != KIND})

    return whole(plain)
