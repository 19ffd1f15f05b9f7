"""Masks as maker and light make them: soft, over-etched, thick, diffracted.

Cells are drawn on grains of about GRAIN_UM. Over-etching moves every edge outward of what is open,
the edge's softness blurs it, diffraction spreads it on the way to the sensor (angular spectrum, see
`simulators.flaws`). A thick layer is two thin ones, its two faces: a ray passes both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_dilation, grey_erosion

from emmc_rig.model.camera import Camera, Plate, build_imaging_matrix, draw_plates
from emmc_rig.model.sensing import Psi
from emmc_rig.simulators.flaws import WAVELENGTHS_UM, diffracted

GRAIN_UM = 2.0
"""A quarter of the first fringe behind a cell of 36 um at 0.12 mm."""
BACK = " (back face)"


@dataclass(frozen=True)
class Print:
    """How a mask comes out. over_etch_um: below 0 where what is open shrinks."""

    edge_um: float = 0.0
    over_etch_um: float = 0.0
    thickness_um: float = 0.0
    diffraction: bool = True


def printed_psi(camera: Camera, size: tuple[int, int], how: Print) -> Psi:
    """Return Psi of a camera whose masks between sensor and lens came out so.

    Raises CameraError as `build_imaging_matrix` does.
    """
    plates, masks = {}, {}
    for name, plate in draw_plates(camera, size).items():
        masks[name] = camera.masks[name]
        between = 0 < plate.distance_mm < camera.lens.distance_mm
        plates[name] = _printed(plate, how) if between else plate
        if between and how.thickness_um:
            distance_mm = plate.distance_mm + how.thickness_um * 1e-3
            plates[name + BACK] = replace(plates[name], distance_mm=distance_mm)
            masks[name + BACK] = masks[name].model_copy(update={"distance_mm": distance_mm})
    shots = tuple(
        shot.model_copy(
            update={
                "masks": _both_faces(camera.shot_masks(index), plates),
                "offset_um": {
                    face: offset
                    for name, offset in shot.offset_um.items()
                    for face in _both_faces((name,), plates)
                },
            }
        )
        for index, shot in enumerate(camera.shots)
    )
    thick = camera.model_copy(update={"masks": masks, "shots": shots})
    return replace(build_imaging_matrix(thick, size, plates), camera_json=camera.model_dump_json())


def _both_faces(names: tuple[str, ...], plates: dict[str, Plate]) -> tuple[str, ...]:
    return tuple(face for name in names for face in (name, name + BACK) if face in plates)


def _printed(plate: Plate, how: Print) -> Plate:
    """Return a plate of grains."""
    parts = max(1, math.ceil(plate.cell_um / GRAIN_UM))
    grain_um = plate.cell_um / parts
    fine = plate.cells.repeat(parts, axis=1).repeat(parts, axis=2)
    for frame in fine:
        for colour, wavelengths_um in enumerate(WAVELENGTHS_UM):
            seen: NDArray[np.floating] = _etched(frame[..., colour], how.over_etch_um / grain_um)
            if how.edge_um:
                seen = gaussian_filter(seen, how.edge_um / grain_um)
            if how.diffraction:
                seen = np.mean(
                    [
                        diffracted(
                            seen.astype(np.float32),
                            grain_um,
                            plate.distance_mm * 1e3,
                            wavelength_um,
                        )
                        for wavelength_um in wavelengths_um
                    ],
                    axis=0,
                )
            frame[..., colour] = seen
    return Plate(fine, grain_um, plate.distance_mm)


def _etched(cells: NDArray[np.floating], by_grains: float) -> NDArray[np.floating]:
    """Return what is open grown by so many grains to every side; the last one in part."""
    turned = grey_dilation if by_grains > 0 else grey_erosion
    whole, part = divmod(abs(by_grains), 1)
    if whole:
        cells = turned(cells, size=(2 * int(whole) + 1,) * 2)
    if part:
        cells = (1 - part) * cells + part * turned(cells, size=(3, 3))
    return cells
