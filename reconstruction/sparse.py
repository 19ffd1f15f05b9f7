"""Dictionary-based reconstruction (Section VI-A): a sparse code for every patch, then averaging.

For every patch, min_beta 1/2 |Psi D beta - I|^2 + eta |beta|_1 (eq. 8), or a greedy relative of
it, with D beta the patch. The sensed dictionary Psi D is built once per patch, or once for all
patches where mask, colours and usable pixels repeat; the sparse solver runs on it; overlapping
patches are averaged.

Cost of a patch with n atoms, m measurements, N samples x views (and n_c stored colours):
building 2 n N n_c operations, `admm` n m^2 + 4 n m per pass, `lars` 4 n m per step, `omp` 2 n m
per atom, `ista`, `fista` and `sl0` 4 n m per step; putting the patch together 2 N c per atom used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.compiling import running_s
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction import bpdn
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.patches import (
    PatchGrid,
    PatchSensing,
    overlap_add,
    pixel_of_sample,
    regular_grid,
    selected_atoms,
    sense_atoms,
    sense_patches,
)
from emmc_rig.reconstruction.result import Progress, Reconstruction, Status

Array = NDArray[np.floating]
FLAT = 1e-3
BATCH_BYTES = 48 * 2**20
"""Of sensed dictionaries that a thread holds at a time."""


class SparseSettings(Settings):
    """The patches; `solver` says how each is coded."""

    removed: ClassVar[tuple[str, ...]] = ("aggregation",)

    stride: int = Field(default=5, ge=1, description="samples between patches")
    flat_favour: float = Field(
        default=8.0, ge=1, description="flat atoms cost this many times less than others"
    )
    solver: bpdn.BPDNSettings = Field(default_factory=bpdn.BPDNSettings)


def favoured(atoms: NDArray[np.float32], favour: float) -> NDArray[np.float32]:
    """Return atoms (atom, v, u, y, x, c) with those of even colour scaled by `favour`.

    A longer atom needs a smaller coefficient, so |beta|_1 hardly counts it. Every patch has a
    mean colour; to penalise it as if it were rare draws all patches towards grey and black, most
    where the frames separate colours weakly (monochrome sensors).
    """
    spread = np.ptp(atoms.reshape(len(atoms), -1, atoms.shape[-1]), axis=1).max(axis=1)
    flat = spread < FLAT * np.abs(atoms).max(axis=(1, 2, 3, 4, 5))
    if favour == 1 or not flat.any():
        return atoms
    return atoms * np.where(flat, np.float32(favour), np.float32(1)).reshape(-1, 1, 1, 1, 1, 1)


@dataclass(frozen=True, eq=False)
class PatchEstimates:
    """Patches put together.

    light_field: (v, u, y, x, c), 0 where no patch says anything. weight: (y, x), how many patches
    do. atoms: of each patch. converged: share of the patches. empty: patches without
    a usable pixel. classes: distinct sensed dictionaries. passes: the solver's mean.
    """

    light_field: NDArray[np.float32]
    weight: NDArray[np.float32]
    atoms: NDArray[np.int64]
    converged: float
    empty: int
    classes: int
    passes: float


@dataclass(frozen=True)
class _Work:
    """Some patches that meet the same colours: those of each class share Psi and usable pixels."""

    members: list[NDArray[np.int64]]
    sensing: PatchSensing


def _same_colours(
    psi: ImagingMatrix, grid: PatchGrid
) -> Iterator[tuple[list[NDArray[np.uint8]] | None, NDArray[np.int64]]]:
    """Yield the colours (shot, sample) that groups of patches meet, and the patches' indices."""
    everything = np.arange(len(grid))
    if psi.colour is None:
        yield None, everything
        return
    rows, columns = grid.shape
    groups: dict[bytes, list[int]] = {}
    for i, (y, x) in enumerate(grid.corners):
        seen = psi.colour[:, y : y + rows, x : x + columns]
        groups.setdefault(seen.tobytes(), []).append(i)
    for key, members in groups.items():
        seen = np.frombuffer(key, dtype=np.uint8).reshape(psi.shots, -1)
        yield list(seen), np.array(members)


def _classes(
    psi: ImagingMatrix, usable: NDArray[np.bool_], grid: PatchGrid, indices: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Return the patches of equal Psi and usable pixels, as groups of indices."""
    k = psi.binning
    rows, columns = grid.shape
    groups: dict[bytes, list[int]] = {}
    for i in indices:
        y, x = grid.corners[i]
        digest = hashlib.blake2b(digest_size=16)
        cut = psi.weights[:, :, :, y : y + rows, :, x : x + columns]
        digest.update(np.ascontiguousarray(cut).data)
        seen = usable[:, y // k : (y + rows) // k, x // k : (x + columns) // k]
        digest.update(np.ascontiguousarray(seen).data)
        groups.setdefault(digest.digest(), []).append(int(i))
    return [np.array(members) for members in groups.values()]


class _Coder:
    """Codes the patches of a grid, a batch at a time, in as many threads as numba uses."""

    def __init__(
        self,
        psi: ImagingMatrix,
        frames: Frames,
        dictionary: Dictionary,
        settings: SparseSettings,
    ) -> None:
        rows, columns = dictionary.patch_shape[2:4]
        dictionary.check_views(psi.light_field_shape[:2])
        self.psi, self.frames, self.settings = psi, frames, settings
        self.noise_sigma = frames.noise_sigma
        self.atoms = favoured(dictionary.atoms, settings.flat_favour)
        self.matrix = self.atoms.reshape(dictionary.size, -1)
        self.grid = regular_grid(psi.size, (rows, columns), settings.stride, psi.binning)
        self.pixel = pixel_of_sample((rows, columns), psi.binning)
        self.pixels = rows * columns // psi.binning**2
        self.classes = 0

    def batches(self) -> Iterator[tuple[list[NDArray[np.float32]], list[int], _Work]]:
        """Yield the atoms as the shots meet them, which of them each shot takes, and patches."""
        atoms = self.atoms
        for colours, indices in _same_colours(self.psi, self.grid):
            if colours is None:
                distinct, which = [selected_atoms(atoms, None)], [0] * self.psi.shots
            else:
                keys = [seen.tobytes() for seen in colours]
                firsts = sorted({keys.index(key) for key in keys})
                distinct = [selected_atoms(atoms, colours[first]) for first in firsts]
                which = [firsts.index(keys.index(key)) for key in keys]
            classes = _classes(self.psi, self.frames.usable, self.grid, indices)
            self.classes += len(classes)
            length = self.psi.shots * self.pixels
            at_once = max(1, int(BATCH_BYTES // (4 * len(atoms) * (length + 8))))
            at_once = min(at_once, max(1, len(classes) // (4 * get_num_threads())))
            for start in range(0, len(classes), at_once):
                members = classes[start : start + at_once]
                flat = np.concatenate(members)
                sensing = sense_patches(
                    self.psi, self.frames, self.grid.corners[flat], self.grid.shape
                )
                yield distinct, which, _Work(members, sensing)

    def code(
        self, batch: tuple[list[NDArray[np.float32]], list[int], _Work]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64], list[bpdn.Code]]:
        """Return the batch's patch indices, the patches, their usable pixels, their codes."""
        distinct, which, work = batch
        sensing = work.sensing
        firsts = np.cumsum([0, *(len(group) for group in work.members)])
        size, length = len(self.atoms), sensing.data.shape[1]
        sensed = np.zeros((len(work.members), size, length), dtype=np.float32)
        for shot, selection in enumerate(which):
            weights = np.ascontiguousarray(sensing.weights[firsts[:-1], shot])
            sense_atoms(distinct[selection], weights, self.pixel, self.pixels, shot, sensed)
        patches = np.zeros((firsts[-1], self.matrix.shape[1]), dtype=np.float32)
        codes = []
        for group, atoms in enumerate(sensed):
            members = range(firsts[group], firsts[group + 1])
            if not sensing.measured[firsts[group]]:
                codes += [bpdn.EMPTY] * len(members)
                continue
            solver = bpdn.prepared(
                atoms, sensing.data[members], self.noise_sigma, self.settings.solver
            )
            for i in members:
                code = solver(sensing.data[i], int(sensing.measured[i]))
                codes.append(code)
                used = np.flatnonzero(code.weights)
                patches[i] = code.weights[used] @ self.matrix[used]
        return np.concatenate(work.members), patches, sensing.measured, codes


def estimate_patches(
    psi: ImagingMatrix,
    frames: Frames,
    dictionary: Dictionary,
    settings: SparseSettings,
    on_step: Callable[[Progress], None] | None = None,
) -> PatchEstimates:
    """Return the estimates of all patches from checked frames; see `reconstruct_sparse`."""
    coder = _Coder(psi, frames, dictionary, settings)
    total = np.zeros(psi.light_field_shape, dtype=np.float32)
    weight = np.zeros(psi.size, dtype=np.float32)
    used = np.zeros(len(coder.grid), dtype=np.int64)
    converged = empty = done = 0
    passes = 0.0
    threads = get_num_threads()
    with ThreadPoolExecutor(threads) as pool:
        for found in _in_order(pool, coder.code, coder.batches(), 2 * threads):
            indices, patches, measured, codes = found
            shape = (len(indices), *dictionary.patch_shape)
            share = (measured > 0).astype(np.float32)
            overlap_add(coder.grid.corners[indices], patches.reshape(shape), share, total, weight)
            used[indices] = [np.count_nonzero(code.weights) for code in codes]
            converged += sum(code.converged for code in codes)
            passes += sum(code.steps for code in codes)
            empty += int((measured == 0).sum())
            done += len(indices)
            if on_step is not None:
                on_step(Progress(done, None, None, len(coder.grid)))
    covered = weight > 0
    total /= np.where(covered, weight, 1)[:, :, None]
    count = len(coder.grid)
    return PatchEstimates(
        total, weight, used, converged / count, empty, coder.classes, passes / count
    )


def _in_order(pool: ThreadPoolExecutor, call: Callable, items: Iterator, ahead: int) -> Iterator:
    """Yield call(item) in order, with at most `ahead` items in memory."""
    waiting = []
    try:
        for item in items:
            waiting.append(pool.submit(call, item))
            if len(waiting) >= ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for future in waiting:
            future.cancel()


def reconstruct_sparse(
    psi: ImagingMatrix,
    frames: Frames,
    dictionary: Dictionary,
    settings: SparseSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    found: PatchEstimates | None = None,
) -> Reconstruction:
    """Return the light field whose patches are sparse in the dictionary.

    The typical deviation of the frames sets the penalty when the settings do not; saturated and
    dead pixels are left out exactly, and where a whole patch is unusable it says nothing. found:
    the estimates of the same inputs, where they are known already. Raises ReconstructionError for
    inputs that do not fit each other, and a light field smaller than a patch.
    """
    settings = settings or SparseSettings()
    started = running_s()
    frames = checked_inputs(psi, frames)
    if found is None:
        found = estimate_patches(psi, frames, dictionary, settings, on_step)
    uncovered = int((found.weight == 0).sum())
    if found.empty == len(found.atoms):
        raise ReconstructionError("no patch holds a usable pixel: nothing can be reconstructed")
    advice = []
    if found.converged < 1:
        advice.append(
            f"{1 - found.converged:.1%} of the patches reached the step limit: raise max_steps"
        )
    if found.empty:
        advice.append(
            f"{found.empty} patches hold no usable pixel, {uncovered} samples were left at 0: "
            "expose shorter or add a shot"
        )
    return Reconstruction(
        method=f"dict-{settings.solver.method}",
        light_field=np.clip(found.light_field, 0, 1),
        status=Status.CONVERGED if found.converged == 1 and not found.empty else Status.INCOMPLETE,
        advice="; ".join(advice),
        steps=round(found.passes),
        objective=(),
        seconds=running_s() - started,
        parameters={
            "noise_sigma": frames.noise_sigma,
            "patches": len(found.atoms),
            "classes": found.classes,
            "atoms_per_patch": float(found.atoms.mean()),
            "stride": settings.stride,
            "dictionary_atoms": dictionary.size,
        },
    )
