"""A process that measures points: jobs as lines of JSON from standard input, figures to the output.

Order matters: imports, frames, a warm-up on a small window (which compiles and loads), the timed
runs, the peak of memory; only then the truth is read and compared. Each job's peak is its own.
Before and after, a fixed reconstruction is timed, by which machines are compared.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.memory import forget_peak, peak_memory_mib
from emmc_rig.model.errors import ModelError
from emmc_rig.model.frames import Frames
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.pages.pictures import epipolar_lines
from emmc_rig.pages.thumbnails import save_thumbnail
from emmc_rig.study.chart.captures import read_frames, read_truth
from emmc_rig.study.chart.peers import PEERS
from emmc_rig.study.scores import scored
from reconstruction.dictionary import Dictionary
from reconstruction.errors import ReconstructionError
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.result import Reconstruction
from reconstruction.tv import TVSettings, reconstruct_tv

SIZE, STEPS, REPEATS = (64, 80), 20, 3


@dataclass(frozen=True)
class Reference:
    """Median seconds, by the clock and of all cores together."""

    seconds: float
    cpu_seconds: float


def reference() -> Reference:
    """Return what 20 steps of total variation take on 5x5 views of 64x80 pixels."""
    run = _warm()
    found = []
    for _ in range(REPEATS):
        cpu, wall = time.process_time(), time.perf_counter()
        run()
        found.append((time.perf_counter() - wall, time.process_time() - cpu))
    walls, cpus = zip(*found, strict=True)
    return Reference(statistics.median(walls), statistics.median(cpus))


@lru_cache(maxsize=1)
def _warm() -> Callable[[], object]:
    """Return the reconstruction, run once, which may have compiled."""
    rng = np.random.default_rng(0)
    weights = rng.random((1, 5, 5, SIZE[0], 1, SIZE[1]), dtype=np.float32)
    colour = rng.integers(0, 3, (1, *SIZE), dtype=np.uint8)
    psi = ImagingMatrix(weights, colour, 1)
    frames = rng.random(psi.frames_shape, dtype=np.float32)
    settings = TVSettings(mu=1e-3, max_steps=STEPS, rtol=1e-30)

    def run() -> object:
        return reconstruct_tv(psi, frames, 0.005, settings)

    run()
    return run


WARM_UP_PX = 27
KNOWN = (AppError, ModelError, ReconstructionError, CalibrationError, DriverError)


def measured(job: dict) -> dict:
    """Return the figures of a job: capture, method, settings, dictionary, repeats, ...

    seconds: median of the repeats. cpu_seconds: likewise, of all cores together. base_mib: resident
    memory of the process before the timed runs, with Psi and frames; peak_mib: at most during them.
    dictionary_s: of the one that this process has made.
    """
    psi, frames = read_frames(Path(job["capture"]))
    settings = MethodSettings.model_validate(job["settings"])
    dictionary, dictionary_s = None, 0.0
    if job["needs_dictionary"]:
        views = psi.light_field_shape[:2]
        dictionary, dictionary_s = _dictionary(job["dictionary"], views, psi.binning)
    _solved(job["method"], *_window(psi, frames), dictionary, settings)
    load, before = os.getloadavg()[0], reference()
    forget_peak()
    base_mib = peak_memory_mib()
    wall, cpu = [], []
    result = None
    while len(wall) < job["repeats"] and (not wall or sum(wall) < job["enough_s"]):
        result = None
        cpu_started, started = time.process_time(), time.perf_counter()
        result = _solved(job["method"], psi, frames, dictionary, settings)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - cpu_started)
    assert result is not None
    peak_mib = peak_memory_mib()
    after = reference()
    truth, disparity = read_truth(Path(job["capture"]))
    own = getattr(result, "maps", {}).get("disparity")
    scores = scored(result.light_field, truth, disparity, own)
    _save_pictures(Path(job["picture"]), result.light_field, truth)
    return {
        **asdict(scores),
        "seconds": statistics.median(wall),
        "fastest_s": min(wall),
        "slowest_s": max(wall),
        "cpu_seconds": statistics.median(cpu),
        "repeats": len(wall),
        "reference_s": (before.seconds + after.seconds) / 2,
        "reference_cpu_s": (before.cpu_seconds + after.cpu_seconds) / 2,
        "dictionary_s": dictionary_s,
        "peak_mib": peak_mib,
        "base_mib": base_mib,
        "cores": get_num_threads(),
        "load": load,
        "steps": result.steps,
        "status": result.status,
        "advice": result.advice,
        "shots": psi.shots,
        "binning": psi.binning,
        "views": list(psi.light_field_shape[:2]),
        "size": list(psi.size),
        "colours_stored": psi.weights.shape[4],
        "disparity_range_px": None if disparity is None else float(np.ptp(disparity)),
        "dictionary_atoms": dictionary.size if dictionary is not None else None,
        "patches": result.parameters.get("patches"),
    }


@lru_cache(maxsize=1)
def _dictionary(name: str | None, views: tuple[int, int], binning: int) -> tuple[Dictionary, float]:
    """Return a dictionary and the seconds that it took to make."""
    started = time.perf_counter()
    made = open_dictionary(name, views, binning)
    return made, time.perf_counter() - started


def _solved(
    method: str,
    psi: ImagingMatrix,
    frames: Frames,
    dictionary: Dictionary | None,
    settings: MethodSettings,
) -> Reconstruction:
    if method in PEERS:
        return PEERS[method].solve(psi, frames, dictionary)
    return reconstruct(
        method, psi, frames.readings, frames.noise_sigma, dictionary, settings, frames.usable
    )


def _window(psi: ImagingMatrix, frames: Frames) -> tuple[ImagingMatrix, Frames]:
    """Return a corner that is large enough for patches and small enough to take no time."""
    k = psi.binning
    side = WARM_UP_PX // k * k
    rows, columns = (slice(0, min(side, length)) for length in psi.size)
    seen = np.s_[:, : rows.stop // k, : columns.stop // k]
    cut = Frames(frames.readings[seen].copy(), frames.deviation[seen], frames.usable[seen].copy())
    return psi.window(rows, columns), cut


def _save_pictures(path: Path, estimate: NDArray, truth: NDArray) -> None:
    """Write what a point shows, and the truth's beside the captures, unless it is there."""
    lines = epipolar_lines(truth)
    truth_path = path.with_name(f"{path.stem.partition('-')[0]}-truth.webp")
    for light_field, where in ((estimate, path), (truth, truth_path)):
        if not where.exists() or where == path:
            save_thumbnail(where, light_field, lines)


def answered(job: dict) -> dict:
    """Return the figures of a job, or why there are none: these are not kept."""
    try:
        return measured(job)
    except KNOWN as fault:
        return {"failed": str(fault), "keep": False}
    except MemoryError:
        return {"failed": "not enough memory", "keep": False}


def main() -> None:
    """Do the jobs on standard input until it ends."""
    for line in sys.stdin:
        print(json.dumps(answered(parse_json(line, "a job", AppError))), flush=True)


if __name__ == "__main__":
    main()
