"""The mask's shadow: what every pixel reads through a set of views, and how that depends on the
placement of the mask.

A pixel p that sees the views of an opening reads, of a white board,

    reading(p) = sum over open views j of  w_j(p) (leak + (clear - leak) T_j(p))
    T_j(p) = sum over cells (a, b) of  down_a across_b cells[row + a, column + b]

with w_j the view's share of the light and T_j the mask as the footprint of (p, j) averages it: see
`placement` for w_j, the point xi where the ray meets the mask, and its column and row.

Cost and memory are linear in the pixels asked for: each (pixel, view) looks up the few cells that
its footprint covers, their shares from tables over where the footprint lies within a cell. The
tables are exact at TABLE_STEPS places and linear between. A turned footprint is taken along the
cells (an error of rotation x footprint, under 0.2 um at 0.3 degrees).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.special import ndtr

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.placement import (
    BLUR,
    BOW,
    CLEAR,
    DISTANCE,
    DISTORTION,
    FALLOFF,
    GLASS,
    LEAK,
    OFFSET_X,
    OFFSET_Y,
    ROTATION,
    SCALARS,
    TILT_X,
    TILT_Y,
    VIGNETTING,
    Placement,
)
from emmc_rig.calibration.repeats import Repeats, repeats_of
from emmc_rig.model.camera import Camera, Plate, draw_plates
from emmc_rig.model.compiling import njit

Array = NDArray[np.floating]
Pixels = NDArray[np.int64]
TABLE_STEPS = 512
"""Of a cell: linear interpolation errs by (1/512)^2 / 8 = 5e-7 of the shares' second derivative."""
TAILS = 4.0
"""Deviations of the blur that a footprint reaches beyond its boxes: 3e-5 of it lies beyond."""
NARROWEST_CELLS = 1e-3
"""Of a box: the shares are divided by the widths."""
GLASS_INDEX = 1.52
"""Refractive index of crown glass, as of a sensor's cover."""
ANY_COLOUR = 3
"""Channel of a pixel that sees all colours."""
OF_VIEW = 5
"""Derivatives of a reading by what one view alone sees."""
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
    plate = _larger_if_same(draw_plates(camera, size)[name], draw_plates(roomy, size)[name])
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


def _larger_if_same(made: Plate, roomy: Plate) -> Plate:
    """Return the larger plate where it is the one made with cells around it (tiles begin anew)."""
    rims = [(a - b) // 2 for a, b in zip(roomy.cells.shape, made.cells.shape, strict=True)][1:3]
    middle = roomy.cells[
        :, rims[0] : rims[0] + made.cells.shape[1], rims[1] : rims[1] + made.cells.shape[2]
    ]
    return roomy if np.array_equal(middle, made.cells) else made


def _third_integral(t: Array, sigma: float) -> Array:
    """Return the thrice integrated Gaussian: 1/2 ((t^2 + s^2) Phi(t / s) + t s phi(t / s))."""
    z = t / sigma
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    return 0.5 * ((t * t + sigma * sigma) * ndtr(z) + t * sigma * density)


def _share_below(t: Array, widths: tuple[float, float], sigma: float) -> Array:
    """Return the share of a footprint around 0 that lies below t, in cells.

    The footprint is the convolution of boxes of widths a and b and a Gaussian. A convolution with a
    box is a difference of integrals over the width, so that with G the Gaussian, integrated thrice,

        share(t) = (G(t + o) - G(t + i) - G(t - i) + G(t - o)) / (a b),
        o = (a + b) / 2,    i = (a - b) / 2
    """
    a, b = (max(width, NARROWEST_CELLS) for width in widths)
    outer, inner = (a + b) / 2, (a - b) / 2

    def third(at: Array) -> Array:
        return _third_integral(at, sigma)

    return (third(t + outer) - third(t + inner) - third(t - inner) + third(t - outer)) / (a * b)


def share_tables(
    mask: ShadowMask, placement: Placement, derivatives: bool = True
) -> tuple[NDArray[np.float64], float]:
    """Return the tables (kind, place, cell), and the reach of a footprint to either side, cells.

    kind: the shares, and their derivatives by position in cells, by rho and by blur_um (by
    differences). place: where the footprint begins within its first cell.
    """
    ratio = mask.distance_um * (1 + placement.distance_share) / mask.lens_um
    blur_um = placement.blur_um
    reach = (
        ((1 - ratio) * mask.pixel_um + ratio * mask.aperture_um) / 2 + TAILS * blur_um
    ) / mask.cell_um
    count = int(np.ceil(2 * reach)) + 1
    places = np.linspace(0, 1, TABLE_STEPS + 1)

    def shares(places: Array, ratio: float, blur_um: float) -> Array:
        widths = (
            (1 - ratio) * mask.pixel_um / mask.cell_um,
            ratio * mask.aperture_um / mask.cell_um,
        )
        edges = np.arange(1, count)[None, :] - reach - places[:, None]
        below = _share_below(edges, widths, blur_um / mask.cell_um)
        ends = np.zeros((len(places), 1)), np.ones((len(places), 1))
        return np.diff(np.hstack([ends[0], below, ends[1]]), axis=1)

    here = shares(places, ratio, blur_um)
    if not derivatives:
        return here[None].astype(np.float64), reach
    # Steps of central differences: in cells, of rho, and of blur_um.
    move, nearer, softer = 1e-5, 1e-6, 1e-4 * mask.cell_um
    by_place = shares(places + move, ratio, blur_um) - shares(places - move, ratio, blur_um)
    by_ratio = shares(places, ratio + nearer, blur_um) - shares(places, ratio - nearer, blur_um)
    by_blur = shares(places, ratio, blur_um + softer) - shares(places, ratio, blur_um - softer)
    tables = [here, by_place / (2 * move), by_ratio / (2 * nearer), by_blur / (2 * softer)]
    return np.stack(tables).astype(np.float64), reach


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


class _Rays(NamedTuple):
    """Parameters of a frame's rays: camera, placement and stage. Others as in `Placement`."""

    rows: int
    columns: int
    binning: int
    pitch_um: float
    view_um: float
    """From one view to the next, on the aperture."""
    corner_um: float
    """From the middle of the picture to its corner."""
    far_um: float
    """From the middle of the aperture to the outermost view."""
    lens_um: float
    cell_um: float
    reach: float
    """Of a footprint to either side, cells."""
    design_share: float
    """d / D as designed."""
    distance_share: float
    """rho: d / D as the mask stands."""
    offset_x_um: float
    """With the stage's place."""
    offset_y_um: float
    distortion_um: float
    clear: float
    leak: float
    vignetting: float
    falloff: float
    tilt_x_rad: float
    tilt_y_rad: float
    bow_um: float
    glass_um: float


class _Light(NamedTuple):
    """A view's light on a pixel: (1 + vignetting lean)(1 + falloff far) = leaning x falling."""

    lean: float
    """x . u, as shares of the picture's corner and the aperture's."""
    far: float
    """|u|^2, as a share of the aperture's corner."""
    leaning: float
    falling: float


class _Point(NamedTuple):
    """Where a ray meets the mask's plane, from the mask's middle, and its direction."""

    x_um: float
    y_um: float
    to_u: float
    """Slopes of the ray: (u - x) / D."""
    to_v: float
    refracted: float
    """By so much of glass_um, times the slope, glass moves the ray."""


class _Passed(NamedTuple):
    """What a footprint passes of the light, T, and its derivatives."""

    share: float
    by_column: float
    """By cells."""
    by_row: float
    by_ratio: float
    """By rho, of the footprint's size alone."""
    by_blur: float
    """By um."""


class _Seen(NamedTuple):
    """Readings of pixels, and their derivatives; arrays that were not asked for have no rows."""

    readings: NDArray[np.float64]
    """(n,)."""
    slopes: NDArray[np.float64]
    """(n, parameter)."""
    each: NDArray[np.float64]
    """(n, view): what every open view adds."""
    by_view: NDArray[np.float64]
    """(n, view, OF_VIEW): by the mask as this view alone sees it, see `Shadow.slopes_by_view`."""


@njit(forceinline=True)
def _centred_um(index, count, step_um):
    """Return the place of one of `count` samples, or views, that lie around 0."""
    return (index - (count - 1) / 2) * step_um


@njit(forceinline=True)
def _light_factors(rays, x_um, y_um, u_um, v_um):
    """Return the light of the view at (u, v) on the pixel at (x, y)."""
    lean = (x_um * u_um + y_um * v_um) / (rays.corner_um * rays.far_um)
    far = (u_um * u_um + v_um * v_um) / (rays.far_um * rays.far_um)
    return _Light(lean, far, 1 + rays.vignetting * lean, 1 + rays.falloff * far)


@njit(forceinline=True)
def _light_sums(rays, aperture, x_um, y_um):
    """Return the weights of all views summed, and the sum's slopes by vignetting and falloff."""
    views_v, views_u = aperture.shape
    total, by_vignetting, by_falloff = 0.0, 0.0, 0.0
    for v in range(views_v):
        for u in range(views_u):
            u_um = _centred_um(u, views_u, rays.view_um)
            v_um = _centred_um(v, views_v, rays.view_um)
            light = _light_factors(rays, x_um, y_um, u_um, v_um)
            total += aperture[v, u] * light.leaning * light.falling
            by_vignetting += aperture[v, u] * light.lean * light.falling
            by_falloff += aperture[v, u] * light.far * light.leaning
    return total, by_vignetting, by_falloff


@njit(forceinline=True)
def _ray_on_mask(rays, x_um, y_um, u_um, v_um):
    """Return where the ray from the pixel at (x, y) to the lens point (u, v) meets the mask.

    t = (u - x) / D,    square = |x|^2 / corner^2
    refracted = 1 / sqrt(n^2 (1 + |t|^2) - |t|^2) - 1 / n
    farther = tilt . x + bow square + glass refracted
    xi = (1 - rho) x + rho u + distortion x square / corner - offset + farther t
    """
    to_u, to_v = (u_um - x_um) / rays.lens_um, (v_um - y_um) / rays.lens_um
    steep = to_u * to_u + to_v * to_v
    refracted = 1 / np.sqrt(GLASS_INDEX**2 * (1 + steep) - steep) - 1 / GLASS_INDEX
    square = (x_um * x_um + y_um * y_um) / rays.corner_um**2
    cube = square / rays.corner_um
    farther_um = rays.tilt_x_rad * x_um + rays.tilt_y_rad * y_um + rays.bow_um * square
    more = farther_um + rays.glass_um * refracted
    ratio, bend = rays.distance_share, rays.distortion_um * cube
    xi_x = (1 - ratio) * x_um + ratio * u_um + bend * x_um - rays.offset_x_um + more * to_u
    xi_y = (1 - ratio) * y_um + ratio * v_um + bend * y_um - rays.offset_y_um + more * to_v
    return _Point(xi_x, xi_y, to_u, to_v, refracted)


@njit(forceinline=True)
def _interpolate_shares(tables, start, shares):
    """Set shares (kind, cell) to those of a footprint from `start`, in cells; return its first."""
    first = int(np.floor(start))
    steps = tables.shape[1] - 1
    place = (start - first) * steps
    below = min(int(place), steps - 1)
    part = place - below
    for kind in range(tables.shape[0]):
        for k in range(tables.shape[2]):
            above = part * tables[kind, below + 1, k]
            shares[kind, k] = (1 - part) * tables[kind, below, k] + above
    return first


@njit(forceinline=True)
def _sum_footprint(cells, top, left, channel, down, across, values):
    """Return what a footprint passes, sum of down x cells x across, and its derivatives.

    down, across: (kind, cell), of one kind where no derivatives are needed. values: (4,), scratch.
    """
    height, width, kinds = cells.shape[0], cells.shape[1], across.shape[0]
    passed, by_column, by_row, by_ratio, by_blur = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(max(-top, 0), min(down.shape[1], height - top)):
        values[:] = 0
        for b in range(max(-left, 0), min(across.shape[1], width - left)):
            for kind in range(kinds):
                values[kind] += cells[top + a, left + b, channel] * across[kind, b]
        passed += down[0, a] * values[0]
        if kinds > 1:
            by_column += down[0, a] * values[1]
            by_row += down[1, a] * values[0]
            by_ratio += down[0, a] * values[2] + down[2, a] * values[0]
            by_blur += down[0, a] * values[3] + down[3, a] * values[0]
    return _Passed(passed, by_column, by_row, by_ratio, by_blur)


@njit(forceinline=True)
def _sum_softenings(cells, top, left, channel, down, across):
    """Return the derivatives of what a footprint passes by blur in x, in y, and across both."""
    height, width = cells.shape[0], cells.shape[1]
    blur_x, blur_y, crossed = 0.0, 0.0, 0.0
    for a in range(max(-top, 0), min(down.shape[1], height - top)):
        for b in range(max(-left, 0), min(across.shape[1], width - left)):
            cell = cells[top + a, left + b, channel]
            blur_x += cell * down[0, a] * across[3, b]
            blur_y += cell * down[3, a] * across[0, b]
            crossed += cell * down[1, a] * across[1, b]
    return blur_x, blur_y, crossed


# Into the code of `_read` before it is compiled: the kernel rounds as if it were written there.
@njit(inline="always")
def _add_ray_slopes(slope, rays, b, x_um, y_um, square, u_um, v_um, light, point, passed, share):
    """Add to slope (parameter,) the derivatives of share (leak + (clear - leak) T), one ray's.

    Return its derivatives by a move of the mask's point: (gain, by x, by y), in um.

        column, row = B xi / cell,    gain = share (clear - leak)
        by_x, by_y = gain (T_column, T_row) B / cell
        offset: xi falls by 1.     rotation, scale, skew: column and row grow by dB xi / cell
        rho: xi grows by u - x, and the footprint's boxes change
        tilt, bow, glass: xi grows by the ray's slope t times x, square, refracted

    share: of the light, w_j; `_read` subtracts what the sum of all views takes from it. b: B and
    its derivatives by rotation, scale and skew, over the cell, (4, 2, 2).
    """
    through = rays.leak + (rays.clear - rays.leak) * passed.share
    gain = share * (rays.clear - rays.leak)
    by_x = gain * (passed.by_column * b[0, 0, 0] + passed.by_row * b[0, 1, 0])
    by_y = gain * (passed.by_column * b[0, 0, 1] + passed.by_row * b[0, 1, 1])
    slope[OFFSET_X] -= by_x
    slope[OFFSET_Y] -= by_y
    for t in range(3):
        column = b[t + 1, 0, 0] * point.x_um + b[t + 1, 0, 1] * point.y_um
        row = b[t + 1, 1, 0] * point.x_um + b[t + 1, 1, 1] * point.y_um
        slope[ROTATION + t] += gain * (passed.by_column * column + passed.by_row * row)
    by_ratio = by_x * (u_um - x_um) + by_y * (v_um - y_um) + gain * passed.by_ratio
    slope[DISTANCE] += rays.design_share * by_ratio
    slope[DISTORTION] += square / rays.corner_um * (by_x * x_um + by_y * y_um)
    slope[BLUR] += gain * passed.by_blur
    slope[CLEAR] += share * passed.share
    slope[LEAK] += share * (1 - passed.share)
    slope[VIGNETTING] += share * light.lean / light.leaning * through
    slope[FALLOFF] += share * light.far / light.falling * through
    along = by_x * point.to_u + by_y * point.to_v
    slope[TILT_X] += along * x_um
    slope[TILT_Y] += along * y_um
    slope[BOW] += along * square
    slope[GLASS] += along * point.refracted
    return gain, by_x, by_y


@njit(cache=True, parallel=True, fastmath=True)
def _read(pixels, channels, cells, tables, turns, rays, views_open, aperture, out):
    """Set out (see `_Seen`) to the readings of pixels (n, 2), and what it has rows for.

        reading = mean over the pixel's samples of  sum_j share_j (leak + (clear - leak) T_j)
        share_j = a_j (1 + vignetting lean_j)(1 + falloff far_j) / total,   total: over all views

    channels: (n,). cells: (row, column, colour). tables: (kind, place, cell), of one kind where
    slopes has no rows, see `share_tables`. turns: see `_turns`. views_open, aperture: (v, u).
    """
    readings, slopes, each, by_view = out
    height, width = cells.shape[0], cells.shape[1]
    views_v, views_u = aperture.shape
    kinds, scalars = tables.shape[0], len(SCALARS)
    parts = rays.binning * rays.binning
    b = turns / rays.cell_um
    for n in prange(pixels.shape[0]):
        across, down = np.empty((kinds, tables.shape[2])), np.empty((kinds, tables.shape[2]))
        values = np.zeros(4)
        gradient = np.zeros(scalars + views_v * views_u)
        channel = channels[n]
        readings[n] = 0.0
        for part in range(parts):
            y = pixels[n, 0] * rays.binning + part // rays.binning
            x = pixels[n, 1] * rays.binning + part % rays.binning
            y_um = _centred_um(y, rays.rows, rays.pitch_um)
            x_um = _centred_um(x, rays.columns, rays.pitch_um)
            square = (x_um * x_um + y_um * y_um) / rays.corner_um**2
            total, by_vignetting, by_falloff = _light_sums(rays, aperture, x_um, y_um)
            here = 0.0
            slope = np.zeros(scalars + views_v * views_u)
            for v in range(views_v):
                for u in range(views_u):
                    if not views_open[v, u]:
                        continue
                    v_um = _centred_um(v, views_v, rays.view_um)
                    u_um = _centred_um(u, views_u, rays.view_um)
                    point = _ray_on_mask(rays, x_um, y_um, u_um, v_um)
                    column = b[0, 0, 0] * point.x_um + b[0, 0, 1] * point.y_um + width / 2
                    row = b[0, 1, 0] * point.x_um + b[0, 1, 1] * point.y_um + height / 2
                    left = _interpolate_shares(tables, column - rays.reach, across)
                    top = _interpolate_shares(tables, row - rays.reach, down)
                    passed = _sum_footprint(cells, top, left, channel, down, across, values)
                    light = _light_factors(rays, x_um, y_um, u_um, v_um)
                    share = aperture[v, u] * light.leaning * light.falling / total
                    through = rays.leak + (rays.clear - rays.leak) * passed.share
                    view = v * views_u + u
                    here += share * through
                    if each.shape[0] > 0:
                        each[n, view] += share * through / parts
                    if kinds == 1:
                        continue
                    gain, by_x, by_y = _add_ray_slopes(
                        slope, rays, b, x_um, y_um, square, u_um, v_um, light, point, passed, share
                    )
                    slope[scalars + view] += share / aperture[v, u] * through
                    if by_view.shape[0] > 0:
                        blur_x, blur_y, crossed = _sum_softenings(
                            cells, top, left, channel, down, across
                        )
                        by_view[n, view, 0] -= by_x / parts
                        by_view[n, view, 1] -= by_y / parts
                        by_view[n, view, 2] += gain * blur_x / parts
                        by_view[n, view, 3] += gain * blur_y / parts
                        by_view[n, view, 4] += gain * crossed / (rays.cell_um * parts)
            readings[n] += here / parts
            if kinds > 1:
                # The shares are divided by the total, which depends on these parameters as well.
                slope[VIGNETTING] -= here * by_vignetting / total
                slope[FALLOFF] -= here * by_falloff / total
                for v in range(views_v):
                    for u in range(views_u):
                        u_um = _centred_um(u, views_u, rays.view_um)
                        v_um = _centred_um(v, views_v, rays.view_um)
                        light = _light_factors(rays, x_um, y_um, u_um, v_um)
                        by_weight = light.leaning * light.falling / total
                        slope[scalars + v * views_u + u] -= here * by_weight
                for p in range(len(gradient)):
                    gradient[p] += slope[p] / parts
        if kinds > 1:
            slopes[n, :] = gradient


@njit(cache=True, parallel=True)
def _find_footprints(pixels, cells, table, turns, rays, chosen, aperture, out):
    """Set out to what `Shadow.footprints` returns of pixels (n, 2) and views chosen (view, 2)."""
    corners, shares, weights = out
    views_v, views_u = aperture.shape
    for n in prange(len(pixels)):
        y_um = _centred_um(pixels[n, 0], rays.rows, rays.pitch_um)
        x_um = _centred_um(pixels[n, 1], rays.columns, rays.pitch_um)
        total, _, _ = _light_sums(rays, aperture, x_um, y_um)
        for k in range(len(chosen)):
            v, u = chosen[k]
            v_um = _centred_um(v, views_v, rays.view_um)
            u_um = _centred_um(u, views_u, rays.view_um)
            point = _ray_on_mask(rays, x_um, y_um, u_um, v_um)
            for axis in range(2):
                turn = turns[0, 1 - axis] / rays.cell_um
                middle = turn[0] * point.x_um + turn[1] * point.y_um + cells.shape[axis] / 2
                start = middle - rays.reach
                corners[n, k, axis] = int(np.floor(start))
                place = int(np.rint((start - corners[n, k, axis]) * TABLE_STEPS))
                shares[axis, n, k] = table[place]
            light = _light_factors(rays, x_um, y_um, u_um, v_um)
            weights[n, k] = aperture[v, u] * light.leaning * light.falling / total


class Shadow:
    """The shadow of one placement: readings and derivatives of any pixels.

    All take pixels (n, 2), row and column, and the colour that each sees, (n,), or ANY_COLOUR;
    views_open (v, u), where the mask stands, x and y in um, and the frame of the pattern.
    """

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
        """Return what pixels read of a white board, (n,)."""
        return self._run(pixels, channels, (views_open, stage_um, frame)).readings

    def with_slopes(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the readings (n,) and their derivatives (n, parameter)."""
        seen = self._run(pixels, channels, (views_open, stage_um, frame), slopes=True)
        return seen.readings, seen.slopes

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
        opening = views_open, stage_um, frame
        seen = self._run(pixels, channels, opening, slopes=True, by_view=True)
        return seen.slopes, seen.by_view.reshape(len(pixels), -1)

    def coefficients(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
    ) -> NDArray[np.float64]:
        """Return Psi's coefficients of pixels and the colours they see, (n, v, u)."""
        every = np.ones(self.mask.views, dtype=bool)
        seen = self._run(pixels, channels, (every, stage_um, frame), each=True)
        return seen.each.reshape(len(pixels), *self.mask.views)

    def footprints(
        self, pixels: Pixels, views_open: NDArray[np.bool_], stage_um: tuple[float, float]
    ) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Return where the footprints of pixels (n, 2) lie on the mask, view by open view.

        Corners (n, view, 2), the first row and column of cells; shares of the cells from there
        down and across, (n, view, cell) each; and what each view counts in the reading (n, view).
        Pixels must be samples (binning 1).
        """
        if self.mask.binning != 1:
            raise CalibrationError("defects are sought on sensors whose pixels are samples")
        chosen, table = np.argwhere(views_open), self._tables[0]
        shape = len(pixels), len(chosen)
        corners = np.empty((*shape, 2), dtype=np.int64)
        shares, weights = np.empty((2, *shape, table.shape[1])), np.empty(shape)
        cells, rays = self.mask.cells[0], self._rays(stage_um)
        out = corners, shares, weights
        _find_footprints(pixels, cells, table, self._turns, rays, chosen, self._aperture, out)
        return corners, shares[0], shares[1], weights

    def _rays(self, stage_um: tuple[float, float]) -> _Rays:
        mask, at = self.mask, self.placement
        design_share = mask.distance_um / mask.lens_um
        return _Rays(
            *mask.size,
            mask.binning,
            mask.pitch_um,
            mask.aperture_cell_um,
            mask.corner_um,
            self._far_um,
            mask.lens_um,
            mask.cell_um,
            self._reach,
            design_share,
            design_share * (1 + at.distance_share),
            float(at.offset_x_um + stage_um[0]),
            float(at.offset_y_um + stage_um[1]),
            *(getattr(at, name) for name in _Rays._fields[_Rays._fields.index("distortion_um") :]),
        )

    def _run(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        opening: tuple[NDArray[np.bool_], tuple[float, float], int],
        *,
        slopes: bool = False,
        each: bool = False,
        by_view: bool = False,
    ) -> _Seen:
        """Return the readings and what is asked for; by_view needs slopes."""
        views_open, stage_um, frame = opening
        if slopes and len(self._tables) == 1:
            self._tables = share_tables(self.mask, self.placement)[0]
        count, views = len(pixels), self._aperture.size
        out = _Seen(
            np.empty(count),
            np.empty((slopes * count, len(SCALARS) + views)),
            np.zeros((each * count, views)),
            np.zeros((by_view * count, views, OF_VIEW)),
        )
        _read(
            np.ascontiguousarray(pixels, dtype=np.int64),
            np.ascontiguousarray(channels, dtype=np.uint8),
            self.mask.cells[frame % len(self.mask.cells)],
            self._tables if slopes else self._tables[:1],
            self._turns,
            self._rays(stage_um),
            np.ascontiguousarray(views_open, dtype=np.bool_),
            self._aperture,
            out,
        )
        return out
