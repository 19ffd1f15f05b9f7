"""Files that appear whole under their name, or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; what is written there takes the name at the end.

    A file of that name is replaced. After an error nothing is left. Raises OSError. Outlives the
    program's end, not a power cut: see `emmc_rig.session.storage` for that.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8), whole or not at all; raises OSError."""
    with whole_file(path) as partial:
        partial.write_bytes(text.encode())
