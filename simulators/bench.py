"""The simulated bench: what the camera's sensor reads, ray by ray, where everything really stands.

This is an independent account of the physics in `emmc_rig.model.camera`: it follows single rays
from points inside every pixel to points inside every aperture cell, looks each mask up where the
ray meets it (misplaced, turned and stretched by errors unknown to the program), and takes the light
from a scene sampled finer than the light field that will be reconstructed. Nothing here uses the
imaging matrix, so that no reconstruction is tested on data made by the operator it inverts.

Source: paper, eq. 2, 4 and 5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from emmc_rig.model.bands import row_kernel
from emmc_rig.model.camera import Camera, draw_plates, pixel_light, sensor_response
from emmc_rig.model.compiling import njit
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.pupil import Pupil
from emmc_rig.simulators.flaws import (
    EVEN_BOARD,
    PERFECT_OPTICS,
    PERFECT_SENSOR,
    STEADY_LAMP,
    BoardFlaws,
    LampFlaws,
    OpticsFlaws,
    SensorFlaws,
)
from emmc_rig.simulators.sobol import sobol_points

Array = NDArray[np.floating]
LAMPS = {
    "off": (0.0, 0.0, 0.0),
    "white": (1.0, 1.0, 1.0),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}
RAYS_PER_VIEW = 128
WINDOW_MARGIN = 0.05
MORE_RAYS = 16
"""Points tried for each ray inside a pupil, at least 4096: open shares are right to 0.1 %."""
FOCUS_PX_PER_UM = 0.01
"""Samples by which the scene moves from view to view for each um that the lens is out of focus."""
KEPT_BYTES = 64_000_000
"""Of readings already traced: the standings of a small bench's whole calibration."""


@dataclass(frozen=True)
class MountingErrors:
    """The true placement and look of the masks, unknown to the program.

    skew: tangent of the angle by which a mask's columns lean. distance_share: relative error of
    their distance. distortion_um: third-order radial displacement of the rays at the corner of
    the picture. edge_blur_um: standard deviation of the mask's edges. tilt_deg: of the mask's
    plane, by which its distance grows with x and with y. bow_um: by which the mask is farther from
    the sensor at the corner of the picture than in the middle. substrate_um: thickness of its
    glass, of index `refractive_index`: positive between pattern and sensor, negative on the lens'
    side.
    """

    offset_um: tuple[float, float] = (6.5, -4.0)
    rotation_deg: float = 0.03
    stretch: float = 1.0004
    skew: float = 0.0
    distance_share: float = 0.0
    distortion_um: float = 0.0
    edge_blur_um: float = 0.0
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    bow_um: float = 0.0
    substrate_um: float = 0.0
    refractive_index: float = 1.52


NO_ERRORS = MountingErrors((0.0, 0.0), 0.0, 1.0)


class MaskRow(NamedTuple):
    """A mask as `trace` reads it: a row of its `plates`.

    Cells of the mask, from its middle: column = column_per_x x + column_per_y y, and rows alike,
    for x and y in um on the mask. The rays of sensor point s are displaced by bend_per_um2 s^2 s.
    The mask lies at distance_um + slope . (x, y) + sag (x^2 + y^2).
    """

    distance_um: float
    x_um: float
    y_um: float
    column_per_x: float
    column_per_y: float
    row_per_x: float
    row_per_y: float
    bend_per_um2: float
    edge_um: float
    slope_x: float
    slope_y: float
    sag_per_um: float
    glass_um: float
    index: float


def ray_points(views: tuple[int, int], count: int, axes: int = 4) -> NDArray[np.float64]:
    """Return where the rays of every view start in a pixel and an aperture cell, in [0, 1).

    Sobol points, scrambled differently for every view: (v, u, count, axes), the last axis x, y,
    u, v, and with six axes where in the blur of an edge.
    """
    rngs = [np.random.default_rng(view) for view in range(views[0] * views[1])]
    points = [sobol_points(count, axes, rng) for rng in rngs]
    return np.reshape(points, (*views, count, axes))


def lens_points_um(points: Array, cell_um: float, fill: float) -> Array:
    """Return where the rays of `ray_points` meet the lens, x and y from its axis: (v, u, ray, 2).

    fill: the open share of the side of an aperture cell.
    """
    y_um, x_um = (centred_grid(count, cell_um) for count in points.shape[:2])
    cells_um = np.stack(np.meshgrid(x_um, y_um), axis=-1)
    return cells_um[:, :, np.newaxis] + fill * cell_um * (points[..., 2:4] - 0.5)


def _passes(lens_um: Array, openings_um: Array) -> NDArray[np.bool_]:
    """Return which rays the plate lets through; openings (opening, 3): x, y, half side."""
    passes = np.zeros(lens_um.shape[:-1], dtype=bool)
    for opening in openings_um:
        passes |= (np.abs(lens_um - opening[:2]) <= opening[2]).all(axis=-1)
    return passes


def inside_pupil(lens_um: Array, pupil: Pupil) -> NDArray[np.bool_]:
    """Return which points of the lens, (..., 2), x and y from its axis, the stop leaves open.

    The rim, which moves with the pixel, cuts the rays in `trace`.
    """
    x, y = np.moveaxis(lens_um / 1e3 - np.array(pupil.centre_mm), -1, 0)
    if pupil.shape == "round":
        return x**2 + y**2 <= (pupil.diameter_mm / 2) ** 2
    turn = np.deg2rad(pupil.turn_deg)
    x, y = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    if pupil.shape == "square":
        return np.maximum(np.abs(x), np.abs(y)) <= pupil.diameter_mm / 2
    corners = np.arange(pupil.blades + 1) * 2 * np.pi / pupil.blades
    at_x, at_y = (pupil.diameter_mm / 2 * of(corners) for of in (np.cos, np.sin))
    # Inside a convex polygon a point lies to the left of every side from corner to corner.
    left = [
        (at_x[k + 1] - at_x[k]) * (y - at_y[k]) >= (at_y[k + 1] - at_y[k]) * (x - at_x[k])
        for k in range(pupil.blades)
    ]
    return np.all(left, axis=0)


def rays_inside(
    camera: Camera, pupil: Pupil, count: int, axes: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `ray_points` that lie inside the pupil, and which share of every view is open, (v, u).

    Of MORE_RAYS times as many points, the first that are inside; of a view that is wholly outside
    the share is 0. A view's light would be as grainy as its few rays, were rays merely stopped.
    """
    tried = max(MORE_RAYS * count, 4096)
    every = ray_points(camera.views, tried, axes)
    lens = camera.lens
    inside = inside_pupil(lens_points_um(every, lens.aperture_cell_um, lens.aperture_fill), pupil)
    points = np.empty((*camera.views, count, axes))
    for view in np.ndindex(camera.views):
        found = np.flatnonzero(inside[view])
        points[view] = every[view][np.resize(found, count) if len(found) else slice(count)]
    return points, inside.mean(axis=-1)


@njit(forceinline=True, fastmath=True)
def _met(x, y, u, v, lens_um, distance_um, slope_x, slope_y, sag, glass_um, index):
    """Return where the ray from sensor point (x, y) to lens point (u, v) meets a mask.

    The mask lies at distance_um + slope . (x, y) + sag (x^2 + y^2); its glass refracts by Snell's
    law. Found by fixed point iteration: each step is better by the slopes, below 1e-2.
    """
    thickness = abs(glass_um)
    reduced = lens_um - thickness + thickness / index
    to_x, to_y = (u - x) / reduced, (v - y) / reduced
    at_x, at_y = x, y
    for _ in range(4):
        squared = to_x * to_x + to_y * to_y
        inside = 1 / np.sqrt(index * index * (1 + squared) - squared)
        length = lens_um - thickness + thickness * inside
        to_x, to_y = (u - x) / length, (v - y) / length
        z = distance_um + slope_x * at_x + slope_y * at_y + sag * (at_x * at_x + at_y * at_y)
        way = z if glass_um <= 0 else z - thickness + thickness * inside
        at_x, at_y = x + to_x * way, y + to_y * way
    return at_x, at_y


@njit(forceinline=True, fastmath=True)
def _place(column, row, start, height, width):
    """Return which of all cells lies there on a mask whose first is `start`; 0 beside the mask."""
    j, i = int(np.floor(column)), int(np.floor(row))
    beside = (i < 0) | (j < 0) | (i >= height) | (j >= width)
    return 0 if beside else start + i * width + j


@njit(forceinline=True, fastmath=True)
def _find_cells(
    place, plate, start, shape, first_x, ray_y, ray_u, ray_v, blur_x, blur_y, lens_um, pitch_um
):
    """Set place (x) to the cell that the ray of every pixel of a row meets on a mask.

    plate: a `MaskRow`. first_x, ray_y: sensor point of the first pixel's ray, in um; ray_u, ray_v:
    the lens point of all. blur_x, blur_y: shift of the mask's edges, in standard deviations. A
    thin, flat, undistorted mask is met at distance d in x + d / lens (u - x), linear in x.
    """
    distance_um, x_um, y_um = plate[:3]
    column_x, column_y, row_x, row_y = plate[3:7]
    bend, edge_um, slope_x, slope_y, sag, glass_um, index = plate[7:]
    ratio = distance_um / lens_um
    at_x = (1 - ratio) * first_x + ratio * ray_u - x_um + edge_um * blur_x
    at_y = (1 - ratio) * ray_y + ratio * ray_v - y_um + edge_um * blur_y
    height, width = shape
    column = column_x * at_x + column_y * at_y + width / 2
    row = row_x * at_x + row_y * at_y + height / 2
    along = (1 - ratio) * pitch_um * column_x
    across = (1 - ratio) * pitch_um * row_x
    flat = slope_x == 0 and slope_y == 0 and sag == 0 and glass_um == 0
    if flat and bend == 0:
        for x in range(place.size):
            place[x] = _place(column + along * x, row + across * x, start, height, width)
        return
    for x in range(place.size):
        to_column, to_row = column + along * x, row + across * x
        ray_x = first_x + x * pitch_um
        if not flat:
            met_x, met_y = _met(
                ray_x, ray_y, ray_u, ray_v,
                lens_um, distance_um, slope_x, slope_y, sag, glass_um, index,
            )  # fmt: skip
            more_x = met_x - ((1 - ratio) * ray_x + ratio * ray_u)
            more_y = met_y - ((1 - ratio) * ray_y + ratio * ray_v)
            to_column += column_x * more_x + column_y * more_y
            to_row += row_x * more_x + row_y * more_y
        cubed = bend * (ray_x * ray_x + ray_y * ray_y)
        to_column += cubed * (column_x * ray_x + column_y * ray_y)
        to_row += cubed * (row_x * ray_x + row_y * ray_y)
        place[x] = _place(to_column, to_row, start, height, width)


@row_kernel("readings", 0, fastmath=True)
def trace(
    begin,
    end,
    scene,
    finer,
    response,
    lamp,
    points,
    at_lens_um,
    passes,
    lengths_um,
    cells,
    starts,
    shapes,
    plates,
    rim,
    falloff,
    readings,
):
    """Set readings (y, x), per sample, to the mean over rays of lamp x masks x scene x response.

    scene: (v f, u f, y g, x g, colour) with finer = (f, g); or 1 x 1 x 1 x 1 x 3 for a whiteboard.
    points: (v, u, ray, 4). at_lens_um: (v, u, ray, 2), where the rays meet the lens, x and y.
    passes: (v, u, ray), whether the plate lets them through. rim: radius of the pupil's rim in um,
    0: none, and by how many um it moves with each um of the pixel. lengths_um: lens distance,
    sample pitch, sample width. cells: (1 + all cells, colour), the first opaque; starts, shapes:
    where each mask lies in it, (rows, columns). plates: a `MaskRow` for each mask. falloff:
    (v, u, y, x), or all 1.
    points: (v, u, ray, 4 or 6), 6 where edges are blurred: the last two are normal.
    """
    rows, columns = readings.shape
    views_v, views_u, count = points.shape[0], points.shape[1], points.shape[2]
    lens_um, pitch_um, width_um = lengths_um
    board = scene.shape[2] == 1
    f, g = finer
    even = falloff.shape[3] == 1
    passed = np.empty((3, columns), np.float32)
    weight = np.empty((3, columns), np.float32)
    place = np.empty(columns, np.int64)
    total = np.zeros(columns)
    seen = np.zeros(columns)
    for y in range(begin, end):
        seen[:] = 0
        for c in range(3):
            for x in range(columns):
                weight[c, x] = response[y, x, c]
        for v in range(views_v):
            for u in range(views_u):
                if not passes[v, u].any():
                    continue
                total[:] = 0
                for ray in range(count):
                    if not passes[v, u, ray]:
                        continue
                    in_x, in_y, in_u, in_v = points[v, u, ray, :4]
                    ray_u, ray_v = at_lens_um[v, u, ray]
                    blur_x = points[v, u, ray, 4] if points.shape[3] == 6 else 0.0
                    blur_y = points[v, u, ray, 5] if points.shape[3] == 6 else 0.0
                    first_x = -(columns - 1) / 2 * pitch_um + (in_x - 0.5) * width_um
                    ray_y = (y - (rows - 1) / 2) * pitch_um + (in_y - 0.5) * width_um
                    for c in range(3):
                        passed[c, :] = lamp[c]
                    if rim[0] > 0:
                        away_v = ray_v - rim[1] * ray_y
                        for x in range(columns):
                            away_u = ray_u - rim[1] * (first_x + x * pitch_um)
                            if away_u * away_u + away_v * away_v > rim[0] * rim[0]:
                                passed[:, x] = 0
                    for mask in range(plates.shape[0]):
                        _find_cells(
                            place, plates[mask], starts[mask], shapes[mask],
                            first_x, ray_y, ray_u, ray_v, blur_x, blur_y, lens_um, pitch_um,
                        )  # fmt: skip
                        for c in range(3):
                            for x in range(columns):
                                passed[c, x] *= cells[place[x], c]
                    fine_v, fine_u = v * f + int(in_v * f), u * f + int(in_u * f)
                    fine_y, fine_x = y * g + int(in_y * g), int(in_x * g)
                    for c in range(3):
                        if board:
                            for x in range(columns):
                                total[x] += passed[c, x] * weight[c, x]
                        else:
                            line = scene[fine_v, fine_u, fine_y]
                            for x in range(columns):
                                total[x] += passed[c, x] * weight[c, x] * line[fine_x + x * g, c]
                for x in range(columns):
                    share = falloff[0, 0, 0, 0] if even else falloff[v, u, y, x]
                    seen[x] += share * total[x]
        for x in range(columns):
            readings[y, x] = seen[x] / (count * views_v * views_u)


def window_side_um(views: tuple[int, int], cell_um: float) -> float:
    """Return the side of the plate's window: a little larger than the aperture."""
    return max(views) * cell_um * (1 + WINDOW_MARGIN)


class Bench:
    """Scene or whiteboard, lamp, masks, pinhole plate and sensor of a camera, as they really are.

    scene: (v f, u f, y g, x g, 3) for a light field of (v, u, y, x) samples; f may be 1. For a
        moving scene, a function that returns this array at a time in seconds: a frame shows the
        scene at the begin of the exposure, without motion blur.
    positions_um: asks where the stages really are; keys mask_x, mask_y (0: masks centred on the
        axis), aperture_x, aperture_y (0: the pinhole on the axis), and focus (0: as the scene is),
        where there is such an axis.
    window_um: the stage's x that brings the plate's window, as large as the aperture, onto the
        axis; but for it and the pinhole of one aperture cell the plate is opaque.
    """

    def __init__(
        self,
        camera: Camera,
        scene: NDArray[np.float32] | Callable[[float], NDArray[np.float32]],
        size: tuple[int, int],
        positions_um: Callable[[], Mapping[str, float]],
        window_um: float,
        rng: np.random.Generator,
        errors: MountingErrors | None = None,
        rays_per_view: int = RAYS_PER_VIEW,
        optics: OpticsFlaws = PERFECT_OPTICS,
        sensor: SensorFlaws = PERFECT_SENSOR,
        board: BoardFlaws = EVEN_BOARD,
        lamp: LampFlaws = STEADY_LAMP,
        seconds: Callable[[], float] = lambda: 0.0,
    ) -> None:
        views = camera.views
        self._scene_at = scene if callable(scene) else None
        if callable(scene):
            scene = scene(0.0)
        finer = (scene.shape[0] // views[0], scene.shape[2] // size[0])
        expected = (*(count * finer[0] for count in views), *(count * finer[1] for count in size))
        if scene.shape != (*expected, 3):
            raise ValueError(f"a scene of shape {scene.shape} is no finer grid of {views} x {size}")
        self.lamp = "off"
        self.target = "scene"
        self.shot = 0
        self.masks_in = True
        self.board_turn_deg = 0.0
        self._began_s = 0.0
        self.camera, self._scene, self._size, self._finer = camera, scene, size, finer
        self.positions_um, self.window_um, self.rng = positions_um, window_um, rng
        self._errors = MountingErrors() if errors is None else errors
        self._sensor, self._board, self._lamp, self._seconds = sensor, board, lamp, seconds
        axes = 4 if self._errors.edge_blur_um == 0 else 6
        lens = camera.lens
        pupil, open_shares = optics.pupil or lens.pupil, np.ones(views)
        if pupil is None:
            self._points = ray_points(views, rays_per_view, axes)
        else:
            self._points, open_shares = rays_inside(camera, pupil, rays_per_view, axes)
        self._points[..., 4:] = ndtri(self._points[..., 4:])
        self._at_lens_um = lens_points_um(self._points, lens.aperture_cell_um, lens.aperture_fill)
        self._rim = np.zeros(2)
        if pupil is not None and pupil.rim is not None:
            self._rim = np.array([pupil.rim.diameter_mm * 500, pupil.rim.shift])
        lengths_um = (lens.distance_mm * 1e3, camera.sensor.sample_pitch_um, lens.aperture_cell_um)
        self._optics = optics
        self._hole_areas = optics.hole_areas(views)
        self._falloff = optics.falloff(size, views, lengths_um)
        if (open_shares < 1).any():
            everywhere = np.ones((1, 1, *size), np.float32)
            of_views = open_shares[:, :, np.newaxis, np.newaxis].astype(np.float32)
            self._falloff = self._falloff * of_views * everywhere
        self._plates = {
            name: [
                (plate, *optics.soiled(frame, plate.cell_um, plate.distance_mm * 1e3))
                for frame in plate.cells
            ]
            for name, plate in draw_plates(camera, size).items()
        }
        response = sensor_response(camera, size)
        self._response = sensor.mixed(response) if sensor.crosstalk else response
        self._light = pixel_light(camera, size)
        self._seen: dict[tuple, Array] = {}

    def set_lamp(self, colour: str) -> None:
        """Switch the lamp to a colour of LAMPS."""
        self.lamp = colour

    def readings(self) -> Array:
        """Return the noise-free readings (pixel_y, pixel_x) of the bench as it now stands."""
        levels = np.array(LAMPS[self.lamp]) * self._lamp.levels(self._seconds())
        lit = levels[levels > 0]
        if lit.size == 0:
            return np.zeros(self._light.shape[1:])
        if lit.min() == lit.max():
            return levels.max() * self._lit(LAMPS[self.lamp])
        return np.sum([levels[c] * self._lit(tuple(np.eye(3)[c])) for c in range(3)], axis=0)

    def _lit(self, lamp: tuple[float, ...]) -> Array:
        """Return the readings under a lamp of this level in red, green and blue."""
        at_um = self._optics.moved(self.positions_um(), self._seconds())
        state = (lamp, self.target, self.shot, self.masks_in, self.board_turn_deg, *at_um.values())
        if self._scene_at is not None and self.target == "scene":
            self._scene = self._scene_at(self._began_s)
            state = (*state, self._began_s)
        if state not in self._seen:
            if sum(readings.nbytes for readings in self._seen.values()) > KEPT_BYTES:
                self._seen.clear()
            self._seen[state] = self._pixels(self._traced(at_um, lamp))
        return self._seen[state]

    def _focused(self, offset_um: float) -> NDArray[np.float32]:
        """Return the scene with the lens so far from focus: its views moved against each other."""
        if offset_um == 0:
            return self._scene
        f, g = self._finer
        step_px = FOCUS_PX_PER_UM * offset_um * g / f
        moved = np.empty_like(self._scene)
        middle = (np.array(self._scene.shape[:2]) - 1) / 2
        for v, u in np.ndindex(self._scene.shape[:2]):
            by_y, by_x = step_px * (np.array([v, u]) - middle)
            matrix = np.array([[1.0, 0.0, by_x], [0.0, 1.0, by_y]])
            moved[v, u] = cv2.warpAffine(
                self._scene[v, u],
                matrix,
                self._scene.shape[3:1:-1],
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
        return moved

    def _pixels(self, samples: Array) -> Array:
        k = self.camera.sensor.binning
        rows, columns = self._size[0] // k, self._size[1] // k
        return samples.reshape(rows, k, columns, k).mean(axis=(1, 3))

    def true_psi(self, shot: int) -> NDArray[np.float32]:
        """Return every coefficient of Psi of one shot, (v, u, y, colour, x), by integration.

        Each is the mean over the rays between its pixel and its aperture cell of what masks, lens
        and sensor pass of one colour, over what the open camera without masks passes of all.
        Frames, lamp and whiteboard do not enter. Masks stand where the stages are.
        """
        camera, size = self.camera, self._size
        k = camera.sensor.binning
        at_um = self.positions_um()
        standing = self.shot, self.masks_in
        psi = np.empty((*camera.views, size[0], 3, size[1]), np.float32)
        try:
            self.shot, self.masks_in = shot, False
            whole = self._pixels(self._traced(at_um, LAMPS["white"], "all"))
            share = 1 / (k**2 * whole).repeat(k, axis=0).repeat(k, axis=1)
            self.masks_in = True
            for v, u in np.ndindex(camera.views):
                for colour in range(3):
                    lamp = tuple(np.eye(3)[colour])
                    psi[v, u, :, colour] = self._traced(at_um, lamp, (v, u)) * share
        finally:
            self.shot, self.masks_in = standing
        return psi

    def expose(self, exposure_s: float, began_s: float | None = None) -> NDArray[np.uint16]:
        """Return one noisy frame (pixel_y, pixel_x) in DN.

        began_s: when its exposure began; by default it is over just now.
        """
        self._began_s = self._seconds() - exposure_s if began_s is None else began_s
        noise, light = self.camera.sensor.noise, self._light[self.shot]
        if self._sensor is PERFECT_SENSOR:
            return noise.expose_dn(self.readings(), exposure_s, light, self.rng)
        seconds = self._seconds()
        return self._sensor.expose_dn(noise, self.readings(), exposure_s, light, self.rng, seconds)

    def light(self, shot: int) -> NDArray[np.float32]:
        """Return how much light each pixel collects in a shot, (pixel_y, pixel_x)."""
        return self._light[shot]

    def _traced(
        self,
        at_um: Mapping[str, float],
        lamp: tuple[float, ...],
        cell: tuple[int, int] | Literal["all"] | None = None,
    ) -> Array:
        """Return `_trace` with the lens's glare, which every colour has of its own light."""
        optics, response = self._optics, self._response[self.shot]
        if not (optics.glare or optics.glare_after):
            return self._trace(at_um, lamp, cell)
        response = response / np.maximum(response.sum(axis=-1, keepdims=True), 1)
        colours = [tuple(level * np.eye(3)[c]) for c, level in enumerate(lamp)]
        return np.sum(
            [
                optics.with_glare(self._trace(at_um, colours[c], cell), response[..., c])
                for c in range(3)
            ],
            axis=0,
        )

    def _trace(
        self,
        at_um: Mapping[str, float],
        lamp: tuple[float, ...],
        cell: tuple[int, int] | Literal["all"] | None = None,
    ) -> Array:
        """Return the readings of samples (y, x), through the aperture plate.

        cell: (v, u), without plate and target: a constant light field through this aperture cell.
        """
        camera = self.camera
        lens, sensor = camera.lens, camera.sensor
        names = camera.shot_masks(self.shot) if self.masks_in else ()
        cells, starts, shapes, plates = [np.zeros((1, 3), np.float32)], [], [], []
        for name in names:
            frames = self._plates[name]
            plate, frame, grain_um = frames[self.shot % len(frames)]
            starts.append(sum(len(part) for part in cells))
            shapes.append(frame.shape[:2])
            cells.append(frame.reshape(-1, 3))
            at_lens = plate.distance_mm >= lens.distance_mm
            moved = (
                (at_um["mask_x"], at_um["mask_y"]) if name in camera.moving_masks else (0.0, 0.0)
            )
            errors = NO_ERRORS if at_lens else self._errors
            plates.append(self._mask_row(errors, plate.distance_mm, grain_um, moved))
        board = self.target == "whiteboard" or cell is not None
        scene = (
            np.ones((1, 1, 1, 1, 3), np.float32)
            if board
            else self._focused(at_um.get("focus", 0.0) + at_um.get("lens", 0.0))
        )
        response = self._response[self.shot]
        seen = np.maximum(response.sum(axis=-1, keepdims=True), 1)
        samples = np.empty(self._size)
        falloff = self._falloff
        if cell is None and self.target == "whiteboard" and self._board is not EVEN_BOARD:
            turn_deg = self.board_turn_deg
            falloff = falloff * self._board.radiance(self._size, camera.views, turn_deg)
        openings = self._openings(at_um["aperture_x"], at_um["aperture_y"])
        if cell is not None:
            openings = self._cell(cell)
        trace(
            scene,
            self._finer,
            (response / seen).astype(np.float32),
            np.array(lamp),
            self._points,
            self._at_lens_um,
            _passes(self._at_lens_um, openings),
            (
                lens.distance_mm * 1e3 + at_um.get("lens", 0.0),
                sensor.sample_pitch_um,
                sensor.sample_pitch_um * sensor.pixel_fill,
            ),
            np.concatenate(cells),
            np.array(starts, dtype=np.int64),
            np.array(shapes, dtype=np.int64).reshape(-1, 2),
            np.array(plates, dtype=np.float64).reshape(-1, len(MaskRow._fields)),
            self._rim,
            falloff,
            samples,
        )
        return samples

    def _cell(self, cell: tuple[int, int] | Literal["all"]) -> Array:
        """Return the opening (1, 3) of one aperture cell, or of all."""
        cell_um, (rows, columns) = self.camera.lens.aperture_cell_um, self.camera.views
        if cell == "all":
            return np.array([(0.0, 0.0, max(rows, columns) * cell_um)])
        y_um, x_um = centred_grid(rows, cell_um)[cell[0]], centred_grid(columns, cell_um)[cell[1]]
        return np.array([(float(x_um), float(y_um), cell_um / 2)])

    def _mask_row(
        self,
        errors: MountingErrors,
        distance_mm: float,
        cell_um: float,
        moved_um: tuple[float, float],
    ) -> MaskRow:
        turn = np.deg2rad(errors.rotation_deg)
        cosine, sine = np.cos(turn), np.sin(turn)
        per_um = 1 / (cell_um * errors.stretch)
        pitch_um = self.camera.sensor.sample_pitch_um
        corner_um = np.hypot(*self._size) / 2 * pitch_um
        return MaskRow(
            distance_um=distance_mm * 1e3 * (1 + errors.distance_share),
            x_um=errors.offset_um[0] + moved_um[0],
            y_um=errors.offset_um[1] + moved_um[1],
            column_per_x=(cosine - errors.skew * sine) * per_um,
            column_per_y=(sine + errors.skew * cosine) * per_um,
            row_per_x=-sine * per_um,
            row_per_y=cosine * per_um,
            bend_per_um2=errors.distortion_um / corner_um**3,
            edge_um=errors.edge_blur_um,
            slope_x=np.tan(np.deg2rad(errors.tilt_deg[0])),
            slope_y=np.tan(np.deg2rad(errors.tilt_deg[1])),
            sag_per_um=errors.bow_um / corner_um**2,
            glass_um=errors.substrate_um,
            index=errors.refractive_index,
        )

    def _openings(self, x_um: float, y_um: float) -> Array:
        """Return the plate's pinhole and window at the lens: (2, 3), x, y and half side in um."""
        cell_um = self.camera.lens.aperture_cell_um
        window_half_um = window_side_um(self.camera.views, cell_um) / 2
        # The window is beside the pinhole along the plate, which may be turned.
        turn = np.deg2rad(self._optics.plate_turn_deg)
        beside_um = self.window_um * np.cos(turn), self.window_um * np.sin(turn)
        window_um = (x_um - beside_um[0], y_um - beside_um[1], window_half_um)
        area = 1.0
        if self._optics.hole_spread:
            nearest = (
                int(np.clip(round(at / cell_um + (count - 1) / 2), 0, count - 1))
                for at, count in zip((y_um, x_um), self.camera.views, strict=True)
            )
            area = float(self._hole_areas[tuple(nearest)])
        return np.array([(x_um, y_um, cell_um / 2 * np.sqrt(area)), window_um])
