"""JSON from outside as plain data, or the caller's error in one line; loads no other package."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def parse_json(data: bytes | str, source: str, error: type[Exception]) -> Any:
    """Return the content of JSON; raises `error` naming `source`."""
    try:
        return json.loads(data)
    except RecursionError as fault:
        raise error(f"{source}: nested too deeply") from fault
    except ValueError as fault:
        raise error(f"{source}: not JSON ({one_line(fault)})") from fault


def shown_path(path: Path | str) -> str:
    """Return a path on one line: control characters escaped, no longer than a name can be."""
    text = "".join(mark if mark.isprintable() else repr(mark)[1:-1] for mark in str(path))
    return text if len(text) <= 300 else f"{text[:300]}..."


def one_line(fault: object) -> str:
    """Return an error's message on one line, cut to a length."""
    text = fault.args[0] if isinstance(fault, KeyError) and fault.args else fault
    return " ".join(str(text).split())[:300]
