"""Frames of a light field for one cell of a table, through its camera's Psi, with eq. 14's noise.

The frames are made with the Psi that reconstructs them, as the paper does: an inverse crime, which
`emmc-rig demo` avoids.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.study.tables.cells import Capture

_GREEN = np.array(
    [[0, 0, -2, 0, 0], [0, 0, 4, 0, 0], [-2, 4, 8, 4, -2], [0, 0, 4, 0, 0], [0, 0, -2, 0, 0]]
)
_ALONG_ROW = np.array(
    [[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]]
)
_ACROSS = np.array(
    [[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]]
)


def demosaiced_rggb(frame: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return (colour, y, x) of a frame (y, x) whose first pixel is red, the next one green."""
    frame = np.asarray(frame, dtype=np.float32)

    def filtered(kernel: NDArray[np.int_]) -> NDArray[np.float32]:
        weights = (kernel / 16).astype(np.float32)
        # Reflection about the edge pixel keeps the phase of the Bayer tile.
        found = cv2.filter2D(frame, -1, weights, borderType=cv2.BORDER_REFLECT_101)
        return found.astype(np.float32, copy=False)

    green, row, column, across = (
        filtered(kernel) for kernel in (_GREEN, _ALONG_ROW, _ALONG_ROW.T, _ACROSS)
    )
    colours = np.repeat(frame[None], 3, axis=0)
    red, blue = (slice(0, None, 2),) * 2, (slice(1, None, 2),) * 2
    beside_red, beside_blue = (red[0], blue[1]), (blue[0], red[1])
    for place in (red, blue):
        colours[(1, *place)] = green[place]
    for colour, own, other, own_row, other_row in (
        (0, red, blue, beside_red, beside_blue),
        (2, blue, red, beside_blue, beside_red),
    ):
        colours[(colour, *own_row)] = row[own_row]
        colours[(colour, *other_row)] = column[other_row]
        colours[(colour, *other)] = across[other]
        colours[(colour, *own)] = frame[own]
    return colours


Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Shots:
    """What the sensor gave. frames, usable: (shot, pixel_y, pixel_x).

    psi: what to reconstruct with. noise_sigma: root mean of the readings' variance, 0 without
    noise. sensor_psnr_db: of the frames against those without noise.
    """

    psi: ImagingMatrix
    frames: NDArray[np.float32]
    usable: NDArray[np.bool_]
    noise_sigma: float
    sensor_psnr_db: float


@lru_cache(maxsize=1)
def _psi(camera_json: str, size: tuple[int, int]) -> ImagingMatrix:
    return build_imaging_matrix(Camera.model_validate_json(camera_json), size)


def shots_of(capture: Capture, light_field: Array, scene: str, seed: int) -> Shots:
    """Return the shots of a light field (v, u, y, x, c).

    The noise depends on the seed and the scene's name only, not on what was taken before.
    """
    size = light_field.shape[2], light_field.shape[3]
    camera = capture.camera()
    psi = _psi(camera.model_dump_json(), size)
    clean = psi.forward(light_field)
    frames, usable, sigma = clean, np.ones(clean.shape, dtype=bool), 0.0
    if capture.noisy:
        read = camera.read_out(clean, np.random.default_rng([seed, *scene.encode()]))
        frames, usable, sigma = read.readings, read.usable, read.noise_sigma
    quality = psnr_db(frames, clean)
    if capture.demosaiced:
        frames = demosaiced_rggb(frames[0])
        usable = np.repeat(usable, 3, axis=0)
        psi = _psi(capture.solved_as().camera().model_dump_json(), size)
    return Shots(psi, frames.astype(np.float32), usable, sigma, quality)
