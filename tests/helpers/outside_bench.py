"""A coded-mask bench that shares no code with the program: NumPy alone, own rays, electrons, DN.

Rays run from 144 points of every pixel to whole aperture cells, whose shadow on the mask is a box:
its mean transmittance is read from a table, made of sums over the mask. Lengths in um. Frames
follow the order of the requests, timed by the bench's own clock; `Bench.psi()` is the true Psi.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
POINTS = 12
COARSE_POINTS, COARSE_PARTS = 6, 6
"""Along a pixel and along an aperture cell, of rays that meet two masks."""
PART_POINTS, PART_UM = 8, 3.5
"""Of a piece of the aperture that the pupil cuts: points along a pixel from which rays run to each
part of it, and how wide the smallest parts' shadows are on the mask."""
FINER = 20
BESIDE_UM = 300.0
"""How far beside the picture the mask is drawn: where rays aslant and a mask that moves reach."""
GEOMETRY = (
    "lens_um", "mask_um", "pitch_um", "cell_um", "aperture_cell_um", "views", "offset_um",
    "rotation_rad", "blur_um", "tilt", "glass_um", "astray_um", "diffraction", "behind_um",
    "behind_cell_um", "pupil_um", "pupil_at_um", "rim_um", "rim_shift",
)  # fmt: skip
LAMPS = {
    "white": (1.0, 1.0, 1.0),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}
WAVELENGTHS_UM = ((0.59, 0.61, 0.63, 0.65), (0.51, 0.53, 0.55, 0.57), (0.44, 0.455, 0.47, 0.485))
"""Of what red, green and blue filters pass."""
LEAST_PIECE_UM = 0.5
"""Narrower pieces of a pinhole pass less than 3e-4 of its light."""
TABLES = 6
"""Tables of boxes kept: of 96x128 pixels each is 50 MB."""
TRACED: dict[Any, dict[Any, Array]] = {}


class Piece(NamedTuple):
    """A rectangle of the aperture, within one of its cells."""

    cell: tuple[int, int]
    """(v, u)."""
    at_um: tuple[Any, Any]
    """Its middle, y and x; as every pixel sees it, (y, x), where a rim cuts the piece."""
    sides_um: tuple[float, float]
    """In y and x."""


@dataclass(frozen=True)
class Optics:
    """Where things are, what they pass, and what the white board sends into the lens.

    blur_um: standard deviation of the mask's edges. tilt: tangent by which the mask's distance
    grows with x and y. glass_um: between mask and sensor, n = 1.52. open, closed: transmittances of
    the cells. aperture: relative spread of what aperture cells pass. falloff: power of the cosine.
    colour_falloff: by which red falls more and blue less. glare: share of the light of every colour
    that is spread over the whole picture before the colour filters; glare_after: of all light that
    passed any filter, behind them: pixels whose filters pass little get more of it. board:
    unevenness of the board over the aperture, across, peak to peak;
    turns with the board. lamp_side: the same of the lamp, which does not turn. gloss: of a lobe
    about the middle of the aperture. turn_sense: -1: "turned by 90 degrees" goes the other way.
    unfilled: by which the board's light falls in the outermost views (it does not fill the lens).
    astray_um: standard deviation by which aberrations displace the shadow of every view.
    turns: what turns with the board: "board", "both" (the lamp with it), "neither". holes: relative
    spread of the areas of the pinhole plate's holes. plate_turn_deg: of the plate about the axis,
    x to y; plate_at_um: (x, y) of its middle. diffraction: behind the mask's edges, by the angular
    spectrum of plane waves. behind_um, behind_cell_um: distance and cells of a second mask, whose
    middle is on the axis, where the bench has one. pupil_um, pupil_at_um: diameter and middle, x
    and y, of the round pupil; 0: the aperture's cells are open to their edges. rim_um: diameter
    of a rim before it; 0: none. rim_shift: its middle's move, um for each um of the pixel.
    """

    lens_um: float = 50_000.0
    mask_um: float = 1_000.0
    pitch_um: float = 8.0
    cell_um: float = 20.0
    aperture_cell_um: float = 1_500.0
    views: tuple[int, int] = (5, 5)
    offset_um: tuple[float, float] = (3.0, -5.0)
    rotation_rad: float = 0.002
    blur_um: float = 0.8
    tilt: tuple[float, float] = (0.0, 0.0)
    glass_um: float = 0.0
    open: float = 1.0
    closed: float = 0.0
    aperture: float = 0.0
    falloff: float = 0.0
    colour_falloff: float = 0.0
    glare: float = 0.0
    board: float = 0.0
    lamp_side: float = 0.0
    gloss: float = 0.0
    unfilled: float = 0.0
    astray_um: float = 0.0
    turn_sense: int = 1
    glare_after: float = 0.0
    turns: str = "board"
    holes: float = 0.0
    plate_turn_deg: float = 0.0
    plate_at_um: tuple[float, float] = (0.0, 0.0)
    diffraction: bool = False
    behind_um: float = 500.0
    behind_cell_um: float = 20.0
    pupil_um: float = 0.0
    pupil_at_um: tuple[float, float] = (0.0, 0.0)
    rim_um: float = 0.0
    rim_shift: float = 0.0


@dataclass(frozen=True)
class Sensor:
    """How light becomes DN. electrons_per_s: of an open camera before the board, in green.

    row_noise: electrons of a row of one frame; row_correlation: with the row above it. prnu, dsnu
    (electrons): of the pixels. crosstalk: share of a filter's light that is of the other two
    colours. odd_gain, odd_dn: by which odd columns respond more, relative, and lie higher.
    """

    electrons_per_s: float = 200_000.0
    colours: tuple[float, float, float] = (0.7, 1.0, 0.6)
    bayer: bool = True
    gain: float = 0.08
    black_dn: float = 64.0
    white_dn: int = 4095
    full_well: float = 60_000.0
    read_noise: float = 3.0
    dark_per_s: float = 5.0
    prnu: float = 0.0
    dsnu: float = 0.0
    hot: float = 0.0
    row_noise: float = 0.0
    row_correlation: float = 0.0
    gamma: float = 1.0
    crosstalk: float = 0.0
    odd_gain: float = 0.0
    odd_dn: float = 0.0


@dataclass(frozen=True)
class Course:
    """What changes between frames.

    flicker: relative, of the lamp, frame by frame; rolling: amplitude over the rows, of a phase
    drawn frame by frame. shutter: relative jitter of the exposure. moves_um: (frame number,
    x): from that frame on the mask stands farther. backlash_um: by which a mask that came from the
    left stands back. dust: specks that sit on the sensor's cover glass from `dust_from` on.
    creep_um: by which the mask creeps to the right from frame to frame; focus_um, soften_um: by
    which the lens gets farther from the sensor, and the mask's edges softer, from frame to frame.
    hands_um: by which a hand puts the pinhole off its hole, aslant as drawn for every board.
    pinhole_longer: relative, exposures through the pinhole over those noted. beside: (view named,
    view in truth) of a pinhole in another hole.
    """

    flicker: float = 0.0
    rolling: float = 0.0
    shutter: float = 0.0
    moves_um: tuple[tuple[int, float], ...] = ()
    backlash_um: float = 0.0
    dust: int = 0
    dust_from: int = 0
    creep_um: float = 0.0
    focus_um: float = 0.0
    soften_um: float = 0.0
    hands_um: float = 0.0
    pinhole_longer: float = 0.0
    beside: tuple[tuple[int, int], tuple[int, int]] | None = None


@dataclass
class Bench:
    """The bench: `take` a frame, ask for the `psi` that is true.

    cells: transmittances as drawn, (row, column) or (row, column, colour), the mask's middle in the
    middle. behind: the same of a second mask.
    """

    cells: Array
    size: tuple[int, int]
    optics: Optics = field(default_factory=Optics)
    sensor: Sensor = field(default_factory=Sensor)
    course: Course = field(default_factory=Course)
    seed: int = 0
    taken: int = 0
    clock_s: float = 0.0
    last_x: float = 0.0
    lag: float = 0.0
    behind: Array | None = None
    last_view: tuple[int, int] | None = None
    hand_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Draw what stays the same: pixels, aperture, dust."""
        self.rng = np.random.default_rng([self.seed, 0])
        fixed = np.random.default_rng([self.seed, 1])
        sensor, optics = self.sensor, self.optics
        self.response = 1 + sensor.prnu * fixed.standard_normal(self.size)
        self.offset = sensor.dsnu * fixed.standard_normal(self.size)
        self.hot = fixed.random(self.size) < sensor.hot
        self.passed = 1 + optics.aperture * fixed.standard_normal(optics.views)
        self.dust = np.ones(self.size)
        rows, columns = np.ogrid[: self.size[0], : self.size[1]]
        for _ in range(self.course.dust):
            y, x = fixed.random(2) * self.size
            self.dust *= 1 - 0.3 * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 8)
        self.astray = optics.astray_um * fixed.standard_normal((2, *optics.views))
        self.hole_areas = 1 + optics.holes * fixed.standard_normal(optics.views)
        self.hand = np.random.default_rng([self.seed, 2])
        cells = optics.closed + (optics.open - optics.closed) * np.asarray(self.cells, float)
        self.masks = [np.atleast_3d(cells)]
        if self.behind is not None:
            self.masks.append(np.atleast_3d(np.asarray(self.behind, float)))
        self.tables: dict[Any, tuple[Array, tuple[float, float]]] = {}
        self.drawn: dict[Any, Array] = {}
        # What the mask's shadow depends on; benches that differ in the rest share it.
        traced = {item: getattr(optics, item) for item in GEOMETRY}
        drawn = [part.tobytes() for part in (*self.masks, self.astray)]
        self.known = TRACED.setdefault((repr(traced), self.size, sensor.bayer, *drawn), {})

    @cached_property
    def colour(self) -> Array:
        """The colour that every pixel sees, (y, x): 0 red, 1 green, 2 blue, of RGGB."""
        rows, columns = np.indices(self.size) % 2
        return rows + columns if self.sensor.bayer else np.ones(self.size, int)

    def light(self) -> Array:
        """Return the light of a whole cell at each pixel, (v, u, y, x); that of all is 1.

        A cell that the pupil cuts sends its open share of it.
        """
        optics = self.optics
        (v, u), (y, x) = self._aperture(), self._pixels()
        down = (y - v[:, None, None, None]) ** 2
        across = (x - u[None, :, None, None]) ** 2
        slope2 = (down + across) / optics.lens_um**2
        power = optics.falloff + optics.colour_falloff * (1 - self.colour)
        share = (1 + slope2) ** (-power / 2) * self.passed[:, :, None, None]
        opened = [self._opened(piece) * np.ones((1, 1)) for piece, _ in self._views()]
        return share / (share * np.reshape(opened, (*optics.views, *opened[0].shape))).sum((0, 1))

    def shadow(self, mask_x: float = 0.0, mask_y: float = 0.0, colour: int | None = None) -> Array:
        """Return what the mask passes of every view to every pixel, (v, u, y, x).

        colour: of the light; None: that of every pixel's filter.
        """
        place = mask_x, mask_y, self._now(), colour
        pieces = [self.piece(piece, *place) for piece, _ in self._views()]
        return np.reshape(pieces, (*self.optics.views, *self.size))

    def piece(
        self, piece: Piece, mask_x: float, mask_y: float, now: Optics, colour: int | None = None
    ) -> Array:
        """Return what mask and pupil pass of a piece of the aperture to every pixel, (y, x)."""
        key = piece, round(mask_x, 6), round(mask_y, 6), now.lens_um, now.blur_um, colour
        if key not in self.known:
            self.known[key] = sum(
                (share * behind * self._traced(seen, mask_x, mask_y, now, colour)
                for part, share in self._open_parts(piece)
                for seen, behind in [self._within_rim(part)]), np.zeros(self.size),
            )  # fmt: skip
        return self.known[key]

    def psi(self, mask_x: float = 0.0, mask_y: float = 0.0) -> Array:
        """Return the true coefficients under white light, (v, u, y, x); without a mask of sum 1."""
        return self.psi_of(mask_x, mask_y, "white")

    def psi_of(self, mask_x: float, mask_y: float, lamp: str) -> Array:
        """Return the part of the true coefficients, (v, u, y, x), that is of a lamp's colour."""
        light = self.light()
        through = self._electrons(
            lambda colour: light * self.shadow(mask_x, mask_y, colour), LAMPS[lamp]
        )
        return through / self._electrons(lambda colour: np.ones(self.size), LAMPS["white"])

    def radiance(self, turned_deg: float = 0.0) -> Array:
        """Return what the board sends into every view, (v, u)."""
        optics = self.optics
        v, u = (np.linspace(-1, 1, count) for count in optics.views)
        turn = np.deg2rad(turned_deg * optics.turn_sense * (optics.turns != "neither"))
        across = np.cos(turn) * u[None, :] + np.sin(turn) * v[:, None]
        radius2 = u[None, :] ** 2 + v[:, None] ** 2
        from_lamp = across if optics.turns == "both" else u[None, :]
        sent = 1 + optics.board / 2 * across + optics.lamp_side / 2 * from_lamp
        sent = sent + optics.gloss * np.exp(-2 * radius2)
        return sent * np.where(
            np.maximum(abs(u[None, :]), abs(v[:, None])) > 0.99, 1 - optics.unfilled, 1
        )

    def take(
        self,
        exposure_s: float,
        view: tuple[int, int] | None = None,
        mask: tuple[float, float] | None = (0.0, 0.0),
        turned_deg: float = 0.0,
        lit: bool = True,
        scene: Array | None = None,
        lamp: str = "white",
    ) -> Array:
        """Return the next frame, uint16 (y, x).

        view: the pinhole's, None: all are open. mask: where the stage is sent, None: no mask in the
        beam. scene: (v, u, y, x, colour) instead of the white board. lamp: its colour.
        """
        self.taken += 1
        self.clock_s += exposure_s + 0.5
        if view != self.last_view:
            aslant = self.hand.uniform(0, 2 * np.pi)
            self.hand_um = (
                self.course.hands_um * np.cos(aslant),
                self.course.hands_um * np.sin(aslant),
            )
            self.last_view = view
        seen = np.zeros(self.size)
        if lit:
            seen = self._seen(view, mask, turned_deg, scene, LAMPS[lamp]) * self._lamp()
        longer = 1 + self.course.pinhole_longer * (view is not None)
        return self._read(seen, exposure_s * longer)

    def _seen(self, view: Any, mask: Any, turned_deg: float, scene: Any, lamp: Any) -> Array:
        """Return the electrons of every pixel, (y, x), over those of an open camera in green."""
        light, now = self.light(), self._now()
        if scene is not None:
            sent = np.take_along_axis(scene, self.colour[None, None, :, :, None], 4)[..., 0]
        else:
            sent = self.radiance(turned_deg)[:, :, None, None]
        sent = light * sent
        place = None if mask is None else (self._stands(mask[0]), mask[1])
        pieces = self._views() if view is None else self._hole(view)

        def seen(colour: int | None) -> Array:
            total = np.zeros(self.size)
            for piece, area in pieces:
                if place is None:
                    passed = self._opened(piece)
                else:
                    passed = self.piece(piece, *place, now, colour)
                total += area * sent[piece.cell] * passed
            return total

        clean = 1.0 if self.taken <= self.course.dust_from else self.dust
        return self._electrons(seen, lamp) * clean

    def _electrons(self, seen: Callable[[int | None], Array], lamp: Any) -> Array:
        """Return electrons (..., y, x) of the light of one colour, or of every pixel's own.

        seen: returns it, (..., y, x), as it arrives before filters and glare.
        """
        sensor, optics = self.sensor, self.optics
        filters = np.diag(sensor.colours) if sensor.bayer else np.eye(3)
        filters = filters @ ((1 - 1.5 * sensor.crosstalk) * np.eye(3) + sensor.crosstalk / 2)
        total = 0.0
        for colour in range(3) if sensor.crosstalk else (None,):
            light = seen(colour)
            if optics.glare and colour is None:
                everywhere = np.empty_like(light)
                for own in range(3):
                    chosen = self.colour == own
                    if chosen.any():
                        everywhere[..., chosen] = light[..., chosen].mean(-1, keepdims=True)
                light = (1 - optics.glare) * light + optics.glare * everywhere
            elif optics.glare:
                everywhere = light.mean((-2, -1), keepdims=True)
                light = (1 - optics.glare) * light + optics.glare * everywhere
            own = self.colour if colour is None else colour
            total = total + filters[self.colour, own] * np.asarray(lamp)[own] * light
        after = optics.glare_after
        return (1 - after) * total + after * np.mean(total, (-2, -1), keepdims=True)

    def _views(self) -> list[tuple[Piece, float]]:
        """Return every view's cell of the aperture, and the share of it: 1."""
        (v, u), side = self._aperture(), self.optics.aperture_cell_um
        return [
            (Piece((j, i), (float(at_v), float(at_u)), (side, side)), 1.0)
            for j, at_v in enumerate(v)
            for i, at_u in enumerate(u)
        ]

    def _hole(self, view: tuple[int, int]) -> list[tuple[Piece, float]]:
        """Return what the pinhole before a view uncovers of every cell, and the cell's share.

        Nothing passes beside the aperture.
        """
        optics, course = self.optics, self.course
        if course.beside is not None and view == course.beside[0]:
            view = course.beside[1]
        (v, u), side = self._aperture(), optics.aperture_cell_um
        turn, half = np.deg2rad(optics.plate_turn_deg), side / 2 * np.sqrt(self.hole_areas[view])
        at_v, at_u = v[view[0]], u[view[1]]
        to_u = np.cos(turn) * at_u - np.sin(turn) * at_v + optics.plate_at_um[0] + self.hand_um[0]
        to_v = np.sin(turn) * at_u + np.cos(turn) * at_v + optics.plate_at_um[1] + self.hand_um[1]
        found = []
        for (j, i), (cell_v, cell_u), _ in (piece for piece, _ in self._views()):
            top, bottom = max(to_v - half, cell_v - side / 2), min(to_v + half, cell_v + side / 2)
            left, right = max(to_u - half, cell_u - side / 2), min(to_u + half, cell_u + side / 2)
            sides = float(bottom - top), float(right - left)
            if min(sides) > LEAST_PIECE_UM:
                middle = float(top + bottom) / 2, float(left + right) / 2
                found.append((Piece((j, i), middle, sides), sides[0] * sides[1] / side**2))
        return found

    def _opened(self, piece: Piece) -> Any:
        """Return the share of a piece of the aperture that pupil and rim leave open.

        Behind a rim of every pixel, (y, x).
        """
        if piece not in self.known:
            shares = [share * self._within_rim(part)[1] for part, share in self._open_parts(piece)]
            self.known[piece] = sum(shares, np.zeros(self.size if self.optics.rim_um else ()))
        return self.known[piece]

    def _within_rim(self, piece: Piece, points: int = 8) -> tuple[Piece, Any]:
        """Return a piece of the aperture about its middle through the rim, and the share of it.

        Both as every pixel sees them, (y, x), where the rim cuts the piece.
        """
        optics = self.optics
        if self._rim_passes(piece):
            return piece, 1.0
        y, x = (optics.rim_shift * place for place in self._pixels())
        beside = (np.arange(points) + 0.5) / points - 0.5
        inside, from_v, from_u = np.zeros((3, *self.size))
        right = (piece.sides_um[1] * beside)[:, None, None]
        for down in piece.sides_um[0] * beside:
            away = (piece.at_um[0] + down - y) ** 2 + (piece.at_um[1] + right - x) ** 2
            within = away < (optics.rim_um / 2) ** 2
            inside += within.sum(axis=0)
            from_v += down * within.sum(axis=0)
            from_u += (right * within).sum(axis=0)
        seen = np.maximum(inside, 1)
        at_um = piece.at_um[0] + from_v / seen, piece.at_um[1] + from_u / seen
        return piece._replace(at_um=at_um), inside / points**2

    def _rim_passes(self, piece: Piece) -> bool:
        """Return whether the rim cuts a piece of the aperture for no pixel.

        The piece is within a disk if its corners are, for every pixel if it is for the outermost.
        """
        optics = self.optics
        y, x = (optics.rim_shift * place.ravel()[[0, -1]] for place in self._pixels())
        (at_v, at_u), (side_v, side_u) = piece.at_um, piece.sides_um
        far_v = np.abs(at_v + side_v * np.array([[-0.5, 0.5]]) - y[:, None]).max()
        far_u = np.abs(at_u + side_u * np.array([[-0.5, 0.5]]) - x[:, None]).max()
        return not optics.rim_um or bool(np.hypot(far_v, far_u) < optics.rim_um / 2)

    def _open_parts(self, piece: Piece, splits: int | None = None) -> list[tuple[Piece, float]]:
        """Return the parts of a piece of the aperture in the pupil, and their shares of it.

        Pieces on the edge of pupil or rim are split in four, so often that the shadows of the last
        are below PART_UM; the last lie about the middle of their part in the pupil.
        """
        optics, points = self.optics, (np.arange(32) + 0.5) / 32 - 0.5
        y = (piece.at_um[0] + piece.sides_um[0] * points)[:, None]
        x = (piece.at_um[1] + piece.sides_um[1] * points)[None, :]
        at_x, at_y = optics.pupil_at_um
        disk = 1.0 * ((x - at_x) ** 2 + (y - at_y) ** 2 < (optics.pupil_um / 2) ** 2)
        uncut = not optics.pupil_um or bool(disk.all())
        if uncut and self._rim_passes(piece):
            return [(piece, 1.0)]
        if uncut:
            disk = np.ones(disk.shape)
        if splits is None:
            shadow_um = optics.mask_um / optics.lens_um * max(piece.sides_um)
            splits = max(int(np.ceil(np.log2(shadow_um / PART_UM))), 0)
        share = float(disk.mean())
        if share == 0 or splits == 0:
            middle_y, middle_x = (float((disk * at).mean()) / max(share, 1e-12) for at in (y, x))
            part = Piece(piece.cell, (middle_y, middle_x), piece.sides_um)
            return [(part, share)] if share else []
        (at_v, at_u), (side_v, side_u) = piece.at_um, piece.sides_um
        quarters = [
            Piece(
                piece.cell, (at_v + down * side_v, at_u + right * side_u), (side_v / 2, side_u / 2)
            )
            for down in (-0.25, 0.25)
            for right in (-0.25, 0.25)
        ]
        return [
            (part, share / 4)
            for quarter in quarters
            for part, share in self._open_parts(quarter, splits - 1)
        ]

    def _now(self) -> Optics:
        """Return the optics as they stand at the frame being taken."""
        course, optics = self.course, self.optics
        if not (course.focus_um or course.soften_um):
            return optics
        farther, softer = self.taken * course.focus_um, self.taken * course.soften_um
        return replace(optics, lens_um=optics.lens_um + farther, blur_um=optics.blur_um + softer)

    def _stands(self, x: float) -> float:
        """Return where the mask really stands that was sent to x."""
        if x != self.last_x:
            self.lag = -self.course.backlash_um if x > self.last_x else 0.0
            self.last_x = x
        moved = sum(by for first, by in self.course.moves_um if self.taken >= first)
        return x + self.lag + moved + self.course.creep_um * self.taken

    def _lamp(self) -> Array:
        course = self.course
        rows = np.arange(self.size[0])[:, None] / self.size[0]
        phase = self.rng.uniform(0, 2 * np.pi)
        level = 1 + course.flicker * self.rng.standard_normal()
        return level * (1 + course.rolling * np.sin(2 * np.pi * 2.3 * rows + phase))

    def _read(self, seen: Array, exposure_s: float) -> Array:
        sensor, rng = self.sensor, self.rng
        time_s = exposure_s * (1 + self.course.shutter * rng.standard_normal())
        odd = np.arange(self.size[1]) % 2
        mean = sensor.electrons_per_s * seen * self.response * time_s
        mean = mean + sensor.dark_per_s * exposure_s + np.where(self.hot, 3e5 * exposure_s, 0)
        electrons = np.minimum(rng.poisson(mean), sensor.full_well) + self.offset
        electrons = electrons + sensor.read_noise * rng.standard_normal(self.size)
        if sensor.row_noise:
            rows = rng.standard_normal(self.size[0])
            for row in range(1, len(rows)):
                same = sensor.row_correlation
                rows[row] = same * rows[row - 1] + np.sqrt(1 - same**2) * rows[row]
            electrons = electrons + sensor.row_noise * rows[:, None]
        dn = sensor.gain * (1 + sensor.odd_gain * odd) * electrons + sensor.odd_dn * odd
        if sensor.gamma != 1:
            top = sensor.white_dn - sensor.black_dn
            dn = top * np.maximum(dn / top, 0) ** sensor.gamma
        return np.clip(np.rint(dn + sensor.black_dn), 0, sensor.white_dn).astype(np.uint16)

    def _aperture(self) -> tuple[Array, Array]:
        v, u = (
            (np.arange(count) - (count - 1) / 2) * self.optics.aperture_cell_um
            for count in self.optics.views
        )
        return v, u

    def _pixels(self) -> tuple[Array, Array]:
        rows, columns = self.size
        y = (np.arange(rows) - (rows - 1) / 2) * self.optics.pitch_um
        x = (np.arange(columns) - (columns - 1) / 2) * self.optics.pitch_um
        return y[:, None], x[None, :]

    def _traced(
        self, piece: Piece, mask_x: float, mask_y: float, now: Optics, colour: int | None
    ) -> Array:
        """Return what the masks pass of a piece of the aperture to every pixel, (y, x)."""
        y, x = np.broadcast_arrays(*self._pixels())
        two = len(self.masks) == 2
        points, parts = (COARSE_POINTS, COARSE_PARTS) if two else (POINTS, 1)
        if piece.sides_um[0] < 0.6 * now.aperture_cell_um:
            # A part of a cell that the pupil cuts: its many neighbours have rays as well.
            points, parts = PART_POINTS, 1
        within = ((np.arange(points) + 0.5) / points - 0.5) * now.pitch_um
        within *= points / np.sqrt(points**2 - 1)  # the variance of a whole pixel
        sides = piece.sides_um[0] / parts, piece.sides_um[1] / parts
        beside = np.arange(parts) - (parts - 1) / 2
        passed = np.zeros(self.size)
        for at_v in [piece.at_um[0] + side for side in sides[0] * beside]:
            for at_u in [piece.at_um[1] + side for side in sides[1] * beside]:
                for dy in within:
                    # All rays of a row of a pixel's points at once, (point, y, x).
                    ray = x + within[:, None, None], y + dy, at_u, at_v
                    row, column = self._met(*ray, piece.cell, (mask_x, mask_y), now)
                    through = self._box(0, row, column, sides, now, colour)
                    if two:
                        far = now.behind_um / now.lens_um
                        row = (1 - far) * (y + dy) + far * at_v
                        column = (1 - far) * ray[0] + far * at_u
                        through = through * self._box(1, row, column, sides, now, colour)
                    passed += through.sum(axis=0)
        return passed / (points * parts) ** 2

    def _met(
        self, x: Array, y: Array, u: float, v: float, cell: Any, mask: Any, now: Optics
    ) -> tuple[Array, Array]:
        """Return where rays from sensor points to a lens point meet the mask: rows, columns, um."""
        stray_x, stray_y = self.astray[:, cell[0], cell[1]]
        to_x, to_y = (u - x) / now.lens_um, (v - y) / now.lens_um
        far = now.mask_um + now.tilt[0] * x + now.tilt[1] * y
        steep = 1 + to_x**2 + to_y**2
        inside = 1 / np.sqrt(1.52**2 * steep - steep + 1)
        far = far + now.glass_um * (inside - 1 / 1.52)
        on_x = x + far * to_x - now.offset_um[0] - mask[0] + stray_x
        on_y = y + far * to_y - now.offset_um[1] - mask[1] + stray_y
        cosine, sine = np.cos(now.rotation_rad), np.sin(now.rotation_rad)
        return -sine * on_x + cosine * on_y, cosine * on_x + sine * on_y

    def _boxes(
        self, mask: int, sides_um: tuple[float, float], now: Optics
    ) -> tuple[Array, tuple[float, float]]:
        """Return the mean transmittance of boxes about corners of the fine grid, and their origin.

        (row, column, colour), and where the mask's middle is among them, in steps of the grid.
        sides_um: of the piece of the aperture whose shadow the boxes are, y and x.
        """
        cells = self.masks[mask]
        cell_um, far_um = (
            (now.cell_um, now.mask_um), (now.behind_cell_um, now.behind_um)
        )[mask]  # fmt: skip
        key = mask, sides_um, now.lens_um, now.blur_um
        if key in self.tables:
            return self.tables[key]
        found = self._fine(mask, cells, cell_um, far_um, now)
        middle = [count / 2 for count in found.shape[:2]]
        begun = []
        for axis in (0, 1):
            reach = far_um / now.lens_um * sides_um[axis] / 2 / (cell_um / FINER)
            whole, part = int(reach), reach - int(reach)
            begun.append(whole + 1)
            area = np.moveaxis(found, axis, 0).cumsum(0)
            area = np.concatenate([np.zeros_like(area[:1]), area])
            last = len(area) - 2 * whole - 2
            near, far = (area[first : first + last] for first in (1, 2 * whole + 1))
            nearer, farther = (area[first : first + last] for first in (0, 2 * whole + 2))
            sums = (1 - part) * (far - near) + part * (farther - nearer)
            found = np.moveaxis(sums / (2 * reach), 0, axis)
        while len(self.tables) >= TABLES:
            self.tables.pop(next(iter(self.tables)))
        table = np.ascontiguousarray(found), (middle[0] - begun[0], middle[1] - begun[1])
        self.tables[key] = table
        return table

    def _fine(self, mask: int, cells: Array, cell_um: float, far_um: float, now: Optics) -> Array:
        """Return the mask drawn FINER than its cells, with its blur: (row, column, colour)."""
        key = mask, now.blur_um
        if key in self.drawn:
            return self.drawn[key]
        spare = [
            max(0, int((count * cell_um - pixels * now.pitch_um) / 2 - BESIDE_UM))
            for count, pixels in zip(cells.shape, self.size, strict=False)
        ]
        rows, columns = (int(beside / cell_um) for beside in spare)
        height, width = cells.shape[:2]
        found = cells[rows : height - rows, columns : width - columns]
        found = found.repeat(FINER, 0).repeat(FINER, 1)
        if now.diffraction:
            found = _diffracted(found, cell_um / FINER, far_um)
        if now.blur_um:
            found = _blurred(found, now.blur_um / (cell_um / FINER))
        if len(self.drawn) == len(self.masks):
            self.drawn.clear()
        self.drawn[key] = found
        return found

    def _box(
        self, mask: int, row: Array, column: Array, sides_um: Any, now: Optics, colour: int | None
    ) -> Array:
        """Return what a mask passes of a piece of the aperture about places, um from its middle."""
        boxes, (middle_row, middle_column) = self._boxes(mask, sides_um, now)
        per_um = FINER / (now.cell_um, now.behind_cell_um)[mask]
        row, column = row * per_um + middle_row, column * per_um + middle_column
        height, width, colours = boxes.shape
        inside = min(row.min(), column.min()) >= 0
        if not (inside and row.max() < height - 1 and column.max() < width - 1):
            raise ValueError("the mask is smaller than the beam")
        seen = self.colour if colour is None else np.full(self.size, colour)
        seen = seen if colours == 3 else np.zeros(self.size, int)
        i, j = row.astype(int), column.astype(int)
        p, q = row - i, column - j
        values, at = boxes.ravel(), (i * width + j) * colours + seen
        above = (1 - q) * values[at] + q * values[at + colours]
        at += width * colours
        below = (1 - q) * values[at] + q * values[at + colours]
        return (1 - p) * above + p * below


def _diffracted(fine: Array, fine_um: float, far_um: float) -> Array:
    """Return the light behind a mask, (row, column, colour), each colour the mean over its band.

    Every plane wave of exp(2 pi i (a x + b y)) goes on with the phase k far sqrt(1 - (la)^2 -
    (lb)^2) of its wavelength l; the directions of an aperture cell are averaged by its box.
    """
    rows, columns, colours = fine.shape
    a, b = np.fft.fftfreq(columns, fine_um)[None, :], np.fft.fftfreq(rows, fine_um)[:, None]
    found = np.zeros(fine.shape)
    for colour in range(colours):
        waves = np.fft.fft2(np.sqrt(fine[..., colour]))
        band = WAVELENGTHS_UM[colour if colours == 3 else 1]
        for length_um in band:
            slope2 = np.minimum(length_um**2 * (a**2 + b**2), 1.0)
            phase = 2 * np.pi * far_um / length_um * np.sqrt(1 - slope2)
            found[..., colour] += np.abs(np.fft.ifft2(waves * np.exp(1j * phase))) ** 2 / len(band)
    return found


def _blurred(fine: Array, deviation: float) -> Array:
    reach = int(4 * deviation) + 1
    kernel = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * deviation**2))
    kernel /= kernel.sum()
    padded = np.pad(fine, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    rows, columns = fine.shape[:2]
    across, found = np.zeros((len(padded), *fine.shape[1:])), np.zeros(fine.shape)
    for i, weight in enumerate(kernel):
        across += weight * padded[:, i : i + columns]
    for i, weight in enumerate(kernel):
        found += weight * across[i : i + rows]
    return found


def changed(bench: Bench, **parts: Any) -> Bench:
    """Return a bench like another with changes: optics={...}, sensor={...}, course={...}."""
    new = {name: replace(getattr(bench, name), **what) for name, what in parts.items()}
    keep = {name: getattr(bench, name) for name in ("optics", "sensor", "course")} | new
    return Bench(bench.cells, bench.size, seed=bench.seed, behind=bench.behind, **keep)
