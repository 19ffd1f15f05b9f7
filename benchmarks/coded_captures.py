"""Frames that real coded cameras took, made by others, by the roads that their owners have.

In a folder as the README beside them describes: `tsa`, `smem` (CASSI: a binary mask, then a prism;
monochrome sensor; Meng et al. 2020) and `colour-aperture` (one opening in the lens for each colour;
Bando, Chen, Nishita 2008). Each camera has a description in `CAMERAS` and a Psi, both explained in
docs/real-captures.md; `emmc-rig import` and the Python API do the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

import emmc_rig as emmc
from emmc_rig.cli import app

BANDS = {"tsa": 28, "smem": 24}
"""Of each spectral camera."""
ARRAYS = {"tsa": "meas_real", "smem": "meas"}
PRISM_PX = 2
"""By which the prism displaces a band against the one before."""
CASSI = """
title: CASSI
views: [1, {bands}]
sensor:
  cfa: [R]  # no filters, and light of one kind
  noise: {{black_level_dn: 0, white_level_dn: 1}}
"""
COLOUR_APERTURE = """
title: Openings behind colour filters
views: [3, 3]
sensor:
  cfa: [R]
  noise: {black_level_dn: 0, white_level_dn: 1}
shots: [{}, {}, {}]
"""
CAMERAS = {kind: CASSI.format(bands=bands) for kind, bands in BANDS.items()}
CAMERAS["colour-aperture"] = COLOUR_APERTURE
OPENINGS = ((1, 2), (0, 1), (1, 0))
"""View (v, u) behind the red, the green and the blue filter."""
GAMMA = 2.2
SOFTER_PX = 0.9
SOFTER = f"{SOFTER_PX} px softer"
"""Deviation of a Gaussian: the shadow of the mask of `tsa` is that much softer than its picture."""
WINDOW = (96, 160)
KEPT, BLOCK_PX, SEED = 0.05, 8, 5


@dataclass(frozen=True, eq=False)
class CodedCapture:
    """psi, frames: what `emmc_rig.open_frames` returns of the imported session, or their middle.

    kept: which to keep from a fit, to compare with: single ones, and where every shot sees another
    colour blocks of one shot, as colours beside tell nothing new.
    """

    psi: emmc.Psi
    frames: emmc.Frames
    kept: NDArray[np.bool_]

    def reconstruct(self, method: str) -> emmc.Result:
        """Return the light field of all readings but those kept."""
        usable = self.frames.usable & ~self.kept
        return emmc.reconstruct(self.psi, self.frames, method, usable=usable)


def available(folder: Path) -> list[str]:
    """Return the names of the captures in a folder, as `coded_capture` takes them."""
    found = [path for kind in BANDS for path in sorted((folder / kind).glob("*.mat"))]
    found += sorted((folder / "colour-aperture").glob("*.ppm"))
    return [f"{path.parent.name}/{path.stem}" for path in found if path.stem != "mask"]


def coded_capture(
    folder: Path,
    name: str,
    size: tuple[int, int] | None = WINDOW,
    mask: str = "right",
    blocks: bool | None = None,
) -> CodedCapture:
    """Return a capture by `emmc-rig import` and the file of its Psi.

    size: rows and columns of the middle; None: the whole frame. mask: of the spectral cameras;
    `right` as published, SOFTER, or a wrong one for comparison: `4 rows off`, `mirrored`. blocks:
    keep blocks and not single readings (default: of `colour-aperture`).
    """
    kind = name.split("/")[0]
    with TemporaryDirectory(prefix="captures-") as work:
        camera, session, psi_file = (Path(work) / name for name in ("mine.yaml", "s", "psi.h5"))
        camera.write_text(CAMERAS[kind], "utf-8")
        if kind in BANDS:
            shots = folder / f"{name}.mat@{ARRAYS[kind]}"
            psi = spectral_psi(folder / kind / "mask.mat", BANDS[kind], mask)
        else:
            shots = Path(work) / "light.npy"
            light = linear_planes(folder / f"{name}.ppm", size)
            np.save(shots, light)
            psi = openings_psi(light.shape[1:])
        psi.save(psi_file)
        command = ["import", "--shots", shots, "--camera", camera, "--out", session]
        app(list(map(str, command)), standalone_mode=False)
        psi, frames = emmc.open_frames(session, psi_file)
    rows, columns = _middle(psi.size, size)
    psi, place = psi.window(rows, columns), (slice(None), rows, columns)
    frames = emmc.Frames(frames.readings[place], frames.deviation[place], frames.usable[place])
    by_blocks = kind not in BANDS if blocks is None else blocks
    return CodedCapture(psi, frames, frames.usable & _kept(frames.shape, by_blocks))


def _middle(have: tuple[int, ...], want: tuple[int, int] | None) -> tuple[slice, slice]:
    """Return the rows and columns in the middle of some, all where none are wanted."""
    rows, columns = have if want is None else want
    top, left = (have[0] - rows) // 2, (have[1] - columns) // 2
    return slice(top, top + rows), slice(left, left + columns)


def spectral_psi(path: Path, bands: int, mask: str = "right") -> emmc.Psi:
    """Return the Psi of a prism behind a mask: band t at column c through mask column c - 2t."""
    code = loadmat(path)["mask"].astype(np.float32)
    if mask == "mirrored":
        code = code[:, ::-1]
    elif mask == SOFTER:
        code = np.asarray(cv2.GaussianBlur(code, (0, 0), SOFTER_PX))
    elif mask != "right":
        code = np.roll(code, int(mask.split()[0]), axis=0)
    widest = PRISM_PX * (bands - 1)
    shifts = range(0, widest + 1, PRISM_PX)
    weights = np.stack([np.pad(code, ((0, 0), (t, widest - t))) for t in shifts])
    weights /= weights.sum(axis=0).mean()
    return emmc.Psi.from_weights(weights[None, None], view_axes=("angle", "band"))


def openings_psi(size: tuple[int, ...]) -> emmc.Psi:
    """Return the Psi of one opening for each colour, a shot each, for rows x columns."""
    weights = np.zeros((3, 3, 3, *size), np.float32)
    for shot, (v, u) in enumerate(OPENINGS):
        weights[shot, v, u] = 1
    return emmc.Psi.from_weights(weights)


def linear_planes(path: Path, size: tuple[int, int] | None) -> NDArray[np.float32]:
    """Return the light of a picture at half size, or of its middle, each colour of one mean.

    size: rows and columns of the middle; None: all. Shape (3, y, x), in [0, 1].
    """
    codes = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert codes is not None, path
    light = np.asarray((codes / 255.0) ** GAMMA, dtype=np.float32)
    light = np.asarray(cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    light = light[_middle(light.shape[:2], size)]
    light = light / light.mean(axis=(0, 1))
    return np.moveaxis(light / light.max(), -1, 0)


def _kept(shape: tuple[int, ...], by_blocks: bool) -> NDArray[np.bool_]:
    """Return which readings (shot, y, x) to keep: single ones, or blocks of the second shot."""
    rng = np.random.default_rng(SEED)
    if not by_blocks:
        return rng.random(shape) < KEPT
    rows, columns = shape[1:]
    chosen = rng.random((-(-rows // BLOCK_PX), -(-columns // BLOCK_PX))) < KEPT
    kept = np.zeros(shape, np.bool_)
    kept[min(1, shape[0] - 1)] = np.kron(chosen, np.ones((BLOCK_PX,) * 2))[:rows, :columns] > 0
    return kept
