"""What is computed is the same to the last bit with any number of threads."""

import json
import os
import subprocess
import sys

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from emmc_rig.model.blas import one_blas_thread
from emmc_rig.reconstruction.methods import METHODS

BEGIN = """
import hashlib, json, sys
import cv2, numba, numpy as np
from threadpoolctl import threadpool_limits
import emmc_rig as emmc

def digests(*values):
    return [hashlib.sha256(np.asarray(value).tobytes()).hexdigest()[:12] for value in values]

def without_times(stated):
    if not isinstance(stated, dict):
        return stated
    kept = {name: without_times(value) for name, value in stated.items()}
    differing = ("seconds", "threads")
    return {name: value for name, value in kept.items() if not any(d in name for d in differing)}

def for_each_number_of_threads(call):
    found = {}
    for threads in (1, 3, 8):
        numba.set_num_threads(threads)
        cv2.setNumThreads(threads)
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(threads)
        with threadpool_limits(threads):
            found[threads] = call()
    return found
"""
METHOD = """
camera = emmc.camera("scenario-ii-cfa", 2)

def solved(method):
    size = (16, 16) if "dict" in method else (32, 40)
    psi = camera.psi(size)
    frames = camera.expose(emmc.scene("deep-occlusions", size=size), seed=0, psi=psi)
    result = emmc.reconstruct(psi, frames, method)
    maps = [result.maps[name] for name in sorted(result.maps)]
    stated = without_times(result.metrics())
    return [*digests(result.light_field, *maps), repr(stated)]

print(json.dumps({name: for_each_number_of_threads(lambda: solved(name)) for name in sys.argv[1:]}))
"""
ROUTES = """
from simulated_calibration import CalibrateSettings, calibrate_simulated
from emmc_rig.model.camera import Camera

camera = Camera.model_validate_json(sys.argv[1])

def calibrated():
    run = calibrate_simulated(CalibrateSettings("small", camera, (32, 40), rays=64)).found
    figures = {name: value for name, value in run.metrics.items() if "seconds" not in name}
    stated = {name: value for name, value in figures.items() if name != "session"}
    return {"stated": repr(stated)} | {
        name: digests(one.psi.weights, one.deviation) for name, one in
        run.outcome.calibrations.items()
    }

print(json.dumps(for_each_number_of_threads(calibrated)))
"""


def printed(program, *arguments):
    """Return what a program prints that may set up to eight threads, of BLAS too."""
    eight = {"NUMBA_NUM_THREADS": "8", "OPENBLAS_NUM_THREADS": "8"}
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + program, *arguments],
        capture_output=True, text=True,
        env={**os.environ, **eight, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def differing(found):
    """Return which numbers of threads gave something else than one thread."""
    return [threads for threads, value in found.items() if value != found["1"]]


@pytest.mark.slow
def test_every_method_gives_the_same_light_field_maps_and_figures_with_any_number_of_threads():
    methods = list(METHODS)
    found = printed(METHOD, *methods)
    assert sorted(found) == sorted(methods)
    assert {name: differing(of) for name, of in found.items() if differing(of)} == {}


@pytest.mark.slow
def test_every_route_of_calibration_gives_the_same_psi_with_any_number_of_threads():
    camera = {
        "title": "small",
        "views": [3, 3],
        "lens": {"aperture_cell_mm": 8.0},
        "sensor": {"cfa": "rggb"},
        "masks": {"code": {"distance_mm": 0.12, "cell_um": 36, "pattern": {"kind": "random_rgbw"}}},
    }
    found = printed(ROUTES, json.dumps(camera))
    assert set(found["1"]) == {"stated", "parametric", "mixed", "free", "combined"}
    assert differing(found) == []


def blas_threads():
    return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}


def test_blas_keeps_one_thread_until_the_last_of_overlapping_calls_ends():
    with threadpool_limits(2, "blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        second.__exit__(None, None, None)
        assert blas_threads() == {2}
