"""The only place that chooses devices: here the simulated rig, which speaks the real bytes.

The stage chain: device 1 carries the coded mask (axes x, y), device 2 the aperture plate (axes
x, y), which has a pinhole of one aperture cell and, beside it, a window that leaves the whole
aperture open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.camera import Camera as CameraDevice
from drivers.camera import RawFileCamera
from drivers.stage import Stage, StageSettings
from drivers.zaber import ZaberStage
from emmc_rig.model.camera import Camera
from simulators.bench import Bench
from simulators.camera import SimulatedRawCamera
from simulators.clock import ManualClock
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
    device = SimulatedRawCamera(
        bench.expose, clock, cfa, noise.black_level_dn, noise.white_level_dn
    )
    k = camera.sensor.binning
    raw = RawFileCamera(device, (size[0] // k, size[1] // k), cfa)
    return Rig(stage, raw, SimulatedAttendant(bench), zero_um, window_um), bench
