"""Blocks of a capture as tasks for workers, each on the disk once it is done.

    KEPT/                       see `emmc_rig.store.folders.kept_folder`
        job.json                what was settled for all blocks, see `emmc_rig.store.jobs`
        frames.h5               the frames
        block-000-001.h5        the arrays of a block's part, its figures and evidence

A block that is there, of the same capture and as its checksums say, is not computed again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.model.camera import measured_views
from emmc_rig.model.compiling import running_s
from emmc_rig.model.files import whole_file
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.view_axes import ATTRIBUTE, stored_as
from emmc_rig.process.cost import peak_memory_mib, task_bytes
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.dictionary import Dictionary, open_dictionary
from emmc_rig.reconstruction.methods import MethodSettings, find_method
from emmc_rig.reconstruction.result import (
    Reconstruction,
    Status,
    WorstPlace,
    square_deviation,
    stated_figures,
    worst_place,
)
from emmc_rig.reconstruction.tiles import (
    AXES,
    ArrayType,
    Block,
    CaptureSurvey,
    Grid,
    Place,
    SolvedBlock,
    assembled,
    grid_of,
    pixels_of,
    solve_block,
    summed_up,
    surveyed,
    verdict_on,
    whole_shapes,
    within,
)
from emmc_rig.reconstruction.verdict.evidence import Evidence
from emmc_rig.reconstruction.verdict.rules import Verdict, verdict_from
from emmc_rig.store.jobs import Store, run_job, settled
from emmc_rig.store.pool import Pool
from emmc_rig.store.products import digest_of
from emmc_rig.store.psi import StoredPsi
from emmc_rig.store.shards import create_array, created_group, opened_array
from emmc_rig.version import __version__

FRAMES, ABOUT = "frames.h5", "about"
REMEDY = "the same command computes it again"
EVERYWHERE = (slice(None),) * 3


@dataclass(frozen=True)
class BlockJob:
    """What the blocks of a capture are computed from; picklable, so that workers get it.

    psi_path, kept: absolute, on a disk that all workers share. dictionary: see `open_dictionary`.
    digest: see `block_job`.
    """

    kept: Path
    psi_path: Path
    method: str
    dictionary: str | None
    settings: MethodSettings
    noise_sigma: float
    digest: str

    @cached_property
    def psi(self) -> StoredPsi:
        """Psi, read window by window."""
        return StoredPsi(self.psi_path)

    def opened_dictionary(self) -> Dictionary | None:
        """Return the dictionary where the method needs one."""
        if not find_method(self.method).needs_dictionary:
            return None
        return open_dictionary(self.dictionary, self.psi.views, self.psi.binning)

    def frames(self, pixels: Any) -> Frames:
        """Return the frames at some pixels."""
        with stored_arrays(self.kept / FRAMES, AppError, REMEDY) as stored:
            usable = stored.dataset("usable")[pixels].astype(bool)
            return even_frames(stored.dataset("readings")[pixels], self.noise_sigma, usable)


@dataclass(frozen=True)
class BlockTask:
    """A block of a capture, with what the survey settled for all of them."""

    job: BlockJob
    survey: CaptureSurvey
    block: Block

    @property
    def path(self) -> Path:
        """The file of the block."""
        return self.job.kept / f"{self.block.name}.h5"


def block_job(
    kept: Path,
    psi_path: Path,
    frames: Frames,
    method: str,
    dictionary: str | None,
    settings: MethodSettings,
) -> BlockJob:
    """Return the job of a capture, with the digest of all that the light field follows from."""
    atoms = Path(dictionary) if dictionary is not None else None
    content = atoms.read_bytes() if atoms is not None and atoms.is_file() else b""
    inputs = {
        "psi": StoredPsi(psi_path).checksum,
        "frames": frames.sha256,
        "noise_sigma": frames.noise_sigma,
        "method": method,
        "dictionary": [dictionary, hashlib.sha256(content).hexdigest()],
        "settings": settings.model_dump(mode="json"),
        "version": __version__,
    }
    digest = digest_of(inputs)
    return BlockJob(kept, psi_path, method, dictionary, settings, frames.noise_sigma, digest)


def _write(path: Path, arrays: Mapping[str, NDArray], about: Mapping[str, Any]) -> None:
    """Write arrays with their checksums, and plain data, as HDF5: whole and on the disk."""
    text = np.frombuffer(json.dumps(about, default=float).encode(), np.uint8)
    with whole_file(path) as partial, h5py.File(partial, "w") as file:
        for name, values in {**arrays, ABOUT: text}.items():
            file.create_dataset(name, data=values, fletcher32=True)


def _read(path: Path, digest: str) -> dict[str, Any] | None:
    """Return the figures of a block's file; None for a missing or damaged file, or another job."""
    try:
        with stored_arrays(path, AppError, REMEDY) as stored:
            for name in map(str, stored.file):
                stored.array(name)
            about = parse_json(stored.array(ABOUT).tobytes(), path.name, AppError)
    except AppError:
        return None
    return about if about["digest"] == digest else None


def survey_task(job: BlockJob) -> CaptureSurvey:
    """Settle in a worker what holds for the whole capture."""
    frames, dictionary = job.frames(EVERYWHERE), job.opened_dictionary()
    return surveyed(job.method, job.psi, frames, dictionary, job.settings)


def block_task(task: BlockTask) -> Generator[tuple[str, None], None, None]:
    """Compute a block in a worker, and write its file; yield its name.

    Raises AppError naming the block where it fails, and OSError where it cannot be written.
    """
    try:
        solved = _solved(task)
    except ERRORS as fault:
        rows, columns = (f"{part.start} to {part.stop}" for part in task.block.inner)
        raise AppError(
            f"rows {rows}, columns {columns} of the light field: {fault}; other blocks that are "
            "done are kept"
        ) from fault
    result = solved.result
    _write(
        task.path,
        solved.arrays,
        {
            "digest": task.job.digest,
            "result": {
                key: getattr(result, key) for key in ("status", "advice", "steps", "parameters")
            },
            "evidence": None if solved.verdict is None else solved.verdict.evidence.as_dict(),
            **_deviation(task, solved.arrays),
            "peak_mib": peak_memory_mib(),
        },
    )
    yield task.block.name, None


def _deviation(task: BlockTask, arrays: Mapping[str, NDArray]) -> dict[str, Any]:
    """Return `variance` and `worst` of a `DoneBlock`."""
    if "sigma" not in arrays:
        return {"variance": None, "worst": None}
    block = task.block
    inner = arrays["sigma"][:, :, *within(block.inner, block.part)]
    views = measured_views(task.job.psi)
    square = square_deviation(inner, views)
    worst, (rows, columns) = worst_place(square), block.inner
    place = worst._replace(row=worst.row + rows.start, column=worst.column + columns.start)
    return {"variance": float(square.sum() * views.sum()), "worst": place}


def _solved(task: BlockTask) -> SolvedBlock:
    job, block = task.job, task.block
    frames = task.survey.applied(job.frames(pixels_of(block.outer, job.psi.binning)))
    return solve_block(
        job.method, job.psi.window(*block.outer), frames, block, task.survey.settings,
        job.opened_dictionary(),
    )  # fmt: skip


@dataclass(frozen=True)
class DoneBlock:
    """What a block says of itself, without its arrays.

    variance: of its inner part, summed over measured views and places; worst: the place where it is
    largest. None for methods without a deviation.
    """

    result: Reconstruction
    verdict: Verdict | None
    variance: float | None
    worst: WorstPlace | None
    peak_mib: float


@dataclass(frozen=True)
class BlockFiles(Store[None, DoneBlock]):
    """The files of blocks, which workers write; tasks: by the names of their blocks."""

    tasks: Mapping[str, BlockTask]

    def get(self, name: str) -> DoneBlock | None:
        """Return a block that is done and whole on the disk, else None."""
        task = self.tasks[name]
        kept = _read(task.path, task.job.digest)
        if kept is None:
            return None
        figures = kept["result"]
        figures["status"] = Status(figures["status"])
        result = Reconstruction(
            method=task.job.method,
            light_field=np.empty((0, 0, 0, 0, 3), np.float32),
            objective=(),
            seconds=0.0,  # those of all blocks together are measured, see `Blocks`
            **figures,
        )
        evidence = kept["evidence"]
        verdict = None if evidence is None else verdict_from(Evidence.from_dict(evidence))
        at = kept.get("worst")  # Earlier versions did not write it.
        worst = None if at is None else WorstPlace(*at)
        return DoneBlock(result, verdict, kept["variance"], worst, kept["peak_mib"])

    def add(self, name: str, result: None) -> DoneBlock:
        """Return a block that a worker wrote; raises AppError where it cannot be read here."""
        done = self.get(name)
        if done is None:
            raise AppError(
                f"{self.tasks[name].path}: a worker wrote it, but it cannot be read here; put "
                "frames, Psi and results on a disk that all workers share"
            )
        return done


def _surveyed(
    job: BlockJob, frames: Frames, pool: Pool, alone: bool, watcher: Watcher
) -> CaptureSurvey:
    """Return what holds for all blocks, from an earlier run where it is of the same capture.

    Frames are on the disk then. alone: there is a single block, which settles everything by itself.
    """

    def settle() -> dict[str, Any]:
        arrays = {"readings": frames.readings, "usable": frames.usable}
        _write(job.kept / FRAMES, arrays, {})
        if alone:
            survey = CaptureSurvey.of_one_block(job.settings, len(frames.readings))
        else:
            ((_, survey),) = pool.run(survey_task, [job])
        return {**asdict(survey), "settings": survey.settings.model_dump(mode="json")}

    def kept() -> str:
        return f"blocks done: {len(list(job.kept.glob('block-*.h5')))}"

    plain = settled(job.kept, job.digest, settle, watcher, kept)
    known: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in plain.items()}
    known["settings"] = MethodSettings.model_validate(known["settings"])
    return CaptureSurvey(**known)


@dataclass(frozen=True)
class Blocks:
    """The blocks of a capture, all done: their grid, what was settled, and what each says.

    done: in the order of the grid. workers: how many computed at a time.
    """

    job: BlockJob
    grid: Grid
    survey: CaptureSurvey
    done: Sequence[DoneBlock]
    seconds: float
    workers: int

    def metrics(self) -> dict[str, Any]:
        """Return what metrics.json has of the blocks.

        peak_gib: the largest resident memory of a worker, workers: at a time, program_peak_gib: of
        this process.
        """
        return {
            "blocks": list(self.grid.shape),
            **stated_figures(self.variance, self.result().parameters, self.worst),
            "workers": self.workers,
            "peak_gib": max(block.peak_mib for block in self.done) / 2**10,
            "program_peak_gib": peak_memory_mib() / 2**10,
        }

    @property
    def variance(self) -> float | None:
        """The mean square of the deviations of all blocks; None where one has none."""
        variances = [block.variance for block in self.done]
        if None in variances:
            return None
        samples = measured_views(self.job.psi).sum() * np.prod(self.grid.size)
        return float(sum(v for v in variances if v is not None) / samples)

    @property
    def worst(self) -> WorstPlace | None:
        """The place of all blocks with the largest deviation; None where none has any."""
        return max((block.worst for block in self.done if block.worst), default=None)

    def result(self) -> Reconstruction:
        """Return the figures of all blocks together, without arrays."""
        results = [block.result for block in self.done]
        summed = summed_up(self.job.method, results, self.survey, self.seconds)
        return replace(summed, measured=self.measured)

    @property
    def measured(self) -> NDArray[np.bool_] | None:
        """Which views are measured, see `Reconstruction`."""
        measured = measured_views(self.job.psi)
        return None if measured.all() else measured

    def verdict(self) -> Verdict:
        """Return the verdict on all blocks; raises ReconstructionError without usable pixels."""
        verdicts = [done.verdict for done in self.done]
        return verdict_on(self.grid, verdicts, self.job.psi.binning)

    def shapes(self) -> dict[str, ArrayType]:
        """Return shape and type of the arrays of the whole, by name, which all blocks have."""
        every: list[dict[str, ArrayType]] = []
        for block in self.grid:
            with stored_arrays(self.job.kept / f"{block.name}.h5", AppError, REMEDY) as stored:
                names = (str(name) for name in stored.file if name != ABOUT)
                parts = {name: stored.dataset(name) for name in names}
                every.append({name: (part.shape, part.dtype) for name, part in parts.items()})
        return whole_shapes(self.grid, every)

    def write(self, name: str, out: Any) -> None:
        """Write an array of the whole into an array or dataset, blocks in a fixed order."""
        for block in self.grid:
            shard_task(ShardTask(self.grid, self.job.kept, name, block.inner), out)

    def write_shards(self, folder: Path, pool: Pool) -> None:
        """Write all arrays into a Zarr group by the workers of a pool, a shard each."""
        tasks, group = [], created_group(folder)
        group.attrs[ATTRIBUTE] = stored_as(self.job.psi.view_axes)
        for name, (shape, dtype) in self.shapes().items():
            for place in create_array(group, name, shape, dtype, AXES.get(name, 0)):
                tasks.append(ShardTask(self.grid, self.job.kept, name, place, folder.absolute()))
        for _ in pool.run(shard_task, tasks):
            pass


@dataclass(frozen=True)
class ShardTask:
    """A place of an array of the whole, to assemble from blocks that are all done.

    folder: the Zarr group to write it into.
    """

    grid: Grid
    kept: Path
    name: str
    place: Place
    folder: Path = Path()


def shard_task(task: ShardTask, out: Any = None) -> None:
    """Write a place into an array or dataset `out`; by default the one of the task's Zarr group."""
    array = opened_array(task.folder, task.name, "r+") if out is None else out
    axes = AXES.get(task.name, 0)

    def part(block: Block, at: tuple) -> NDArray:
        with stored_arrays(task.kept / f"{block.name}.h5", AppError, REMEDY) as stored:
            return stored.dataset(task.name)[at]

    values = assembled(task.grid, task.place, axes, array.dtype, part)
    array[(slice(None),) * axes + task.place] = values


def compute_blocks(job: BlockJob, frames: Frames, pool: Pool, watcher: Watcher) -> Blocks:
    """Return the blocks of a capture, computed by a pool, those done before left as they are.

    watcher: gets the blocks done. Raises WorkersError, AppError, and what a block raises.
    """
    started = running_s()
    psi, dictionary = job.psi, job.opened_dictionary()
    grid = grid_of(psi, dictionary, job.settings)
    pool.fit(task_bytes(psi, grid))
    survey = _surveyed(job, frames, pool, len(grid) == 1, watcher)
    grid = replace(grid, halo=survey.halo)
    pool.fit(task_bytes(psi, grid))
    tasks = {block.name: BlockTask(job, survey, block) for block in grid}
    done = run_job(
        list(tasks),
        lambda missing: [tasks[name] for name in missing],
        block_task,
        BlockFiles(tasks),
        watcher,
        job.kept.parents[1],
        "blocks",
        pool,
    )
    ordered = [done[block.name] for block in grid]
    took_s = running_s() - started
    return Blocks(job, grid, survey, ordered, took_s, pool.size)
