"""A Psi fitted blindly to the frames recovers what a moved mask costs: InverseNet's scenarios.

Ideal: nothing moved. Assumed: the mask moved, Psi is the design's. Oracle: the same readings with
the Psi that made them. Mended: with the Psi that the readings themselves suggest, as `emmc-rig
calibrate --drift` corrects it (after arXiv 2603.04538).
"""

from __future__ import annotations

from dataclasses import replace

import lab
import numpy as np

from emmc_rig.calibration.drift import DriftSettings, find_drift
from emmc_rig.calibration.parametric import psi_at, shot_stages
from emmc_rig.calibration.placement import designed_placement
from emmc_rig.calibration.shadow import Shadow, shadow_mask
from emmc_rig.model.camera import camera_of, pixel_light
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.methods import installed_methods
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.trial import Capture, Trial

ERRORS = (("mask-shift", 0.5), ("mask-rotation", 0.5), ("mask-distance-error", 25.0))
QUICK = DriftSettings(blocks=60, coarse_blocks=24, block_px=6, disparity_steps=7)


def mended(moved: Trial) -> Psi:
    """Return Psi as fitted to the readings, unchanged where no drift is detected."""
    psi = moved.psi
    camera = camera_of(psi)
    noise, light = camera.sensor.noise, pixel_light(camera, psi.size)
    variance = noise.variance(moved.readings, camera.exposures_s()[:, None, None], light)
    mask, stages = shadow_mask(camera, psi.size), shot_stages(camera)
    colour = None if psi.colour is None else psi.colour[:, :: psi.binning, :: psi.binning]
    taken = Frames(moved.readings, np.sqrt(variance), moved.usable)
    drift = find_drift(taken, colour, mask, designed_placement(camera), stages, QUICK)
    if drift.refused or not drift.drifted:
        return psi
    return psi_at(Shadow(mask, drift.placement), psi, stages)


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, method: str, error: str, by: float
) -> dict:
    """Return a method's PSNR by scenario, and the error of Psi before and after."""
    capture = Capture(scene, camera, size, seed)
    moved, unmoved = Point(capture, error, by).trial(), Point(capture, error, 0.0).trial()
    psi = mended(moved)

    def psnr_db(trial: Trial) -> float:
        return trial.psnr_db(trial.solved(method).light_field)

    return {
        "ideal_db": psnr_db(unmoved),
        "assumed_db": psnr_db(moved),
        "oracle_db": psnr_db(replace(moved, psi=moved.true_psi)),
        "mended_db": psnr_db(replace(moved, psi=psi)),
        "psi_error": moved.psi.relative_difference(moved.true_psi),
        "psi_left": psi.relative_difference(moved.true_psi),
    }


def main() -> None:
    """Measure every error on every scene, by every method."""
    methods = installed_methods()
    args = lab.parsed(
        lab.arguments(__doc__, camera="rgbw-bayer-1shot", size="32x40", methods=methods)
    )
    choices = [
        {"method": method, "error": error, "by": by}
        for error, by in (ERRORS[:1] if args.smallest else ERRORS)
        for method in args.methods
    ]
    rows = lab.measured(lab.points(args, choices), measure, "mismatch", args)
    scenarios = ["ideal_db", "assumed_db", "oracle_db", "mended_db"]
    axes = rows.groupby("method")[scenarios].mean().plot.barh(ylabel="", xlabel="dB")
    axes.set_xlim(left=rows[scenarios].min().min() - 1)
    lab.finished(rows, axes, "mismatch", args)
    lost, gained = rows.oracle_db - rows.assumed_db, rows.mended_db - rows.assumed_db
    print(f"mended: {gained.sum() / lost.sum():.0%} of what the true Psi recovers")


if __name__ == "__main__":
    main()
