"""Removing what a crash left behind: part-written files, and files whose journal line is missing.

A file that the session did not make is never touched, nor one that counts.
"""

from __future__ import annotations

from contextlib import suppress

from emmc_rig.errors import AppError
from emmc_rig.session.session import Session
from emmc_rig.session.storage import part_of


def prune(session: Session, dry_run: bool = False) -> tuple[list[str], int]:
    """Remove a session's leftovers; returns their names and how many bytes they had.

    What was left of a session that never came to be, beside this one, goes too. Raises AppError.
    """
    leftovers, _ = session.strangers()
    size = 0
    unborn = part_of(session.folder)
    with suppress(OSError):
        if unborn.name in session.disk.sizes(unborn.parent):
            leftovers.append(f"../{unborn.name}")
    for name in leftovers:
        path = session.folder / name
        size += max(0, session.disk.sizes(path.parent).get(path.name, 0))
        if dry_run:
            continue
        try:
            if name.startswith("../"):
                session.disk.remove_folder(unborn)
            else:
                session.disk.remove(path)
        except OSError as fault:
            raise AppError(f"{path}: cannot be removed ({fault.strerror})") from fault
    return leftovers, size
