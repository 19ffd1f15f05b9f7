"""Kernels run at the speed of memory: their time over that of a triad which moves as many bytes.

Bytes are counted as in STREAM (McCalpin 1995): every array read or written once. The triad is
measured again before every kernel, so that both see the same machine.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import cache

import lab
import numpy as np
from numba import njit, prange

from emmc_rig.files.cameras import find_camera
from emmc_rig.model import kernels
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.sensing import rows_of_colours
from reconstruction import kernels as tv_kernels
from reconstruction.differences import stencils
from reconstruction.problem import colour_metric

TRIAD_VALUES = 40_000_000


@njit(parallel=True)
def triad(a, b, c, scale):
    """Set a = b + scale c."""
    for i in prange(a.size):
        a[i] = b[i] + scale * c[i]


def median_s(call: Callable[[], object], repeats: int) -> float:
    """Return the median seconds of so many calls, after one that warms caches and compiles."""
    call()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


@cache
def cases(camera: str, size: tuple[int, int]) -> dict[str, tuple[Callable[[], object], int]]:
    """Return each kernel's call, and the bytes that it moves."""
    psi = build_imaging_matrix(find_camera(camera), size)
    light_field = np.random.default_rng(0).random(psi.light_field_shape, dtype=np.float32)
    frames = psi.forward(light_field)
    inverse = psi.inverted_blocks(0.01)
    planar = np.ascontiguousarray(rows_of_colours(light_field))
    dual = np.zeros((*planar.shape[:3], 4, *planar.shape[3:]), dtype=np.float32)
    taps, room = stencils(1, psi.light_field_shape, planar.dtype), np.empty_like(planar)
    moved = np.zeros((psi.frames_shape[1], 2))
    one, operator = np.float32(1), (psi.weights, psi.colour_map)
    data = tv_kernels.FrameFit(*operator, inverse, frames, psi.binning)
    steps = tv_kernels.Steps(one, one / 64, one, one, colour_metric(2.0).astype(np.float32))
    once = psi.weights.nbytes + light_field.nbytes
    return {
        "forward": (
            lambda: kernels.project(*operator, light_field, psi.binning, frames.copy()), once,
        ),
        "adjoint": (
            lambda: kernels.back_project(*operator, frames, psi.binning, light_field), once,
        ),
        "TV step": (
            lambda: tv_kernels.sweep(data, steps, taps, planar, dual, room, moved),
            once + light_field.nbytes + 2 * dual.nbytes,
        ),
    }  # fmt: skip


def measure(camera: str, size: tuple[int, int], repeats: int, kernel: str) -> dict:
    """Return a kernel's milliseconds, and how many times its bound that is."""
    values = TRIAD_VALUES if repeats > 1 else 1000
    a, b, c = (np.ones(values, dtype=np.float32) for _ in range(3))
    rate = 3 * a.nbytes / median_s(lambda: triad(a, b, c, np.float32(2)), repeats)
    call, moved = cases(camera, size)[kernel]
    seconds = median_s(call, repeats)
    return {"ms": seconds * 1e3, "GB": moved / 1e9, "times_bound": seconds * rate / moved}


def main() -> None:
    """Time every kernel."""
    args = lab.parsed(lab.arguments(__doc__, camera="rgbw-bayer-1shot", size="593x840"))
    repeats = 1 if args.smallest else 7
    points = [
        {"camera": args.camera, "size": args.size, "repeats": repeats, "kernel": kernel}
        for kernel in cases(args.camera, args.size)
    ]
    rows = lab.measured(points, measure, "kernels", args)
    axes = rows.set_index("kernel").times_bound.plot.barh(xlabel="times the bound of memory")
    lab.finished(rows, axes, "kernels", args)


if __name__ == "__main__":
    main()
