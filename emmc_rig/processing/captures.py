"""Several captures in one call, on one pool of workers, within a ceiling of memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

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
from emmc_rig.processing.pool import Pool, opened_pool
from emmc_rig.processing.reconstructing import reconstruct_folder
from emmc_rig.session.session import RECONSTRUCTION
from reconstruction.methods import MethodSettings
from reconstruction.result import Progress


@dataclass(frozen=True)
class Request:
    """A capture to reconstruct; its fields are those of `reconstruct_folder`.

    out: the folder to write, in a session only the one it has for this.
    """

    folder: Path
    out: Path
    method: str
    psi: Path | None = None
    dictionary: str | None = None
    settings: MethodSettings | None = None
    truth: str | None = None
    chosen: str | None = None
    as_zarr: bool = False


def ceiling_for(memory: int, requests: Sequence[Request]) -> tuple[Ceiling, int, int]:
    """Return a ceiling, and how many workers and captures at a time fit below it.

    Workers become fewer where a survey finds larger disparities than assumed here. Raises AppError
    where not even one worker fits.
    """
    need = own = 0
    for request in requests:
        if is_session(request.folder) and request.psi is None:
            raise AppError(
                f"{request.folder}: --memory needs Psi before the workers start; run `emmc-rig "
                "calibrate` and give --psi"
            )
        psi = open_psi(request.psi or psi_beside(request.folder))
        settings = request.settings or MethodSettings()
        need = max(need, task_bytes(psi, assumed_grid(psi, settings)))
        own = max(own, own_bytes(psi, settings, request.as_zarr, request.truth is not None))
    single, double = (Ceiling(memory, BASE_BYTES + captures * own) for captures in (1, 2))
    if len(requests) > 1 and double.total - double.own >= 2 * need:
        return double, double.workers(need), 2
    return single, single.workers(need), 1


def reconstruct_captures(
    requests: Sequence[Request],
    workers: int | None,
    cluster: str | None,
    memory: int | None,
    on_step: Callable[[Progress], None],
) -> Iterator[tuple[Request, dict | Exception]]:
    """Yield each capture with its metrics, or with what it failed by, in the order they are done.

    workers: processes; None and one capture that is one block: this process and its threads.
    memory: bytes of all processes together, kept by computing less at a time. on_step: called with
    the progress of a single capture, or with the captures done. Raises WorkersError, and AppError
    for a ceiling that is too low.
    """
    alone = len(requests) == 1
    count, ceiling = workers or get_num_threads(), None
    # One more than the pool computes at a time is read ahead, or written behind.
    at_a_time = len(requests)
    if memory is not None:
        ceiling, most, at_a_time = ceiling_for(memory, requests)
        count = min(count, most)
    shared = not alone or workers is not None or cluster is not None or memory is not None
    with opened_pool(count, cluster, ceiling) if shared else nullcontext() as pool:
        if pool is None or alone:
            yield requests[0], _outcome(requests[0], pool, on_step)
            return
        with ThreadPoolExecutor(min(at_a_time, pool.size + 1)) as threads:
            futures = {
                threads.submit(_outcome, request, pool, lambda _: None): request
                for request in requests
            }
            try:
                for done, future in enumerate(as_completed(futures), 1):
                    outcome = future.result()
                    on_step(Progress(done, None, None, len(requests)))
                    yield futures[future], outcome
            except BaseException:
                for future in futures:
                    future.cancel()
                pool.end()
                raise


def _outcome(
    request: Request, pool: Pool | None, on_step: Callable[[Progress], None]
) -> dict | Exception:
    """Return a capture's metrics, or what it failed by; raises StoppedError by Ctrl-C."""
    place = request.folder / RECONSTRUCTION if is_session(request.folder) else None
    try:
        with result_folder(request.out, "reconstruct", belongs_to=place, resumes=True) as folder:
            try:
                return reconstruct_folder(
                    request.folder, folder, request.method, request.psi, request.dictionary,
                    request.settings, request.truth, on_step, request.chosen, pool, request.as_zarr,
                )  # fmt: skip
            except KeyboardInterrupt as stop:
                if not (folder.parent / KEPT).is_dir():
                    raise
                raise StoppedError(
                    f"stopped by Ctrl-C; blocks that are done are kept in {request.out}, and the "
                    "same command goes on"
                ) from stop
    except ERRORS as fault:
        return fault
