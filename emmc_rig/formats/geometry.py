"""The scene in space: a coloured point cloud, and cameras for tools that learn radiance fields.

Lengths are nominal, since disparities alone are measured: the focal length is the picture's width,
views lie BASELINE apart, and disparity 0 lies at distance 1. A point of disparity d is then at
z = 1 / (1 + d / (width BASELINE)): near is more.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from emmc_rig.formats.format import Array, Export, Format, write_picture
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.novel_view import centre_disparity
from emmc_rig.model.srgb import codes_of, srgb_of

BASELINE = 0.02
"""Between views, where disparity 0 lies at 1: a disparity of 1 % of the width is a third nearer."""


def depths(disparity: Array) -> Array:
    """Return the distance z of disparities (y, x), pixels per view step."""
    return 1 / np.maximum(1 + disparity / (disparity.shape[1] * BASELINE), 1e-3)


def _write_ply(folder: Path, export: Export) -> None:
    """One vertex a sample of the centre view: x right, y down, z away; sRGB; sigma of its light."""
    disparity = centre_disparity(export.light_field, export.disparity)
    height, width = disparity.shape
    y, x = np.mgrid[:height, :width]
    z = depths(disparity)
    rows, columns = export.light_field.shape[:2]
    sigma = np.zeros_like(z) if export.sigma is None else export.sigma[rows // 2, columns // 2]
    names = ("x", "y", "z", "red", "green", "blue", "sigma")
    kinds = ("<f4",) * 3 + ("u1",) * 3 + ("<f4",)
    vertices = np.empty(disparity.size, list(zip(names, kinds, strict=True)))
    colours = codes_of(srgb_of(centre_view(export.light_field)))
    placed = (x - (width - 1) / 2) / width * z, (y - (height - 1) / 2) / width * z, z
    for name, values in zip(names, (*placed, *np.moveaxis(colours, -1, 0), sigma), strict=True):
        vertices[name] = values.ravel()
    words = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment emmc-rig: lengths are nominal, sigma is of linear light",
        f"element vertex {vertices.size}",
        *(f"property {words[kind]} {name}" for name, kind in zip(names, kinds, strict=True)),
        "end_header\n",
    ]
    (folder / "points.ply").write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())


def _write_transforms(folder: Path, export: Export) -> None:
    """Every view as a PNG, and transforms.json: cameras side by side, looking along -z.

    Views are off-axis: the principal point moves so that what is at distance 1 stays. Near points
    move right and down with (u, v), so that cameras go left and up.
    """
    rows, columns, height, width, _ = export.light_field.shape
    (folder / "images").mkdir()
    frames = []
    for v, u in np.ndindex(rows, columns):
        name = f"images/view_{v}_{u}.png"
        write_picture(folder / name, codes_of(srgb_of(export.light_field[v, u])))
        right, down = -(u - columns // 2) * BASELINE, -(v - rows // 2) * BASELINE
        pose = np.eye(4)
        pose[:3, 3] = right, -down, 0
        frames.append(
            {
                "file_path": name,
                "transform_matrix": pose.tolist(),
                "cx": width / 2 + width * right,
                "cy": height / 2 + width * down,
            }
        )
    about = {
        "camera_model": "OPENCV", "w": width, "h": height, "fl_x": width, "fl_y": width,
        "cx": width / 2, "cy": height / 2, "k1": 0, "k2": 0, "p1": 0, "p2": 0, "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


FORMATS = (
    Format(
        "ply", "points.ply, a point cloud of the centre view", "place, colour and sigma",
        _write_ply, parallax=True,
    ),
    Format(
        "transforms", "images and transforms.json for radiance-field tools",
        "8-bit sRGB, nominal poses", _write_transforms, parallax=True,
    ),
)  # fmt: skip
