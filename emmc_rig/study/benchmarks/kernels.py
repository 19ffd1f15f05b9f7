"""Kernel timings as ratios to a memory triad measured in the same run.

Bytes are counted as in STREAM (McCalpin 1995): every array read or written once, no write
allocation. The bound of a kernel is its bytes over the triad's bandwidth.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import get_num_threads, prange

from emmc_rig.files.memory import forget_peak, peak_memory_mib
from emmc_rig.files.scenes import open_scene
from emmc_rig.model import kernels
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.compiling import njit
from emmc_rig.model.sensing import rows_of_colours
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures, median_s, start_timings
from reconstruction import kernels as tv_kernels
from reconstruction.differences import stencils
from reconstruction.problem import colour_metric
from reconstruction.tv import reconstruct_tv, row_bands

TRIAD_VALUES = 40_000_000


@dataclass(frozen=True)
class Timing(Figures):
    """One kernel: the bytes counted, median seconds, and the ratio to its bound."""

    name: str
    gigabytes: float
    seconds: float
    bound_s: float

    @property
    def ratio(self) -> float:
        """Seconds over bound; 1 is as fast as memory allows."""
        return self.seconds / self.bound_s


@njit(parallel=True, cache=True)
def triad(a, b, c, scale):
    """Set a = b + scale c."""
    for i in prange(a.size):
        a[i] = b[i] + scale * c[i]


def kernel_timings(camera: Camera, size: tuple[int, int], repeats: int) -> Iterator[Timing]:
    """Yield the triad, then every kernel on a light field of `size` (rows, columns).

    The triad is measured again before every kernel, so that both see the same machine.
    """
    a, b, c = (np.ones(TRIAD_VALUES, dtype=np.float32) for _ in range(3))
    triad_bytes = a.nbytes + b.nbytes + c.nbytes

    def bandwidth() -> float:
        return triad_bytes / median_s(lambda: triad(a, b, c, np.float32(2)), repeats)

    rate = bandwidth()
    yield Timing("triad", triad_bytes / 1e9, triad_bytes / rate, triad_bytes / rate)
    psi = build_imaging_matrix(camera, size)
    light_field = np.random.default_rng(0).random(psi.light_field_shape, dtype=np.float32)
    frames = psi.forward(light_field)
    inverse = psi.solver(0.01).inverse
    planar = np.ascontiguousarray(rows_of_colours(light_field))
    dual = np.zeros((*planar.shape[:3], 4, *planar.shape[3:]), dtype=np.float32)
    taps, room = stencils(1, psi.light_field_shape, planar.dtype), np.empty_like(planar)
    moved = np.zeros((psi.frames_shape[1], 2))
    bands = row_bands(psi.frames_shape[1], get_num_threads())
    pool = ThreadPoolExecutor(len(bands))
    one = np.float32(1)
    metric = colour_metric(2.0).astype(np.float32)
    operator = (psi.weights, psi.colour_map)

    data = tv_kernels.Data(*operator, inverse, frames, psi.binning)
    steps = tv_kernels.Steps(one, one / 64, one, one, metric)

    cases: list[tuple[str, Callable[[], object], int]] = [
        (
            "forward",
            lambda: kernels.project(*operator, light_field, psi.binning, frames.copy()),
            psi.weights.nbytes + light_field.nbytes,
        ),
        (
            "adjoint",
            lambda: kernels.back_project(*operator, frames, psi.binning, light_field),
            psi.weights.nbytes + light_field.nbytes,
        ),
        (
            "data step",
            lambda: kernels.data_step(*operator, inverse, frames, psi.binning, planar),
            psi.weights.nbytes + 2 * light_field.nbytes,
        ),
        (
            "TV step",
            lambda: tv_kernels.sweep(data, steps, taps, planar, dual, room, bands, moved, pool.map),
            psi.weights.nbytes + 2 * light_field.nbytes + 2 * dual.nbytes,
        ),
    ]
    with pool:
        for name, call, counted in cases:
            rate = bandwidth()
            yield Timing(name, counted / 1e9, median_s(call, repeats), counted / rate)


def reconstruction_memory(camera: Camera, size: tuple[int, int]) -> tuple[float, float]:
    """Return seconds and peak memory (GiB) of this process, of a converged TV reconstruction."""
    psi = build_imaging_matrix(camera, size)
    frames = psi.forward(open_scene("deep-occlusions", size=size, views=camera.views).light_field)
    forget_peak()
    started = time.perf_counter()
    reconstruct_tv(psi, frames, 0.005)
    return time.perf_counter() - started, peak_memory_mib() / 2**10


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Time kernels against their memory bound, a reconstruction, and starts (`chart --kernels`)."""
    size, repeats = asked.size or (593, 840), asked.repeats or 7
    seconds, peak_gib = reconstruction_memory(asked.described, size)
    kernels = list(kernel_timings(asked.described, size, repeats))
    show.table(
        ("kernel", "GB counted", "ms", "GB/s", "times its bound"),
        [
            (one.name, f"{one.gigabytes:.3f}", f"{one.seconds * 1e3:.1f}",
             f"{one.gigabytes / one.seconds:.1f}", f"{one.ratio:.2f}")
            for one in kernels
        ],
    )  # fmt: skip
    show.line(f"one TV reconstruction: {seconds:.1f} s, peak memory {peak_gib:.2f} GiB")
    starts = start_timings(repeats)
    for start in starts:
        show.line(f"{start.name}: {start.seconds:.2f} s to start")
    return {
        "camera": asked.camera,
        "size": list(size),
        "kernels": [one.as_dict() for one in kernels],
        "starts": [start.as_dict() for start in starts],
        "reconstruction_seconds": seconds,
        "reconstruction_peak_gib": peak_gib,
    }
