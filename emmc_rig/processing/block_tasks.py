"""Blocks of a capture as tasks for workers, each on the disk once it is done.

    KEPT/                       see `emmc_rig.files.folders.kept_folder`
        job.json                what the blocks are of, and what was settled for all of them
        frames.h5               the frames as the blocks get them
        block-000-001.h5        the arrays of a block's part
        block-000-001.json      their SHA-256, the block's figures and evidence: the block is done

A block whose two files agree, and with the job, is not computed again.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.memory import peak_memory_mib
from emmc_rig.files.psi import SavedPsi, open_psi
from emmc_rig.files.shards import create_array, created_group, opened_array
from emmc_rig.model.files import whole_file
from emmc_rig.model.frames import Frames
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import stored_arrays
from emmc_rig.processing.memory import task_bytes
from emmc_rig.processing.pool import Pool
from emmc_rig.version import __version__
from reconstruction.dictionary import Dictionary
from reconstruction.methods import MethodSettings, find_method
from reconstruction.result import Reconstruction, Status
from reconstruction.tiles import (
    AXES,
    Block,
    Grid,
    Place,
    SolvedBlock,
    Survey,
    assembled,
    judged_block,
    multiple_of,
    pixels_of,
    solve_block,
    summed_up,
    surveyed,
    within,
)
from reconstruction.verdict.blocks import judged_together
from reconstruction.verdict.evidence import Evidence
from reconstruction.verdict.rules import Verdict, verdict_from

FRAMES, JOB = "frames.h5", "job.json"
AGAIN = "the same command computes it again"


@dataclass(frozen=True)
class Capture:
    """What the blocks of a capture are computed from; picklable, so that workers get it.

    psi_path, kept: absolute, on a disk that all workers share. dictionary: see `open_dictionary`.
    """

    kept: Path
    psi_path: Path
    method: str
    dictionary: str | None
    settings: MethodSettings
    noise_sigma: float
    fingerprint: str

    @cached_property
    def psi(self) -> SavedPsi:
        """Psi, read window by window."""
        return open_psi(self.psi_path)

    def opened_dictionary(self) -> Dictionary | None:
        """Return the dictionary where the method needs one."""
        if not find_method(self.method).needs_dictionary:
            return None
        return open_dictionary(self.dictionary, self.psi.views, self.psi.binning)


@dataclass(frozen=True)
class BlockTask:
    """A block of a capture, with the settings that the survey settled."""

    capture: Capture
    settings: MethodSettings
    block: Block

    def path(self, suffix: str) -> Path:
        """Return the file of the block with this suffix."""
        return self.capture.kept / f"{self.block.name}.{suffix}"


def fingerprint_of(
    psi: SavedPsi, frames: Frames, method: str, dictionary: str | None, settings: MethodSettings
) -> str:
    """Return a SHA-256 of all that the light field follows from."""
    digest = hashlib.sha256()
    for array in (frames.readings, frames.usable):
        digest.update(np.ascontiguousarray(array).view(np.uint8).data)
    atoms = Path(dictionary) if dictionary is not None else None
    content = atoms.read_bytes() if atoms is not None and atoms.is_file() else b""
    what = (
        psi.checksum, frames.shape, frames.noise_sigma, method, dictionary,
        hashlib.sha256(content).hexdigest(), settings.model_dump(mode="json"), __version__,
    )  # fmt: skip
    digest.update(json.dumps(what).encode())
    return digest.hexdigest()


def _write_json(path: Path, content: object) -> None:
    with whole_file(path) as partial, open(partial, "w", encoding="utf-8") as file:
        json.dump(content, file, default=float)
        file.flush()
        os.fsync(file.fileno())


def _read_json(path: Path) -> dict[str, Any] | None:
    """Return what a file of a job says; None where it is missing or damaged."""
    try:
        content = parse_json(path.read_bytes(), path.name, ValueError)
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _sha256(path: Path) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> str:
    """Write arrays as HDF5, whole and on the disk; return the file's SHA-256."""
    with whole_file(path) as partial:
        with h5py.File(partial, "w") as file:
            for name, values in arrays.items():
                file[name] = values
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        return _sha256(partial)


def survey_task(capture: Capture) -> tuple[dict[str, Any], float]:
    """Settle in a worker what holds for the whole capture; return it as plain data, and its CPU."""
    started = time.process_time()
    readings, usable = _frames(capture.kept / FRAMES, np.s_[:, :, :])
    survey = surveyed(
        capture.method, capture.psi, readings, capture.noise_sigma, usable,
        capture.opened_dictionary(), capture.settings,
    )  # fmt: skip
    return _plain(survey), time.process_time() - started


def _plain(survey: Survey) -> dict[str, Any]:
    return {**asdict(survey), "settings": survey.settings.model_dump(mode="json")}


def _survey(found: Mapping[str, Any]) -> Survey:
    plain = {key: tuple(one) if isinstance(one, list) else one for key, one in found.items()}
    return Survey(**{**plain, "settings": MethodSettings.model_validate(found["settings"])})


def _frames(path: Path, seen: Any) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    with stored_arrays(path, AppError, AGAIN) as stored:
        return stored.dataset("readings")[seen], stored.dataset("usable")[seen].astype(bool)


def block_task(task: BlockTask) -> None:
    """Compute a block in a worker, and write its two files.

    Raises AppError naming the block where it fails, and OSError where it cannot be written.
    """
    started, cpu = time.perf_counter(), time.process_time()
    try:
        solved = _solved(task)
    except ERRORS as fault:
        rows, columns = (f"{part.start} to {part.stop}" for part in task.block.inner)
        raise AppError(
            f"rows {rows}, columns {columns} of the light field: {fault}; other blocks that are "
            "done are kept"
        ) from fault
    result = solved.result
    _write_json(
        task.path("json"),
        {
            "fingerprint": task.capture.fingerprint,
            "sha256": _write_arrays(task.path("h5"), solved.arrays),
            "result": {
                key: getattr(result, key)
                for key in ("status", "advice", "steps", "parameters", "left_out")
            },
            "evidence": None if solved.verdict is None else solved.verdict.evidence.as_dict(),
            "variance": _variance(task.block, solved.arrays),
            "seconds": time.perf_counter() - started,
            "cpu_seconds": time.process_time() - cpu,
            "peak_mib": peak_memory_mib(),
        },
    )


def _variance(block: Block, arrays: Mapping[str, NDArray]) -> float | None:
    """Return the sum of the light field's variance over a block's inner part; None without one."""
    if "sigma" not in arrays:
        return None
    inner = arrays["sigma"][:, :, *within(block.inner, block.part)]
    return float(np.sum(np.square(inner, dtype=np.float64)))


def _solved(task: BlockTask) -> SolvedBlock:
    capture, block = task.capture, task.block
    readings, usable = _frames(capture.kept / FRAMES, pixels_of(block.outer, capture.psi.binning))
    return solve_block(
        capture.method,
        capture.psi.window(*block.outer),
        readings,
        capture.noise_sigma,
        usable,
        block,
        capture.psi.size,
        task.settings,
        capture.opened_dictionary(),
    )


@dataclass(frozen=True)
class DoneBlock:
    """What a block says of itself, without its arrays; variance: see `_variance`."""

    result: Reconstruction
    verdict: Verdict | None
    variance: float | None
    seconds: float
    cpu_seconds: float
    peak_mib: float


def done_block(task: BlockTask) -> DoneBlock | None:
    """Return a block that is done and whole on the disk, else None."""
    kept = _read_json(task.path("json"))
    if kept is None or kept.get("fingerprint") != task.capture.fingerprint:
        return None
    if "cpu_seconds" not in kept:  # of an earlier version
        return None
    if kept.get("sha256") != _sha256(task.path("h5")):
        return None
    figures = {**kept["result"], "left_out": tuple(kept["result"]["left_out"])}
    figures["status"] = Status(figures["status"])
    result = Reconstruction(
        method=task.capture.method,
        light_field=np.empty((0, 0, 0, 0, 3), np.float32),
        objective=(),
        seconds=kept["seconds"],
        **figures,
    )
    verdict = (
        None if kept["evidence"] is None else verdict_from(Evidence.from_dict(kept["evidence"]))
    )
    measured = (kept[key] for key in ("variance", "seconds", "cpu_seconds", "peak_mib"))
    return DoneBlock(result, verdict, *measured)


def _settle(capture: Capture, frames: Frames, pool: Pool, alone: bool) -> Survey:
    """Return what holds for all blocks, from an earlier run where it is of the same capture.

    alone: there is one block, which settles everything by itself.
    """
    job = _read_json(capture.kept / JOB)
    if job is None or job.get("fingerprint") != capture.fingerprint:
        for path in capture.kept.iterdir():
            path.unlink()
        _write_arrays(capture.kept / FRAMES, {"readings": frames.readings, "usable": frames.usable})
        if alone:
            found, cpu_s = _plain(Survey.of_one_block(capture.settings, len(frames.readings))), 0.0
        else:
            ((_, (found, cpu_s)),) = pool.run(survey_task, [capture])
        survey = _survey(found)
        readings, usable = survey.applied(frames.readings, frames.usable)
        sha256 = _write_arrays(capture.kept / FRAMES, {"readings": readings, "usable": usable})
        job = {
            "fingerprint": capture.fingerprint, "frames": sha256, "survey": found,
            "survey_cpu_seconds": cpu_s,
        }  # fmt: skip
        _write_json(capture.kept / JOB, job)
    survey = _survey(job["survey"])
    if _sha256(capture.kept / FRAMES) != job["frames"]:
        readings, usable = survey.applied(frames.readings, frames.usable)
        _write_arrays(capture.kept / FRAMES, {"readings": readings, "usable": usable})
    return survey


@dataclass(frozen=True)
class Blocks:
    """The blocks of a capture, all done: their grid, what was settled, and what each says.

    workers: how many computed at a time.
    """

    grid: Grid
    survey: Survey
    tasks: Mapping[str, BlockTask]
    done: Mapping[str, DoneBlock]
    seconds: float
    workers: int

    def metrics(self) -> dict[str, Any]:
        """Return what metrics.json has of the blocks.

        peak_gib: the largest resident memory of a worker, workers: at a time, program_peak_gib: of
        this process, task_bytes: that travel to a worker for a block, all measured.
        """
        job = _read_json(self.kept / JOB) or {}
        return {
            "blocks": list(self.grid.shape),
            "stated_db": self.stated_db,
            "block_seconds": [one.seconds for one in self.done.values()],
            "block_cpu_seconds": [one.cpu_seconds for one in self.done.values()],
            "survey_cpu_seconds": job.get("survey_cpu_seconds"),
            "task_bytes": len(pickle.dumps(next(iter(self.tasks.values())))),
            "workers": self.workers,
            "peak_gib": max(one.peak_mib for one in self.done.values()) / 2**10,
            "program_peak_gib": peak_memory_mib() / 2**10,
        }

    @property
    def stated_db(self) -> float | None:
        """The PSNR that the deviations of all blocks stand for; None where one has none."""
        each = [one.variance for one in self.done.values()]
        views = int(np.prod(next(iter(self.tasks.values())).capture.psi.views))
        if None in each:
            return None
        mean = sum(one for one in each if one is not None) / (views * np.prod(self.grid.size))
        return float(-10 * np.log10(mean))

    def result(self) -> Reconstruction:
        """Return the figures of all blocks together, without arrays."""
        method = next(iter(self.tasks.values())).capture.method
        results = [one.result for one in self.done.values()]
        return summed_up(method, results, self.survey, self.seconds)

    def verdict(self, binning: int) -> Verdict:
        """Return the verdict on all blocks; raises AppError where none could be judged."""
        found = [
            judged_block(one.verdict, self.tasks[name].block, binning)
            for name, one in self.done.items()
            if one.verdict is not None
        ]
        if not found:
            raise AppError("no usable pixel: every one is saturated or excluded")
        return judged_together(found)

    def shapes(self) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
        """Return shape and type of the arrays of the whole, by name, which all blocks have."""
        each: list[dict[str, tuple[tuple[int, ...], np.dtype]]] = []
        for task in self.tasks.values():
            with stored_arrays(task.path("h5"), AppError, AGAIN) as stored:
                parts = {name: stored.dataset(name) for name in map(str, stored.file)}
                each.append({name: (part.shape, part.dtype) for name, part in parts.items()})
        found = {}
        for name, (shape, dtype) in each[0].items():
            if all(name in one for one in each):
                axes = AXES.get(name, 0)
                found[name] = (*shape[:axes], *self.grid.size, *shape[axes + 2 :]), dtype
        return found

    def write(self, name: str, out: Any) -> None:
        """Write an array of the whole into an array or dataset, blocks in a fixed order."""
        axes = AXES.get(name, 0)
        for block in self.grid:
            out[(slice(None),) * axes + block.inner] = _assembled(
                self.grid, self.kept, name, out.dtype, block.inner
            )

    @property
    def kept(self) -> Path:
        """The folder that the blocks lie in."""
        return next(iter(self.tasks.values())).capture.kept

    def write_shards(self, folder: Path, pool: Pool) -> None:
        """Write all arrays into a Zarr group by the workers of a pool, a shard each."""
        tasks = []
        group = created_group(folder)
        for name, (shape, dtype) in self.shapes().items():
            places = create_array(group, name, shape, dtype, AXES.get(name, 0))
            tasks += [ShardTask(self.grid, self.kept, folder.absolute(), name, at) for at in places]
        for _ in pool.run(shard_task, tasks):
            pass


@dataclass(frozen=True)
class ShardTask:
    """A shard of an array of a Zarr group, of blocks that are all done."""

    grid: Grid
    kept: Path
    folder: Path
    name: str
    place: Place


def shard_task(task: ShardTask) -> None:
    """Write a shard in a worker."""
    array = opened_array(task.folder, task.name, "r+")
    values = _assembled(task.grid, task.kept, task.name, array.dtype, task.place)
    array[(slice(None),) * AXES.get(task.name, 0) + task.place] = values


def _assembled(grid: Grid, kept: Path, name: str, dtype: np.dtype, place: Place) -> NDArray:
    def part(block: Block, at: tuple) -> NDArray:
        with stored_arrays(kept / f"{block.name}.h5", AppError, AGAIN) as stored:
            return stored.dataset(name)[at]

    return assembled(grid, place, AXES.get(name, 0), dtype, part)


def run_capture(
    capture: Capture,
    frames: Frames,
    pool: Pool,
    group: int | None = None,
    on_block: Callable[[int, int], None] | None = None,
) -> Blocks:
    """Return the blocks of a capture, computed by a pool, those done before left as they are.

    group: rows and columns in samples of the tiles that are handed out one after another; the
    blocks in them, and so the light field, are the same for any. on_block: called with the blocks
    done and their number. Raises WorkersError, AppError, and what a block raises.
    """
    started = time.perf_counter()
    psi, dictionary = capture.psi, capture.opened_dictionary()
    multiple = multiple_of(psi.binning, dictionary, capture.settings)
    grid = Grid(psi.size, multiple, 0, capture.settings.blocks)
    pool.fit(task_bytes(psi, grid))
    survey = _settle(capture, frames, pool, len(grid) == 1)
    grid = replace(grid, halo=survey.halo)
    pool.fit(task_bytes(psi, grid))
    tasks = {block.name: BlockTask(capture, survey.settings, block) for block in grid}
    done = {name: one for name, task in tasks.items() if (one := done_block(task)) is not None}
    left = [task for name, task in tasks.items() if name not in done]
    if group is not None:
        left.sort(key=lambda task: [part.start // group for part in task.block.inner])
    if on_block is not None and done:
        on_block(len(done), len(tasks))
    for task, _ in pool.run(block_task, left):
        one = done_block(task)
        if one is None:
            raise AppError(
                f"{task.path('h5')}: a worker wrote it, but it cannot be read here; put frames, "
                "Psi and --out on a disk that all workers share"
            )
        done[task.block.name] = one
        if on_block is not None:
            on_block(len(done), len(tasks))
    ordered = {name: done[name] for name in tasks}
    return Blocks(grid, survey, tasks, ordered, time.perf_counter() - started, pool.size)
