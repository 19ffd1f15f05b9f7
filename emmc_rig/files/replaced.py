"""A person's own text file, replaced by an edited one: whole, and only as it was read."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.model.files import whole_file


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
        raise AppError(f"{path}: cannot be written ({fault.strerror}); mend that") from fault
