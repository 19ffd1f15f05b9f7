"""The mask's shadow: what every pixel reads through a set of views, and how that depends on the
placement of the mask.

A pixel p that sees the views of an opening reads, of a white board,

    reading(p) = sum over open views j of  w_j(p) (leak + (clear - leak) T_j(p))
    T_j(p) = sum over cells (a, b) of  down_a across_b cells[row + a, column + b]

with w_j the view's share of the light and T_j the mask as the footprint of (p, j) averages it: see
`placement` for w_j, the point xi where the ray meets the mask, and its column and row. A view that
the pupil cuts is several boxes (see `emmc_rig.model.pupil`), each with its share of the view's
light, its own ray and its own footprint; a whole view is one box.

Cost and memory are linear in the pixels asked for: each (pixel, box) looks up the few cells that
its footprint covers, their shares from tables over where the footprint lies within a cell. The
tables are exact at TABLE_STEPS places and linear between; so they are over the squared width of the
box, exact for whole views. A turned footprint is taken along the cells (an error of rotation x
footprint, under 0.2 um at 0.3 degrees).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

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
    PUPIL_X,
    RIM_SHIFT,
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
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.pupil import (
    LEAST_SHARE,
    Knot,
    Openings,
    cell_openings,
    field_knots,
)

Array = NDArray[np.floating]
Pixels = NDArray[np.int64]
TABLE_STEPS = 256
"""Of a cell: linear interpolation errs by (1/256)^2 / 8 = 2e-6 of the shares' second derivative."""
KINDS, WIDTH = 4, 4
"""Of the tables; after them, where a pupil is fitted, the derivative by the place of the box's
squared width among the tables' widths."""
FAR_OUT = 7.0
"""Deviations beyond which a Gaussian's tail is 0: 1e-12 of it lies there."""
CUT_WIDTHS = 16
"""Of boxes of cut views, for which there are tables; whole views need that of the whole cell. With
8 the shadow of 25 um of round pupil on cells of 24 um is 0.1 % off, with 16 nothing is seen."""
STRIPS_PER_CELL, FEWEST_STRIPS, MOST_STRIPS = 6.0, 4, 12
"""Of a cut view, by the width of a whole view's shadow in cells of the mask: Psi of a round pupil
of 25 mm behind 5 x 5 views of 5 mm, fitted to whiteboards of every view, is then 0.04 % off; with 4
and 9 strips a cell 0.06 and 0.03 %, in the same time but for a tenth."""
PUPIL_PARAMETERS = SCALARS[PUPIL_X : RIM_SHIFT + 1]
STEP_UM = 100.0
"""By which central differences by these parameters move the pupil's edge. Smaller ones resolve the
lines by which `emmc_rig.model.pupil` cuts views: with 16 lines a strip, 10 um made the slopes 5 %
wrong."""
OF_BOX = ("share", "x_um", "y_um", "width", "height")
"""What follows the pupil: width and height as places of their squares among the tables' widths."""
NARROWEST = 0.2
"""Side of a hole, over that of its view: a narrower hole counts as so wide."""
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


@njit(forceinline=True)
def _integrals(t, sigma):
    """Return the Gaussian integrated once, twice and thrice up to t.

    G1 = Phi(t / s),    G2 = t Phi + s phi,    G3 = 1/2 ((t^2 + s^2) Phi + t s phi)
    """
    z = t / sigma
    if z > FAR_OUT:
        return 1.0, t, 0.5 * (t * t + sigma * sigma)
    if z < -FAR_OUT:
        return 0.0, 0.0, 0.0
    below = 0.5 * math.erfc(-z / math.sqrt(2.0))
    density = sigma * math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
    return below, t * below + density, 0.5 * ((t * t + sigma * sigma) * below + t * density)


@njit(cache=True)
def _fill_tables(tables, reach, pixel, boxes, sigma, by_ratio):
    """Set tables (kind, width, place, cell), see `share_tables`; lengths in cells of the mask.

    The footprint is the convolution of the pixel's box, of width a, the aperture's, of width b, and
    a Gaussian of deviation s. A convolution with a box is a difference of integrals over the width,
    so that of the footprint around 0 the share below t is, with G3 the Gaussian integrated thrice,

        S(t) = sum over (p, q) = (+-, +-) of  p q G3(t + (p a + q b) / 2) / (a b)
        dS/dt = sum of p q G2 / (a b),    dS/ds = s sum of p q G1 / (a b)
        dS/da = sum of q G2 / (2 a b) - S / a,    dS/db = sum of p G2 / (2 a b) - S / b

    A cell's share is the difference of S at its edges. pixel: a. boxes: (width,), b. by_ratio:
    (2, width), derivatives of a and b by rho.
    """
    kinds, widths, places, cells = tables.shape
    a = max(pixel, NARROWEST_CELLS)
    before = np.empty(kinds)
    for w in range(widths):
        b = max(boxes[w], NARROWEST_CELLS)
        for i in range(places):
            before[:] = 0
            for cell in range(cells):
                if cell == cells - 1:
                    below, by_t, by_rho, by_blur = 1.0, 0.0, 0.0, 0.0
                else:
                    t = cell + 1 - reach - i / (places - 1)
                    below, by_t, by_a, by_b, by_blur = 0.0, 0.0, 0.0, 0.0, 0.0
                    for p in (-1.0, 1.0):
                        for q in (-1.0, 1.0):
                            first, second, third = _integrals(t + (p * a + q * b) / 2, sigma)
                            below += p * q * third
                            by_t += p * q * second
                            by_a += q * second / 2
                            by_b += p * second / 2
                            by_blur += p * q * first * sigma
                    below, by_t, by_blur = below / (a * b), by_t / (a * b), by_blur / (a * b)
                    by_a, by_b = by_a / (a * b) - below / a, by_b / (a * b) - below / b
                    by_rho = by_a * by_ratio[0, w] + by_b * by_ratio[1, w]
                tables[0, w, i, cell] = below - before[0]
                before[0] = below
                if kinds > 1:
                    # A footprint that begins farther on has its cells' edges nearer.
                    tables[1, w, i, cell] = before[1] - by_t
                    tables[2, w, i, cell] = by_rho - before[2]
                    tables[3, w, i, cell] = by_blur - before[3]
                    before[1], before[2], before[3] = by_t, by_rho, by_blur


def share_tables(
    mask: ShadowMask, placement: Placement, kinds: int = KINDS, widths: int = 1
) -> tuple[NDArray[np.float64], float]:
    """Return the tables (kind, width, place, cell), and the reach of a footprint to either side.

    kind: the first `kinds` of the shares, and their derivatives by position in cells, by rho and by
    blur_um. width: of the box on the aperture; their squares are `widths` even steps up to the
    cell's, the last. place: where the footprint begins within its first cell. reach: in cells.
    """
    ratio = mask.distance_um * (1 + placement.distance_share) / mask.lens_um
    pixel, aperture = mask.pixel_um / mask.cell_um, mask.aperture_um / mask.cell_um
    reach = ((1 - ratio) * pixel + ratio * aperture) / 2 + TAILS * placement.blur_um / mask.cell_um
    count = int(np.ceil(2 * reach)) + 1
    tables = np.empty((kinds, widths, TABLE_STEPS + 1, count))
    boxes = aperture * (np.sqrt(np.linspace(0, 1, widths)) if widths > 1 else np.ones(1))
    by_ratio = np.stack([np.full(widths, -pixel), boxes])
    sigma = placement.blur_um / mask.cell_um
    _fill_tables(tables, reach, (1 - ratio) * pixel, ratio * boxes, sigma, by_ratio)
    tables[3:] /= mask.cell_um
    return tables, reach


def openings(mask: ShadowMask, placement: Placement, **how: Any) -> Openings:
    """Return the boxes of all views of a placement; how: see `cell_openings`."""
    fill = mask.aperture_um / mask.aperture_cell_um
    shadow = mask.distance_um / mask.lens_um * mask.aperture_um / mask.cell_um
    strips = int(np.clip(np.ceil(STRIPS_PER_CELL * shadow), FEWEST_STRIPS, MOST_STRIPS))
    pupil = placement.fitted_pupil()
    return cell_openings(pupil, mask.views, mask.aperture_cell_um, fill, strips=strips, **how)


def pupil_steps(mask: ShadowMask, placement: Placement) -> dict[str, float]:
    """Return the steps of central differences by the parameters of pupil and rim that there are."""
    pupil = placement.pupil
    if pupil is None:
        return {}
    steps = {"pupil_x_um": STEP_UM, "pupil_y_um": STEP_UM}
    steps["pupil_share"] = 2 * STEP_UM / 1e3 / pupil.diameter_mm
    if pupil.rim is not None:
        steps["rim_share"] = 2 * STEP_UM / 1e3 / pupil.rim.diameter_mm
        steps["rim_shift"] = STEP_UM / mask.corner_um
    return steps


def light_slopes(mask: ShadowMask, placement: Placement) -> NDArray[np.float64]:
    """Return the relative slopes of the light of every view, (view, parameter).

    Of a_j open_j (1 + falloff far_j); by the pupil, of what is open. Views that are all but shut
    count as LEAST_SHARE open. Behind a rim, of a pixel in the middle of the picture.
    """
    found = openings(mask, placement)
    opened = np.maximum(found.shares(mask.views), LEAST_SHARE)
    weights, first = np.array(placement.aperture), len(SCALARS)
    slopes = np.zeros((weights.size, first + weights.size))
    slopes[:, first:] = np.diag(1 / weights.ravel())
    far = far_shares(mask.views).ravel()
    slopes[:, FALLOFF] = far / (1 + placement.falloff * far)
    changes = _pupil_slopes(mask, placement, found)
    for p in range(changes.shape[1] if len(changes) else 0):
        change = np.zeros(mask.views)
        np.add.at(change, tuple(found.view.T), changes[:, p, 0])
        slopes[:, PUPIL_X + p] = (change / opened).ravel()
    return slopes


def far_shares(views: tuple[int, int]) -> NDArray[np.float64]:
    """Return |u|^2 of every view as a share of the outermost's, (v, u)."""
    v, u = (centred_grid(count, 1.0) for count in views)
    far = v[:, None] ** 2 + u**2
    return far / max(float(far.max()), 1e-12)


class _Boxes(NamedTuple):
    """The boxes through which the views look, without those that are shut."""

    v: NDArray[np.int64]
    """(box,), row of the view."""
    u: NDArray[np.int64]
    share: NDArray[np.float64]
    """(box,), of the cell's area."""
    x_um: NDArray[np.float64]
    """(box,), from the middle of the view."""
    y_um: NDArray[np.float64]
    width: NDArray[np.int64]
    """(box, 2): across and down, the table's width that is next below the box's."""
    part: NDArray[np.float64]
    """(box, 2): how far the box's squared width lies from there towards the next width's."""
    slopes: NDArray[np.float64]
    """(box, 5, 5): of OF_BOX by PUPIL_PARAMETERS; no boxes without a pupil."""

    def of_views(self, views_open: NDArray[np.bool_]) -> _Boxes:
        """Return the boxes of the open views, (v, u)."""
        chosen = views_open[self.v, self.u]
        return _Boxes(*(values[chosen] if len(values) else values for values in self))


def _boxes_of(
    found: Openings, mask: ShadowMask, widths: int, slopes: NDArray[np.float64]
) -> _Boxes:
    """Return the boxes; widths: that the tables have; slopes: see `_Boxes`."""
    last = widths - 1
    place = _width_places(found, mask) if last else np.zeros((len(found.share), 2))
    # A whole view's box is the cell: rounding must not lead beside the last table.
    place = np.where(place > last - 1e-9, last, place)
    width = np.minimum(place.astype(np.int64), last)
    columns = (*found.view.T, found.share, found.x_um, found.y_um, width, place - width)
    opened = found.share > LEAST_SHARE / 10
    rows = [np.ascontiguousarray(values[opened]) for values in columns]
    return _Boxes(*rows, slopes[opened] if len(slopes) else slopes)


def _width_places(found: Openings, mask: ShadowMask) -> NDArray[np.float64]:
    """Return where the squares of width and height lie among the tables' widths, (box, 2)."""
    widths = np.stack([found.width_um, found.height_um], axis=1)
    return (CUT_WIDTHS - 1) * np.square(widths / max(mask.aperture_um, 1e-9))


def _pupil_slopes(
    mask: ShadowMask,
    placement: Placement,
    found: Openings,
    pixel_um: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float64]:
    """Return the slopes of every box by pupil and rim, see `_Boxes`; pixel_um: x and y of it."""
    if placement.pupil is None:
        return np.zeros((0, len(PUPIL_PARAMETERS), len(OF_BOX)))
    boxes = [tuple(view) for view in found.view]
    whole = [view for view in boxes if boxes.count(view) == 1]
    slopes = np.zeros((len(boxes), len(PUPIL_PARAMETERS), len(OF_BOX)))
    for p, (name, step) in enumerate(pupil_steps(mask, placement).items()):
        near = (replace(placement, **{name: getattr(placement, name) + by}) for by in (step, -step))
        ahead, behind = (openings(mask, other, whole=whole, pixel_um=pixel_um) for other in near)
        changes = [ahead.share - behind.share, ahead.x_um - behind.x_um, ahead.y_um - behind.y_um]
        widths = _width_places(ahead, mask) - _width_places(behind, mask)
        slopes[:, p] = np.column_stack([*changes, widths]) / (2 * step)
        # Middle and width of an opening that is shut mean nothing.
        slopes[np.minimum(ahead.share, behind.share) <= 0, p, 1:] = 0
    return slopes


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


class _Weights(NamedTuple):
    """The light of the views."""

    aperture: NDArray[np.float64]
    """(v, u): a_j of the placement."""
    opened: NDArray[np.float64]
    """(v, u): share of each view's cell that is open."""
    sums: NDArray[np.float64]
    """(kind, 3), over all views: light, light times u_um, light times v_um, see `_light_sum`.

    kind: of the light, of its derivative by falloff, and by the pupil's parameters if there are
    slopes."""


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
def _light_sum(rays, sums, x_um, y_um):
    """Return the light of all views on the pixel at (x, y), of the weights of `Shadow.light_sums`.

    sum_j a_j (1 + vignetting x.u_j)(1 + falloff |u_j|^2)
        = sum_j b_j + vignetting x . sum_j b_j u_j,    b_j = a_j (1 + falloff |u_j|^2)
    """
    lean = (x_um * sums[1] + y_um * sums[2]) / (rays.corner_um * rays.far_um)
    return sums[0] + rays.vignetting * lean


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
def _interpolate_shares(tables, start, width, part_of_width, shares):
    """Set shares (kind, cell) to those of a footprint from `start`, in cells; return its first.

    width, part_of_width: of the box, see `_Boxes`. shares may have kind WIDTH as well.
    """
    first = int(np.floor(start))
    steps = tables.shape[2] - 1
    place = (start - first) * steps
    below = min(int(place), steps - 1)
    part = place - below
    for kind in range(tables.shape[0]):
        for k in range(tables.shape[3]):
            above = part * tables[kind, width, below + 1, k]
            shares[kind, k] = (1 - part) * tables[kind, width, below, k] + above
    if part_of_width > 0:
        for kind in range(tables.shape[0]):
            for k in range(tables.shape[3]):
                above = part * tables[kind, width + 1, below + 1, k]
                wider = (1 - part) * tables[kind, width + 1, below, k] + above
                shares[kind, k] += part_of_width * (wider - shares[kind, k])
    if shares.shape[0] > WIDTH:
        lower = min(width, tables.shape[1] - 2)
        for k in range(tables.shape[3]):
            above = tables[0, lower + 1, below + 1, k] - tables[0, lower, below + 1, k]
            here = tables[0, lower + 1, below, k] - tables[0, lower, below, k]
            shares[WIDTH, k] = (1 - part) * here + part * above
    return first


@njit(forceinline=True)
def _sum_footprint(cells, top, left, channel, down, across):
    """Return what a footprint passes, sum of down x cells x across, and its derivatives.

    down, across: (kind, cell), of one kind where no derivatives are needed.
    """
    height, width = cells.shape[0], cells.shape[1]
    first, last = max(-left, 0), min(across.shape[1], width - left)
    passed, by_column, by_row, by_ratio, by_blur = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(max(-top, 0), min(down.shape[1], height - top)):
        # Sums in registers, not in an array: the kernel waits for nothing else so long.
        row, row_by_column, row_by_ratio, row_by_blur = 0.0, 0.0, 0.0, 0.0
        if across.shape[0] == 1:
            for b in range(first, last):
                row += cells[top + a, left + b, channel] * across[0, b]
            passed += down[0, a] * row
        else:
            for b in range(first, last):
                cell = cells[top + a, left + b, channel]
                row += cell * across[0, b]
                row_by_column += cell * across[1, b]
                row_by_ratio += cell * across[2, b]
                row_by_blur += cell * across[3, b]
            passed += down[0, a] * row
            by_column += down[0, a] * row_by_column
            by_row += down[1, a] * row
            by_ratio += down[0, a] * row_by_ratio + down[2, a] * row
            by_blur += down[0, a] * row_by_blur + down[3, a] * row
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


@njit(forceinline=True)
def _sum_widenings(cells, top, left, channel, down, across):
    """Return the derivatives of what a footprint passes by its box's width and height."""
    height, width = cells.shape[0], cells.shape[1]
    wider, higher = 0.0, 0.0
    for a in range(max(-top, 0), min(down.shape[1], height - top)):
        for b in range(max(-left, 0), min(across.shape[1], width - left)):
            cell = cells[top + a, left + b, channel]
            wider += cell * down[0, a] * across[WIDTH, b]
            higher += cell * down[WIDTH, a] * across[0, b]
    return wider, higher


@njit(forceinline=True)
def _add_pupil_slopes(slope, rays, of_box, by_share, by_x, by_y, by_width, by_height):
    """Add to slope (parameter,) the derivatives of one box's reading by the pupil's parameters.

    xi follows the box's middle by rho. of_box: (parameter, 5), see `_Boxes`. The others are the
    derivatives of the reading by the box's share, by xi, and by the box's sides.
    """
    for p in range(of_box.shape[0]):
        moved = rays.distance_share * (by_x * of_box[p, 1] + by_y * of_box[p, 2])
        sized = by_width * of_box[p, 3] + by_height * of_box[p, 4]
        slope[PUPIL_X + p] += by_share * of_box[p, 0] + moved + sized


@njit(cache=True, parallel=True, fastmath=True)
def _read(pixels, channels, cells, tables, turns, rays, boxes, weights, out):
    """Set out (see `_Seen`) to the readings of pixels (n, 2), and what it has rows for.

        reading = mean over the pixel's samples of  sum_k share_k (leak + (clear - leak) T_k)
        share_k = a_j open_k (1 + vignetting lean_j)(1 + falloff far_j) / total

    k: the boxes of open views, j the view of box k, total: over all views. channels: (n,). cells:
    (row, column, colour). tables: (kind, width, place, cell), of one kind where slopes has no rows,
    see `share_tables`. turns: see `_turns`. weights: see `_Weights`.
    """
    readings, slopes, each, by_view = out
    aperture, opened, sums = weights
    height, width = cells.shape[0], cells.shape[1]
    views_v, views_u = aperture.shape
    kinds, scalars = tables.shape[0], len(SCALARS)
    parts = rays.binning * rays.binning
    fitted = kinds > 1 and boxes.slopes.shape[0] > 0
    b = turns / rays.cell_um
    for n in prange(pixels.shape[0]):
        rows = WIDTH + 1 if fitted else kinds
        across, down = np.empty((rows, tables.shape[3])), np.empty((rows, tables.shape[3]))
        gradient = np.zeros(scalars + views_v * views_u)
        channel = channels[n]
        readings[n] = 0.0
        for sample in range(parts):
            y = pixels[n, 0] * rays.binning + sample // rays.binning
            x = pixels[n, 1] * rays.binning + sample % rays.binning
            y_um = _centred_um(y, rays.rows, rays.pitch_um)
            x_um = _centred_um(x, rays.columns, rays.pitch_um)
            square = (x_um * x_um + y_um * y_um) / rays.corner_um**2
            total = _light_sum(rays, sums[0], x_um, y_um)
            here = 0.0
            slope = np.zeros(scalars + views_v * views_u)
            for k in range(len(boxes.v)):
                v, u = boxes.v[k], boxes.u[k]
                v_um = _centred_um(v, views_v, rays.view_um)
                u_um = _centred_um(u, views_u, rays.view_um)
                box_u_um, box_v_um = u_um + boxes.x_um[k], v_um + boxes.y_um[k]
                point = _ray_on_mask(rays, x_um, y_um, box_u_um, box_v_um)
                column = b[0, 0, 0] * point.x_um + b[0, 0, 1] * point.y_um + width / 2
                row = b[0, 1, 0] * point.x_um + b[0, 1, 1] * point.y_um + height / 2
                left = _interpolate_shares(
                    tables, column - rays.reach, boxes.width[k, 0], boxes.part[k, 0], across
                )
                top = _interpolate_shares(
                    tables, row - rays.reach, boxes.width[k, 1], boxes.part[k, 1], down
                )
                passed = _sum_footprint(cells, top, left, channel, down, across)
                light = _light_factors(rays, x_um, y_um, u_um, v_um)
                share = aperture[v, u] * boxes.share[k] * light.leaning * light.falling / total
                through = rays.leak + (rays.clear - rays.leak) * passed.share
                view = v * views_u + u
                here += share * through
                if each.shape[0] > 0:
                    each[n, view] += share * through / parts
                if kinds == 1:
                    continue
                gain, by_x, by_y = _add_ray_slopes(
                    slope, rays, b, x_um, y_um, square, box_u_um, box_v_um, light, point, passed,
                    share,
                )  # fmt: skip
                slope[scalars + view] += share / aperture[v, u] * through
                if fitted:
                    wider, higher = _sum_widenings(cells, top, left, channel, down, across)
                    by_share = share / boxes.share[k] * through
                    _add_pupil_slopes(
                        slope, rays, boxes.slopes[k], by_share, by_x, by_y, gain * wider,
                        gain * higher,
                    )  # fmt: skip
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
                lean = (x_um * sums[0, 1] + y_um * sums[0, 2]) / (rays.corner_um * rays.far_um)
                slope[VIGNETTING] -= here * lean / total
                slope[FALLOFF] -= here * _light_sum(rays, sums[1], x_um, y_um) / total
                for p in range(2, sums.shape[0]):
                    light_by = _light_sum(rays, sums[p], x_um, y_um)
                    slope[PUPIL_X + p - 2] -= here * light_by / total
                for v in range(views_v):
                    for u in range(views_u):
                        u_um = _centred_um(u, views_u, rays.view_um)
                        v_um = _centred_um(v, views_v, rays.view_um)
                        light = _light_factors(rays, x_um, y_um, u_um, v_um)
                        by_weight = opened[v, u] * light.leaning * light.falling / total
                        slope[scalars + v * views_u + u] -= here * by_weight
                for p in range(len(gradient)):
                    gradient[p] += slope[p] / parts
        if kinds > 1:
            slopes[n, :] = gradient


@njit(cache=True, parallel=True)
def _find_footprints(pixels, cells, tables, turns, rays, boxes, weights, out):
    """Set out to what `Shadow.footprints` returns of pixels (n, 2) and the boxes of open views."""
    corners, shares, light_shares = out
    aperture, _, sums = weights
    views_v, views_u = aperture.shape
    for n in prange(len(pixels)):
        y_um = _centred_um(pixels[n, 0], rays.rows, rays.pitch_um)
        x_um = _centred_um(pixels[n, 1], rays.columns, rays.pitch_um)
        total = _light_sum(rays, sums[0], x_um, y_um)
        found = np.empty((1, tables.shape[3]))
        for k in range(len(boxes.v)):
            v, u = boxes.v[k], boxes.u[k]
            v_um = _centred_um(v, views_v, rays.view_um)
            u_um = _centred_um(u, views_u, rays.view_um)
            point = _ray_on_mask(rays, x_um, y_um, u_um + boxes.x_um[k], v_um + boxes.y_um[k])
            for axis in range(2):
                turn = turns[0, 1 - axis] / rays.cell_um
                middle = turn[0] * point.x_um + turn[1] * point.y_um + cells.shape[axis] / 2
                width, part = boxes.width[k, 1 - axis], boxes.part[k, 1 - axis]
                corners[n, k, axis] = _interpolate_shares(
                    tables, middle - rays.reach, width, part, found
                )
                shares[axis, n, k] = found[0]
            light = _light_factors(rays, x_um, y_um, u_um, v_um)
            weight = aperture[v, u] * boxes.share[k]
            light_shares[n, k] = weight * light.leaning * light.falling / total


@dataclass(eq=False)
class _Part:
    """The pixels about a knot, and the openings that they see; of a lens without a rim, all."""

    knot: Knot
    openings: Openings
    boxes: _Boxes
    weights: _Weights

    def counts(self, pixels: Pixels) -> NDArray[np.float64]:
        """Return how much the part counts at each pixel, (n,)."""
        count = np.ones(len(pixels))
        along = (self.knot.rows, self.knot.down), (self.knot.columns, self.knot.across)
        for axis, (near, counts) in enumerate(along):
            start = near.start or 0
            inside = (pixels[:, axis] >= start) & (pixels[:, axis] < start + len(counts))
            place = np.where(inside, pixels[:, axis] - start, 0)
            count *= np.where(inside, counts[place], 0.0)
        return count


class Shadow:
    """The shadow of one placement: readings and derivatives of any pixels.

    All take pixels (n, 2), row and column, and the colour that each sees, (n,), or ANY_COLOUR;
    views_open (v, u), where the mask stands, x and y in um, and the frame of the pattern.
    """

    def __init__(self, mask: ShadowMask, placement: Placement) -> None:
        self.mask, self.placement = mask, placement
        # A pupil whose slopes are asked for may cut a view that it leaves whole now.
        self._widths = 1 if placement.pupil is None else CUT_WIDTHS
        self._tables, self._reach = share_tables(mask, placement, 1, self._widths)
        self._turns = _turns(placement)
        span = np.array([(count - 1) / 2 * mask.aperture_cell_um for count in mask.views])
        self._far_um = max(float(np.hypot(*span)), 1.0)
        rows, columns = mask.pixel_shape()
        pixel_um = mask.pitch_um * mask.binning
        pixels_um = centred_grid(rows, pixel_um), centred_grid(columns, pixel_um)
        # Knots of the pupil as described: a fit must not jump by more of them.
        knots = field_knots(placement.pupil, mask.aperture_cell_um, pixels_um)
        self._parts = [self._part(knot) for knot in knots]

    def _part(self, knot: Knot) -> _Part:
        """Return boxes and light of the views as a knot sees them."""
        found = openings(self.mask, self.placement, pixel_um=(knot.x_um, knot.y_um))
        none = np.zeros((0, len(PUPIL_PARAMETERS), len(OF_BOX)))
        boxes = _boxes_of(found, self.mask, self._widths, none)
        return _Part(knot, found, boxes, self._light(found, none))

    def _with_slopes(self, part: _Part) -> _Part:
        """Return a part with slopes by the pupil's parameters."""
        place, found = (part.knot.x_um, part.knot.y_um), part.openings
        slopes = _pupil_slopes(self.mask, self.placement, found, place)
        boxes = _boxes_of(found, self.mask, self._widths, slopes)
        return replace(part, boxes=boxes, weights=self._light(found, slopes))

    def _light(self, found: Openings, slopes: NDArray[np.float64]) -> _Weights:
        """Return the light of the views; slopes: see `_Boxes`."""
        aperture = np.array(self.placement.aperture, dtype=np.float64)
        opened = found.shares(self.mask.views)
        by_pupil = np.zeros((len(PUPIL_PARAMETERS), *self.mask.views))
        for p in range(len(by_pupil) if len(slopes) else 0):
            np.add.at(by_pupil[p], tuple(found.view.T), slopes[:, p, 0])
        rows, columns = self.mask.views
        v_um = centred_grid(rows, self.mask.aperture_cell_um)[:, None]
        u_um = centred_grid(columns, self.mask.aperture_cell_um)[None, :]
        far = (u_um**2 + v_um**2) / self._far_um**2
        falling = 1 + self.placement.falloff * far
        light = [aperture * opened * falling, aperture * opened * far]
        if len(slopes):
            light += [aperture * change * falling for change in by_pupil]
        sums = [[part.sum(), (part * u_um).sum(), (part * v_um).sum()] for part in light]
        return _Weights(aperture, opened, np.array(sums))

    def _middle(self) -> _Part:
        """Return the part of the picture's middle."""
        return min(self._parts, key=lambda part: np.hypot(part.knot.x_um, part.knot.y_um))

    @property
    def opened(self) -> NDArray[np.float64]:
        """The share of every view's cell that the pupil leaves open, (v, u).

        Of a lens with a rim, seen from about the middle of the picture.
        """
        return self._middle().weights.opened

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

    def with_widening(
        self,
        pixels: Pixels,
        channels: NDArray[np.uint8],
        views_open: NDArray[np.bool_],
        stage_um: tuple[float, float] = (0.0, 0.0),
        frame: int = 0,
        *,
        sides: Sequence[float] | NDArray[np.float64] = (0.0, 0.0),
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return `with_slopes` through boxes of other sides, and derivatives by these, (n, 2).

        sides: relative width and height more than the boxes have, at the same light. Of more, what
        is read is known to first order.
        """
        narrower, wider = np.minimum(sides, 0.0), np.maximum(sides, 0.0)
        how = pixels, channels, (views_open, stage_um, frame)
        sized = self._run(*how, slopes=True, narrower=narrower)
        by_sides = sized.slopes[:, PUPIL_X : PUPIL_X + 2].copy()
        slopes = sized.slopes
        if self.placement.pupil is None:
            slopes[:, PUPIL_X : PUPIL_X + 2] = 0
        else:
            slopes = self.with_slopes(pixels, channels, views_open, stage_um, frame)[1]
        return sized.readings + by_sides @ wider, slopes, by_sides

    def _sized(self, part: _Part, sides: NDArray[np.float64]) -> _Part:
        """Return a part whose slopes by the pupil's first two parameters are those by the sides."""
        scale = np.maximum(1 + sides, NARROWEST)
        found = part.openings
        cut = replace(
            found, width_um=found.width_um * scale[0], height_um=found.height_um * scale[1]
        )
        places = _width_places(cut, self.mask)
        slopes = np.zeros((len(places), len(PUPIL_PARAMETERS), len(OF_BOX)))
        for axis, side in enumerate(("width", "height")):
            slopes[:, axis, OF_BOX.index(side)] = 2 * places[:, axis] / scale[axis]
        boxes = _boxes_of(cut, self.mask, CUT_WIDTHS, slopes)
        weights = part.weights._replace(sums=part.weights.sums[:2].copy())
        return replace(part, boxes=boxes, weights=weights)

    @cached_property
    def _wide_tables(self) -> NDArray[np.float64]:
        """The tables of boxes of every width."""
        return share_tables(self.mask, self.placement, KINDS, CUT_WIDTHS)[0]

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
        """Return where the footprints of pixels (n, 2) lie on the mask, by boxes of open views.

        Corners (n, box, 2), the first row and column of cells; shares of the cells from there down
        and across, (n, box, cell) each; and what each box counts in the reading (n, box). A whole
        view is one box. Pixels must be samples (binning 1). Behind a rim all see what the middle of
        the picture sees.
        """
        if self.mask.binning != 1:
            raise CalibrationError(
                "defects are sought only where a pixel is one sample (binning 1)"
            )
        middle = self._middle()
        boxes = middle.boxes.of_views(views_open)
        shape, tables = (len(pixels), len(boxes.v)), self._tables[:1]
        corners = np.empty((*shape, 2), dtype=np.int64)
        shares, light_shares = np.empty((2, *shape, tables.shape[3])), np.empty(shape)
        cells, rays = self.mask.cells[0], self._rays(stage_um)
        out = corners, shares, light_shares
        _find_footprints(pixels, cells, tables, self._turns, rays, boxes, middle.weights, out)
        return corners, shares[0], shares[1], light_shares

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
        narrower: NDArray[np.float64] | None = None,
    ) -> _Seen:
        """Return the readings and what is asked for; by_view needs slopes; narrower: `_sized`."""
        if slopes and narrower is None and len(self._tables) == 1:
            self._tables = share_tables(self.mask, self.placement, KINDS, self._widths)[0]
            self._parts = [self._with_slopes(part) for part in self._parts]
        views = self.mask.views[0] * self.mask.views[1]

        def rows(count: int) -> _Seen:
            return _Seen(
                np.empty(count),
                np.empty((slopes * count, len(SCALARS) + views)),
                np.zeros((each * count, views)),
                np.zeros((by_view * count, views, OF_VIEW)),
            )

        def read(part: _Part, pixels: Pixels, channels: NDArray[np.uint8], out: _Seen) -> None:
            views_open, stage_um, frame = opening
            tables = self._tables
            if narrower is not None:
                part, tables = self._sized(part, narrower), self._wide_tables
            _read(
                np.ascontiguousarray(pixels, dtype=np.int64),
                np.ascontiguousarray(channels, dtype=np.uint8),
                self.mask.cells[frame % len(self.mask.cells)],
                tables if slopes else tables[:1],
                self._turns,
                self._rays(stage_um),
                part.boxes.of_views(np.asarray(views_open, dtype=bool)),
                part.weights,
                out,
            )

        seen = rows(len(pixels))
        if len(self._parts) == 1:
            read(self._parts[0], pixels, channels, seen)
            return seen
        for values in seen:
            values[...] = 0
        for part in self._parts:
            counts = part.counts(pixels)
            near = np.flatnonzero(counts)
            if len(near):
                out = rows(len(near))
                read(part, pixels[near], channels[near], out)
                for values, found in zip(seen, out, strict=True):
                    if len(values):
                        shape = (-1,) + (1,) * (values.ndim - 1)
                        values[near] += counts[near].reshape(shape) * found
        return seen
