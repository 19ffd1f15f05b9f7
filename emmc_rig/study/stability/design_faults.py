"""The camera's design taken to its ends: mask, shots, views, pixels; Psi is always the true one."""

from __future__ import annotations

from emmc_rig.model.camera import Camera, Mask
from emmc_rig.model.errors import CameraError
from emmc_rig.study.stability.trial import Setup, Trial, taken
from emmc_rig.study.sweep import NotApplicableError


def _near_mask(camera: Camera) -> tuple[str, Mask]:
    near = [
        (name, mask)
        for name, mask in camera.masks.items()
        if mask.distance_mm < camera.lens.distance_mm / 2
    ]
    if len(near) != 1:
        raise NotApplicableError("needs a camera with one mask near its sensor")
    return near[0]


def _with_mask(setup: Setup, **changed: float) -> Trial:
    name, mask = _near_mask(setup.camera)
    masks = {**setup.camera.masks, name: mask.model_copy(update=changed)}
    return taken(setup.with_camera(masks=masks))


def mask_cell(setup: Setup, px: float) -> Trial:
    """The mask's cells are so many samples wide."""
    return _with_mask(setup, cell_um=px * setup.camera.sensor.sample_pitch_um)


def mask_distance(setup: Setup, px: float) -> Trial:
    """The mask stands where its shadow moves by so many samples from view to view."""
    camera = setup.camera
    ratio = px * camera.sensor.sample_pitch_um / camera.lens.aperture_cell_um
    return _with_mask(setup, distance_mm=ratio * camera.lens.distance_mm)


def shots(setup: Setup, count: float) -> Trial:
    """The camera takes so many shots in the same total time."""
    try:
        camera = setup.camera.with_shots(round(count))
    except CameraError as fault:
        raise NotApplicableError(str(fault)) from fault
    return taken(Setup(setup.scene, camera, setup.size, setup.seed, setup.zoom))


def views(setup: Setup, count: float) -> Trial:
    """So many views a side are wanted, through the same aperture; of a measured scene, fewer."""
    side, camera = round(count), setup.camera
    if not setup.is_built_in and side > max(camera.views):
        raise NotApplicableError(f"built-in scenes only: {side} x {side} views were not measured")
    lens = camera.lens
    if setup.is_built_in:
        cell_mm = lens.aperture_cell_mm * max(camera.views) / side
        lens = lens.model_copy(update={"aperture_cell_mm": cell_mm})
    return taken(setup.with_camera(views=(side, side), lens=lens))


def pixel_size(setup: Setup, r: float) -> Trial:
    """One pixel sums k x k samples, r = 1 / k^2."""
    k, own = round(r**-0.5), setup.camera.sensor
    # A larger pixel holds more electrons: white stays within the range.
    gain = own.noise.gain_dn_per_electron * (own.binning / k) ** 2
    noise = own.noise.model_copy(update={"gain_dn_per_electron": gain})
    sensor = own.model_copy(update={"binning": k, "noise": noise})
    try:
        return taken(setup.with_camera(sensor=sensor))
    except CameraError as fault:
        raise NotApplicableError(str(fault)) from fault
