"""Difficult scenes: depth, occlusions, mirrors, little contrast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emmc_rig.simulators import changes
from emmc_rig.simulators.scenes import SCENES
from emmc_rig.study.stability.fault import SCENE, Fault
from emmc_rig.study.trial import Capture, Trial, trial_of


def disparity_range(capture: Capture, px: float) -> Trial:
    """The scene's disparities span a wider range."""
    capture.need_built_in()
    known = capture.scene_seen().disparity_px
    assert known is not None
    factor = px / float(np.ptp(known))
    changed = capture.scene_seen(change=lambda world: changes.deepened(world, factor))
    return trial_of(capture, scene=changed)


def occlusion(capture: Capture, percent: float) -> Trial:
    """Leaves nearer than everything hide a share of every view."""
    capture.need_built_in()
    nearest = SCENES[capture.scene].disparity_px[1]
    rng = np.random.default_rng([capture.seed, 7])
    changed = capture.scene_seen(
        change=lambda world: changes.overgrown(world, percent / 100, nearest, rng)
    )
    return trial_of(capture, scene=changed)


def specularity(capture: Capture, percent: float) -> Trial:
    """Every surface mirrors a textured room, which makes a share of its light."""
    capture.need_built_in()
    rng = np.random.default_rng([capture.seed, 8])
    changed = capture.scene_seen(change=lambda world: changes.mirroring(world, percent / 100, rng))
    return trial_of(capture, scene=changed)


def contrast(capture: Capture, percent: float) -> Trial:
    """The scene has a share of its contrast; the PSNR is that of the stretched picture."""
    seen, share = capture.scene_seen(), percent / 100
    mean = seen.light_field.mean(axis=(0, 1, 2, 3), keepdims=True, dtype=np.float64)
    faded = np.asarray(mean + share * (seen.light_field - mean), dtype=np.float32)
    trial = trial_of(capture, scene=replace(seen, light_field=faded))
    return replace(trial, peak=share)


FAULTS = (
    Fault(
        "disparity-range", "Disparity range", "px per view",
        (0.5, 1, 2, 4, 8, 16, 32), (0.5, 2, 8, 32),
        SCENE, disparity_range,
    ),
    Fault(
        "occlusion", "Occlusion density", "% hidden",
        (0, 5, 10, 20, 40, 60, 80), (0, 10, 30, 60),
        SCENE, occlusion,
    ),
    Fault(
        "specularity", "Specularity", "% mirrored",
        (0, 5, 10, 20, 40, 60, 80), (0, 10, 40, 80),
        SCENE, specularity,
    ),
    Fault(
        "contrast", "Texture contrast", "%",
        (100, 50, 25, 10, 5, 2.5, 1), (100, 25, 5, 1),
        SCENE, contrast,
    ),
)  # fmt: skip
