"""What a reconstruction costs: seconds, by which a method is chosen, and memory, which is limited.

The seconds of a method are those of the method of factor 1 on a window of the frames, on this
machine, times the light field's values over the window's, times the factor of the method, see
`reconstruction.method.Method`. Factors are from the charts docs/results/chart-group-*.csv
(64x80 samples, one and three shots) and from 128x160 samples: there they lie within 0.6 and 1.6
times these for any scene, camera and size.

The number of workers follows from the memory that a block is estimated to need. What the processes
really hold is limited by the system, see `emmc_rig.store.pool`, measured, and stated in
metrics.json.
"""

from __future__ import annotations

import ctypes
import gc
import re
import sys
from pathlib import Path

import numpy as np

from emmc_rig.errors import WrongUsageError
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, reconstruct
from emmc_rig.reconstruction.tiles import SAMPLE, SAMPLES, TEXTURE_REACH, Grid
from emmc_rig.store.psi import StoredPsi
from emmc_rig.store.results import parse_seconds

FACTORS = {name: method.factor for name, method in METHODS.items() if method.factor is not None}
TIMED = next(name for name, factor in FACTORS.items() if factor == 1)
WINDOW = 96
"""Samples a side of the window that is timed, at most."""
UNITS = {"K": 10**3, "M": 10**6, "G": 10**9, "KI": 2**10, "MI": 2**20, "GI": 2**30}
BASE_BYTES = 512 * 2**20
"""Of a process with the program's libraries, its kernels compiled."""
RAY_BYTES, WEIGHT_BYTES = 170, 26
"""Of a block, for each of its rays (views times samples), and for each of their weights (shots
times stored colours). Measured, Psi included: 169 a ray of adaptive-fast on blocks of 190,000
samples, one shot; less for smaller ones, tv and adaptive."""
READING_BYTES = 60
"""Of a capture's reading in the program itself: readings, deviation, usable, and copies."""
WHOLE, COMPARED = 8, 4
"""Copies of a light field that the program holds to draw a light field of one block, and to compare
any."""
PARALLAX_PX = 3.0
"""Disparity whose halo is reckoned with before a survey has found the capture's own."""


def method_within(psi: Psi, frames: Frames, budget: str) -> tuple[str, str]:
    """Return the method for a budget as typed, such as "30s", and why it is, in words.

    Raises WrongUsageError for what is no time, ReconstructionError for frames that do not fit Psi.
    """
    budget_s = parse_seconds(budget, "budget")
    assert budget_s is not None
    unit_s = timed(psi, frames)
    within = [method for method, factor in FACTORS.items() if factor * unit_s <= budget_s]
    choose = max if within else min
    method = choose(within or FACTORS, key=FACTORS.__getitem__)
    why = "the most accurate within" if within else "the quickest: none is done within"
    takes_s = FACTORS[method] * unit_s
    return method, f"{method}: {why} {budget_s:g} s; about {takes_s:.2g} s on this machine"


def timed(psi: Psi, frames: Frames) -> float:
    """Return the seconds that TIMED takes for all of the frames, from its time for a window."""
    k, places = psi.binning, []
    for length in psi.size:
        side = min(WINDOW // k * k, length)
        start = (length - side) // 2 // k * k
        places.append(slice(start, start + side))
    part = psi.window(*places)
    pixels = (slice(None), *(slice(at.start // k, at.stop // k) for at in places))
    solved = reconstruct(TIMED, part, frames.cut(pixels))
    return solved.seconds * float(np.prod(psi.size)) / float(np.prod(part.size))


def parse_memory(text: str) -> int:
    """Return the bytes of "2GiB" or "800MB"; raises WrongUsageError."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMG]?I?)B?", text.strip().upper())
    if match is None or match[2] not in UNITS:
        raise WrongUsageError(f"memory {text}: write bytes with a unit, for instance 2GiB")
    return int(float(match[1]) * UNITS[match[2]])


def task_bytes(psi: StoredPsi, grid: Grid) -> int:
    """Return what a worker needs for the largest block of a grid, and for the survey."""
    samples = max(_samples(block.outer) for block in grid)
    if len(grid) > 1:
        samples = max(samples, min((SAMPLE * SAMPLES) ** 2, int(np.prod(psi.size))))
    shots, v, u, _, stored, _ = psi.weights_shape
    return int(BASE_BYTES + samples * v * u * (RAY_BYTES + WEIGHT_BYTES * shots * stored))


def assumed_grid(psi: StoredPsi, settings: MethodSettings) -> Grid:
    """Return the grid of blocks with the halo of usual disparities."""
    views = max(psi.views)
    halo = int(TEXTURE_REACH * psi.binning + PARALLAX_PX * (views // 2))
    return Grid(psi.size, 2 * psi.binning, halo, settings.blocks)


def own_bytes(psi: StoredPsi, settings: MethodSettings, as_zarr: bool, compares: bool) -> int:
    """Return what the program holds of a capture beside its workers."""
    grid, views = assumed_grid(psi, settings), int(np.prod(psi.views))
    light_field = int(np.prod(psi.size)) * views * 12
    if len(grid) == 1 and not as_zarr:
        written = WHOLE * light_field + 4 * int(np.prod(psi.weights_shape))
    else:
        written = 2 * views * 12 * max(_samples(block.part) for block in grid)
    compared = COMPARED * light_field if compares else 0
    return READING_BYTES * int(np.prod(psi.frames_shape)) + max(written, compared)


def _samples(place: tuple[slice, slice]) -> int:
    rows, columns = place
    return (rows.stop - rows.start) * (columns.stop - columns.start)


def peak_memory_mib() -> float:
    """Return the peak of resident memory, in MiB.

    On Linux from /proc: there getrusage starts a new program with the peak of the one that
    started it, and would count the parent's memory as the child's.
    """
    if sys.platform == "win32":
        import psutil

        return psutil.Process().memory_info().peak_wset / 2**20
    if sys.platform == "linux":
        status = Path("/proc/self/status").read_text("ascii", errors="replace")
        if match := re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE):
            return int(match[1]) / 2**10
    import resource

    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def forget_peak() -> bool:
    """Give back what is not used, and count the peak from here on; return whether that is possible.

    Linux resets it where 5 is written to /proc/self/clear_refs, see proc_pid_clear_refs(5).
    """
    gc.collect()
    if sys.platform != "linux":
        return False
    if hasattr(library := ctypes.CDLL(None), "malloc_trim"):
        library.malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", "ascii")
    except OSError:
        return False
    return True
