"""Exposures kept in memory: whiteboards through the stepped pinhole, and the shots of a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from calibration.frames import average
from calibration.whiteboard import Whiteboards
from emmc_rig.acquisition.expand import mask_offsets_um
from emmc_rig.acquisition.plan import METERING_EXPOSURE_S
from emmc_rig.bench.hardware import Rig
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.geometry import centred_grid

WHITEBOARD_LEVEL = 0.7
MAX_EXPOSURE_S = 30.0
REFERENCE_REPEATS = 4

Frame = NDArray[np.uint16]


def whiteboard_exposures(camera: Camera, lamps: tuple[str, ...], repeats: int) -> int:
    """Return how many frames `capture_whiteboards` takes."""
    per_shot = len(lamps) * (1 + REFERENCE_REPEATS + camera.views[0] * camera.views[1] * repeats)
    return REFERENCE_REPEATS + len(camera.shots) * per_shot


def move_masks(rig: Rig, camera: Camera, shot: int) -> None:
    """Bring the masks on the stage to where a shot wants them.

    Raises AppError when a shot wants two of them at different places: there is one mask stage.
    """
    offsets_um = mask_offsets_um(camera, shot)
    if offsets_um:
        _go(rig, offsets_um)


def open_aperture(rig: Rig) -> None:
    """Bring the window of the aperture plate onto the axis."""
    _go(rig, {"aperture_x": rig.window_um, "aperture_y": 0.0})


def place_pinhole(rig: Rig, camera: Camera, v: int, u: int) -> None:
    """Bring the pinhole before one view."""
    cell_um = camera.lens.aperture_cell_um
    y_um = float(centred_grid(camera.views[0], cell_um)[v])
    x_um = float(centred_grid(camera.views[1], cell_um)[u])
    _go(rig, {"aperture_x": x_um, "aperture_y": y_um})


def _go(rig: Rig, offsets_um: dict[str, float]) -> None:
    rig.stage.move_to_um({axis: rig.zero_um[axis] + um for axis, um in offsets_um.items()})


def _expose(rig: Rig, exposure_s: float) -> float:
    """Set the exposure and return the one that the camera took: cameras have steps."""
    rig.camera.set_exposure_s(exposure_s)
    return rig.camera.exposure_s


def _snaps(rig: Rig, count: int, label: str, on_frame: Callable[[str], None]) -> Iterator[Frame]:
    for _ in range(count):
        yield rig.camera.snap().mosaic
        on_frame(label)


def capture_whiteboards(
    rig: Rig,
    camera: Camera,
    lamps: tuple[str, ...],
    repeats: int,
    on_frame: Callable[[str], None] = lambda label: None,
    on_setting: Callable[[tuple[int, int, int, str]], None] = lambda key: None,
) -> Whiteboards:
    """Home the rig and take every frame that `calibration.whiteboard.measure_psi` needs.

    on_frame is called after every exposure; on_setting when the bench stands ready for
    (shot, v, u, lamp). The lamp is off and the scene back when this returns or fails.
    """
    rig.stage.home()
    white_dn = camera.sensor.noise.white_level_dn
    black_dn = camera.sensor.noise.black_level_dn
    try:
        rig.attendant.place("whiteboard")
        rig.attendant.set_lamp("off")
        exposure_s = _expose(rig, METERING_EXPOSURE_S)
        dark_frames = _snaps(rig, REFERENCE_REPEATS, "dark", on_frame)
        dark = average(dark_frames, exposure_s, white_dn, "dark frame")
        references, pinholes = {}, {}
        for shot in range(len(camera.shots)):
            rig.attendant.fit_masks(shot, fitted=False)
            open_aperture(rig)
            for lamp in lamps:
                label = f"reference, shot {shot + 1}, {lamp} lamp"
                rig.attendant.set_lamp(lamp)
                metered_s = _expose(rig, METERING_EXPOSURE_S)
                (metered,) = _snaps(rig, 1, label, on_frame)
                bright = float(np.percentile(metered, 99.9)) - black_dn
                if bright < 1:
                    raise AppError(f"{label}: the whiteboard is dark; is the lamp on?")
                level = WHITEBOARD_LEVEL * (white_dn - black_dn) / bright
                exposure_s = _expose(rig, min(metered_s * level, MAX_EXPOSURE_S))
                frames = _snaps(rig, REFERENCE_REPEATS, label, on_frame)
                references[shot, lamp] = average(frames, exposure_s, white_dn, label)
            rig.attendant.fit_masks(shot)
            move_masks(rig, camera, shot)
            for v in range(camera.views[0]):
                for u in range(camera.views[1]):
                    place_pinhole(rig, camera, v, u)
                    for lamp in lamps:
                        rig.attendant.set_lamp(lamp)
                        on_setting((shot, v, u, lamp))
                        label = f"whiteboard, shot {shot + 1}, view {v},{u}, {lamp} lamp"
                        exposure_s = references[shot, lamp].exposure_s
                        exposure_s = _expose(
                            rig,
                            min(exposure_s * camera.views[0] * camera.views[1], MAX_EXPOSURE_S),
                        )
                        frames = _snaps(rig, repeats, label, on_frame)
                        pinholes[shot, v, u, lamp] = average(frames, exposure_s, white_dn, label)
        return Whiteboards(dark, references, pinholes)
    finally:
        rig.attendant.set_lamp("off")
        rig.attendant.place("scene")


def capture_shots(
    rig: Rig, camera: Camera, on_frame: Callable[[str], None] = lambda label: None
) -> tuple[Frame, NDArray[np.float64]]:
    """Return the shots of the scene, (shot, pixel_y, pixel_x) uint16 DN, and their exposures in s.

    The lamp is off after.
    """
    frames, exposures_s = [], []
    try:
        rig.attendant.place("scene")
        rig.attendant.set_lamp("white")
        open_aperture(rig)
        for shot, exposure_s in enumerate(camera.exposures_s()):
            rig.attendant.fit_masks(shot)
            move_masks(rig, camera, shot)
            exposures_s.append(_expose(rig, float(exposure_s)))
            frames.extend(_snaps(rig, 1, f"shot {shot + 1}", on_frame))
    finally:
        rig.attendant.set_lamp("off")
    return np.stack(frames), np.array(exposures_s)
