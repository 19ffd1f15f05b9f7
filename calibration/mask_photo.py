"""A mask from its photograph: the grid of its cells is found, then what each cell lets through.

A point (x, y) of the mask, in cells from its top left corner, is photographed where a homography
puts it, moved away from the photograph's middle by the lens:

    p = middle + d (1 + bow |d|^2 / R^2),    d = H (x, y) - middle,    R: half the diagonal

Corners and bow are those for which cells are most even within (nonlinear least squares). A sample
at (x, y) is then the sum of the cells, each a box blurred by a Gaussian: columns and rows separate,
so that two small pseudoinverses give all cells. The light is a polynomial through the clear parts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter
from scipy.optimize import fminbound, least_squares
from scipy.special import ndtr

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.model.masks import fiducial_marks

FEWEST_PX = 5.0
"""The least side of a cell: with 4 px, a blur of one pixel mixes neighbours into all of a cell."""
INNER, INNER_CHECK = 0.7, 0.25
"""Of a cell's side is sampled: a grid that is off by a seventh of a cell mixes no neighbour in. How
far the cells are others by the inner samples alone, part of their deviation, is what blur and grid
leave in error."""
FEWEST_CELLS = 4
RING = 3
"""Cells around the mask that are looked at too; the outer two of them as the surround."""
BLURS = (0.02, 0.4)
"""Of a photograph, the least and the most, deviations in cells."""
BOWS = 0.06
"""The strongest lens bow looked for, either way, at the photograph's corners."""
LINE_SAMPLES = 6
"""Along a cell, for the spectrum of edges: it knows three times as many lines as asked for."""
FIT_CELLS, FIT_SAMPLES, FIT_STEP = 4096, 6, 0.05
"""How many cells the fit of the grid looks at, samples along a side of each, and how far corners
are moved for a slope, cells."""
SAME_AS = 0.1
"""Least difference in transmittance between two kinds of cells."""
GREY = 0.03
"""Root mean square difference of colours below which a mask is grey."""
NO_LIGHT = 1e-3
"""Of what saturates: clear parts are brighter everywhere."""

FARTHEST = 0.45
"""Cells that a corner may be moved: with one row too few or too many, one moves by half a cell."""
OVEREXPOSED, SATURATED = 0.005, 0.99
"""The share of a mask's pixels that may lie at a photograph's upper end, and where that begins."""

Array = NDArray[np.floating]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Defect:
    """A faulty cell (row, column), and its fault."""

    row: int
    column: int
    what: str


@dataclass(frozen=True, eq=False)
class Grid:
    """Where a mask of `cells` (rows, columns) lies in a photograph.

    corners_px: (4, 2), x and y of the mask's corners, from its top left clockwise; whole numbers
    are the centres of pixels. bow: see the module. photo: rows and columns of the photograph, px.
    """

    cells: tuple[int, int]
    corners_px: Array
    bow: float
    photo: tuple[int, int]

    def place(self, x: Array, y: Array) -> Array:
        """Return where points (x, y), in cells, are photographed: (..., 2), x and y in px."""
        rows, columns = self.cells
        ends = np.array([(0, 0), (columns, 0), (columns, rows), (0, rows)], np.float32)
        middle, radius = (np.array(self.photo[::-1]) - 1) / 2, np.hypot(*self.photo) / 2
        observed = (self.corners_px - middle) / radius
        straight = observed
        for _ in range(12):
            squares = (straight**2).sum(axis=-1, keepdims=True)
            straight = observed / (1 + self.bow * squares)
        matrix = cv2.getPerspectiveTransform(ends, straight.astype(np.float32))
        points = np.stack([x, y, np.ones_like(x)], axis=-1) @ matrix.T
        flat = points[..., :2] / points[..., 2:]
        squares = (flat**2).sum(axis=-1, keepdims=True)
        return middle + radius * flat * (1 + self.bow * squares)

    def samples(self, photo: Array, x: Array, y: Array) -> Array:
        """Return a photograph (y, x, colour) at points of the mask; beyond it, its edge."""
        at = self.place(x, y).astype(np.float32)
        columns, rows = at[..., 0], at[..., 1]
        seen = cv2.remap(photo, columns, rows, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE)
        return np.atleast_3d(np.asarray(seen, np.float32))

    def pitch_px(self) -> float:
        """Return the smallest side of a cell in the photograph, px."""
        rows, columns = self.cells
        y, x = np.meshgrid(
            np.linspace(0, rows - 1, 5), np.linspace(0, columns - 1, 5), indexing="ij"
        )
        here = self.place(x, y)
        steps = (self.place(x + 1, y) - here, self.place(x, y + 1) - here)
        return float(min(np.hypot(*np.moveaxis(step, -1, 0)).min() for step in steps))


@dataclass(frozen=True, eq=False)
class MaskReading:
    """Transmittances of a mask's cells by its photograph.

    cells: transmittance against the clear parts, (row, column, colour), 1 colour where all are
    alike or the photograph is grey. sigma: its standard deviation by the photograph's noise, of
    the same shape. light_sigma: the deviation common to all cells, of the clear parts' level.
    blur_cells: the photograph's blur, deviation in cells. clear: share of cells that are clear.
    """

    cells: NDArray[np.float32]
    sigma: NDArray[np.float32]
    light_sigma: float
    blur_cells: float
    clear: float
    grid: Grid
    defects: tuple[Defect, ...]


def read_mask(
    photo: Array,
    cells: tuple[int, int],
    corners_px: ArrayLike | None = None,
    ordered: Array | None = None,
) -> MaskReading:
    """Return what a photograph says of the cells of a mask.

    Args:
        photo: linear light, 0 without any, 1 where saturated, (y, x) or (y, x, colour).
        cells: rows and columns of the mask's cells.
        corners_px: (4, 2), x and y of the mask's outer corners, px, from its top left clockwise as
            the mask is to be seen; None: they are found from the mask's outline.
        ordered: the mask as it should be, (row, column) or (row, column, colour) in [0, 1].

    Raises:
        CalibrationError: no mask found, of other cells, too small, turned or mirrored, overexposed
            or without clear parts; arguments of different sizes.
    """
    light = np.atleast_3d(np.asarray(photo, np.float32))
    if light.ndim != 3 or light.size == 0 or not (light.min() >= -1 and light.max() <= 1):
        raise CalibrationError("a photograph is light (y, x) or (y, x, colour), 1 where saturated")
    if min(cells) < FEWEST_CELLS:
        raise CalibrationError(f"{_shown(cells)} cells: at least {FEWEST_CELLS} a side are needed")
    if ordered is not None and ordered.shape[:2] != tuple(cells):
        raise CalibrationError(
            f"the mask as ordered has {_shown(ordered.shape)} cells, not {_shown(cells)}"
        )
    corners = find_corners(light, cells) if corners_px is None else np.asarray(corners_px, float)
    _check_corners(corners, light.shape)
    (left, top), (right, bottom) = corners.min(axis=0).astype(int), corners.max(axis=0).astype(int)
    at_end = (light[max(top, 0) : bottom + 1, max(left, 0) : right + 1] > SATURATED).mean()
    if at_end > OVEREXPOSED:
        raise CalibrationError(
            f"{at_end:.0%} of the mask's pixels are saturated: photograph it with less exposure, "
            "clear parts at two thirds of the brightest code"
        )
    start = Grid(cells, corners, 0.0, (light.shape[0], light.shape[1]))
    if start.pitch_px() < FEWEST_PX:
        raise CalibrationError(
            f"{start.pitch_px():.1f} pixels a cell of {_shown(cells)}, at least {FEWEST_PX:g} are "
            "needed: photograph it closer, or correct the number of cells"
        )
    grid = _fit_grid(light, _find_bow(light, start))
    _check_count(_line_spectra(light, grid), cells)
    seen, fewer = (_cell_values(light, grid, width) for width in (INNER, INNER_CHECK))
    by_grid = np.sqrt(((fewer.values - seen.values) ** 2).mean(axis=(0, 1)))
    lamp = _fit_light(seen.values, grid)
    inner = (slice(RING, -RING),) * 2
    found, sigma, spread = (
        array[inner] / lamp.level[inner]
        for array in (seen.values, np.hypot(seen.sigma, by_grid), seen.spread)
    )
    if np.sqrt(((found - found.mean(axis=-1, keepdims=True)) ** 2).mean()) < GREY:
        found, spread = (array.mean(axis=-1, keepdims=True) for array in (found, spread))
        sigma = np.sqrt((sigma**2).mean(axis=-1, keepdims=True) / sigma.shape[-1])
    _check_face(found, ordered)
    defects = tuple(_defects(found, spread, ordered))
    return MaskReading(
        cells=found.astype(np.float32),
        sigma=sigma.astype(np.float32),
        light_sigma=lamp.sigma,
        blur_cells=seen.blur,
        clear=lamp.clear,
        grid=grid,
        defects=defects,
    )


def _shown(shape: tuple[int, ...]) -> str:
    return f"{shape[0]}x{shape[1]}"


def find_corners(light: Array, cells: tuple[int, int]) -> Array:
    """Return the mask's outer corners (4, 2), x and y in px, from its outline in a photograph.

    light: (y, x, colour).
    The photograph must show some of an even surround, dark or clear, on all sides, and the mask
    upright within 45 degrees. Raises CalibrationError where no such outline is there.
    """
    differs = _differs_from_surround(light)
    points = np.argwhere(differs)
    nothing = CalibrationError(
        "no mask with an even surround on all sides is seen: give its corners, clockwise from "
        "its top left"
    )
    if len(points) < 100:
        raise nothing
    side_px = np.sqrt(np.prod(np.ptp(points, axis=0)) / np.prod(cells))
    kernel = np.ones((max(3, int(4 * side_px)),) * 2, np.uint8)
    whole = cv2.morphologyEx(np.pad(differs, kernel.shape[0]), cv2.MORPH_CLOSE, kernel)
    whole = whole[(slice(kernel.shape[0], -kernel.shape[0]),) * 2]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(whole)
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    points = np.argwhere((labels == largest) & (differs > 0))[:, ::-1].astype(float)
    beside = points.min(axis=0) <= 1
    beyond = points.max(axis=0) >= np.array(light.shape[1::-1]) - 2
    if beside.any() or beyond.any():
        raise nothing
    angle = np.radians((cv2.minAreaRect(points.astype(np.float32))[2] + 45) % 90 - 45)
    along = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    turned = points @ along.T
    left, right, top, bottom = (
        _side(turned[:, ::-1] if axis else turned, outward, cells[axis])
        for axis, outward in ((0, -1), (0, 1), (1, -1), (1, 1))
    )
    pairs = ((left, top), (right, top), (right, bottom), (left, bottom))
    middle = turned.mean(axis=0)
    return np.array([_crossing(x_of, y_of, middle) for x_of, y_of in pairs]) @ along


def _differs_from_surround(light: Array) -> NDArray[np.uint8]:
    """Return where a photograph differs from its border's light (a quadratic), without specks."""
    size = light.shape[1::-1]
    few = (min(size[0], 400), min(size[1], 400))
    small = np.asarray(cv2.resize(light, few, interpolation=cv2.INTER_AREA), np.float32)
    small = np.atleast_3d(small)
    y, x = np.mgrid[-1 : 1 : small.shape[0] * 1j, -1 : 1 : small.shape[1] * 1j]
    border = np.broadcast_to((np.maximum(abs(x), abs(y)) > 0.95)[..., None], small.shape)
    surround = cv2.resize(_surface(small, border, x, y, 2).astype(np.float32), size)
    difference = np.abs(cv2.GaussianBlur(light - surround.reshape(light.shape), (0, 0), 0.8))
    if difference.ndim == 3:
        difference = difference.max(axis=-1)
    differs = (difference > 0.3 * np.quantile(difference, 0.99)).astype(np.uint8)
    opened = cv2.morphologyEx(differs, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(opened, np.uint8)


def _side(points: Array, outward: int, count: int) -> NDArray[np.float64]:
    """Return the quadratic (see polyval) of the outermost of points (x, y) as a function of y.

    outward: -1 for the side of small x. Half of the outer cells may look like the surround: only
    what lies outside of the last fit stays in the next.
    """
    low, high = points[:, 1].min(), points[:, 1].max()
    bins = ((points[:, 1] - low) / (high - low + 1e-9) * 2 * count).astype(int)
    outermost = np.full(2 * count, -np.inf)
    np.maximum.at(outermost, bins, outward * points[:, 0])
    y = low + (np.arange(2 * count) + 0.5) * (high - low) / (2 * count)
    kept = np.isfinite(outermost) & (abs(np.linspace(-1, 1, 2 * count)) < 0.95)
    y, x = y[kept], outermost[kept]
    middle = y.mean()
    use = np.ones(y.size, bool)
    fit = np.polyfit(y - middle, x, 2)
    tolerance = 0.15 * (high - low) / count
    for _ in range(20):
        beyond = x - np.polyval(fit, y - middle)
        use = beyond > -tolerance
        if use.sum() < 6:
            break
        fit = np.polyfit(y[use] - middle, x[use], 2)
    straight = np.poly1d(outward * fit)(np.poly1d([1, -middle]))
    return np.asarray(np.atleast_1d(straight.coeffs), np.float64)


def _crossing(x_of: Array, y_of: Array, start: Array) -> Array:
    """Return the point (x, y) with x = x_of(y) and y = y_of(x)."""
    x, y = start
    for _ in range(50):
        x = np.polyval(x_of, y)
        y = np.polyval(y_of, x)
    return np.array([x, y])


def _check_corners(corners: Array, photo: tuple[int, ...]) -> None:
    """Raise CalibrationError for corners that are none, or are given against the clock."""
    if corners.shape != (4, 2) or not np.isfinite(corners).all():
        raise CalibrationError("four corners are needed, x and y in pixels each")
    if corners.min() < -0.5 or (corners > np.array(photo[1::-1]) - 0.5).any():
        raise CalibrationError(
            f"a corner lies outside the photograph of {photo[1]} x {photo[0]} pixels (x, y)"
        )
    sides = np.roll(corners, -1, axis=0) - corners
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    if (turns < 0).all():
        raise CalibrationError(
            "the corners run against the clock: the photograph is mirrored, or they are in the "
            "wrong order; give them clockwise from the mask's top left, of a photograph of its face"
        )
    if not (turns > 0).all():
        raise CalibrationError(
            "the corners are those of no quadrilateral: give them clockwise from the mask's top "
            "left"
        )


def _find_bow(light: Array, start: Grid) -> Grid:
    """Return the grid with the bow for which edges lie on its lines most regularly.

    Raises CalibrationError where they lie on the lines of another number of cells.
    """
    step = min(0.01, 0.5 / max(start.cells))
    count = int(np.ceil(BOWS / step))
    tried = [
        Grid(start.cells, start.corners_px, bow, start.photo)
        for bow in np.linspace(-BOWS, BOWS, 2 * count + 1).tolist()
    ]
    spectra = [_line_spectra(light, grid) for grid in tried]
    strength = [
        sum(float(by[n]) for by, n in zip(both, start.cells, strict=True) if n < by.size)
        for both in spectra
    ]
    strongest = [np.max([by[axis] for by in spectra], axis=0) for axis in (0, 1)]
    seen = tuple(_line_count(by, n) for by, n in zip(strongest, start.cells, strict=True))
    if 0 in seen:
        raise CalibrationError(
            f"no grid of {_shown(start.cells)} cells is seen between the corners: is the "
            "photograph sharp, and are the corners those of the outermost cells?"
        )
    if seen != tuple(start.cells):
        raise _other_count(seen, start.cells)
    return tried[int(np.argmax(strength))]


def _other_count(seen: tuple[int, ...], asked: tuple[int, int]) -> CalibrationError:
    turned = seen == asked[::-1]
    remedy = (
        "the photograph is turned, or the cells are given as columns x rows" if turned
        else "correct their number, or give the corners to a third of a cell"
    )  # fmt: skip
    return CalibrationError(
        f"about {_shown(seen)} cells are seen (rows x columns), not {_shown(asked)}: {remedy}"
    )


def _check_count(spectra: tuple[Array, Array], cells: tuple[int, int]) -> None:
    """Raise CalibrationError unless edges in the fitted grid repeat as often as it has cells.

    With a cell more or fewer they repeat at several neighbouring numbers, 0.7 to 2.7 times as
    strongly as at the number given; below 0.06 where that is right.
    """
    near = [by[n - 2 : n + 3] / by[n] for by, n in zip(spectra, cells, strict=True)]
    if any(np.sort(ratios)[-2] > 0.4 or ratios.max() > 1 for ratios in near):
        seen = tuple(n - 2 + int(ratios.argmax()) for n, ratios in zip(cells, near, strict=True))
        raise _other_count(seen, cells)


def _line_spectra(light: Array, grid: Grid) -> tuple[Array, Array]:
    """Return how strongly edges repeat n times over the mask's height, and width: (n,) each."""
    rows, columns = grid.cells
    spectra = []
    for across, along in ((rows, columns), (columns, rows)):
        fine = np.arange(LINE_SAMPLES * across) / LINE_SAMPLES
        coarse = (np.arange(4 * min(along, 64)) + 0.5) * along / (4 * min(along, 64))
        over, beside = np.meshgrid(fine, coarse, indexing="ij")
        x, y = (over, beside) if spectra else (beside, over)
        seen = grid.samples(light, x, y)
        edges = np.abs(seen[2:] - seen[:-2]).mean(axis=(1, 2))
        spectrum = np.abs(np.fft.rfft(edges - edges.mean(), LINE_SAMPLES * across))
        spectra.append(spectrum / (edges.sum() + 1e-12))
    return spectra[0], spectra[1]


def _line_count(spectrum: Array, asked: int) -> int:
    """Return the number of cells along a side: `asked` where the spectrum bears it out, 0: none."""
    least = max(FEWEST_CELLS, asked // 4)
    strongest = least + int(np.argmax(spectrum[least : 2 * asked + asked // 2]))
    if spectrum[strongest] < 0.12:
        return 0
    for part in range(strongest // FEWEST_CELLS, 1, -1):
        if strongest % part == 0 and spectrum[strongest // part] > 0.6 * spectrum[strongest]:
            strongest //= part
            break
    return (
        asked if spectrum[asked] > 0.8 * spectrum[strongest] and strongest >= asked else strongest
    )


def _fit_grid(light: Array, start: Grid) -> Grid:
    """Return the grid whose cells are most even within; raises CalibrationError for none."""
    every = int(np.ceil(np.sqrt(np.prod(start.cells) / FIT_CELLS)))
    # With the surround: blurred into the outer cells, it would move the corners inward.
    rows, columns = (np.unique([-1, *range(0, n, every), n - 1, n]) for n in start.cells)
    inside = (np.arange(FIT_SAMPLES) + 0.5) / FIT_SAMPLES
    y, x = np.meshgrid(
        (rows[:, None] + inside).ravel(), (columns[:, None] + inside).ravel(), indexing="ij"
    )
    shape = (rows.size, FIT_SAMPLES, columns.size, FIT_SAMPLES, light.shape[-1])
    pitch_px = start.pitch_px()
    bow_unit = pitch_px / np.hypot(*start.photo)

    def grid_of(change: Array) -> Grid:
        corners = start.corners_px + pitch_px * change[:8].reshape(4, 2)
        return Grid(start.cells, corners, start.bow + bow_unit * float(change[8]), start.photo)

    def uneven(change: Array) -> Array:
        seen = grid_of(change).samples(light, x, y).reshape(shape)
        return np.asarray((seen - seen.mean(axis=(1, 3), keepdims=True)).ravel(), np.float64)

    def slopes(change: Array) -> Array:
        """Return central differences: OpenCV rounds places to a 32nd of a pixel."""
        steps = FIT_STEP * np.eye(change.size)
        rows = [uneven(change + step) - uneven(change - step) for step in steps]
        return np.stack(rows, axis=1) / (2 * FIT_STEP)

    found = least_squares(
        uneven, np.zeros(9), cast("Any", slopes), xtol=1e-3, ftol=1e-5, max_nfev=30
    )
    if abs(found.x[:8]).max() > FARTHEST:
        raise CalibrationError(
            f"a grid of {_shown(start.cells)} cells fits only {abs(found.x[:8]).max():.1f} cells "
            "beside the corners: correct their number, or give the corners to a third of a cell"
        )
    return grid_of(found.x)


class _Cells(NamedTuple):
    """Cells and RING around them, (row, column, colour), in the photograph's units."""

    values: Array
    sigma: Array
    """Standard deviation of the values, by noise."""
    spread: Array
    """Root mean square of the residuals within a cell."""
    blur: float
    """Standard deviation, cells."""


def _cell_values(light: Array, grid: Grid, width: float) -> _Cells:
    """Return the cells whose blurred boxes explain the samples within them best.

        samples = D cells A^T + noise,    cells = D^+ samples (A^+)^T

    D, A: what samples along columns and rows see of every cell, see `_blurred_boxes`; D^+ the
    pseudoinverse. The blur leaves the least residual. width: of a cell, that is sampled.
    """
    count = int(np.clip(width * grid.pitch_px(), 3, 16))
    inside = 0.5 + width * ((np.arange(count) + 0.5) / count - 0.5)
    rows, columns = ((np.arange(-RING, n + RING)[:, None] + inside).ravel() for n in grid.cells)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    seen = grid.samples(light, x, y).astype(np.float64)
    few = [min(n, 48) for n in grid.cells]
    some = seen[: few[0] * count, : few[1] * count]

    def misfit(blur: float) -> float:
        down, across = (_blurred_boxes(n, inside, blur) for n in few)
        return float((_fit_cells(some, down, across)[1] ** 2).sum())

    blur = float(cast("Any", fminbound(misfit, *BLURS, xtol=0.005)))
    down, across = (_blurred_boxes(n + 2 * RING, inside, blur) for n in grid.cells)
    values, residual = _fit_cells(seen, down, across)
    by_cell = residual.reshape(len(values), count, -1, count, values.shape[-1])
    rms = np.sqrt((by_cell**2).mean(axis=(1, 3)))
    gain = [np.linalg.norm(np.linalg.pinv(boxes), axis=1) for boxes in (down, across)]
    # A cubic sample between pixels has, on average, 0.7 of a pixel's variance.
    sigma = 0.7**-0.5 * rms * (gain[0][:, None] * gain[1])[..., None]
    return _Cells(values, sigma, rms, blur)


def _blurred_boxes(cells: int, inside: Array, blur: float) -> NDArray[np.float64]:
    """Return what samples at the places `inside` every cell see of every cell, (sample, cell).

    What lies beyond is as the first and the last cell.
    """
    at = (np.arange(cells)[:, None] + inside).reshape(-1, 1)
    edges = np.arange(cells + 1.0)
    edges[[0, -1]] = -np.inf, np.inf
    return np.diff(-ndtr((at - edges) / blur), axis=1)


def _fit_cells(seen: Array, down: Array, across: Array) -> tuple[Array, Array]:
    """Return the cells whose blurred boxes come nearest to samples (y, x, colour), and the rest."""
    inverse = [np.linalg.pinv(boxes) for boxes in (down, across)]
    cells = np.einsum("ry,yxk,cx->rck", inverse[0], seen, inverse[1], optimize=True)
    return cells, seen - np.einsum("yr,rck,xc->yxk", down, cells, across, optimize=True)


class _Lamp(NamedTuple):
    """The light through clear parts."""

    level: Array
    """On cells and ring, (row, column, colour)."""
    sigma: float
    """Relative standard deviation, common to all cells."""
    clear: float
    """Share of cells that are clear."""


def _fit_light(values: Array, grid: Grid) -> _Lamp:
    """Return the light: a polynomial through the clear ring, if there is one, and clear cells.

    Which cells are clear depends on the light: both in turn, four times. Raises CalibrationError
    where nothing is seen to be clear.
    """
    rows, columns, _ = values.shape
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    ring = np.ones((rows, columns), bool)
    ring[RING - 1 : 1 - RING, RING - 1 : 1 - RING] = False
    inner = np.zeros((rows, columns), bool)
    inner[RING:-RING, RING:-RING] = True
    at = grid.place(*np.meshgrid(np.arange(columns) - RING + 0.5, np.arange(rows) - RING + 0.5))
    in_photo = ((at >= 0) & (at <= np.array(grid.photo[::-1]) - 1)).all(axis=-1)
    ring &= in_photo
    bright = np.quantile(values[inner], 0.98, axis=0)
    lit = ring.sum() > rows + columns and (np.median(values[ring], axis=0) > 0.7 * bright).all()
    around = np.repeat((ring & lit)[..., None], values.shape[-1], axis=-1)
    clear = around if lit else _brightest(values, inner, x, y)
    degree = 2
    for _ in range(4):
        level = np.maximum(_surface(values, clear, x, y, degree), NO_LIGHT)
        among = _clear_cells(values / level, inner, 0.5 * SAME_AS if lit else SAME_AS)
        clear, degree = around | among, 4 if _spread_out(among) else 2
    if not clear.any(axis=(0, 1)).all() or level.min() <= NO_LIGHT:
        raise CalibrationError(
            "no clear parts are seen, neither around the mask nor among its cells: photograph it "
            "with clear glass around it"
        )
    terms, count = (degree + 1) * (degree + 2) / 2, clear.sum(axis=(0, 1))
    rest = np.where(clear, values / level - 1, 0)
    light_sigma = float(np.sqrt((rest**2).sum(axis=(0, 1)) * terms).max() / count.min())
    return _Lamp(level, light_sigma, float(among[inner].any(axis=-1).mean()))


def _surface(values: Array, where: Flags, x: Array, y: Array, degree: int) -> NDArray[np.float64]:
    """Return the polynomial of x and y through values (row, column, colour) where so marked."""
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], -1)
    fits = [
        np.linalg.lstsq(terms[where[..., k]], values[..., k][where[..., k]], rcond=None)[0]
        for k in range(values.shape[-1])
    ]
    return np.stack([terms @ fit for fit in fits], axis=-1)


def _brightest(values: Array, inner: Flags, x: Array, y: Array) -> Flags:
    """Return each colour's brightest cells under uneven light: a fit leaves out what is below."""
    bright = np.repeat(inner[..., None], values.shape[-1], axis=-1)
    for _ in range(20):
        level = _surface(values, bright, x, y, 2)
        above = inner[..., None] & (values > (1 - SAME_AS) * level)
        if not above.any(axis=(0, 1)).all():
            break
        bright = above
    return bright


def _clear_cells(relative: Array, inner: Flags, within: float) -> Flags:
    """Return the cells (row, column, colour) at 1, as far as they stand out from those below.

    Where some are clear in all colours, those alone: a filter in its own colour is no clear part.
    """

    def standing_out(of: Array) -> Flags:
        near, below = (inner[..., None] & (abs(of - at) < within) for at in (1, 1 - 2 * within))
        return near & (near.sum(axis=(0, 1)) > 2 * below.sum(axis=(0, 1)))

    lowest = relative.min(axis=-1, keepdims=True)
    white = standing_out(lowest) & (relative.max(axis=-1, keepdims=True) < 1 + within)
    if white.sum() > max(11, inner.sum() / 100):
        return np.broadcast_to(white, relative.shape)
    return standing_out(relative)


def _spread_out(clear: Flags) -> bool:
    """Return whether clear cells lie in most of the 16 parts of a mask, in every colour."""
    bands = [np.array_split(band, 4, 1) for band in np.array_split(clear, 4)]
    parts = [part.any(axis=(0, 1)) for band in bands for part in band]
    return bool((np.sum(parts, axis=0) > 12).all())


def _check_face(cells: Array, ordered: Array | None) -> None:
    """Raise CalibrationError for a mask that is turned or mirrored, as far as something tells.

    That is the mask as ordered or, without it, the ring among the fiducials of `emmc-rig design`.
    """
    grey = cells.mean(axis=-1)
    if ordered is None:
        _check_ring(grey)
        return
    wanted = np.atleast_3d(ordered).mean(axis=-1)
    likeness = {}
    for mirrored in (False, True):
        for quarter in range(4):
            seen = np.rot90(grey[:, ::-1] if mirrored else grey, quarter)
            if seen.shape == wanted.shape:
                how = ["mirrored"] * mirrored
                how += [f"turned by {90 * quarter} degrees"] * (quarter > 0)
                likeness[" and ".join(how)] = float(np.corrcoef(seen.flat, wanted.flat)[0, 1])
    best = max(likeness, key=lambda name: likeness[name])
    if likeness[best] < 0.5:
        raise CalibrationError(
            "the photograph resembles the mask as ordered in no orientation (correlation "
            f"{likeness[best]:.2f} at best): is it this mask, and are the corners right?"
        )
    if best:
        raise CalibrationError(
            f"the photograph shows the mask as ordered only when it is {best}: turn or mirror it, "
            "or give the corners from the mask's own top left"
        )


def _check_ring(grey: Array) -> None:
    ring, cross = fiducial_marks()
    if min(grey.shape) < 3 * len(ring):
        return
    photo = grey.astype(np.float32)
    marks = (mark.astype(np.float32) for mark in (ring, cross))
    seen = [
        np.argwhere(cv2.matchTemplate(photo, mark, cv2.TM_CCOEFF_NORMED) > 0.85) for mark in marks
    ]
    if len(seen[0]) != 1 or len(seen[1]) != 3:
        return
    low, right = seen[0][0] > seen[1].mean(axis=0)
    if low or right:
        where = f"{'bottom' if low else 'top'} {'right' if right else 'left'}"
        raise CalibrationError(
            f"the ring among the fiducials is at the {where}, not at the top left: the photograph "
            "is turned or mirrored"
        )


def _defects(cells: Array, spread: Array, ordered: Array | None) -> Iterator[Defect]:
    """Yield what is wrong with cells (row, column, colour); spread: rms within each."""
    level, rough = cells.mean(axis=-1), spread.max(axis=-1)
    order = np.argsort(level, axis=None)
    usual = np.empty(level.size)
    usual[order] = median_filter(rough.ravel()[order], size=min(101, level.size // 4 * 2 + 1))
    dirty = rough > np.maximum(4 * usual.reshape(rough.shape), 0.05)
    kinds: list[tuple[Flags, str]] = [(dirty, "uneven within: dust, a scratch or a hole")]
    if ordered is not None:
        wanted = np.atleast_3d(ordered).mean(axis=-1)
        fit = np.polyfit(wanted.ravel(), level.ravel(), 1)
        off = abs(level - np.polyval(fit, wanted)) > 2 * SAME_AS
        kinds.append((off, "not as ordered"))
    elif cells.shape[-1] == 1:
        is_open = level > (level.min() + level.max()) / 2
        ends = [np.median(level[part]) if part.any() else np.nan for part in (is_open, ~is_open)]
        between = np.minimum(*(abs(level - end) for end in ends)) > 1.5 * SAME_AS
        if between.mean() < 0.03:
            kinds.append((between, "partly open, where all others are open or shut"))
    known = np.zeros(level.shape, bool)
    for where, what in kinds:
        new, known = where & ~known, where | known
        for row, column in np.argwhere(new):
            yield Defect(int(row), int(column), f"{what} ({level[row, column]:.2f})")
