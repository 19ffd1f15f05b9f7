"""Frozen settings read from YAML, which refuse unknown keys and name the nearest valid one."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, TypeGuard, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from emmc_rig.model.errors import RemovedSettingWarning, did_you_mean


class Settings(BaseModel):
    """Base of every configuration object: frozen, no unknown keys, no coercion of NaN.

    removed: keys that files of earlier versions may hold; they are ignored, with a warning.
    renamed: earlier names of keys, and what they are called now; both are read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    removed: ClassVar[tuple[str, ...]] = ()
    renamed: ClassVar[Mapping[str, str]] = {}

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_versions(cls, data: object) -> object:
        """Drop keys that earlier versions had, and say so; rename others."""
        if not isinstance(data, dict):
            return data
        for name in sorted(set(cls.removed).intersection(data)):
            text = f"the setting '{name}' was removed and is ignored"
            warnings.warn(text, RemovedSettingWarning, stacklevel=2)
        kept = {name: value for name, value in data.items() if name not in cls.removed}
        for old, new in cls.renamed.items():
            if old in kept and new in kept:
                raise ValueError(f"{old} is an earlier name of {new}: leave {old} out")
        return cls.under_new_names(kept)

    @classmethod
    def under_new_names(cls, data: Mapping[str, Any]) -> dict[str, Any]:
        """Return plain data with every key under its present name."""
        return {cls.renamed.get(name, name): value for name, value in data.items()}

    @model_validator(mode="before")
    @classmethod
    def _no_truth_for_a_number(cls, data: object) -> object:
        """Refuse `yes` and `true` where a number is meant: Python would take them for 1."""
        if isinstance(data, dict):
            for name, field in cls.model_fields.items():
                if _holds_truth(data.get(name)) and bool not in _parts(field.annotation):
                    raise ValueError(f"{name}: a number is meant, not true or false")
        return data


def _holds_truth(value: object) -> bool:
    if isinstance(value, (list, tuple)):
        return any(map(_holds_truth, value))
    return isinstance(value, bool)


def _parts(annotation: object) -> set[object]:
    return {annotation}.union(*(_parts(part) for part in get_args(annotation)))


S = TypeVar("S", bound=Settings)


def _keys_beside(cls: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the valid keys at the place of an unknown key."""
    kinds: list[object] = [cls]
    for part in location[:-1]:
        kinds = [inner for kind in kinds for inner in _at(kind, part)]
    models = [part for kind in kinds for part in _parts(kind) if _is_model(part)]
    return sorted({key for model in models for key in model.model_fields})


def _is_model(kind: object) -> TypeGuard[type[BaseModel]]:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _at(kind: object, part: int | str) -> list[object]:
    """Return the types at a key, an index, or the tag of a union's alternative."""
    if _is_model(kind):
        fields = kind.model_fields
        if part in fields:
            return [fields[str(part)].annotation]
        is_tag = "kind" in fields and part in get_args(fields["kind"].annotation)
        return [kind] if is_tag else []
    if get_origin(kind) in (dict, tuple, list):
        return [next(inner for inner in reversed(get_args(kind)) if inner is not Ellipsis)]
    return [inner for option in get_args(kind) for inner in _at(option, part)]


def explain(error: ValidationError, cls: type[BaseModel]) -> str:
    """Return the first fault of a failed validation as one line for the user.

    An unknown key comes before others: a misspelt key that is required is also a missing one.
    """
    faults = error.errors()
    first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), faults[0])
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        key = str(first["loc"][-1])
        valid = _keys_beside(cls, first["loc"])
        hint = did_you_mean(key, valid).strip() or f"valid keys: {', '.join(valid)}"
        return f"unknown key '{where}': {hint}"
    message = first["msg"].replace("\n", " ")
    for pattern, words in _WORDS:
        message = re.sub(pattern, words, message)
    message = message.removeprefix("Value error, ")
    if first["type"] != "value_error":
        message = message[:1].lower() + message[1:]
    return f"{where}: {message}" if where else message


_WORDS = (
    (r"valid tuple|valid list|valid array", "list"),
    (r"valid dictionary or instance of \w+|valid dictionary|valid mapping", "mapping (key: value)"),
    (r"a valid string", "text"),
    (r"a valid integer", "a whole number"),
    (r"a valid number", "a number"),
    (r"a valid boolean", "true or false"),
    (r"\bNone\b|NoneType", "nothing"),
)
"""Words of the file's format in place of Python's in messages of the validator."""


_KINDS = {
    type(None): "nothing", list: "a list", tuple: "a list", bool: "true or false",
    int: "a number", float: "a number",
}  # fmt: skip
"""Types of plain data in words; all others are text."""


def validated(cls: type[S], data: object, source: str, error: type[Exception]) -> S:
    """Return `cls` built from plain data; raise `error` with one line naming `source`."""
    if not isinstance(data, dict):
        kind = _KINDS.get(type(data), "text")
        raise error(f"{source}: holds {kind}, where settings (key: value) are meant")
    try:
        return cls.model_validate(data)
    except ValidationError as fault:
        # A key may hold line breaks; a message is one line.
        raise error(" ".join(f"{source}: {explain(fault, cls)}".split())) from fault
