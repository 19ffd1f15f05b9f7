"""Several captures in one call, on one pool of workers, within a ceiling of memory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import get_num_threads

from emmc_rig.errors import ERRORS, AppError, StoppedError, WrongUsageError
from emmc_rig.files.folders import KEPT, is_session, result_folder
from emmc_rig.files.frames import PSI
from emmc_rig.reconstruct.pool import Pool, opened_pool
from emmc_rig.reconstruct.solve import reconstruct_folder
from emmc_rig.session.session import RECONSTRUCTION
from reconstruction.methods import MethodSettings
from reconstruction.result import Progress
from reconstruction.tiles import SAMPLE, SAMPLES, TEXTURE_REACH, SavedPsi

UNITS = {"K": 10**3, "M": 10**6, "G": 10**9, "KI": 2**10, "MI": 2**20, "GI": 2**30}
BASE_BYTES = 480 * 2**20
"""Of a process with the program's libraries, its kernels compiled."""
RAY_BYTES, WEIGHT_BYTES = 150, 26
"""Of a block, for each of its rays (views times samples), and for each of their weights (shots
times stored colours). Measured: adaptive-fast on 240x240 samples, one and three shots, 141 and 184
a ray beside Psi; on blocks of 190,000 samples, one shot, 169 with it."""
PARALLAX_PX = 3.0
"""Disparity whose halo is reckoned with before a survey has found the capture's own."""


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
    tile: int | None = None
    as_zarr: bool = False


def parse_memory(text: str) -> int:
    """Return the bytes of "2GiB" or "800MB"; raises WrongUsageError."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMG]?I?)B?", text.strip().upper())
    if found is None or found[2] not in UNITS:
        raise WrongUsageError(f"--memory {text}: write bytes with a unit, for instance 2GiB")
    return int(float(found[1]) * UNITS[found[2]])


def worker_bytes(shape: Sequence[int], settings: MethodSettings, disparity_px: float) -> int:
    """Return the memory that a worker needs for a block of Psi of a shape (s, v, u, y, k, x).

    disparity_px: the capture's largest, for the halo.
    """
    shots, v, u, rows, stored, columns = shape
    blocks = settings.blocks
    halo = TEXTURE_REACH + disparity_px * (max(v, u) // 2)
    samples = rows * columns
    if samples > blocks.whole:
        sides = (min(side, blocks.side + 2 * (blocks.blend + halo)) for side in (rows, columns))
        samples = max(int(np.prod(list(sides))), (SAMPLE * SAMPLES) ** 2)
    return int(BASE_BYTES + samples * v * u * (RAY_BYTES + WEIGHT_BYTES * shots * stored))


def workers_within(memory: int, requests: Sequence[Request], wanted: int) -> int:
    """Return how many processes fit below a ceiling beside this one; raises AppError for none."""
    need = 0
    for request in requests:
        if is_session(request.folder) and request.psi is None:
            raise AppError(
                f"{request.folder}: --memory needs Psi before the workers start; run `emmc-rig "
                "calibrate` and give --psi"
            )
        psi = SavedPsi(request.psi or request.folder / PSI)
        settings = request.settings or MethodSettings()
        need = max(need, worker_bytes(psi.shape, settings, PARALLAX_PX))
    fitting = (memory - BASE_BYTES) // need if need else wanted
    if fitting < 1:
        raise AppError(
            f"--memory of {memory / 2**30:.2f} GiB: this program and one worker need about "
            f"{(BASE_BYTES + need) / 2**30:.2f} GiB for a block; give more, or smaller blocks by "
            "--settings (blocks: side, whole)"
        )
    return int(min(fitting, wanted))


def _one(request: Request, pool: Pool | None, on_step: Callable[[Progress], None]) -> dict:
    place = request.folder / RECONSTRUCTION if is_session(request.folder) else None
    with result_folder(request.out, "reconstruct", belongs_to=place, resumes=True) as folder:
        try:
            return reconstruct_folder(
                request.folder, folder, request.method, request.psi, request.dictionary,
                request.settings, request.truth, on_step, request.chosen, pool, request.tile,
                request.as_zarr,
            )  # fmt: skip
        except KeyboardInterrupt as stop:
            if not (folder.parent / KEPT).is_dir():
                raise
            raise StoppedError(
                f"stopped by Ctrl-C; blocks that are done are kept in {request.out}, and the same "
                "command goes on"
            ) from stop


def reconstruct_captures(
    requests: Sequence[Request],
    workers: int | None,
    cluster: str | None,
    memory: int | None,
    on_step: Callable[[Progress], None],
) -> Iterator[tuple[Request, dict | Exception]]:
    """Yield each capture with its metrics, or with what it failed by, in the order they are done.

    workers: processes; None and one capture that is one block: this process and its threads.
    memory: bytes of all processes together. on_step: called with the progress of a single capture,
    or with the captures done. Raises WorkersError, AppError for a ceiling that is too low.
    """
    alone = len(requests) == 1
    count = workers or get_num_threads()
    if memory is not None:
        count = workers_within(memory, requests, count)
    shared = not alone or workers is not None or cluster is not None or memory is not None
    with opened_pool(count, cluster) if shared else nullcontext() as pool:
        if alone:
            try:
                yield requests[0], _one(requests[0], pool, on_step)
            except ERRORS as fault:
                yield requests[0], fault
            return
        assert pool is not None
        # One more than the pool computes at a time is read ahead, or written behind.
        with ThreadPoolExecutor(min(len(requests), pool.size + 1)) as threads:
            futures = {
                threads.submit(_one, request, pool, lambda _: None): request for request in requests
            }
            try:
                for done, future in enumerate(as_completed(futures), 1):
                    fault = future.exception()
                    if fault is not None and not isinstance(fault, ERRORS):
                        raise fault
                    on_step(Progress(done, None, None, len(requests)))
                    outcome = future.result() if fault is None else fault
                    yield futures[future], outcome
            except BaseException:
                for future in futures:
                    future.cancel()
                pool.end()
                raise
