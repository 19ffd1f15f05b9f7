"""Frames that real coded cameras took, made by others, each with its Psi.

In a folder as the README beside them describes: `tsa`, `smem` (CASSI: a binary mask, then a prism;
monochrome sensor; Meng et al. 2020) and `colour-aperture` (one opening in the lens for each colour;
Bando, Chen, Nishita 2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

import emmc_rig as emmc

BANDS = {"tsa": (28, "meas_real"), "smem": (24, "meas")}
"""Of each spectral camera, and the name of its readings."""
PRISM_PX = 2
"""By which the prism displaces a band against the one before."""
NOISE = 0.01
"""Deviation of the readings over the brightest: nobody measured it."""
OPENINGS = ((1, 2), (0, 1), (1, 0))
"""View (v, u) behind the red, the green and the blue filter."""
GAMMA = 2.2
SOFTER_PX = 0.9
SOFTER = f"{SOFTER_PX} px softer"
"""Deviation of a Gaussian: the shadow of the mask of `tsa` is that much softer than its picture."""
KEPT, BLOCK_PX, SEED = 0.05, 8, 5


@dataclass(frozen=True, eq=False)
class CodedCapture:
    """psi; readings (shot, pixel_y, pixel_x), and their deviation.

    kept: which to keep from a fit, to compare with: single ones, and where every shot sees another
    colour blocks of one shot, as colours beside tell nothing new.
    """

    name: str
    psi: emmc.Psi
    readings: NDArray[np.float32]
    noise: float
    kept: NDArray[np.bool_]


def available(folder: Path) -> list[str]:
    """Return the names of the captures in a folder, as `coded_capture` takes them."""
    found = [path for kind in BANDS for path in sorted((folder / kind).glob("*.mat"))]
    found += sorted((folder / "colour-aperture").glob("*.ppm"))
    return [f"{path.parent.name}/{path.stem}" for path in found if path.stem != "mask"]


def coded_capture(
    folder: Path, name: str, size: tuple[int, int] = (96, 160), mask: str = "right"
) -> CodedCapture:
    """Return the middle of a capture.

    size: rows and columns; of `colour-aperture` of the picture at half size. mask: of the spectral
    cameras; `right` as published, SOFTER, or a wrong one for comparison: `4 rows off`, `mirrored`.
    """
    kind = name.split("/")[0]
    if kind in BANDS:
        return _spectral(folder / kind, name, size, mask)
    return _colour_aperture(folder / f"{name}.ppm", name, size)


def _middle(count: int, wanted: int) -> int:
    return (count - wanted) // 2


def _spectral(folder: Path, name: str, size: tuple[int, int], mask: str) -> CodedCapture:
    bands, key = BANDS[folder.name]
    frame = loadmat(folder / f"{name.split('/')[1]}.mat")[key].astype(np.float32)
    code = loadmat(folder / "mask.mat")["mask"].astype(np.float32)
    if mask == "mirrored":
        code = code[:, ::-1]
    elif mask == SOFTER:
        code = np.asarray(cv2.GaussianBlur(code, (0, 0), SOFTER_PX))
    elif mask != "right":
        code = np.roll(code, int(mask.split()[0]), axis=0)
    rows, columns = size
    top, left = _middle(frame.shape[0], rows), _middle(frame.shape[1], columns)
    firsts = [left - PRISM_PX * band for band in range(bands)]
    weights = np.stack([code[top : top + rows, first : first + columns] for first in firsts])
    weights = weights[None, None] / weights.sum(axis=0).mean()
    psi = emmc.Psi.from_weights(weights, view_axes=("angle", "band"))
    readings = frame[None, top : top + rows, left : left + columns]
    readings = readings / readings.max()
    kept = np.random.default_rng(SEED).random(readings.shape) < KEPT
    return CodedCapture(name, psi, readings, NOISE, kept)


def _colour_aperture(path: Path, name: str, size: tuple[int, int]) -> CodedCapture:
    codes = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert codes is not None, path
    light = np.asarray((codes / 255.0) ** GAMMA, dtype=np.float32)
    light = np.asarray(cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    top, left = (_middle(have, want) for have, want in zip(light.shape[:2], size, strict=True))
    light = light[top : top + size[0], left : left + size[1]]
    light = light / light.mean(axis=(0, 1)) * light.mean()
    weights = np.zeros((3, 3, 3, *size))
    for shot, (v, u) in enumerate(OPENINGS):
        weights[shot, v, u] = 1
    readings = np.moveaxis(light / light.max(), -1, 0).astype(np.float32)
    kept = np.zeros(readings.shape, np.bool_)
    cells = tuple(-(-side // BLOCK_PX) for side in size)
    blocks = np.random.default_rng(SEED).random(cells) < KEPT
    kept[1] = np.kron(blocks, np.ones((BLOCK_PX, BLOCK_PX)))[: size[0], : size[1]] > 0
    return CodedCapture(name, emmc.Psi.from_weights(weights), readings, NOISE, kept)
