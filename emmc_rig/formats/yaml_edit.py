"""Numbers set in a YAML text, everything else of it left as it stands: comments, order, layout."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from emmc_rig.errors import AppError
from emmc_rig.model.files import whole_file
from emmc_rig.model.reading import parse_yaml

Key = tuple[str | int, ...]
DIGITS = 6


def with_values(text: str, values: Mapping[Key, float], source: str) -> str:
    """Return the text with these numbers, each named by its keys and places from the top.

    source: the file's name, for messages. Raises AppError for a text that cannot be edited so
    that nothing else changes.
    """
    wanted = parse_yaml(text, source, AppError)
    for key, value in values.items():
        number = _written(value)
        wanted = _set(wanted, key, float(number))
        text = _with_value(text, key, number)
        try:
            same = parse_yaml(text, source, AppError) == wanted
        except AppError:
            same = False
        if not same:
            raise AppError(
                f"{source}: cannot be edited here; write {'.'.join(map(str, key))}: {number}"
            )
    return text


def _written(value: float) -> str:
    return np.format_float_positional(value, precision=DIGITS, trim="0")


def _set(data: Any, key: Key, value: float) -> Any:
    """Return a copy of plain data with a value at its place, mappings made that are missing."""
    if not key:
        return value
    first, rest = key[0], key[1:]
    if isinstance(data, list):
        return [_set(item, rest, value) if i == first else item for i, item in enumerate(data)]
    mapping = data if isinstance(data, dict) else {}
    return {**mapping, first: _set(mapping.get(first), rest, value)}


def _with_value(text: str, key: Key, number: str) -> str:
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    for depth, name in enumerate(key):
        child = _child(node, name)
        if child is None:
            return _inserted(text, node, key[depth:], number)
        node = child
    if isinstance(node, yaml.CollectionNode) and not node.flow_style:
        return text
    return text[: node.start_mark.index] + number + text[node.end_mark.index :]


def _child(node: yaml.Node | None, name: str | int) -> yaml.Node | None:
    if isinstance(node, yaml.SequenceNode) and isinstance(name, int):
        return node.value[name]
    if isinstance(node, yaml.MappingNode):
        return next((value for key, value in node.value if key.value == name), None)
    return None


def _inserted(text: str, node: yaml.Node | None, key: Key, number: str) -> str:
    """Return the text with what is missing below a node: a line in a block, else in its braces."""
    line = number
    for name in reversed(key[1:]):
        line = f"{{{name}: {line}}}"
    line = f"{key[0]}: {line}"
    if isinstance(node, yaml.MappingNode) and node.value:
        if node.flow_style:
            return f"{text[: node.start_mark.index + 1]}{line}, {text[node.start_mark.index + 1 :]}"
        if node.start_mark.column == 0:
            return f"{text.rstrip()}\n{line}\n"
        first = node.value[0][0].start_mark
        return f"{text[: first.index]}{line}\n{' ' * first.column}{text[first.index :]}"
    if node is None:
        return f"{text}{line}\n"
    start, end = node.start_mark.index, node.end_mark.index
    return f"{text[:start]}{' ' if start == end else ''}{{{line}}}{text[end:]}"


def replace_text(path: Path, before: str, after: str) -> None:
    """Write `after` in place of `before`; line ends, permissions and links stay.

    Raises AppError, nothing written, where the file holds something else by now, or cannot be
    written.
    """
    real = Path(os.path.realpath(path))
    try:
        with real.open(encoding="utf-8", newline="") as file:
            there = file.read()
        if there.replace("\r\n", "\n") != before.replace("\r\n", "\n"):
            raise AppError(f"{path}: was changed meanwhile; look at it, then begin anew")
        end = "\r\n" if "\r\n" in there else "\n"
        with whole_file(real) as partial:
            partial.write_text(after.replace("\r\n", "\n"), encoding="utf-8", newline=end)
            shutil.copymode(real, partial)
    except OSError as fault:
        raise AppError(f"{path}: cannot be written ({fault.strerror}); correct that") from fault
