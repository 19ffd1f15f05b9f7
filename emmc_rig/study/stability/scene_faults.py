"""Faults between shots (flicker, motion, missing and repeated frames), and difficult scenes.

Difficult scenes have much depth, occlusions, mirrors or little contrast.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.errors import SceneError
from emmc_rig.model.lightfield import shifted
from emmc_rig.simulators import changes
from emmc_rig.simulators.raycaster import World
from emmc_rig.simulators.scenes import SCENES
from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.stability.fault import SCENE, SEVERAL, SHOTS, Fault
from emmc_rig.study.trial import Array, Capture, Trial, trial_of

FLICKER_SEED = 6
DIRECTION = (np.cos(np.pi / 6), np.sin(np.pi / 6))
"""Of the camera's motion: across, down."""


def flicker_gains(shots: int, percent: float, seed: int) -> Array:
    """Return the lamp's brightness in every shot, mean 1, its logarithm deviating by `percent`."""
    drawn = np.random.default_rng([seed, FLICKER_SEED]).standard_normal(shots)
    drawn = (drawn - drawn.mean()) / drawn.std()
    gains = np.exp(percent / 100 * drawn)
    return gains / gains.mean()


def flicker(capture: Capture, percent: float) -> Trial:
    """The lamp's brightness differs from shot to shot."""
    gains = flicker_gains(len(capture.described.shots), percent, capture.seed)
    return trial_of(capture, change_clean=lambda clean: clean * gains[:, None, None])


def scene_motion(capture: Capture, px: float) -> Trial:
    """Things move to the right before a background that stands, from shot to shot."""
    capture.need_built_in()
    return _moving(capture, px, background=False)


def camera_motion(capture: Capture, px: float) -> Trial:
    """The camera turns: the picture moves aslant from shot to shot.

    A measured scene is interpolated, and needs to be larger than what is reconstructed.
    """
    if capture.is_built_in:
        return _moving(capture, px, background=True)
    truth = capture.scene_seen()
    rows, columns = truth.light_field.shape[2:4]
    shots = len(capture.described.shots)
    margin = int(np.ceil(px * (shots - 1))) + 2
    size = (rows + 2 * margin, columns + 2 * margin)
    try:
        wide = open_scene(capture.scene, size, capture.described.views).light_field
    except SceneError as fault:
        raise NotApplicableError(
            f"needs {margin} samples of the scene around what is reconstructed: choose a smaller "
            "size"
        ) from fault
    across, down = px * np.array(DIRECTION)
    inside = np.s_[:, :, margin:-margin, margin:-margin]
    seen = [
        np.stack([[shifted(item, -down * i, -across * i) for item in row] for row in wide])[inside]
        for i in range(shots)
    ]
    return trial_of(capture, scene=truth, shot_scenes=[truth.light_field, *seen[1:]])


def _moving(capture: Capture, px: float, background: bool) -> Trial:
    truth = capture.scene_seen()
    width = truth.light_field.shape[3] * (capture.zoom if capture.size is not None else 1)
    across, down = DIRECTION if background else (1.0, 0.0)
    seen = [truth.light_field]
    for shot in range(1, len(capture.described.shots)):
        s, t = across * px * shot / width, down * px * shot / width

        def moved(world: World, s: float = s, t: float = t) -> World:
            return changes.moved(world, s, t, background)

        seen.append(capture.scene_seen(change=moved).light_field)
    return trial_of(capture, shot_scenes=seen)


def missing_shot(capture: Capture, count: float) -> Trial:
    """The last shots stay dark: no light came through."""
    dark = len(capture.described.shots) - _count(capture, count)

    def lost(clean: Array) -> Array:
        kept = clean.copy()
        kept[dark:] = 0
        return kept

    return trial_of(capture, change_clean=lost)


def repeated_shot(capture: Capture, count: float) -> Trial:
    """The mask stage stays where it is before the last shots."""
    psi = capture.psi()
    weights = psi.weights.copy()
    last = len(capture.described.shots) - _count(capture, count) - 1
    weights[last + 1 :] = weights[last]
    return trial_of(capture, true_psi=replace(psi, weights=weights))


def _count(capture: Capture, count: float) -> int:
    shots = len(capture.described.shots)
    if count >= shots:
        raise NotApplicableError(f"{count:g} of {shots} shots: one at least must be whole")
    return round(count)


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
        "flicker", "Lamp flicker between shots", "%",
        (0, 1, 2, 5, 10, 20, 40, 80), (0, 2, 10, 40),
        SHOTS, flicker, repairable=True, shots=SEVERAL,
    ),
    Fault(
        "scene-motion", "Scene motion", "px a shot",
        (0, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.5, 2, 8),
        SHOTS, scene_motion, repairable=True, shots=SEVERAL,
    ),
    Fault(
        "camera-motion", "Camera motion", "px a shot",
        (0, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.25, 1, 4),
        SHOTS, camera_motion, repairable=True, shots=SEVERAL,
    ),
    Fault(
        "missing-shot", "Missing shots", "shots",
        (0, 1, 2), (0, 1, 2),
        SHOTS, missing_shot, repairable=True, shots=SEVERAL,
        whole=True,
    ),
    Fault(
        "repeated-shot", "Repeated shots", "shots",
        (0, 1, 2), (0, 1, 2),
        SHOTS, repeated_shot, repairable=True, shots=SEVERAL,
        whole=True,
    ),
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
