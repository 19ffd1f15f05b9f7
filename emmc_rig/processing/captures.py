"""Several captures in one call, on one pool of workers, within a ceiling of memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from numba import get_num_threads

from emmc_rig.errors import ERRORS, AppError, StoppedError
from emmc_rig.files.folders import KEPT, is_session, result_folder
from emmc_rig.files.psi import open_psi, psi_beside
from emmc_rig.processing.memory import (
    BASE_BYTES,
    Ceiling,
    assumed_grid,
    own_bytes,
    task_bytes,
)
from emmc_rig.processing.pool import opened_pool
from emmc_rig.processing.reconstructing import reconstruct_folder
from emmc_rig.session.session import RECONSTRUCTION
from reconstruction.methods import MethodSettings
from reconstruction.result import Progress

Place = tuple[Path, Path]
"""A capture's folder, and the folder to write: in a session only the one it has for this."""


def ceiling_for(
    memory: int,
    folders: Sequence[Path],
    psi: Path | None,
    settings: MethodSettings,
    as_zarr: bool,
    compares: bool,
) -> tuple[Ceiling, int, int]:
    """Return a ceiling, and how many workers and captures at a time fit below it.

    Workers become fewer where a survey finds larger disparities than assumed here. Raises AppError
    where not even one worker fits.
    """  # fmt: skip
    need = own = 0
    for folder in folders:
        if is_session(folder) and psi is None:
            raise AppError(
                f"{folder}: --memory needs Psi before the workers start; run `emmc-rig calibrate` "
                "and give --psi"
            )
        saved = open_psi(psi or psi_beside(folder))
        need = max(need, task_bytes(saved, assumed_grid(saved, settings)))
        own = max(own, own_bytes(saved, settings, as_zarr, compares))
    single, double = (Ceiling(memory, BASE_BYTES + captures * own) for captures in (1, 2))
    if len(folders) > 1 and double.total - double.own >= 2 * need:
        return double, double.workers(need), 2
    return single, single.workers(need), 1


def reconstruct_captures(
    places: Sequence[Place],
    workers: int | None,
    cluster: str | None,
    memory: int | None,
    on_step: Callable[[Progress], None],
    **given: Any,
) -> Iterator[tuple[Place, dict | Exception]]:
    """Yield each capture with its metrics, or with what it failed by, in the order they are done.

    workers: processes; None and one capture that is one block: this process and its threads.
    memory: bytes of all processes together, kept by computing less at a time. on_step: called with
    the progress of a single capture, or with the captures done. given: see `reconstruct_folder`.
    Raises WorkersError, and AppError for a ceiling that is too low.
    """
    alone = len(places) == 1
    count, ceiling = workers or get_num_threads(), None
    # One more than the pool computes at a time is read ahead, or written behind.
    at_a_time = len(places)
    if memory is not None:
        ceiling, most, at_a_time = ceiling_for(
            memory, [folder for folder, _ in places], given.get("psi_path"),
            given.get("settings") or MethodSettings(), given.get("as_zarr", False),
            given.get("truth") is not None,
        )  # fmt: skip
        count = min(count, most)
    shared = not alone or workers is not None or cluster is not None or memory is not None
    with opened_pool(count, cluster, ceiling) if shared else nullcontext() as pool:
        if pool is None or alone:
            yield places[0], _outcome(places[0], pool=pool, on_step=on_step, **given)
            return
        with ThreadPoolExecutor(min(at_a_time, pool.size + 1)) as threads:
            futures = {
                threads.submit(_outcome, place, pool=pool, **given): place for place in places
            }
            try:
                for done, future in enumerate(as_completed(futures), 1):
                    outcome = future.result()
                    on_step(Progress(done, None, None, len(places)))
                    yield futures[future], outcome
            except BaseException:
                for future in futures:
                    future.cancel()
                pool.end()
                raise


def _outcome(place: Place, **given: Any) -> dict | Exception:
    """Return a capture's metrics, or what it failed by; raises StoppedError by Ctrl-C."""
    frames, out = place
    of_session = frames / RECONSTRUCTION if is_session(frames) else None
    try:
        with result_folder(out, "reconstruct", belongs_to=of_session, resumes=True) as folder:
            try:
                return reconstruct_folder(frames, folder, **given)
            except KeyboardInterrupt as stop:
                if not (folder.parent / KEPT).is_dir():
                    raise
                raise StoppedError(
                    f"stopped by Ctrl-C; blocks that are done are kept in {out}, and the same "
                    "command goes on"
                ) from stop
    except ERRORS as fault:
        return fault
