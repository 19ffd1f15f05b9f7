"""The formats of the HCI light fields: the folders of the 4D benchmark, and the older HDF5.

Their cameras move right and down from view to view, so that near points move left and up; here
near points move right and down with (u, v). Views are therefore written in the opposite order
along both axes, and disparities keep their sign: near is more. Pictures are 8-bit sRGB.

Sources: Honauer et al. 2016, "A dataset and evaluation methodology for depth estimation on 4D
light fields", its parameters.cfg; Wanner et al. 2013, "Datasets and benchmarks for densely sampled
4D light fields".
"""

from __future__ import annotations

import configparser
from pathlib import Path

import h5py
import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.formats.format import Array, Export, Format, write_picture
from emmc_rig.model.lightfield import read_picture
from emmc_rig.model.novel_view import centre_disparity
from emmc_rig.model.reading import holds_array, stored_arrays
from emmc_rig.model.srgb import codes_of, linear_of, srgb_of

PARAMETERS, DISPARITY = "parameters.cfg", "gt_disp_lowres.pfm"
FOCAL_MM, SENSOR_MM, BASELINE_MM = 100.0, 35.0, 1.0
"""Of the benchmark's files; nominal here, where disparities and not lengths are measured."""


def _write_folder(folder: Path, export: Export) -> None:
    rows, columns, height, width, _ = export.light_field.shape
    for number, (v, u) in enumerate(np.ndindex(rows, columns)):
        view = export.light_field[rows - 1 - v, columns - 1 - u]
        write_picture(folder / f"input_Cam{number:03}.png", codes_of(srgb_of(view)))
    disparity = centre_disparity(export.light_field, export.disparity)
    write_picture(folder / DISPARITY, disparity)
    sections = {
        "intrinsics": {
            "focal_length_mm": FOCAL_MM,
            "image_resolution_x_px": width,
            "image_resolution_y_px": height,
            "sensor_size_mm": SENSOR_MM,
            "fstop": 100,
        },
        "extrinsics": {
            "num_cams_x": columns,
            "num_cams_y": rows,
            "baseline_mm": BASELINE_MM,
            "focus_distance_m": FOCAL_MM * BASELINE_MM * max(width, height) / SENSOR_MM / 1000,
            **{f"center_cam_{axis}_m": 0 for axis in "xyz"},
            **{f"center_cam_r{axis}_rad": 0 for axis in "xyz"},
        },
        "meta": {
            "scene": export.title.replace("%", ""),
            "category": "emmc-rig",
            "disp_min": float(disparity.min()),
            "disp_max": float(disparity.max()),
            "notes": "lengths are nominal; disparities are in pixels per view",
        },
    }
    config = configparser.ConfigParser()
    config.read_dict(sections)
    with open(folder / PARAMETERS, "w", encoding="utf-8") as file:
        config.write(file)


def _read_folder(path: Path) -> Array:
    config = configparser.ConfigParser()
    try:
        config.read(path / PARAMETERS, encoding="utf-8")
        columns, rows = (config.getint("extrinsics", f"num_cams_{axis}") for axis in "xy")
    except (configparser.Error, ValueError, OSError) as fault:
        raise AppError(
            f"{path / PARAMETERS}: num_cams_x and num_cams_y cannot be read; copy it again"
        ) from fault
    there = sum(1 for _ in path.glob("input_Cam*.png"))
    if not 0 < rows * columns == there:
        raise AppError(
            f"{path}: {there} files input_Cam###.png, but {PARAMETERS} says {rows}x{columns}; "
            "copy it again"
        )
    paths = [path / f"input_Cam{number:03}.png" for number in range(rows * columns)]
    missing = next((view.name for view in paths if not view.is_file()), None)
    if missing:
        raise AppError(f"{path}: {missing} is missing; copy it again")
    views = [linear_of(read_picture(view)) for view in paths]
    if len({view.shape for view in views}) > 1:
        raise AppError(f"{path}: the views differ in size; copy it again")
    return np.stack(views).reshape(rows, columns, *views[0].shape)[::-1, ::-1]


def _write_hdf5(folder: Path, export: Export) -> None:
    rows, columns, height, width, colours = export.light_field.shape
    with h5py.File(folder / "lf.h5", "w") as file:
        pictures = codes_of(srgb_of(export.light_field))[::-1, ::-1]
        file.create_dataset("LF", data=pictures, compression="gzip")
        file.attrs.update(
            vRes=rows, hRes=columns, yRes=height, xRes=width, channels=colours,
            focalLength=FOCAL_MM, dH=BASELINE_MM / 1000, dV=BASELINE_MM / 1000, shift=0.0,
        )  # fmt: skip


def _read_hdf5(path: Path) -> Array:
    with stored_arrays(path, AppError, "copy it again") as stored:
        pictures = stored.array("LF")
    if pictures.dtype != np.uint8 or pictures.ndim != 5:
        raise AppError(
            f"{path}: LF is {pictures.dtype} of shape {pictures.shape}, where "
            "HCI's format has 8 bits and (v, u, y, x, colour)"
        )
    return linear_of(pictures[::-1, ::-1].astype(np.float32) / 255)


FORMATS = (
    Format(
        "hci", "folder of the HCI 4D benchmark: input_Cam###.png, parameters.cfg, PFM disparity",
        "8-bit sRGB; disparity", _write_folder,
        lambda path: (path / "input_Cam000.png").is_file(), _read_folder, parallax=True,
    ),
    Format(
        "hci-hdf5", "HDF5 of HCI's: LF", "8-bit sRGB", _write_hdf5,
        lambda path: path.suffix.lower() in (".h5", ".hdf5") and holds_array(path, "LF"),
        _read_hdf5,
    ),
)  # fmt: skip
