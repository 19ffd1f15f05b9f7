"""Removing what a crash left behind: part-written files, and files whose journal line is missing.

A file that the session did not make is never touched, nor one that counts.
"""

from __future__ import annotations

from emmc_rig.errors import AppError
from emmc_rig.session.session import Session


def prune(session: Session, dry_run: bool = False) -> tuple[list[str], int]:
    """Remove a session's leftovers; returns their names and how many bytes they had.

    Raises AppError.
    Hold the session (`lock.held`), which clears what was left beside it, and open it then.
    """
    leftovers, _ = session.unexpected_files()
    size = 0
    for name in leftovers:
        path = session.folder / name
        size += max(0, session.disk.sizes(path.parent).get(path.name, 0))
        if dry_run:
            continue
        try:
            session.disk.remove(path)
        except OSError as fault:
            raise AppError(f"{path}: cannot be removed ({fault.strerror})") from fault
    return leftovers, size
