"""The mask's shadow: what every pixel reads through a set of views, and how that depends on the
placement of the mask.

Cost and memory are linear in the pixels asked for: each (pixel, view) looks up the few cells that
its footprint covers, their shares from tables over where the footprint lies within a cell. The
tables are exact at TABLE_STEPS places and linear between. A turned footprint is taken as one along
the cells (an error of rotation x footprint, under 0.2 um at 0.3 degrees).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.special import ndtr

from calibration.errors import CalibrationError
from calibration.placement import SCALARS, Placement
from calibration.repeats import Repeats, repeats_of
from emmc_rig.model.camera import Camera, Plate, draw_plates
from emmc_rig.model.compiling import njit

Array = NDArray[np.floating]
Pixels = NDArray[np.int64]
TABLE_STEPS = 512
TAILS = 4.0
NARROWEST_CELLS = 1e-3
GLASS_INDEX = 1.52
ANY_COLOUR = 3
OF_VIEW = 5
"""Derivatives of a reading by what one view alone sees."""
OWN_PIXELS = 2**12
"""Whose derivatives are held at once."""
SPARE_UM = 900.0
"""Beyond the beam, for a mask that sits askew."""
SEARCH_UM = 600.0
"""How far from where it should be a mask is looked for, along either axis."""


@dataclass(frozen=True, eq=False)
class ShadowMask:
    """The one mask between lens and sensor, as designed, and the camera's geometry in um.

    cells: (frame, row, column, 4): red, green, blue, and their mean, for a pixel that sees all.
    coloured: some pixel sees one colour alone.
    """

    cells: NDArray[np.float32]
    cell_um: float
    distance_um: float
    lens_um: float
    pitch_um: float
    pixel_um: float
    aperture_um: float
    aperture_cell_um: float
    views: tuple[int, int]
    size: tuple[int, int]
    binning: int
    coloured: bool = True

    @cached_property
    def repeats(self) -> Repeats:
        """After which shifts within SEARCH_UM the sensor sees the same mask."""
        seen = self.cells[0, :, :, :3] if self.coloured else self.cells[0, :, :, 3:]
        return repeats_of(seen, self.cell_um, SEARCH_UM)

    @property
    def corner_um(self) -> float:
        """From the middle of the picture to its corner."""
        return float(np.hypot(*self.size)) / 2 * self.pitch_um

    def pixel_shape(self) -> tuple[int, int]:
        """Rows and columns of sensor pixels."""
        return self.size[0] // self.binning, self.size[1] // self.binning


def shadow_mask(camera: Camera, size: tuple[int, int]) -> ShadowMask:
    """Return the camera's mask for a light field of `size` samples.

    Raises CalibrationError where the camera has not exactly one mask between lens and sensor.
    """
    lens, sensor = camera.lens, camera.sensor
    used = {camera.shot_masks(shot) for shot in range(len(camera.shots))}
    near = [name for name, mask in camera.masks.items() if mask.distance_mm < lens.distance_mm]
    if used != {tuple(camera.masks)} or len(near) != 1 or len(camera.masks) != 1:
        what = f"this camera has {len(camera.masks)} masks"
        if camera.masks and not near:
            what = "this camera's masks lie at the lens"
        raise CalibrationError(
            "the shadow of one mask between lens and sensor is modelled, the same in every shot; "
            f"{what}: use method free to calibrate it"
        )
    (name,) = near
    mask = camera.masks[name]
    spare = mask.spare_cells + int(np.ceil(SPARE_UM / mask.cell_um))
    roomy = camera.model_copy(
        update={"masks": {name: mask.model_copy(update={"spare_cells": spare})}}
    )
    plate = _roomier(draw_plates(camera, size)[name], draw_plates(roomy, size)[name])
    mean = plate.cells.mean(axis=-1, keepdims=True)
    return ShadowMask(
        np.ascontiguousarray(np.concatenate([plate.cells, mean], axis=-1)),
        mask.cell_um,
        mask.distance_mm * 1e3,
        lens.distance_mm * 1e3,
        sensor.sample_pitch_um,
        sensor.sample_pitch_um * sensor.pixel_fill,
        lens.aperture_cell_um * lens.aperture_fill,
        lens.aperture_cell_um,
        camera.views,
        size,
        sensor.binning,
        sensor.cfa_name != "mono" or any(shot.filter != "none" for shot in camera.shots),
    )


def _roomier(made: Plate, roomy: Plate) -> Plate:
    """Return the larger plate where it is the one made with cells around it (tiles begin anew)."""
    rims = [(a - b) // 2 for a, b in zip(roomy.cells.shape, made.cells.shape, strict=True)][1:3]
    middle = roomy.cells[
        :, rims[0] : rims[0] + made.cells.shape[1], rims[1] : rims[1] + made.cells.shape[2]
    ]
    return roomy if np.array_equal(middle, made.cells) else made


def _third_integral(t: Array, sigma: float) -> Array:
    """Return the thrice integrated Gaussian: its second difference is two boxes' and its share."""
    z = t / sigma
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    return 0.5 * ((t * t + sigma * sigma) * ndtr(z) + t * sigma * density)


def _below(t: Array, widths: tuple[float, float], sigma: float) -> Array:
    """Return the share of the footprint (two boxes and a Gaussian, in cells) below t."""
    a, b = (max(width, NARROWEST_CELLS) for width in widths)
    outer, inner = (a + b) / 2, (a - b) / 2

    def third(at: Array) -> Array:
        return _third_integral(at, sigma)

    return (third(t + outer) - third(t + inner) - third(t - inner) + third(t - outer)) / (a * b)


def _shares(
    mask: ShadowMask, ratio: float, blur_um: float, reach: float, count: int, places: Array
) -> Array:
    """Return the share of `count` cells for footprints at `places` in the first: (place, cell)."""
    widths = ((1 - ratio) * mask.pixel_um / mask.cell_um, ratio * mask.aperture_um / mask.cell_um)
    edges = np.arange(1, count)[None, :] - reach - places[:, None]
    below = _below(edges, widths, blur_um / mask.cell_um)
    ends = np.zeros((len(places), 1)), np.ones((len(places), 1))
    return np.diff(np.hstack([ends[0], below, ends[1]]), axis=1)


def share_tables(
    mask: ShadowMask, placement: Placement, derivatives: bool = True
) -> tuple[NDArray[np.float64], float]:
    """Return (kind, place, cell) and the reach of a footprint in cells.

    kind: the shares, and their derivatives by position in cells, by rho and by blur_um.
    """
    ratio = mask.distance_um * (1 + placement.distance_share) / mask.lens_um
    blur_um = placement.blur_um
    reach = (
        ((1 - ratio) * mask.pixel_um + ratio * mask.aperture_um) / 2 + TAILS * blur_um
    ) / mask.cell_um
    count = int(np.ceil(2 * reach)) + 1
    places = np.linspace(0, 1, TABLE_STEPS + 1)

    def at(places: Array, ratio: float, blur_um: float) -> Array:
        return _shares(mask, ratio, blur_um, reach, count, places)

    if not derivatives:
        return at(places, ratio, blur_um)[None].astype(np.float64), reach
    small, turn, soft = 1e-5, 1e-6, 1e-4 * mask.cell_um
    tables = np.stack(
        [
            at(places, ratio, blur_um),
            (at(places + small, ratio, blur_um) - at(places - small, ratio, blur_um)) / (2 * small),
            (at(places, ratio + turn, blur_um) - at(places, ratio - turn, blur_um)) / (2 * turn),
            (at(places, ratio, blur_um + soft) - at(places, ratio, blur_um - soft)) / (2 * soft),
        ]
    )
    return tables.astype(np.float64), reach


def _turns(placement: Placement) -> NDArray[np.float64]:
    """Return B and its derivatives by rotation, scale and skew: (4, 2, 2)."""
    cosine, sine = np.cos(placement.rotation_rad), np.sin(placement.rotation_rad)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    turned = np.array([[-sine, cosine], [-cosine, -sine]])
    lean = np.array([[1.0, placement.skew], [0.0, 1.0]])
    leaned = np.array([[0.0, 1.0], [0.0, 0.0]])
    scale = placement.scale
    return np.stack(
        [
            lean @ turn / scale,
            lean @ turned / scale,
            -lean @ turn / scale**2,
            leaned @ turn / scale,
        ]
    )


@njit(cache=True, parallel=True, fastmath=True)
def _read(
    pixels,
    channels,
    cells,
    tables,
    reach,
    turns,
    lengths,
    numbers,
    views_open,
    aperture,
    out,
    slope,
    each,
    by_view,
):
    """Set out (n,) to the readings of pixels (n, 2), and slope (n, parameter) if it has rows.

    each (n, view), if it has rows, is set to what every open view adds, and by_view (n, view, 5) to
    the reading's derivatives by the mask as that view alone sees it: its x and y, its blur along
    columns and rows, and across both.

    numbers: size (rows, columns), binning. lengths: cell, rho, d / D, pitch, aperture cell, corner,
    aperture corner, offset x, y, bend, clear, leak, vignetting, falloff, tilt x, y, bow, glass,
    lens.
    """
    cell_um, ratio, designed, pitch_um, view_um, corner_um, far_um = lengths[:7]
    off_x, off_y, bend, clear, leak, vignetting, falloff = lengths[7:14]
    tilt_x, tilt_y, bow, glass, lens_um = lengths[14:]
    rows, columns, binning = numbers
    height, width = cells.shape[0], cells.shape[1]
    views_v, views_u = aperture.shape
    count = tables.shape[2]
    steps = tables.shape[1] - 1
    wanted = slope.shape[0] > 0
    scalars = 16
    parts = binning * binning
    for n in prange(pixels.shape[0]):
        across = np.empty((4, count))
        down = np.empty((4, count))
        value = np.zeros(4)
        gradient = np.zeros(scalars + views_v * views_u)
        channel = channels[n]
        reading = 0.0
        for part in range(parts):
            y = pixels[n, 0] * binning + part // binning
            x = pixels[n, 1] * binning + part % binning
            y_um = (y - (rows - 1) / 2) * pitch_um
            x_um = (x - (columns - 1) / 2) * pitch_um
            square = (x_um * x_um + y_um * y_um) / corner_um**2
            cube = square / corner_um
            farther_um = tilt_x * x_um + tilt_y * y_um + bow * square
            weight_sum, leaning_sum, far_sum = 0.0, 0.0, 0.0
            for v in range(views_v):
                for u in range(views_u):
                    v_um = (v - (views_v - 1) / 2) * view_um
                    u_um = (u - (views_u - 1) / 2) * view_um
                    lean = (x_um * u_um + y_um * v_um) / (corner_um * far_um)
                    far = (u_um * u_um + v_um * v_um) / (far_um * far_um)
                    leaning, falling = 1 + vignetting * lean, 1 + falloff * far
                    weight_sum += aperture[v, u] * leaning * falling
                    leaning_sum += aperture[v, u] * lean * falling
                    far_sum += aperture[v, u] * far * leaning
            here = 0.0
            here_gradient = np.zeros(scalars + views_v * views_u)
            for v in range(views_v):
                for u in range(views_u):
                    if not views_open[v, u]:
                        continue
                    v_um = (v - (views_v - 1) / 2) * view_um
                    u_um = (u - (views_u - 1) / 2) * view_um
                    to_u, to_v = (u_um - x_um) / lens_um, (v_um - y_um) / lens_um
                    steep = to_u * to_u + to_v * to_v
                    refracted = 1 / np.sqrt(GLASS_INDEX**2 * (1 + steep) - steep) - 1 / GLASS_INDEX
                    more = farther_um + glass * refracted
                    xi_x = (1 - ratio) * x_um + ratio * u_um + bend * cube * x_um - off_x
                    xi_y = (1 - ratio) * y_um + ratio * v_um + bend * cube * y_um - off_y
                    xi_x += more * to_u
                    xi_y += more * to_v
                    column = (turns[0, 0, 0] * xi_x + turns[0, 0, 1] * xi_y) / cell_um + width / 2
                    row = (turns[0, 1, 0] * xi_x + turns[0, 1, 1] * xi_y) / cell_um + height / 2
                    left = int(np.floor(column - reach))
                    top = int(np.floor(row - reach))
                    place = (column - reach - left) * steps
                    j = min(int(place), steps - 1)
                    part_x = place - j
                    place = (row - reach - top) * steps
                    i = min(int(place), steps - 1)
                    part_y = place - i
                    kinds = 4 if wanted else 1
                    for kind in range(kinds):
                        for k in range(count):
                            across[kind, k] = (1 - part_x) * tables[kind, j, k] + part_x * tables[
                                kind, j + 1, k
                            ]
                            down[kind, k] = (1 - part_y) * tables[kind, i, k] + part_y * tables[
                                kind, i + 1, k
                            ]
                    passed, by_column, by_row, by_ratio, by_blur = 0.0, 0.0, 0.0, 0.0, 0.0
                    for a in range(count):
                        if top + a < 0 or top + a >= height:
                            continue
                        value[:] = 0
                        for b in range(count):
                            if left + b < 0 or left + b >= width:
                                continue
                            cell = cells[top + a, left + b, channel]
                            for kind in range(kinds):
                                value[kind] += cell * across[kind, b]
                        passed += down[0, a] * value[0]
                        if wanted:
                            by_column += down[0, a] * value[1]
                            by_row += down[1, a] * value[0]
                            by_ratio += down[0, a] * value[2] + down[2, a] * value[0]
                            by_blur += down[0, a] * value[3] + down[3, a] * value[0]
                    lean = (x_um * u_um + y_um * v_um) / (corner_um * far_um)
                    far = (u_um * u_um + v_um * v_um) / (far_um * far_um)
                    leaning, falling = 1 + vignetting * lean, 1 + falloff * far
                    share = aperture[v, u] * leaning * falling / weight_sum
                    through = leak + (clear - leak) * passed
                    here += share * through
                    if each.shape[0] > 0:
                        each[n, v * views_u + u] += share * through / parts
                    if not wanted:
                        continue
                    gain = share * (clear - leak)
                    to_x = gain * (by_column * turns[0, 0, 0] + by_row * turns[0, 1, 0]) / cell_um
                    to_y = gain * (by_column * turns[0, 0, 1] + by_row * turns[0, 1, 1]) / cell_um
                    here_gradient[0] -= to_x
                    here_gradient[1] -= to_y
                    for t in range(3):
                        here_gradient[2 + t] += (
                            gain
                            * (
                                by_column * (turns[t + 1, 0, 0] * xi_x + turns[t + 1, 0, 1] * xi_y)
                                + by_row * (turns[t + 1, 1, 0] * xi_x + turns[t + 1, 1, 1] * xi_y)
                            )
                            / cell_um
                        )
                    here_gradient[5] += designed * (
                        to_x * (u_um - x_um) + to_y * (v_um - y_um) + gain * by_ratio
                    )
                    here_gradient[6] += cube * (to_x * x_um + to_y * y_um)
                    here_gradient[7] += gain * by_blur
                    if by_view.shape[0] > 0:
                        blur_x, blur_y, crossed = 0.0, 0.0, 0.0
                        for a in range(count):
                            for b in range(count):
                                if 0 <= top + a < height and 0 <= left + b < width:
                                    cell = cells[top + a, left + b, channel]
                                    blur_x += cell * down[0, a] * across[3, b]
                                    blur_y += cell * down[3, a] * across[0, b]
                                    crossed += cell * down[1, a] * across[1, b]
                        view = by_view[n, v * views_u + u]
                        view[0] -= to_x / parts
                        view[1] -= to_y / parts
                        view[2] += gain * blur_x / parts
                        view[3] += gain * blur_y / parts
                        view[4] += gain * crossed / (cell_um * parts)
                    here_gradient[8] += share * passed
                    here_gradient[9] += share * (1 - passed)
                    here_gradient[10] += share * lean / leaning * through
                    here_gradient[11] += share * far / falling * through
                    along = to_x * to_u + to_y * to_v
                    here_gradient[12] += along * x_um
                    here_gradient[13] += along * y_um
                    here_gradient[14] += along * square
                    here_gradient[15] += along * refracted
                    here_gradient[scalars + v * views_u + u] += share / aperture[v, u] * through
            reading += here / parts
            if wanted:
                here_gradient[10] -= here * leaning_sum / weight_sum
                here_gradient[11] -= here * far_sum / weight_sum
                for v in range(views_v):
                    for u in range(views_u):
                        v_um = (v - (views_v - 1) / 2) * view_um
                        u_um = (u - (views_u - 1) / 2) * view_um
                        lean = (x_um * u_um + y_um * v_um) / (corner_um * far_um)
                        far = (u_um * u_um + v_um * v_um) / (far_um * far_um)
                        here_gradient[scalars + v * views_u + u] -= (
                            here * (1 + vignetting * lean) * (1 + falloff * far) / weight_sum
                        )
                for p in range(gradient.shape[0]):
                    gradient[p] += here_gradient[p] / parts
        out[n] = reading
        if wanted:
            slope[n, :] = gradient


class Shadow:
    """The shadow of one placement: readings and derivatives of any pixels."""

    def __init__(self, mask: ShadowMask, placement: Placement) -> None:
        self.mask, self.placement = mask, placement
        self._tables, self._reach = share_tables(mask, placement, derivatives=False)
        self._turns = _turns(placement)
        self._aperture = np.array(placement.aperture, dtype=np.float64)
        span = np.array([(count - 1) / 2 * mask.aperture_cell_um for count in mask.views])
        self._far_um = max(float(np.hypot(*span)), 1.0)

    def readings(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> NDArray[np.float64]:
        """Return what pixels (n, 2), row and column, read of a white board, (n,).

        channels: (n,), the colour each sees, or ANY_COLOUR. views_open: (v, u). stage_um: where
        the mask stands, x and y. frame: of the pattern.
        """
        return self._both(pixels, channels, views_open, stage_um, frame)[0]

    def with_slopes(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the readings (n,) and their derivatives (n, parameter), as `readings`."""
        return self._both(pixels, channels, views_open, stage_um, frame, len(pixels))[:2]

    def slopes_by_view(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the derivatives of the readings by the parameters, (n, parameter), and by view.

        The latter by what each view alone sees of the mask, (n, view x 5): x, y, blur along columns
        and rows, all in um, and across both, in cells times um.
        """
        by_view = np.zeros((len(pixels), self._aperture.size, OF_VIEW))
        count = len(pixels)
        slope = self._both(pixels, channels, views_open, stage_um, frame, count, 0, by_view)[1]
        return slope, by_view.reshape(count, -1)

    def own_slopes(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> NDArray[np.float64]:
        """Return the derivatives of one open view's readings by what it alone sees, (n, 5)."""
        found = np.empty((len(pixels), OF_VIEW))
        for first in range(0, len(pixels), OWN_PIXELS):
            part = slice(first, first + OWN_PIXELS)
            how = pixels[part], channels[part], views_open, stage_um, frame
            by_view = self.slopes_by_view(*how)[1].reshape(-1, self._aperture.size, OF_VIEW)
            found[part] = by_view.sum(axis=1)
        return found

    def coefficients(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> NDArray[np.float64]:
        """Return Psi's coefficients of pixels (n, 2) and the colours they see, (n, v, u)."""
        every = np.ones(self.mask.views, dtype=bool)
        each = self._both(pixels, channels, every, stage_um, frame, 0, len(pixels))[2]
        return each.reshape(len(pixels), *self.mask.views)

    def footprints(
        self, pixels: Pixels, views_open: NDArray[np.bool_], stage_um: tuple[float, float]
    ) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Return where the footprints of pixels (n, 2) lie on the mask, view by open view.

        Corners (n, view, 2), the first row and column of cells; shares of the cells from there
        down and across, (n, view, cell) each; and what each view counts in the reading (n, view).
        Pixels must be samples (binning 1).
        """
        mask, at = self.mask, self.placement
        if mask.binning != 1:
            raise CalibrationError("defects are sought on sensors whose pixels are samples")
        ratio = mask.distance_um * (1 + at.distance_share) / mask.lens_um
        y, x = (
            (pixels[:, axis] - (mask.size[axis] - 1) / 2)[:, None] * mask.pitch_um
            for axis in (0, 1)
        )
        chosen = np.argwhere(views_open)
        grid_v, grid_u = (
            (np.arange(count) - (count - 1) / 2) * mask.aperture_cell_um for count in mask.views
        )
        square = (x**2 + y**2) / mask.corner_um**2
        bend = at.distortion_um * square / mask.corner_um
        to_u, to_v = (
            (grid_u[chosen[:, 1]] - x) / mask.lens_um,
            (grid_v[chosen[:, 0]] - y) / mask.lens_um,
        )
        steep = to_u**2 + to_v**2
        refracted = 1 / np.sqrt(GLASS_INDEX**2 * (1 + steep) - steep) - 1 / GLASS_INDEX
        farther_um = at.tilt_x_rad * x + at.tilt_y_rad * y + at.bow_um * square
        more = farther_um + at.glass_um * refracted
        xi_x = (1 - ratio) * x + ratio * grid_u[chosen[:, 1]] + bend * x + more * to_u
        xi_y = (1 - ratio) * y + ratio * grid_v[chosen[:, 0]] + bend * y + more * to_v
        xi_x = xi_x - at.offset_x_um - stage_um[0]
        xi_y = xi_y - at.offset_y_um - stage_um[1]
        turn = self._turns[0] / mask.cell_um
        height, width = mask.cells.shape[1:3]
        starts = [
            turn[1, 0] * xi_x + turn[1, 1] * xi_y + height / 2 - self._reach,
            turn[0, 0] * xi_x + turn[0, 1] * xi_y + width / 2 - self._reach,
        ]
        corners = np.stack([np.floor(start).astype(np.int64) for start in starts], axis=-1)
        shares = []
        for axis, start in enumerate(starts):
            place = np.rint((start - corners[..., axis]) * TABLE_STEPS).astype(np.int64)
            shares.append(self._tables[0][place])

        def counted(v: Array, u: Array, y: Array, x: Array) -> Array:
            leaning = (x * u + y * v) / (mask.corner_um * self._far_um)
            far = (u**2 + v**2) / self._far_um**2
            return (1 + at.vignetting * leaning) * (1 + at.falloff * far)

        every = np.argwhere(np.ones(mask.views, dtype=bool))
        totals = sum(
            self._aperture[v, u] * counted(grid_v[v], grid_u[u], y[:, 0], x[:, 0]) for v, u in every
        )
        weights = np.stack(
            [
                self._aperture[v, u] * counted(grid_v[v], grid_u[u], y[:, 0], x[:, 0]) / totals
                for v, u in chosen
            ],
            axis=1,
        )
        return corners, shares[0], shares[1], weights

    def _both(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float],
        frame: int,
        slopes: int = 0,
        views: int = 0,
        by_view: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        mask, at = self.mask, self.placement
        if slopes and len(self._tables) == 1:
            self._tables = share_tables(mask, at)[0]
        out = np.empty(len(pixels))
        slope = np.empty((slopes, len(SCALARS) + self._aperture.size))
        each = np.zeros((views, self._aperture.size))
        designed = mask.distance_um / mask.lens_um
        lengths = np.array(
            [
                mask.cell_um,
                designed * (1 + at.distance_share),
                designed,
                mask.pitch_um,
                mask.aperture_cell_um,
                mask.corner_um,
                self._far_um,
                at.offset_x_um + stage_um[0],
                at.offset_y_um + stage_um[1],
                at.distortion_um,
                at.clear,
                at.leak,
                at.vignetting,
                at.falloff,
                at.tilt_x_rad,
                at.tilt_y_rad,
                at.bow_um,
                at.glass_um,
                mask.lens_um,
            ]
        )
        _read(
            np.ascontiguousarray(pixels, dtype=np.int64),
            np.ascontiguousarray(channels, dtype=np.uint8),
            mask.cells[frame % len(mask.cells)],
            self._tables,
            self._reach,
            self._turns,
            lengths,
            np.array([*mask.size, mask.binning], dtype=np.int64),
            np.ascontiguousarray(views_open, dtype=np.bool_),
            self._aperture,
            out,
            slope,
            each,
            np.zeros((0, 0, OF_VIEW)) if by_view is None else by_view,
        )
        return out, slope, each
