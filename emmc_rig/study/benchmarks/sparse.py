"""Sparse solvers timed patch by patch, against the machine's bound and against scikit-learn.

All run on the same sensed dictionaries in the same run, one core each. The bound of a solver is
its operations, counted from the passes it took, at the rate at which a core multiplies and adds
data that lies in its first-level cache.
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.compiling import njit
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures
from emmc_rig.study.benchmarks.variational import peer_module
from reconstruction import bpdn
from reconstruction.dictionary import Dictionary
from reconstruction.patches import (
    pixel_of_sample,
    regular_grid,
    selected_atoms,
    sense_atoms,
    sense_patches,
)

PATCHES = 24
STRIDE = 5
TIMED_SIZE = (120, 160)
"""Rows and columns of the scene from which they are taken."""
STEP_LIMIT = 500
"""Of ISTA and FISTA, which would take thousands."""


@dataclass(frozen=True)
class SolverTiming(Figures):
    """One solver: median milliseconds a patch, passes over the atoms, and what they cost.

    gigaflops: operations done a second. ratio: milliseconds over those at the machine's rate.
    gap: relative, the largest (NaN where none is known). psnr_db: of the patches.
    """

    name: str
    milliseconds: float
    passes: float
    gigaflops: float
    ratio: float
    gap: float
    psnr_db: float


@njit(cache=True, fastmath=True, nogil=True)
def _multiply_add(rounds, out):
    """Multiply and add in registers: twice out.size x rounds operations."""
    for _ in range(rounds):
        for i in range(out.size):
            out[i] = out[i] * np.float32(0.999) + np.float32(0.001)


def peak_gigaflops() -> float:
    """Return the operations a second (1e9) of one core on data in its first-level cache."""
    values = np.ones(2048, dtype=np.float32)
    rounds = 200_000
    _multiply_add(1, values)
    best = np.inf
    for _ in range(3):
        started = time.perf_counter()
        _multiply_add(rounds, values)
        best = min(best, time.perf_counter() - started)
    return 2 * values.size * rounds / best / 1e9


@dataclass(frozen=True, eq=False)
class _Problem:
    sensed: NDArray[np.float32]
    data: NDArray[np.float32]
    measured: NDArray[np.int64]
    truth: NDArray[np.float32]
    building_s: float
    building_operations: float


def _problem(
    camera: Camera, size: tuple[int, int], dictionary: Dictionary, noise_sigma: float
) -> _Problem:
    """Sense some patches of a built-in scene through a camera."""
    psi = build_imaging_matrix(camera, size)
    light_field = open_scene("deep-occlusions", size=size, views=camera.views).light_field
    rng = np.random.default_rng(0)
    frames = psi.forward(light_field) + rng.normal(0, noise_sigma, psi.frames_shape)
    rows, columns = dictionary.checked(camera.views, dictionary.patch_shape[2:4]).patch_shape[2:4]
    grid = regular_grid(size, (rows, columns), STRIDE // psi.binning * psi.binning, psi.binning)
    # Patches that meet the same colours are sensed together, as in a reconstruction.
    seen = [
        b"" if psi.colour is None else psi.colour[:, y : y + rows, x : x + columns].tobytes()
        for y, x in grid.corners
    ]
    alike = grid.corners[[i for i, key in enumerate(seen) if key == seen[0]]]
    corners = rng.permutation(alike)[:PATCHES]
    usable = np.ones(psi.frames_shape, dtype=bool)
    sensing = sense_patches(psi, frames, usable, corners, (rows, columns))
    pixel = pixel_of_sample((rows, columns), psi.binning)
    sensed = np.zeros((len(corners), dictionary.size, sensing.data.shape[1]), dtype=np.float32)
    selections = [
        selected_atoms(
            dictionary.atoms, None if sensing.colours is None else sensing.colours[0, shot]
        )
        for shot in range(psi.shots)
    ]

    def build() -> None:
        for shot, selected in enumerate(selections):
            weights = np.ascontiguousarray(sensing.weights[:, shot])
            sense_atoms(selected, weights, pixel, int(pixel.max()) + 1, shot, sensed)

    build()
    started = time.perf_counter()
    build()
    building_s = time.perf_counter() - started
    values = np.count_nonzero(sensing.weights[0])
    operations = 2.0 * len(corners) * dictionary.size * max(values, 1)
    truth = np.stack([light_field[:, :, y : y + rows, x : x + columns] for y, x in corners])
    return _Problem(sensed, sensing.data, sensing.measured, truth, building_s, operations)


def solver_timings(
    camera: Camera, size: tuple[int, int], dictionary: Dictionary, noise_sigma: float = 0.005
) -> Iterator[SolverTiming]:
    """Yield the building of Psi D, then every solver, on the same patches."""
    problem = _problem(camera, size, dictionary, noise_sigma)
    rate = peak_gigaflops()
    patches, atoms, length = problem.sensed.shape
    building = problem.building_s / patches
    flops = problem.building_operations / patches
    yield SolverTiming(
        "Psi D",
        building * 1e3,
        1,
        flops / building / 1e9,
        building * rate * 1e9 / flops,
        np.nan,
        np.nan,
    )
    for method in get_args(bpdn.Method):
        limit = {"max_steps": STEP_LIMIT} if method in ("ista", "fista") else {}
        settings = bpdn.BPDNSettings.model_validate({"method": method, **limit})
        seconds, codes = _timed(
            lambda i, settings=settings: bpdn.prepared(
                problem.sensed[i], problem.data[i : i + 1], noise_sigma, settings
            )(problem.data[i], int(problem.measured[i])),
            patches,
        )
        passes = statistics.mean(code.steps for code in codes)
        each = 2 if method in ("omp", "lars") else 4
        flops = each * passes * atoms * length
        if method not in ("omp", "lars"):
            flops += atoms * length**2
        estimate = np.stack([code.weights @ dictionary.matrix for code in codes])
        yield SolverTiming(
            method,
            seconds * 1e3,
            passes,
            flops / seconds / 1e9,
            seconds * rate * 1e9 / flops,
            max((code.gap for code in codes), default=np.nan),
            psnr_db(estimate.reshape(problem.truth.shape), problem.truth),
        )


def _timed(call: Callable[[int], Any], patches: int) -> tuple[float, list[Any]]:
    """Return the median seconds of a call by patch, and the results."""
    call(0)
    seconds, results = [], []
    for i in range(patches):
        started = time.perf_counter()
        results.append(call(i))
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds), results


@dataclass(frozen=True)
class PeerTiming(Figures):
    """Ours against theirs: median milliseconds a patch, their ratio, how far the codes differ."""

    name: str
    ours_ms: float
    theirs_ms: float
    difference: float

    @property
    def ratio(self) -> float:
        """How many times faster ours is."""
        return self.theirs_ms / self.ours_ms


def peer_timings(
    camera: Camera, size: tuple[int, int], dictionary: Dictionary, noise_sigma: float = 0.005
) -> Iterator[PeerTiming]:
    """Yield OMP with 20 atoms and LARS against scikit-learn's, on the same sensed dictionaries.

    For OMP theirs gets float32 columns in the order it wants; for LARS float64, as its path breaks
    off early in float32. `difference` is that of the fitted readings, relative. Raises AppError
    when the extra `peers` is not installed.
    """
    linear_model = peer_module("sklearn.linear_model")
    problem = _problem(camera, size, dictionary, noise_sigma)
    patches, length = problem.sensed.shape[0], problem.data.shape[1]
    columns = [np.asfortranarray(sensed.T) for sensed in problem.sensed]
    wide = [one.astype(float) for one in columns]
    greedy = bpdn.BPDNSettings(method="omp", atoms=20, tolerance_factor=0)
    path = bpdn.BPDNSettings(method="lars")
    etas = [
        bpdn.penalty_of(
            bpdn.median_norm(problem.sensed[i]),
            problem.sensed.shape[1],
            problem.data[i],
            noise_sigma,
            path,
        )
        for i in range(patches)
    ]

    def ours(settings: bpdn.BPDNSettings) -> Callable[[int], NDArray]:
        return lambda i: (
            bpdn.prepared(problem.sensed[i], problem.data[i : i + 1], noise_sigma, settings)(
                problem.data[i], int(problem.measured[i])
            ).weights
        )

    def normalised(i: int) -> NDArray:
        """Theirs wants atoms of unit norm: bring them to it, and the code back."""
        size = np.linalg.norm(columns[i], axis=0)
        size[size == 0] = 1
        code = linear_model.orthogonal_mp(
            columns[i] / size, problem.data[i], n_nonzero_coefs=20, precompute=False
        )
        return code / size

    def lasso(i: int) -> NDArray:
        return linear_model.lars_path(
            wide[i],
            problem.data[i].astype(float),
            method="lasso",
            alpha_min=etas[i] / length,
            return_path=False,
        )[2]

    # Their warnings about degenerate regressors are about duplicate atoms, which change nothing.
    warnings.filterwarnings("ignore", module="sklearn")
    for name, our, their in (
        ("OMP, 20 atoms", ours(greedy), normalised),
        ("LARS (Lasso path)", ours(path), lasso),
    ):
        our_s, our_codes = _timed(our, patches)
        their_s, their_codes = _timed(their, patches)
        fits = [
            np.linalg.norm((a - b) @ sensed) / max(np.linalg.norm(b @ sensed), 1e-12)
            for a, b, sensed in zip(our_codes, their_codes, problem.sensed, strict=True)
        ]
        yield PeerTiming(name, our_s * 1e3, their_s * 1e3, float(max(fits)))


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Time the sparse solvers on one sensed dictionary, and another library's (`--solvers`)."""
    camera, peers = asked.described, []
    atoms = open_dictionary(asked.dictionary, camera.views, camera.sensor.binning)
    solvers = list(solver_timings(camera, TIMED_SIZE, atoms))
    show.table(
        ("solver", "ms/patch", "passes", "GFLOP/s", "times its bound", "gap", "dB"),
        [
            (one.name, f"{one.milliseconds:.2f}", f"{one.passes:.0f}", f"{one.gigaflops:.1f}",
             f"{one.ratio:.1f}", f"{one.gap:.1e}", f"{one.psnr_db:.2f}")
            for one in solvers
        ],
    )  # fmt: skip
    try:
        peers = list(peer_timings(camera, TIMED_SIZE, atoms))
    except AppError as missing:
        show.note("not compared", missing)
    for one in peers:
        show.line(
            f"{one.name}: ours {one.ours_ms:.2f} ms a patch, scikit-learn's {one.theirs_ms:.2f} "
            f"ms: {one.ratio:.1f} times faster"
        )
    return {
        "camera": asked.camera,
        "dictionary": atoms.kind,
        "atoms": atoms.size,
        "solvers": [one.as_dict() for one in solvers],
        "peers": [one.as_dict() for one in peers],
    }
