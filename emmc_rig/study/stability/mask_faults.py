"""Faults of mask and lens that Psi does not model: misplaced, soft edges, vignetting.

The true Psi is that of the calibration's placement model; the method assumes the design's.
"""

from __future__ import annotations

import math
from dataclasses import replace

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.parametric import psi_at, shot_stages
from emmc_rig.calibration.placement import Placement, designed_placement
from emmc_rig.calibration.shadow import Shadow, shadow_mask
from emmc_rig.model.camera import Camera
from emmc_rig.model.sensing import Psi
from emmc_rig.simulators.flaws import OpticsFlaws
from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.stability.fault import MASK, Fault
from emmc_rig.study.trial import Capture, Trial, trial_of


def misplaced_psi(capture: Capture, placement: Placement) -> Psi:
    """Return Psi of a capture whose mask sits otherwise than designed.

    Raises NotApplicableError unless the camera has one mask, between lens and sensor.
    """
    design, camera = capture.psi(), capture.described
    try:
        mask = shadow_mask(_roomy(camera, design.size, placement), design.size)
    except CalibrationError as fault:
        raise NotApplicableError(
            "needs a camera with one mask between lens and sensor, in every shot"
        ) from fault
    return psi_at(Shadow(mask, placement), design, shot_stages(camera))


def _roomy(camera: Camera, size: tuple[int, int], placement: Placement) -> Camera:
    """Return the camera with a mask so large that a misplaced one still covers the beam."""
    corner_um = math.hypot(*size) / 2 * camera.sensor.sample_pitch_um
    turned = abs(math.sin(placement.rotation_rad)) + abs(1 / placement.scale - 1)
    shift_um = math.hypot(placement.offset_x_um, placement.offset_y_um)
    view_um = max(camera.views) / 2 * camera.lens.aperture_cell_um
    masks = {}
    for name, mask in camera.masks.items():
        ratio = mask.distance_mm / camera.lens.distance_mm
        away_um = shift_um + corner_um * turned + view_um * ratio * abs(placement.distance_share)
        away_um += 5 * placement.blur_um
        spare = mask.spare_cells + math.ceil(away_um / mask.cell_um)
        masks[name] = mask.model_copy(update={"spare_cells": spare})
    return camera.model_copy(update={"masks": masks})


def _misplaced(capture: Capture, **changed: float) -> Trial:
    if "scale" in changed:
        changed["scale"] += 1
    placement = replace(designed_placement(capture.described), **changed)
    return trial_of(capture, true_psi=misplaced_psi(capture, placement))


def _diagonal(px: float, capture: Capture) -> dict[str, float]:
    """Return a shift in samples, at 30 degrees to the rows."""
    um = px * capture.described.sensor.sample_pitch_um
    return {"offset_x_um": um * math.cos(math.pi / 6), "offset_y_um": -um * math.sin(math.pi / 6)}


def shift(capture: Capture, px: float) -> Trial:
    """The mask is shifted, at 30 degrees to the rows."""
    return _misplaced(capture, **_diagonal(px, capture))


def rotation(capture: Capture, degrees: float) -> Trial:
    """The mask is turned about the axis."""
    return _misplaced(capture, rotation_rad=math.radians(degrees))


def scale(capture: Capture, percent: float) -> Trial:
    """The mask's cells are too large."""
    return _misplaced(capture, scale=percent / 100)


def distance(capture: Capture, percent: float) -> Trial:
    """The mask stands further from the sensor than designed."""
    return _misplaced(capture, distance_share=percent / 100)


def edge_blur(capture: Capture, px: float) -> Trial:
    """The mask's shadow is blurred, as by diffraction: deviation of a Gaussian in samples."""
    return _misplaced(capture, blur_um=px * capture.described.sensor.sample_pitch_um)


def vignetting(capture: Capture, percent: float) -> Trial:
    """The outermost ray loses a share of light, the others less, by a power of the cos^4 law."""
    psi, camera = capture.psi(), capture.described
    lens = camera.lens
    lengths = (lens.distance_mm * 1e3, camera.sensor.sample_pitch_um, lens.aperture_cell_um)
    natural = OpticsFlaws(vignetting=1.0).falloff(psi.size, camera.views, lengths)
    power = math.log(1 - percent / 100) / math.log(float(natural.min()))
    passed = (natural**power).astype(psi.weights.dtype)
    weights = psi.weights * passed[None, :, :, :, None, :]
    return trial_of(capture, true_psi=replace(psi, weights=weights))


FAULTS = (
    Fault(
        "mask-shift", "Mask shift", "px",
        (0, 0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.25, 1, 4),
        MASK, shift, repairable=True,
    ),
    Fault(
        "mask-rotation", "Mask rotation", "degrees",
        (0, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.5, 2, 8),
        MASK, rotation, repairable=True,
    ),
    Fault(
        "mask-distance-error", "Error of the mask's distance", "%",
        (0, 5, 10, 25, 50, 100, 200), (0, 10, 50, 200),
        MASK, distance, repairable=True,
    ),
    Fault(
        "mask-scale", "Error of the mask's scale", "%",
        (0, 0.1, 0.25, 0.5, 1, 2, 5, 10), (0, 0.5, 2, 10),
        MASK, scale, repairable=True,
    ),
    Fault(
        "edge-blur", "Blur of the mask's edges", "px",
        (0, 0.1, 0.2, 0.35, 0.5, 0.75, 1, 2), (0, 0.2, 0.5, 2),
        MASK, edge_blur, repairable=True,
    ),
    Fault(
        "vignetting", "Vignetting", "% lost by the outermost ray",
        (0, 5, 10, 20, 40, 60, 80, 95), (0, 10, 40, 90),
        MASK, vignetting, repairable=True,
    ),
)  # fmt: skip
