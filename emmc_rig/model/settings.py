"""Frozen settings read from YAML, which refuse unknown keys and name the nearest valid one."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError


class Settings(BaseModel):
    """Base of every configuration object: frozen, no unknown keys, no coercion of NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


S = TypeVar("S", bound=Settings)


def _keys_beside(cls: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the valid keys at the place of an unknown key, by walking the JSON schema."""
    root = cls.model_json_schema()
    nodes = [root]
    for part in location[:-1]:
        nodes = [child for node in nodes for child in _children(node, part, root)]
    found = [option for node in nodes for option in (_resolve(node, root), *_options(node, root))]
    return sorted({key for node in found for key in node.get("properties", {})})


def _options(node: dict[str, Any], root: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the alternatives of a node: a setting that may be left out is one of null."""
    node = _resolve(node, root)
    return [_resolve(option, root) for option in node.get("oneOf", []) + node.get("anyOf", [])]


def _resolve(node: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in node:
        node = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
    return node


def _children(node: dict[str, Any], part: int | str, root: dict[str, Any]) -> list[dict[str, Any]]:
    node = _resolve(node, root)
    options = _options(node, root)
    if options:
        tagged = [o for o in options if part in _tags(o)]
        return tagged or [child for o in options for child in _children(o, part, root)]
    if isinstance(part, int):
        return [node["items"]] if "items" in node else []
    if part in node.get("properties", {}):
        return [node["properties"][part]]
    extra = node.get("additionalProperties")
    return [extra] if isinstance(extra, dict) else []


def _tags(node: dict[str, Any]) -> list[str]:
    kind = node.get("properties", {}).get("kind", {})
    return [kind["const"]] if "const" in kind else []


def explain(error: ValidationError, cls: type[BaseModel]) -> str:
    """Return the first fault of a failed validation as one line for the user.

    An unknown key comes before others: a misspelt key that is required is also a missing one.
    """
    faults = error.errors()
    first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), faults[0])
    where = ".".join(str(part) for part in first["loc"]) or "the file"
    if first["type"] == "extra_forbidden":
        key = str(first["loc"][-1])
        valid = _keys_beside(cls, first["loc"])
        near = difflib.get_close_matches(key, valid, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"valid keys: {', '.join(valid)}"
        return f"unknown key '{where}': {hint}"
    message = first["msg"].replace("\n", " ")
    if first["type"] == "value_error":
        return f"{where}: {message.removeprefix('Value error, ')}"
    return f"{where}: {message[:1].lower()}{message[1:]}"


def validated(cls: type[S], data: object, source: str, error: type[Exception]) -> S:
    """Return `cls` built from plain data; raise `error` with one line naming `source`."""
    if not isinstance(data, dict):
        raise error(f"{source}: expected a mapping of settings, found {type(data).__name__}")
    try:
        return cls.model_validate(data)
    except ValidationError as fault:
        raise error(f"{source}: {explain(fault, cls)}") from fault


def read_yaml(path: Path, error: type[Exception]) -> object:
    """Return the content of a YAML file; raise `error` with one line when it cannot be read."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as fault:
        raise error(f"{path}: no such file") from fault
    except (OSError, UnicodeDecodeError) as fault:
        raise error(f"{path}: cannot be read ({fault})") from fault
    except yaml.YAMLError as fault:
        mark = getattr(fault, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(fault, "problem", None) or "malformed"
        raise error(f"{path}: not valid YAML{where}: {problem}") from fault
    except ValueError as fault:
        raise error(f"{path}: not valid YAML: {fault}") from fault
