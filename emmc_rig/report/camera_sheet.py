"""A camera in figures, as a row of a table, and as a drawing."""

from __future__ import annotations

import textwrap
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model.camera import (
    Camera,
    Mask,
    Plate,
    build_imaging_matrix,
    draw_plates,
    sensor_response,
)
from emmc_rig.model.files import whole_file
from emmc_rig.model.geometry import centred_grid, fresnel_number, mask_position
from emmc_rig.model.masks import cfa_tile
from emmc_rig.model.sensing import Psi
from emmc_rig.model.view_axes import grid_name, picture_name, place_name, shows_parallax
from emmc_rig.report.camera_list import sensor_name, square_size
from emmc_rig.report.drawing import FAINT, INK

SHEET_SAMPLES = 64
WEIGHTS_SHOWN = 20
HALF_CELLS_SHOWN = 8
BLOCKED, RAY, WARNING = "#2b2f38", "#c2410c", "#b45309"


def camera_figures(camera: Camera, size: tuple[int, int] = (64, 64)) -> dict[str, Any]:
    """Return what a camera measures, on a light field of `size` (rows, columns) samples.

    views: rows and columns of views, in words.
    sampling_rate: measurements per light-field value (rows over columns of Psi).
    light_efficiency: reading from a white light field, 1 for the open camera behind its filters.
    dark_share: share of the measurements that no light reaches.
    masks: per mask the shift of its shadow from view to view in samples and its magnification on
        the sensor (both None at the lens, where a view sees one value), and the Fresnel number of
        a cell (None in contact with the sensor).
    Raises CameraError when the camera cannot be built at that size.
    """
    psi = build_imaging_matrix(camera, size)
    return {
        "views": grid_name(camera.view_axes, camera.views),
        "sampling_rate": psi.shape[0] / psi.shape[1],
        "light_efficiency": psi.light_efficiency(),
        "dark_share": float(np.mean(psi.row_norms() == 0)),
        "total_exposure_s": float(camera.exposures_s().sum()),
        "masks": {name: _mask_figures(camera, mask) for name, mask in camera.masks.items()},
    }


def _mask_figures(camera: Camera, mask: Mask) -> dict[str, float | None]:
    ratio = mask.distance_mm / camera.lens.distance_mm
    at_lens = ratio >= 1 - 1e-9
    seen_um = (1 - ratio) * camera.sensor.sample_pitch_um
    shift_um = ratio * camera.lens.aperture_cell_um
    return {
        "view_shift_samples": None if at_lens else shift_um / seen_um,
        "magnification": None if at_lens else 1 / (1 - ratio),
        "fresnel_number": fresnel_number(mask.cell_um, mask.distance_mm) if ratio else None,
    }


def draw_camera(camera: Camera, path: Path) -> None:
    """Write a drawing of a camera as PNG, 1400 px wide: optics, masks, weights.

    Raises CameraError when the camera cannot be built, AppError when the file cannot be written.
    """
    size = square_size(camera, SHEET_SAMPLES)
    psi = build_imaging_matrix(camera, size)
    masked = bool(camera.shot_masks(0))
    heights = [0.6, 2.8, *([3.6] if masked else []), 3.5]
    figure = Figure(figsize=(14, sum(heights)), dpi=100, layout="constrained")
    bands = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    bands[0].text(0.01, 0.62, camera.title, fontsize=17, weight="bold", color=INK, va="center")
    bands[0].text(0.01, 0.12, camera.reference, fontsize=10.5, color=FAINT, va="center")
    optics, text = bands[1].subplots(1, 2)
    _draw_axis(optics, camera)
    _write_figures(text, camera, psi)
    if masked:
        _draw_masks(bands[2], camera, draw_plates(camera, size))
    _draw_weights(bands[-1], camera, psi)
    try:
        with whole_file(path) as partial:
            figure.savefig(partial, format="png")
    except OSError as fault:
        raise AppError(f"{path}: cannot be written ({fault.strerror})") from fault


def _draw_axis(axes: Axes, camera: Camera) -> None:
    """Draw the camera along its optical axis, in mm; only the sensor is drawn larger than it is."""
    lens_mm, cell_mm = camera.lens.distance_mm, camera.lens.aperture_cell_mm
    half_mm = camera.views[1] * cell_mm / 2
    for view in centred_grid(camera.views[1], cell_mm):
        axes.plot([0, lens_mm], [0, view], color=RAY, lw=0.7, alpha=0.7)
    axes.axhline(0, color=FAINT, lw=0.6, ls=(0, (6, 3, 1, 3)))
    lens = Ellipse((lens_mm, 0), 0.07 * lens_mm, 2.1 * half_mm, fc="#dbeafe", ec="#1d4ed8")
    axes.add_patch(lens)
    axes.plot([0, 0], [-0.35 * half_mm, 0.35 * half_mm], color=INK, lw=4, solid_capstyle="butt")
    for name in camera.shot_masks(0):
        distance_mm = camera.masks[name].distance_mm
        axes.plot([distance_mm] * 2, [-half_mm, half_mm], color="#7c3aed", lw=1.5, ls="--")
        axes.text(distance_mm, 1.05 * half_mm, name, ha="center", va="bottom", fontsize=8.5)
    axes.set_xlim(-0.08 * lens_mm, 1.1 * lens_mm)
    axes.set_ylim(-1.3 * half_mm, 1.4 * half_mm)
    _label(axes, "optical axis, mm (sensor drawn larger)")
    kind = "camera" if shows_parallax(camera.view_axes) else "equivalent camera"
    seen = f"{picture_name(camera.view_axes)}s"
    axes.set_title(f"{kind}, shot 0, one pixel's rays to the {seen}", fontsize=10)


def _label(axes: Axes, x: str) -> None:
    axes.set_xlabel(x, fontsize=8.5)
    axes.tick_params(labelsize=8)


def _write_figures(axes: Axes, camera: Camera, psi: Psi) -> None:
    axes.set_axis_off()
    lens = camera.lens
    open_mm = lens.aperture_cell_mm * lens.aperture_fill
    width = f"{open_mm:g} mm wide" if open_mm else "points"
    exposure_ms = 1e3 * float(camera.exposures_s().sum())
    lines = [
        ("sensor", f"{sensor_name(camera)}, {camera.sensor.sample_pitch_um:g} um per sample"),
        ("views", f"{grid_name(camera.view_axes, camera.views)}, "
         f"{lens.aperture_cell_mm:g} mm apart, {width}"),
        ("shots", f"{len(camera.shots)}, {exposure_ms:.3g} ms in all"),
        ("sampling rate", f"{Fraction(*psi.shape)} measurements per value"),
        ("light", f"{psi.light_efficiency():.1%}"),
        *((f"'{name}'", f"at {mask.distance_mm:g} mm, cells {mask.cell_um:g} um")
          for name, mask in camera.masks.items()),
        *(("", textwrap.fill(warning, 62)) for warning in camera.warnings()),
    ]  # fmt: skip
    level = 1.0
    for key, value in lines:
        color = INK if key else WARNING
        for x, text, ink in ((0.03, key, FAINT), (0.2, value, color)):
            axes.text(x, level, text, fontsize=9.5, color=ink, va="top", transform=axes.transAxes)
        level -= 0.09 * (1 + value.count("\n"))


def _draw_masks(band: SubFigure, camera: Camera, plates: dict[str, Plate]) -> None:
    """Draw the masks of shot 0 as the beam meets them."""
    seen = f"{picture_name(camera.view_axes)}s"
    _band_title(band, f"masks of shot 0, around the optical axis; dots: one pixel's rays to {seen}")
    names = camera.shot_masks(0)
    panels = band.subplots(1, max(len(names), 5), squeeze=False)[0]
    for axes, name in zip(panels, names, strict=False):
        x, y = offset = camera.shots[0].offset_um.get(name, (0.0, 0.0))
        _draw_plate(axes, camera, plates[name], offset)
        axes.set_title(f"{name}, at ({x:g}, {y:g}) um" if x or y else name, fontsize=9)
    for axes in panels[len(names) :]:
        axes.set_axis_off()


def _band_title(band: SubFigure, title: str) -> None:
    band.suptitle(title, fontsize=10.5, x=0.01, ha="left", color=INK)


def _draw_plate(axes: Axes, camera: Camera, plate: Plate, offset_um: tuple[float, float]) -> None:
    """Draw a plate's cells near the axis, and where one sample's rays to the views meet them."""
    _, rows, columns, _ = plate.cells.shape
    far = plate.distance_mm > 0.5 * camera.lens.distance_mm
    unit, name = (1e-3, "mm") if far else (1.0, "um")
    x, y = offset_um
    half_x, half_y = columns * plate.cell_um / 2, rows * plate.cell_um / 2
    left, right, below, above = x - half_x, x + half_x, y + half_y, y - half_y
    axes.imshow(
        plate.cells[0],
        extent=(left * unit, right * unit, below * unit, above * unit),
        interpolation="nearest",
    )
    lens_um = camera.lens.distance_mm * 1e3
    start_um = camera.sensor.sample_pitch_um / 2
    meets = [
        mask_position(
            start_um,
            centred_grid(count, camera.lens.aperture_cell_um),
            plate.distance_mm * 1e3,
            lens_um,
        )
        for count in camera.views
    ]
    at_y, at_x = np.meshgrid(*meets, indexing="ij")
    axes.scatter(at_x * unit, at_y * unit, s=9, c=INK, edgecolors="white", linewidths=0.6)
    axes.set_facecolor(BLOCKED)
    rays_um = 1.1 * np.abs(np.concatenate(meets)).max()
    shown = min(half_x, half_y) if far else max(rays_um, HALF_CELLS_SHOWN * plate.cell_um)
    axes.set_xlim(-shown * unit, shown * unit)
    axes.set_ylim(shown * unit, -shown * unit)
    _label(axes, f"x, {name}")


def _draw_weights(band: SubFigure, camera: Camera, psi: Psi) -> None:
    """Draw the colour filters, and shot 0's weights: two views, and all of them together."""
    _band_title(band, "weights of shot 0: the share of light that passes, in each pixel's colours")
    passed = _transmittance(camera, psi)
    middle, corner = (camera.views[0] // 2, camera.views[1] // 2), (0, 0)
    name, place = picture_name(camera.view_axes), (camera.view_axes, camera.views)
    whiteboard = passed.mean(axis=(0, 1))
    peak = float(whiteboard.max())
    tile = cfa_tile(camera.sensor.cfa)
    filters = np.tile(tile, (8 // len(tile) + 1, 8 // len(tile[0]) + 1, 1))[:8, :8]
    panels = [
        (f"colour filters: {sensor_name(camera)}", "pixel", filters),
        (f"centre {name}: {place_name(*place, middle)}", "sample", _crop(passed[middle])),
        (f"first {name}: {place_name(*place, corner)}", "sample", _crop(passed[corner])),
        (f"all {name}s (a whiteboard); full scale {peak:.2f}", "sample", _crop(whiteboard) / peak),
    ]
    for axes, (title, unit, picture) in zip(band.subplots(1, 4), panels, strict=True):
        axes.imshow(np.clip(picture, 0, 1), interpolation="nearest")
        axes.set_title(title, fontsize=9)
        axes.locator_params(nbins=5, integer=True)
        _label(axes, unit)


def _crop(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the middle of a picture (y, x, c)."""
    top, left = ((length - WEIGHTS_SHOWN) // 2 for length in picture.shape[:2])
    return picture[max(top, 0) :, max(left, 0) :][:WEIGHTS_SHOWN, :WEIGHTS_SHOWN]


def _transmittance(camera: Camera, psi: Psi) -> NDArray[np.float32]:
    """Return what passes from every view in shot 0: (v, u, y, x, colour), 0 to 1."""
    response = sensor_response(camera, psi.size)[0]
    scale = camera.views[0] * camera.views[1] * camera.sensor.binning**2
    weights = psi.weights[0].swapaxes(-1, -2) * scale
    passed = weights * response.sum(axis=-1, keepdims=True) * (response > 0)
    psi.even_unseen_colours(passed)
    return passed
