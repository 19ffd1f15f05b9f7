"""A folder of cells that outlives interruptions: one JSON line per cell, appended when it is done.

A cell is found again by a digest of everything that it depends on, so changed settings never meet
old results. A line torn by a crash is ignored.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from emmc_rig.errors import AppError

EVERY_POINT = "every point that was done is"


@contextmanager
def kept_when_stopped(
    out: Path,
    folder: Path,
    stopped: type[KeyboardInterrupt],
    what: Callable[[], str] = lambda: EVERY_POINT,
) -> Iterator[None]:
    """Say, when Ctrl-C or a full disk ends the block, what is kept.

    out: the folder as asked for, folder: where it is. what: "3 of 10 points are", say. Raises
    `stopped` and AppError.
    """
    try:
        yield
    except stopped:
        raise
    except KeyboardInterrupt as stop:
        raise stopped(
            f"stopped by Ctrl-C; {what()} kept in {folder}: run the same command again to go on"
        ) from stop
    except OSError as fault:
        raise AppError(
            f"--out {out}: cannot be written ({fault.strerror or fault}); {what()} kept: "
            "make room and run the same command again to go on"
        ) from fault


def digest_of(inputs: Mapping[str, object]) -> str:
    """Return a digest of plain data, the same for equal content in any order of keys."""
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return hashlib.blake2b(text.encode(), digest_size=12).hexdigest()


def open_folder(out: Path, name: str, what: str) -> Path:
    """Return the folder of a journal called `name`, created where missing.

    what: what the folder holds, in words. Raises AppError when it holds something else.
    """
    out = Path(os.path.abspath(out))
    if out.is_file():
        raise AppError(f"--out {out}: a file of that name exists; choose another folder")
    if out.is_dir() and any(out.iterdir()) and not (out / name).is_file():
        raise AppError(
            f"--out {out}: the folder holds something else than {what}; "
            "choose another folder or empty it"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        with open(out / name, "ab"):
            pass
    except OSError as fault:
        raise AppError(f"--out {out}: cannot be written ({fault.strerror})") from fault
    return out


class Journal:
    """The cells done so far, by digest."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._results: dict[str, dict] = {}
        text = self._path.read_bytes().decode("utf-8", errors="replace")
        self._torn = bool(text) and not text.endswith("\n")
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._results[entry["digest"]] = entry["result"]
            except (ValueError, KeyError, TypeError):
                continue

    def __len__(self) -> int:
        return len(self._results)

    def get(self, digest: str) -> dict | None:
        """Return a cell's result, None when it is not done."""
        return self._results.get(digest)

    def add(self, digest: str, inputs: Mapping[str, object], result: dict) -> None:
        """Keep a result: it is on the disk when this returns. Raises OSError when it cannot be."""
        entry = {"digest": digest, "inputs": inputs, "result": result}
        line = json.dumps(entry, allow_nan=False) + "\n"
        start, self._torn = (b"\n" if self._torn else b""), True
        with open(self._path, "ab") as file:
            file.write(start + line.encode())
            file.flush()
            os.fsync(file.fileno())
        self._torn = False
        self._results[digest] = result
