"""What tools for lenslet cameras read: LFToolbox's .mat, and ESLF, views interleaved in one PNG.

Sources: Dansereau, "Light Field Toolbox for Matlab" 0.5: LF (row, column, y, x, RGB and weight)
uint16; Stanford Lytro archive: pixel (y, x) of view (v, u) lies at (y V + v, x U + u).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.formats.format import Array, Export, Format, write_picture
from emmc_rig.model.decoding.stored import read_stored
from emmc_rig.model.lightfield import read_picture
from emmc_rig.model.srgb import codes_of, linear_of, srgb_of

ESLF = re.compile(r".*_(\d+)x(\d+)_eslf\.png")


def _write_mat(folder: Path, export: Export) -> None:
    from scipy.io import savemat  # SciPy loads for a third of a second

    pictures = codes_of(export.light_field, 16)
    weight = np.full((*pictures.shape[:4], 1), 65535, np.uint16)
    savemat(
        folder / "light_field.mat",
        {
            "LF": np.concatenate([pictures, weight], axis=-1),
            "LFMetadata": {"Source": "emmc-rig", "Colour": "linear RGB, 65535 is white"},
        },
        do_compression=True,
    )


def _read_mat(path: Path) -> Array:
    pictures = read_stored(path, AppError, "LF").array
    if pictures.ndim == 4:  # MATLAB drops a last axis of length 1
        pictures = pictures[..., None]
    if pictures.ndim != 5 or pictures.dtype.kind not in "uf":
        raise AppError(
            f"{path}: LF is {pictures.dtype} of shape {pictures.shape}, where a light "
            "field has (v, u, y, x, colour)"
        )
    white = np.iinfo(pictures.dtype).max if pictures.dtype.kind == "u" else 1
    light = pictures[..., :3].astype(np.float32) / white
    return np.repeat(light, 3, axis=-1) if light.shape[-1] == 1 else light


def _write_eslf(folder: Path, export: Export) -> None:
    rows, columns, height, width, colours = export.light_field.shape
    woven = codes_of(srgb_of(export.light_field), 16).transpose(2, 0, 3, 1, 4)
    name = f"light_field_{rows}x{columns}_eslf.png"
    write_picture(folder / name, woven.reshape(height * rows, width * columns, colours))


def _read_eslf(path: Path) -> Array:
    match = ESLF.fullmatch(path.name)
    assert match is not None
    rows, columns = int(match[1]), int(match[2])
    picture = linear_of(read_picture(path))
    height, width, colours = picture.shape
    if not rows or not columns or height % rows or width % columns:
        raise AppError(
            f"{path}: {height}x{width} pixels cannot be {rows}x{columns} views: "
            "correct VxU in its name"
        )
    woven = picture.reshape(height // rows, rows, width // columns, columns, colours)
    return woven.transpose(1, 3, 0, 2, 4)


FORMATS = (
    Format(
        "lftoolbox", "light_field.mat for LFToolbox", "16 bits, linear", _write_mat,
        lambda path: path.suffix.lower() == ".mat" and path.exists(), _read_mat,
    ),
    Format(
        "eslf", "light_field_VxU_eslf.png, views interleaved", "16-bit sRGB", _write_eslf,
        lambda path: path.is_file() and ESLF.fullmatch(path.name) is not None, _read_eslf,
    ),
)  # fmt: skip
