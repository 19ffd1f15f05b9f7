"""The mask as its maker takes it: cells with fiducials as GDSII, and as the camera's own picture.

GDSII is what every mask maker takes; gdstk writes it (extra `design`). Lengths are um, the origin
is the middle of the mask, y grows with the picture's rows. What is drawn lets light through: layer
1 clear, 2 red, 3 green, 4 blue; what is not drawn is opaque.
"""

from __future__ import annotations

import datetime
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.shadow import SPARE_UM
from emmc_rig.model.camera import Camera, draw_plates
from emmc_rig.model.masks import FILTERS, Picture, fiducial_marks
from emmc_rig.study.design.bench import DesignBench
from emmc_rig.study.design.search import MASK

LAYERS = {"W": 1, "R": 2, "G": 3, "B": 4}
PLACES = 0.35
"""Of the picture's sides, from the middle to the fiducials: inside what the sensor sees."""
MADE = datetime.datetime(2000, 1, 1)
"""The date in the file: equal masks give equal files."""
PICTURE, GDSII = "mask.png", "mask.gds"


def mask_cells(camera: Camera, bench: DesignBench) -> NDArray[np.uint8]:
    """Return the cells of a designed camera's mask (row, column, colour), 0 or 1, with fiducials.

    They cover the beam at every place that the stage reaches, and as far beyond as calibration
    searches for a misplaced mask. One of the four fiducials is a ring: a turned or mirrored mask
    shows.
    """
    mask = camera.masks[MASK]
    room_um = SPARE_UM + max(bench.stage_travel_um) / 2
    roomy = mask.model_copy(update={"spare_cells": int(np.ceil(room_um / mask.cell_um))})
    whole = camera.model_copy(update={"masks": {MASK: roomy}})
    cells = draw_plates(whole, bench.size)[MASK].cells[0].astype(np.uint8)
    for row, column, shape in _fiducials(cells.shape[:2], bench, mask.cell_um):
        cells[row : row + len(shape), column : column + len(shape)] = shape[..., None]
    return cells


def _fiducials(
    shape: tuple[int, ...], bench: DesignBench, cell_um: float
) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
    """Yield the first row and column of every fiducial, and its cells."""
    ring, cross = fiducial_marks()
    per_cell = bench.sensor.sample_pitch_um / cell_um
    far = [round(PLACES * count * per_cell) for count in bench.size]
    for down in (-1, 1):
        for across in (-1, 1):
            row, column = shape[0] // 2 + down * far[0], shape[1] // 2 + across * far[1]
            marks = ring if (down, across) == (-1, -1) else cross
            yield row - len(marks) // 2, column - len(marks) // 2, marks


def with_picture(camera: Camera) -> Camera:
    """Return the camera whose mask is the picture beside its file."""
    mask = camera.masks[MASK]
    pattern = Picture(kind="picture", path=Path(PICTURE))
    return camera.model_copy(update={"masks": {MASK: mask.model_copy(update={"pattern": pattern})}})


def write_picture(cells: NDArray[np.uint8], path: Path) -> None:
    """Write cells as a picture, one pixel a cell."""
    path.write_bytes(cv2.imencode(".png", cells[:, :, ::-1] * 255)[1].tobytes())


def can_write_gdsii() -> bool:
    """Return whether gdstk is installed."""
    return importlib.util.find_spec("gdstk") is not None


def write_gdsii(cells: NDArray[np.uint8], cell_um: float, path: Path) -> None:
    """Write cells as GDSII; a run of equal filters in a row becomes a rectangle."""
    import gdstk

    library = gdstk.Library("emmc-rig", unit=1e-6, precision=1e-9)
    mask = library.new_cell("MASK")
    rows, columns = cells.shape[:2]
    for layer, row, first, last in _runs(cells):
        left, right = ((edge - columns / 2) * cell_um for edge in (first, last))
        low, high = ((edge - rows / 2) * cell_um for edge in (row, row + 1))
        mask.add(gdstk.rectangle((left, low), (right, high), layer=layer))
    library.write_gds(path, timestamp=MADE)


def _runs(cells: NDArray[np.uint8]) -> Iterator[tuple[int, int, int, int]]:
    """Yield layer, row, first and past-the-last column of every run of cells of one filter."""
    for letter, colours in FILTERS.items():
        passing = (cells == np.array(colours)).all(axis=-1)
        for row, line in enumerate(passing):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
            for first, last in edges.reshape(-1, 2):
                yield LAYERS[letter], row, int(first), int(last)
