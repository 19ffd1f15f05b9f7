"""A mask read from a photograph, as files: its picture, its figures, and a drawing for the eye."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emmc_rig.calibration.mask_photo import MaskReading
from emmc_rig.model.srgb import codes_of, srgb_of
from emmc_rig.report.drawing import ACCENT, COLOURS, FAINT, save_publication, sheet, titled
from emmc_rig.store.folders import new_file
from emmc_rig.store.results import metrics_text, provenance

MARK = COLOURS[1]
MOST_LINES = 16
"""Of the grid, each way, that are drawn."""
LONGEST_PX = 1600
WIDE_IN = 5.2


def write_mask(
    photo: NDArray[np.floating], mask: MaskReading, out: Path, cell_um: float
) -> tuple[Path, Path]:
    """Write OUT.png, OUT.json and OUT-check.png; return the paths of the latter two.

    photo: linear light, (y, x, colour). out: the mask's picture, of 16 bits, one pixel a cell; what
    lets through more than the clear parts, by noise, is written as they are. Raises AppError where
    one of the three exists, and where nothing can be written; then nothing is.
    """
    listed, checked = out.with_suffix(".json"), out.with_name(f"{out.stem}-check.png")
    facts = {
        "cells": mask.grid.cells,
        "cell_um": cell_um,
        "corners_px": mask.grid.corners_px.tolist(),
        "bow": mask.grid.bow,
        "px_per_cell": mask.grid.pitch_px(),
        "blur_cells": mask.blur_cells,
        "clear": mask.clear,
        "light_sigma": mask.light_sigma,
        "defects": [asdict(defect) for defect in mask.defects],
        "sigma": np.round(mask.sigma.astype(float), 5).tolist(),
        **provenance(),
    }
    with ExitStack() as files:
        picture, figures, drawing = (
            files.enter_context(new_file(path)) for path in (out, listed, checked)
        )
        codes = codes_of(mask.cells[..., ::-1], 16)
        picture.write_bytes(cv2.imencode(".png", codes)[1].tobytes())
        figures.write_text(metrics_text(facts), encoding="utf-8")
        figure = draw_mask(photo, mask)
        save_publication(figure, drawing, f"the mask {out.name} beside its photograph")
    return listed, checked


def draw_mask(photo: NDArray[np.floating], mask: MaskReading) -> Figure:
    """Return a figure: the photograph with the grid found, the cells, and how sure they are.

    photo: linear light, (y, x, colour). Defects are ringed in the first two.
    """
    rows, columns = mask.grid.cells
    high = WIDE_IN * max(photo.shape[0] / photo.shape[1], rows / columns)
    figure, (seen, cells, sure) = sheet(3, WIDE_IN, min(high, 2 * WIDE_IN), label="")
    for axes in (seen, cells, sure):
        axes.grid(visible=False)
    every = max(1, int(np.ceil(max(photo.shape[:2]) / LONGEST_PX)))
    extent = (-0.5, photo.shape[1] - 0.5, photo.shape[0] - 0.5, -0.5)
    seen.imshow(_shown(photo[::every, ::every] / photo.max()), cmap="gray", extent=extent)
    for axis, count in enumerate((rows, columns)):
        for line in np.unique(np.linspace(0, count, min(count, MOST_LINES) + 1).round()):
            along = np.linspace(0, (columns, rows)[axis], 60)
            fixed = np.full_like(along, line)
            at = mask.grid.place(*((along, fixed) if axis == 0 else (fixed, along)))
            seen.plot(at[:, 0], at[:, 1], color=ACCENT, linewidth=0.6)
    cells.imshow(_shown(mask.cells), cmap="gray", vmin=0, vmax=1)
    if mask.defects:
        at = np.array([(defect.column, defect.row) for defect in mask.defects])
        ring = {"s": 60, "facecolors": "none", "edgecolors": MARK, "linewidths": 1.2}
        cells.scatter(at[:, 0], at[:, 1], **ring)
        seen.scatter(*mask.grid.place(at[:, 0] + 0.5, at[:, 1] + 0.5).T, **ring)
    drawn = sure.imshow(mask.sigma.max(axis=-1), cmap="viridis", vmin=0)
    figure.colorbar(drawn, ax=sure, shrink=0.7)
    titled(seen, "photograph, and some lines of the grid", "px")
    titled(cells, f"{rows}x{columns} cells, {len(mask.defects)} defects ringed", "cells")
    titled(sure, "standard deviation of transmittance", "cells")
    for axes in (seen, cells, sure):
        axes.tick_params(colors=FAINT, labelsize=8)
    return figure


def _shown(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return linear light as imshow takes it: grey (y, x), or sRGB (y, x, 3)."""
    values = srgb_of(linear)
    return values[..., 0] if values.shape[-1] == 1 else values
