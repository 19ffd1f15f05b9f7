"""Dictionary-based reconstruction (Section VI-A): a sparse code for every patch, then averaging.

For every patch, min_beta 1/2 |Psi D beta - I|^2 + eta |beta|_1 (eq. 8), with D beta the patch. The
sensed dictionary Psi D is built once per patch, or once for all patches where mask and colours
repeat; ADMM runs on it; overlapping patches are averaged.

Cost of a patch with n atoms, m measurements, N samples x views (and n_c stored colours): building
2 n N n_c operations, ADMM n m^2 + 4 n m per pass, putting together 2 N c per atom used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.compiling import running_s
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction import bpdn
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.patches import (
    PatchSensing,
    grouped,
    overlap_add,
    regular_grid,
    selected_atoms,
    sense_atoms,
    sense_patches,
)
from emmc_rig.reconstruction.result import Progress, Reconstruction, Status

Array = NDArray[np.floating]
FLAT = 1e-3
"""Spread of each colour in an atom, over its largest value, below which the atom is flat."""
SOME = 100
"""Of so many samples the first alone rules out most atoms that are not flat."""
BATCH_BYTES = 48 * 2**20
"""Size of the sensed dictionaries that a thread holds at a time."""
MOST_TOGETHER = 128
"""Patches of a class at a time: products of matrices are no faster with more."""


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
    if favour == 1:
        return atoms
    samples = atoms.reshape(len(atoms), -1, atoms.shape[-1])
    largest = np.float32(FLAT) * np.abs(samples).max(axis=(1, 2))
    flat = np.flatnonzero(np.ptp(samples[:, ::SOME], axis=1).max(axis=1) < largest)
    flat = flat[np.ptp(samples[flat], axis=1).max(axis=1) < largest[flat]]
    if not len(flat):
        return atoms
    scaled = atoms.copy()
    scaled[flat] *= np.float32(favour)
    return scaled


@dataclass(frozen=True, eq=False)
class PatchEstimates:
    """Patches put together.

    light_field: (v, u, y, x, c), 0 where no patch says anything. weight: (y, x), how many patches
    do. atoms: number used by each patch. converged: share of the patches. empty: patches without
    a usable pixel. classes: distinct sensed dictionaries. passes: the solver's mean.
    """

    light_field: NDArray[np.float32]
    weight: NDArray[np.float32]
    atoms: NDArray[np.int64]
    converged: float
    empty: int
    classes: int
    passes: float


@dataclass(frozen=True, eq=False)
class _Batch:
    """Patches whose pixels see the same colours, in classes of equal Psi.

    atoms: the different sets of atoms as shots see them, (pixel, ray, atom) each.
    set_of_shot: index of each shot's set. classes: indices of the patches of each class. sensing:
    of all patches, class by class.
    """

    atoms: list[NDArray[np.float32]]
    set_of_shot: list[int]
    classes: list[NDArray[np.int64]]
    sensing: PatchSensing

    @property
    def patches(self) -> NDArray[np.int64]:
        """Indices of all patches in the grid, class by class."""
        return np.concatenate(self.classes)


@dataclass(frozen=True, eq=False)
class _CodedBatch:
    """patches: indices in the grid. estimates: (patch, v u y x c). measured: usable pixels."""

    patches: NDArray[np.int64]
    estimates: NDArray[np.float32]
    measured: NDArray[np.int64]
    codes: list[bpdn.Code]


class _Coder:
    """Codes the patches of a grid, a batch at a time, in as many threads as numba uses."""

    def __init__(
        self,
        psi: Psi,
        frames: Frames,
        dictionary: Dictionary,
        settings: SparseSettings,
    ) -> None:
        rows, columns = dictionary.patch_shape[2:4]
        dictionary.check_views(psi.light_field_shape[:2])
        self.psi, self.frames, self.settings = psi, frames, settings
        self.atoms = favoured(dictionary.atoms, settings.flat_favour)
        self.matrix = self.atoms.reshape(dictionary.size, -1)
        self.grid = regular_grid(psi.size, (rows, columns), settings.stride, psi.binning)
        self.pixels = rows * columns // psi.binning**2
        self.classes = 0

    def _cut(self, array: NDArray, corner: NDArray[np.int64], step: int = 1) -> NDArray:
        """Return a patch of an array (..., y, x), of pixels of `step` x `step` samples."""
        (y, x), (rows, columns) = corner, self.grid.shape
        return array[..., y // step : (y + rows) // step, x // step : (x + columns) // step]

    def _colour_groups(self) -> Iterator[tuple[NDArray[np.uint8] | None, NDArray[np.int64]]]:
        """Yield the colours (shot, sample) that patches see (None: all), and these patches."""
        colour = self.psi.colour
        if colour is None:
            yield None, np.arange(len(self.grid))
            return
        seen = (self._cut(colour, corner).tobytes() for corner in self.grid.corners)
        for key, members in grouped(seen).items():
            colours = np.frombuffer(key, dtype=np.uint8).reshape(self.psi.shots, -1)
            yield colours, np.array(members)

    def _classes(self, patches: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return the patches in groups of equal Psi: one sensed dictionary."""

        def key(corner: NDArray[np.int64]) -> bytes:
            (y, x), (rows, columns) = corner, self.grid.shape
            weights = self.psi.weights[:, :, :, y : y + rows, :, x : x + columns]
            return hashlib.blake2b(np.ascontiguousarray(weights).data, digest_size=16).digest()

        groups = grouped(key(corner) for corner in self.grid.corners[patches]).values()
        self.classes += len(groups)
        return [
            patches[places[first : first + MOST_TOGETHER]]
            for places in groups
            for first in range(0, len(places), MOST_TOGETHER)
        ]

    def batches(self) -> Iterator[_Batch]:
        """Yield all patches; a batch's sensed dictionaries fit into BATCH_BYTES."""
        of_class = len(self.atoms) * (self.psi.shots * self.pixels + 8)
        for colours, patches in self._colour_groups():
            if colours is None:
                sets = [selected_atoms(self.atoms, None, self.psi.binning)]
                set_of_shot = [0] * self.psi.shots
            else:
                shots = list(grouped(of_shot.tobytes() for of_shot in colours).values())
                sets = [
                    selected_atoms(self.atoms, colours[alike[0]], self.psi.binning)
                    for alike in shots
                ]
                set_of_shot = [
                    next(i for i, alike in enumerate(shots) if shot in alike)
                    for shot in range(self.psi.shots)
                ]
            classes = self._classes(patches)
            largest = max(map(len, classes))
            size = 4 * (of_class + 2 * largest * self.matrix.shape[1])
            fitting = max(1, BATCH_BYTES // size)
            at_once = min(fitting, max(1, len(classes) // (4 * get_num_threads())))
            for start in range(0, len(classes), at_once):
                part = classes[start : start + at_once]
                corners = self.grid.corners[np.concatenate(part)]
                sensing = sense_patches(self.psi, self.frames, corners, self.grid.shape)
                yield _Batch(sets, set_of_shot, part, sensing)

    def code(self, batch: _Batch) -> _CodedBatch:
        """Return the batch with a code and an estimate of each patch, D beta.

        Psi D is built shot by shot, once for each class.
        """
        sensing = batch.sensing
        counts = np.array([len(members) for members in batch.classes])
        ends = np.cumsum(counts)
        firsts = ends - counts
        shape = len(batch.classes), len(self.atoms), sensing.data.shape[1]
        sensed = np.zeros(shape, dtype=np.float32)
        for shot, chosen in enumerate(batch.set_of_shot):
            sense_atoms(batch.atoms[chosen], sensing.weights[shot][:, firsts], shot, sensed)
        estimates = np.zeros((ends[-1], self.matrix.shape[1]), dtype=np.float32)
        codes = []
        for atoms, first, end in zip(sensed, firsts, ends, strict=True):
            of_class = sensing.data[first:end], sensing.usable[first:end]
            codes += bpdn.codes(atoms, *of_class, self.frames.noise_sigma, self.settings.solver)
        for estimate, code in zip(estimates, codes, strict=True):
            used = np.flatnonzero(code.weights)
            estimate[:] = code.weights[used] @ self.matrix[used]
        return _CodedBatch(batch.patches, estimates, sensing.usable.sum(axis=1), codes)


@one_blas_thread()
def estimate_patches(
    psi: Psi,
    frames: Frames,
    dictionary: Dictionary,
    settings: SparseSettings,
    on_step: Callable[[Progress], None] | None = None,
) -> PatchEstimates:
    """Return the estimates of all patches from checked frames; see `reconstruct_sparse`."""
    coder = _Coder(psi, frames, dictionary, settings)
    total = np.zeros(psi.light_field_shape, dtype=np.float32)
    weight = np.zeros(psi.size, dtype=np.float32)
    count = len(coder.grid)
    used = np.zeros(count, dtype=np.int64)
    converged = empty = done = 0
    passes = 0.0
    threads = get_num_threads()
    with ThreadPoolExecutor(threads) as pool:
        for batch in _in_order(pool, coder.code, coder.batches(), 2 * threads):
            corners = coder.grid.corners[batch.patches]
            share = (batch.measured > 0).astype(np.float32)
            patches = batch.estimates.reshape(len(corners), *dictionary.patch_shape)
            overlap_add(corners, patches, share, total, weight)
            used[batch.patches] = [np.count_nonzero(code.weights) for code in batch.codes]
            converged += sum(code.converged for code in batch.codes)
            passes += sum(code.steps for code in batch.codes)
            empty += int((batch.measured == 0).sum())
            done += len(corners)
            if on_step is not None:
                on_step(Progress(done, None, None, count))
    total /= np.where(weight > 0, weight, 1)[:, :, None]
    return PatchEstimates(
        total, weight, used, converged / count, empty, coder.classes, passes / count
    )


def _in_order(
    pool: ThreadPoolExecutor,
    call: Callable[[_Batch], _CodedBatch],
    batches: Iterator[_Batch],
    ahead: int,
) -> Iterator[_CodedBatch]:
    """Yield call(batch) in order, with at most `ahead` batches in memory."""
    waiting: list[Future[_CodedBatch]] = []
    try:
        for batch in batches:
            waiting.append(pool.submit(call, batch))
            if len(waiting) >= ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for future in waiting:
            future.cancel()


def reconstruct_sparse(
    psi: Psi,
    frames: Frames,
    dictionary: Dictionary,
    settings: SparseSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    estimates: PatchEstimates | None = None,
) -> Reconstruction:
    """Return the light field whose patches are sparse in the dictionary.

    The typical deviation of the frames sets the penalty when the settings do not; saturated and
    dead pixels are left out exactly, and where a whole patch is unusable it says nothing.
    estimates: of the same inputs, where they are known already. Raises ReconstructionError for
    inputs that do not fit each other, and a light field smaller than a patch.
    """
    settings = settings or SparseSettings()
    started = running_s()
    frames = checked_inputs(psi, frames)
    if estimates is None:
        estimates = estimate_patches(psi, frames, dictionary, settings, on_step)
    patches = len(estimates.atoms)
    if estimates.empty == patches:
        raise ReconstructionError("no patch holds a usable pixel: nothing can be reconstructed")
    advice = []
    if estimates.converged < 1:
        share = 1 - estimates.converged
        advice.append(f"{share:.1%} of the patches reached the step limit: raise max_steps")
    if estimates.empty:
        uncovered = int((estimates.weight == 0).sum())
        advice.append(
            f"patches without a usable pixel: {estimates.empty}; samples left at 0: {uncovered}; "
            "expose shorter or add a shot"
        )
    return Reconstruction(
        method="dict-admm",
        light_field=np.clip(estimates.light_field, 0, 1),
        status=Status.INCOMPLETE if advice else Status.CONVERGED,
        advice="; ".join(advice),
        steps=round(estimates.passes),
        objective=(),
        seconds=running_s() - started,
        parameters={
            "noise_sigma": frames.noise_sigma,
            "patches": patches,
            "classes": estimates.classes,
            "atoms_per_patch": float(estimates.atoms.mean()),
            "stride": settings.stride,
            "dictionary_atoms": dictionary.size,
        },
    )
