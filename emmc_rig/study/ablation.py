"""What each piece of the adaptive method buys in dB and costs in seconds, on one scene's shot.

Every row leaves one piece out of the whole; the rows after them are what else there is to compare
with, on the same frames.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import Camera
from emmc_rig.model.lightfield import psnr_db, replicate_centre
from emmc_rig.study.benchmarks.timing import Figures
from emmc_rig.study.oracle import matched_disparity
from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.methods import MethodSettings, reconstruct

WHOLE = "adaptive"
LEFT_OUT = {
    "heavy tails of the evidence": {"freedom": 1000.0},
    "belief propagation": {"jump": 0.999},
    "a second length of textures": {"lengths_px": (3.0,)},
    "plane sweeps with the texture": {"texture": {"sweeps": ()}},
    "sharpening of the disparity": {"texture": {"refine_steps": 0}},
    "stacking of like blocks": {"texture": {"reach": 0}},
    "higher threshold of chrominance": {"texture": {"chroma": 1.0}},
    "momentum": {"texture": {"momentum": 0.0}},
    "total variation in the mean": {"free": False},
    "a second fit, of less misfit": {"misfits": (0.004,)},
    "a second fit, of more misfit": {"misfits": (0.0015,)},
    "disparity (all at 0)": {"furthest_px": 0.01},
}
"""Pieces of the method, and the settings without them."""
ORACLE = "true disparity in place of the searched one"
RIVALS = ("adaptive-fast", "tv", "tv-dict")


@dataclass(frozen=True)
class Ablation(Figures):
    """One row: what was left out, its PSNR and seconds, and both less those of the whole."""

    name: str
    psnr_db: float
    seconds: float
    buys_db: float
    costs_s: float


def ablations(scene: str, camera: Camera, size: tuple[int, int], seed: int) -> Iterator[Ablation]:
    """Yield the whole method, then the method without each piece, its rivals, and the oracle.

    The frames are exposed once. The whole runs twice, so that compiling is not counted.
    """
    truth = open_scene(scene, size=size, views=camera.views, seed=seed).light_field
    psi = camera.psi(size)
    frames = camera.expose(truth, seed, psi)
    dictionary = open_dictionary(None, camera.views, psi.binning)

    def run(method: str, settings: MethodSettings) -> tuple[float, float]:
        result = reconstruct(
            method,
            psi,
            frames.readings,
            frames.noise_sigma,
            dictionary,
            settings,
            frames.usable,
        )
        return psnr_db(result.light_field, truth), result.seconds

    run(WHOLE, MethodSettings())
    best, took = run(WHOLE, MethodSettings())
    yield Ablation(WHOLE, best, took, 0.0, 0.0)
    for name, without in LEFT_OUT.items():
        settings = MethodSettings(adaptive=AdaptiveSettings.model_validate(without))
        decibels, seconds = run(WHOLE, settings)
        yield Ablation(f"without {name}", decibels, seconds, best - decibels, took - seconds)
    for method in RIVALS:
        decibels, seconds = run(method, MethodSettings())
        yield Ablation(method, decibels, seconds, best - decibels, took - seconds)
    started = time.perf_counter()
    known = reconstruct_adaptive(
        psi,
        frames.readings,
        frames.noise_sigma,
        usable=frames.usable,
        disparity=matched_disparity(truth),
    )
    decibels, seconds = psnr_db(known.light_field, truth), time.perf_counter() - started
    yield Ablation(ORACLE, decibels, seconds, best - decibels, took - seconds)
    copied = psnr_db(replicate_centre(truth), truth)
    yield Ablation("copied true centre view", copied, 0.0, best - copied, took)
