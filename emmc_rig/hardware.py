"""The only place that chooses devices: real ones by name, or simulated ones on the same bytes.

The stage chain: device 1 carries the coded mask (axes x, y), device 2 the aperture plate (axes
x, y), which has a pinhole of one aperture cell and, beside it, a window that leaves the whole
aperture open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.camera import Camera as CameraDevice
from drivers.clock import SYSTEM_CLOCK, Clock
from drivers.folder import FolderCamera
from drivers.ptp import PtpCamera, PtpSession
from drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from drivers.stage import Stage, StageSettings
from drivers.u3v import open_u3v
from drivers.usb import open_device
from drivers.zaber import ZaberStage
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, Sensor
from emmc_rig.model.masks import cfa_tile
from emmc_rig.scene import open_scene
from simulators.bench import Bench
from simulators.clock import ManualClock
from simulators.ptp import ANY_EXPOSURE, THIRD_STOPS, PtpCameraSimulator, PtpUsbFunction
from simulators.usb import SimulatedUsb
from simulators.zaber import AxisSpec, ZaberChain

STAGE_AXES = {
    "mask_x": (1, 1),
    "mask_y": (1, 2),
    "aperture_x": (2, 1),
    "aperture_y": (2, 2),
}
MASK_TRAVEL_UM = 25_400.0
POSITION_TOLERANCE_UM = 0.5


class Attendant(Protocol):
    """What somebody, or a relay, does at the bench between exposures."""

    def set_lamp(self, colour: str) -> None:
        """Light the scene or the board: off, white, red, green or blue."""
        ...

    def place(self, target: str) -> None:
        """Put the "scene" or the "whiteboard" before the camera."""
        ...

    def fit_masks(self, shot: int, fitted: bool = True) -> None:
        """Fit the masks and the filter of a shot; or only its filter, the masks taken out."""
        ...


@dataclass(frozen=True)
class Rig:
    """The devices of one bench.

    zero_um: where each stage axis centres the mask or the pinhole on the optical axis.
    window_um: aperture_x, from its zero, that brings the plate's open window onto the axis.
    """

    stage: Stage
    camera: CameraDevice
    attendant: Attendant
    zero_um: Mapping[str, float]
    window_um: float


class SimulatedAttendant:
    """An `Attendant` that acts on the simulated bench."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def set_lamp(self, colour: str) -> None:
        """Switch the bench's lamp."""
        self._bench.lamp = colour

    def place(self, target: str) -> None:
        """Change what the camera looks at."""
        self._bench.target = target

    def fit_masks(self, shot: int, fitted: bool = True) -> None:
        """Change what is in the beam."""
        self._bench.shot = shot
        self._bench.masks_in = fitted


def simulated_rig(
    camera: Camera, fine_scene: NDArray[np.float32], size: tuple[int, int], seed: int
) -> tuple[Rig, Bench]:
    """Return a rig of simulated devices, and the bench that they look at (for its truth).

    fine_scene: see `simulators.bench.Bench`. size: rows and columns of the light field.
    """
    clock = ManualClock()
    aperture_um = max(camera.views) * camera.lens.aperture_cell_um
    travel_um = {1: MASK_TRAVEL_UM, 2: 4 * aperture_um}
    chain = ZaberChain(
        clock, {key: AxisSpec(travel_um=travel_um[key[0]]) for key in STAGE_AXES.values()}
    )
    zero_um = {
        name: (MASK_TRAVEL_UM / 2 if device == 1 else aperture_um)
        for name, (device, _) in STAGE_AXES.items()
    }

    def positions_um() -> dict[str, float]:
        return {
            name: chain.position_um(*address) - zero_um[name]
            for name, address in STAGE_AXES.items()
        }

    window_um = 2 * aperture_um
    bench = Bench(camera, fine_scene, size, positions_um, window_um, np.random.default_rng(seed))
    stage = ZaberStage(
        chain.transport(),
        STAGE_AXES,
        microstep_um=AxisSpec().microstep_um,
        clock=clock,
        settings=StageSettings(tolerance_um=POSITION_TOLERANCE_UM),
    )
    noise = camera.sensor.noise
    cfa = camera.sensor.cfa_name
    simulator = PtpCameraSimulator(
        bench.expose, clock, cfa, noise.black_level_dn, noise.white_level_dn, span=ANY_EXPOSURE
    )
    k = camera.sensor.binning
    still = _ptp_camera(
        clock,
        SimulatedUsb(clock, PtpUsbFunction(simulator)),
        shape=(size[0] // k, size[1] // k),
        cfa=cfa,
        # The card lies in this computer's memory.
        from_card=True,
    )
    return Rig(stage, still, SimulatedAttendant(bench), zero_um, window_um), bench


def open_camera(spec: str, clock: Clock = SYSTEM_CLOCK, backend: Any = None) -> CameraDevice:
    """Open the camera that `spec` names: a kind, a colon and what tells it from others.

    `ptp:` or `ptp:SERIAL`, `u3v:` or `u3v:SERIAL`, `folder:DIR`, `simulated`. `backend`: of pyusb,
    for a simulated bus.
    Raises AppError for any other kind, or an error of the driver.
    """
    kind, _, rest = spec.partition(":")
    if kind not in CAMERAS:
        raise AppError(f"--camera {spec}: no such kind of camera; use {CAMERA_KINDS}")
    return CAMERAS[kind](rest, clock, backend)


def _ptp_camera(
    clock: Clock,
    backend: Any,
    serial: str = "",
    shape: tuple[int, int] | None = None,
    cfa: str | None = None,
    from_card: bool = False,
) -> PtpCamera:
    device = open_device(PTP_INTERFACE, serial=serial, backend=backend, wanted="PTP camera")
    return PtpCamera(PtpSession(PtpUsb(device, clock), clock), shape, cfa, from_card)


def _open_ptp(serial: str, clock: Clock, backend: Any) -> CameraDevice:
    return _ptp_camera(clock, backend, serial)


def _open_u3v(serial: str, clock: Clock, backend: Any) -> CameraDevice:
    return open_u3v(serial, backend=backend, clock=clock)


def _open_folder(folder: str, clock: Clock, backend: Any) -> CameraDevice:
    return FolderCamera(folder or ".", clock)


def _open_simulated(rest: str, clock: Clock, backend: Any) -> CameraDevice:
    """Return a PTP camera on a simulated bus, which looks at a built-in scene."""
    bus = SimulatedUsb(clock, PtpUsbFunction(scene_simulator(clock)))
    return _ptp_camera(clock, bus, from_card=True)


CAMERAS: dict[str, Callable[[str, Clock, Any], CameraDevice]] = {
    "ptp": _open_ptp,
    "u3v": _open_u3v,
    "folder": _open_folder,
    "simulated": _open_simulated,
}
CAMERA_KINDS = "ptp:, ptp:SERIAL, u3v:, u3v:SERIAL, folder:DIR or simulated"
SCENE_SIZE = (240, 320)


def scene_simulator(clock: Clock, seed: int = 0) -> PtpCameraSimulator:
    """Return a simulated camera with a plain lens before a built-in scene."""
    sensor = Sensor(cfa="rggb")
    noise, rng = sensor.noise, np.random.default_rng(seed)
    view = open_scene("deep-occlusions", SCENE_SIZE, (1, 1)).light_field[0, 0]
    tile = cfa_tile(sensor.cfa)
    repeats = (-(-SCENE_SIZE[0] // tile.shape[0]), -(-SCENE_SIZE[1] // tile.shape[1]), 1)
    colours = np.tile(tile, repeats)[: SCENE_SIZE[0], : SCENE_SIZE[1]]
    readings = (view * colours).sum(axis=2)
    return PtpCameraSimulator(
        lambda exposure_s: noise.expose_dn(readings, exposure_s, 1.0, rng),
        clock,
        sensor.cfa_name,
        noise.black_level_dn,
        noise.white_level_dn,
        exposures=THIRD_STOPS,
    )
