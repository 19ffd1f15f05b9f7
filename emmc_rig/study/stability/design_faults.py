"""Extremes of the camera's design: mask, shots, views, pixels; Psi is always the true one."""

from __future__ import annotations

from dataclasses import replace

from emmc_rig.model.camera import Camera, Mask
from emmc_rig.model.errors import CameraError
from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.trial import DESIGN, Capture, Fault, Trial, trial_of


def _near_mask(camera: Camera) -> tuple[str, Mask]:
    near = [
        (name, mask)
        for name, mask in camera.masks.items()
        if mask.distance_mm < camera.lens.distance_mm / 2
    ]
    if len(near) != 1:
        raise NotApplicableError("needs a camera with one mask near its sensor")
    return near[0]


def _with_mask(capture: Capture, **changed: float) -> Trial:
    name, mask = _near_mask(capture.described)
    masks = {**capture.described.masks, name: mask.model_copy(update=changed)}
    return trial_of(capture.with_camera(masks=masks))


def mask_cell(capture: Capture, px: float) -> Trial:
    """The width of the mask's cells."""
    return _with_mask(capture, cell_um=px * capture.described.sensor.sample_pitch_um)


def mask_distance(capture: Capture, px: float) -> Trial:
    """How far the mask's shadow moves from view to view, by its distance from the sensor."""
    camera = capture.described
    ratio = px * camera.sensor.sample_pitch_um / camera.lens.aperture_cell_um
    return _with_mask(capture, distance_mm=ratio * camera.lens.distance_mm)


def shots(capture: Capture, count: float) -> Trial:
    """The number of shots in the same total time."""
    return trial_of(replace(capture, shots=round(count)))


def views(capture: Capture, count: float) -> Trial:
    """The number of views, through the same aperture; of a measured scene, fewer."""
    side, camera = round(count), capture.described
    if not capture.is_built_in and side > max(camera.views):
        raise NotApplicableError(f"built-in scenes only: {side} x {side} views were not measured")
    lens = camera.lens
    if capture.is_built_in:
        cell_mm = lens.aperture_cell_mm * max(camera.views) / side
        lens = lens.model_copy(update={"aperture_cell_mm": cell_mm})
    return trial_of(capture.with_camera(views=(side, side), lens=lens))


def pixel_size(capture: Capture, r: float) -> Trial:
    """One pixel sums k x k samples, r = 1 / k^2."""
    k, own = round(r**-0.5), capture.described.sensor
    # A larger pixel holds more electrons: white stays within the range.
    gain = own.noise.gain_dn_per_electron * (own.binning / k) ** 2
    noise = own.noise.model_copy(update={"gain_dn_per_electron": gain})
    sensor = own.model_copy(update={"binning": k, "noise": noise})
    try:
        return trial_of(capture.with_camera(sensor=sensor))
    except CameraError as fault:
        raise NotApplicableError(str(fault)) from fault


FAULTS = (
    Fault(
        "mask-cell", "Mask cell", "px",
        (0.1, 0.25, 0.5, 1, 1.5, 2, 3, 4, 8, 16, 32, 64), (0.1, 1.5, 6, 32),
        DESIGN, mask_cell,
    ),
    Fault(
        "mask-distance", "Mask distance", "px of shadow per view",
        (0, 0.125, 0.25, 0.5, 1, 2, 4, 8, 16), (0, 0.25, 1, 8),
        DESIGN, mask_distance, clean=False,
    ),
    Fault(
        "shots", "Shots", "shots",
        (6, 4, 3, 2, 1), (4, 2, 1),
        DESIGN, shots, whole=True,
    ),
    Fault(
        "views", "Views", "views a side",
        (1, 3, 5, 7), (3, 5, 7),
        DESIGN, views, whole=True,
    ),
    Fault(
        "r", "Pixel size, r", "measurements per sample",
        (1, 1 / 4, 1 / 16, 1 / 64), (1, 1 / 4, 1 / 16),
        DESIGN, pixel_size, whole=True,
    ),
)  # fmt: skip
