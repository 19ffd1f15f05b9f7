"""A coded-mask bench that shares no code with the program: NumPy alone, own rays, electrons, DN.

Rays run from 144 points of every pixel to whole aperture cells, whose shadow on the mask is a box:
its mean transmittance is read from a table, made of sums over the mask. Lengths in um. Frames
follow the order of the requests, timed by the bench's own clock; `Bench.psi()` is the true Psi.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

POINTS = 12
ACROSS = 8
"""Parts along a side of an aperture cell that the pupil cuts, to which rays are traced."""
FINER = 20
BESIDE_UM = 300.0
"""How far beside the picture the mask is drawn: where rays aslant and a mask that moves reach."""
GEOMETRY = (
    "lens_um", "mask_um", "pitch_um", "cell_um", "aperture_cell_um", "views", "offset_um",
    "rotation_rad", "blur_um", "tilt", "glass_um", "astray_um", "pupil_um", "pupil_at_um",
)  # fmt: skip
TRACED: dict[Any, dict[tuple[float, float], np.ndarray]] = {}


@dataclass(frozen=True)
class Optics:
    """Where things are, what they pass, and what the white board sends into the lens.

    blur_um: standard deviation of the mask's edges. tilt: tangent by which the mask's distance
    grows with x and y. glass_um: between mask and sensor, n = 1.52. open, closed: transmittances of
    the cells. aperture: relative spread of what aperture cells pass. falloff: power of the cosine.
    colour_falloff: by which red falls more and blue less. glare: share of all light that is spread
    over the whole picture. board: unevenness of the board over the aperture, across, peak to peak;
    turns with the board. lamp_side: the same of the lamp, which does not turn. gloss: of a lobe
    about the middle of the aperture. turn_sense: -1: "turned by 90 degrees" goes the other way.
    unfilled: by which the board's light falls in the outermost views (it does not fill the lens).
    astray_um: standard deviation by which aberrations displace the shadow of every view.
    pupil_um, pupil_at_um: diameter and middle, x and y, of the round pupil; 0: the cells are open.
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
    pupil_um: float = 0.0
    pupil_at_um: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Sensor:
    """How light becomes DN. electrons_per_s: of an open camera before the board, in green.

    row_noise: electrons of a row of one frame; row_correlation: with the row above it. prnu, dsnu
    (electrons): of the pixels.
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


@dataclass(frozen=True)
class Course:
    """What changes between frames.

    flicker: relative, of the lamp, frame by frame; rolling: amplitude over the rows, of a phase
    drawn frame by frame. shutter: relative jitter of the exposure. moves_um: (frame number,
    x): from that frame on the mask stands farther. backlash_um: by which a mask that came from the
    left stands back. dust: specks that sit on the sensor's cover glass from `dust_from` on.
    """

    flicker: float = 0.0
    rolling: float = 0.0
    shutter: float = 0.0
    moves_um: tuple[tuple[int, float], ...] = ()
    backlash_um: float = 0.0
    dust: int = 0
    dust_from: int = 0


@dataclass
class Bench:
    """The bench: `take` a frame, ask for the `psi` that is true.

    cells: transmittances as drawn, (row, column) or (row, column, colour), the mask's middle in the
    middle.
    """

    cells: np.ndarray
    size: tuple[int, int]
    optics: Optics = field(default_factory=Optics)
    sensor: Sensor = field(default_factory=Sensor)
    course: Course = field(default_factory=Course)
    seed: int = 0
    taken: int = 0
    clock_s: float = 0.0
    last_x: float = 0.0
    lag: float = 0.0

    def __post_init__(self) -> None:
        """Draw what stays the same: pixels, aperture, dust."""
        self.rng = np.random.default_rng([self.seed, 0])
        fixed = np.random.default_rng([self.seed, 1])
        sensor, optics = self.sensor, self.optics
        self.response = 1 + sensor.prnu * fixed.standard_normal(self.size)
        self.offset = sensor.dsnu * fixed.standard_normal(self.size)
        self.hot = fixed.random(self.size) < sensor.hot
        self.passed = 1 + optics.aperture * fixed.standard_normal(optics.views)
        self.parts, self.tables = self._open_parts(), dict[float, Any]()
        self.passed = self.passed * self.parts[0].mean((2, 3))
        self.lens, self.dust = np.ones(self.size), np.ones(self.size)
        rows, columns = np.ogrid[: self.size[0], : self.size[1]]
        for _ in range(self.course.dust):
            y, x = fixed.random(2) * self.size
            self.dust *= 1 - 0.3 * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 8)
        self.astray = optics.astray_um * fixed.standard_normal((2, *optics.views))
        cells = optics.closed + (optics.open - optics.closed) * np.asarray(self.cells, float)
        self.passing = np.atleast_3d(cells)
        self.filtered = self.colour if self.passing.shape[2] == 3 else np.zeros(self.size, int)
        # What the mask's shadow depends on; benches that differ in the rest share it.
        traced = {item: getattr(optics, item) for item in GEOMETRY}
        drawn = cells.tobytes(), self.astray.tobytes()
        self.known = TRACED.setdefault((repr(traced), self.size, sensor.bayer, *drawn), {})

    @property
    def colour(self) -> np.ndarray:
        """The colour that every pixel sees, (y, x): 0 red, 1 green, 2 blue, of RGGB."""
        rows, columns = np.indices(self.size) % 2
        return rows + columns if self.sensor.bayer else np.ones(self.size, int)

    def light(self) -> np.ndarray:
        """Return what share of a view's light reaches each pixel, (v, u, y, x), of all views' 1."""
        optics = self.optics
        (v, u), (y, x) = self._aperture(), self._pixels()
        down = (y - v[:, None, None, None]) ** 2
        across = (x - u[None, :, None, None]) ** 2
        slope2 = (down + across) / optics.lens_um**2
        power = optics.falloff + optics.colour_falloff * (1 - self.colour)
        share = (1 + slope2) ** (-power / 2) * self.passed[:, :, None, None]
        return share / share.sum((0, 1))

    def shadow(self, mask_x: float = 0.0, mask_y: float = 0.0) -> np.ndarray:
        """Return what the mask passes of every view to every pixel, (v, u, y, x)."""
        key = round(mask_x, 6), round(mask_y, 6)
        if key not in self.known:
            self.known[key] = self._traced(*key)
        return self.known[key]

    def psi(self, mask_x: float = 0.0, mask_y: float = 0.0) -> np.ndarray:
        """Return the true coefficients, (v, u, y, x); without a mask their sum is 1."""
        every = self.shadow(mask_x, mask_y) * self.light()
        glare = self.optics.glare
        return (1 - glare) * every + glare * every.mean((2, 3), keepdims=True)

    def radiance(self, turned_deg: float = 0.0) -> np.ndarray:
        """Return what the board sends into every view, (v, u)."""
        optics = self.optics
        v, u = (np.linspace(-1, 1, count) for count in optics.views)
        turn = np.deg2rad(turned_deg * optics.turn_sense)
        across = np.cos(turn) * u[None, :] + np.sin(turn) * v[:, None]
        radius2 = u[None, :] ** 2 + v[:, None] ** 2
        sent = 1 + optics.board / 2 * across + optics.lamp_side / 2 * u[None, :]
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
        scene: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the next frame, uint16 (y, x).

        view: the pinhole's, None: all are open. mask: where the stage is sent, None: no mask in the
        beam. scene: (v, u, y, x, colour) instead of the white board.
        """
        self.taken += 1
        self.clock_s += exposure_s + 0.5
        seen = np.zeros(self.size)
        if lit:
            seen = self._seen(view, mask, turned_deg, scene) * self._lamp()
        return self._read(seen, exposure_s)

    def _seen(self, view: Any, mask: Any, turned_deg: float, scene: Any) -> np.ndarray:
        light = self.light()
        if mask is not None:
            light = light * self.shadow(self._stands(mask[0]), mask[1])
        if scene is not None:
            sent = np.take_along_axis(scene, self.colour[None, None, :, :, None], 4)[..., 0]
        else:
            sent = self.radiance(turned_deg)[:, :, None, None]
        seen = light * sent
        seen = seen.sum((0, 1)) if view is None else seen[view]
        seen = (1 - self.optics.glare) * seen + self.optics.glare * seen.mean()
        return seen * self.lens * (self.dust if self.taken > self.course.dust_from else 1)

    def _stands(self, x: float) -> float:
        """Return where the mask really stands that was sent to x."""
        if x != self.last_x:
            self.lag = -self.course.backlash_um if x > self.last_x else 0.0
            self.last_x = x
        return x + self.lag + sum(by for first, by in self.course.moves_um if self.taken >= first)

    def _lamp(self) -> np.ndarray:
        course = self.course
        rows = np.arange(self.size[0])[:, None] / self.size[0]
        phase = self.rng.uniform(0, 2 * np.pi)
        level = 1 + course.flicker * self.rng.standard_normal()
        return level * (1 + course.rolling * np.sin(2 * np.pi * 2.3 * rows + phase))

    def _read(self, seen: np.ndarray, exposure_s: float) -> np.ndarray:
        sensor, rng = self.sensor, self.rng
        time_s = exposure_s * (1 + self.course.shutter * rng.standard_normal())
        by_colour = np.array(sensor.colours)[self.colour] if sensor.bayer else 1.0
        mean = sensor.electrons_per_s * by_colour * seen * self.response * time_s
        mean = mean + sensor.dark_per_s * exposure_s + np.where(self.hot, 3e5 * exposure_s, 0)
        electrons = np.minimum(rng.poisson(mean), sensor.full_well) + self.offset
        electrons = electrons + sensor.read_noise * rng.standard_normal(self.size)
        if sensor.row_noise:
            rows = rng.standard_normal(self.size[0])
            for row in range(1, len(rows)):
                same = sensor.row_correlation
                rows[row] = same * rows[row - 1] + np.sqrt(1 - same**2) * rows[row]
            electrons = electrons + sensor.row_noise * rows[:, None]
        dn = sensor.gain * electrons
        if sensor.gamma != 1:
            top = sensor.white_dn - sensor.black_dn
            dn = top * np.maximum(dn / top, 0) ** sensor.gamma
        return np.clip(np.rint(dn + sensor.black_dn), 0, sensor.white_dn).astype(np.uint16)

    def _aperture(self) -> tuple[np.ndarray, np.ndarray]:
        v, u = (
            (np.arange(count) - (count - 1) / 2) * self.optics.aperture_cell_um
            for count in self.optics.views
        )
        return v, u

    def _pixels(self) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = self.size
        y = (np.arange(rows) - (rows - 1) / 2) * self.optics.pitch_um
        x = (np.arange(columns) - (columns - 1) / 2) * self.optics.pitch_um
        return y[:, None], x[None, :]

    def _open_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return open share, and y and x in um of the open part's middle, (v, u, part, part)."""
        optics, (v, u), finer = self.optics, self._aperture(), 32
        points = (np.arange(ACROSS * finer) + 0.5) / (ACROSS * finer) - 0.5
        y, x = np.broadcast_arrays(
            v[:, None, None, None] + points[:, None] * optics.aperture_cell_um,
            u[None, :, None, None] + points * optics.aperture_cell_um,
        )
        radius = optics.pupil_um / 2 if optics.pupil_um else np.inf
        at_x, at_y = optics.pupil_at_um
        disk = (x - at_x) ** 2 + (y - at_y) ** 2 < radius**2
        parts = (*optics.views, ACROSS, finer, ACROSS, finer)
        share, *middle = (
            values.reshape(parts).mean((3, 5)) for values in (1.0 * disk, disk * y, disk * x)
        )
        return share, *(values / np.maximum(share, 1e-12) for values in middle)

    def _traced(self, mask_x: float, mask_y: float) -> np.ndarray:
        optics = self.optics
        (v, u), (y, x) = self._aperture(), self._pixels()
        y, x = np.broadcast_arrays(y, x)
        passed = np.zeros((*optics.views, *self.size))
        for j, i in np.ndindex(optics.views):
            stray = self.astray[:, j, i]
            place = mask_x - stray[0], mask_y - stray[1]
            share, at_y, at_x = (values[j, i] for values in self.parts)
            if share.min() == 1:
                passed[j, i] = self._through(y, x, v[j], u[i], place)
                continue
            # A cell that is cut: rays to small parts, each a box of the aperture of its own.
            for part in zip(*np.nonzero(share), strict=True):
                seen = self._through(y, x, at_y[part], at_x[part], place, 1 / ACROSS)
                passed[j, i] += share[part] / share.sum() * seen
        return passed

    def _through(
        self, y: Any, x: Any, at_v: Any, at_u: Any, place: Any, part: float = 1.0
    ) -> np.ndarray:
        """Return what the mask at a place passes of a square part of the aperture, (y, x).

        at_v, at_u: its middle; part: its side, of an aperture cell's.
        """
        optics = self.optics
        # The pixels' points need not be many before a part that is small as well.
        count = POINTS if part == 1 else POINTS // 2
        within = ((np.arange(count) + 0.5) / count - 0.5) * optics.pitch_um
        within *= count / np.sqrt(count**2 - 1)  # the variance of a whole pixel
        cosine, sine = np.cos(optics.rotation_rad), np.sin(optics.rotation_rad)
        passed = np.zeros(self.size)
        for dy in within:
            for dx in within:
                to_x = (at_u - x - dx) / optics.lens_um
                to_y = (at_v - y - dy) / optics.lens_um
                far = optics.mask_um + optics.tilt[0] * x + optics.tilt[1] * y
                steep = 1 + to_x**2 + to_y**2
                inside = 1 / np.sqrt(1.52**2 * steep - steep + 1)
                far = far + optics.glass_um * (inside - 1 / 1.52)
                on_x = x + dx + far * to_x - optics.offset_um[0] - place[0]
                on_y = y + dy + far * to_y - optics.offset_um[1] - place[1]
                column = cosine * on_x + sine * on_y
                row = -sine * on_x + cosine * on_y
                passed += self._box(row, column, part)
        return passed / count**2

    def _boxes(self, part: float) -> tuple[np.ndarray, tuple[float, float]]:
        """Return the mean transmittance of boxes about corners of the fine grid, and their origin.

        (row, column, colour), and where the mask's middle is among them, in steps of the grid.
        part: side of the box on the aperture, of a cell's.
        """
        optics, fine_um = self.optics, self.optics.cell_um / FINER
        spare = [
            max(0, int((count * optics.cell_um - pixels * optics.pitch_um) / 2 - BESIDE_UM))
            for count, pixels in zip(self.passing.shape, self.size, strict=False)
        ]
        rows, columns = (int(beside / optics.cell_um) for beside in spare)
        height, width = self.passing.shape[:2]
        found = self.passing[rows : height - rows, columns : width - columns]
        found = found.repeat(FINER, 0).repeat(FINER, 1)
        if optics.blur_um:
            found = _blurred(found, optics.blur_um / fine_um)
        middle = [count / 2 for count in found.shape[:2]]
        reach = optics.mask_um / optics.lens_um * optics.aperture_cell_um * part / 2 / fine_um
        whole, part = int(reach), reach - int(reach)
        for axis in (0, 1):
            area = np.moveaxis(found, axis, 0).cumsum(0)
            area = np.concatenate([np.zeros_like(area[:1]), area])
            last = len(area) - 2 * whole - 2
            near, far = (area[first : first + last] for first in (1, 2 * whole + 1))
            nearer, farther = (area[first : first + last] for first in (0, 2 * whole + 2))
            sums = (1 - part) * (far - near) + part * (farther - nearer)
            found = np.moveaxis(sums / (2 * reach), 0, axis)
        return np.ascontiguousarray(found), (middle[0] - whole - 1, middle[1] - whole - 1)

    def _box(self, row: np.ndarray, column: np.ndarray, part: float) -> np.ndarray:
        """Return what the mask passes of aperture cells seen about places, um from its middle."""
        if part not in self.tables:
            self.tables[part] = self._boxes(part)
        boxes, (middle_row, middle_column) = self.tables[part]
        row = row * (FINER / self.optics.cell_um) + middle_row
        column = column * (FINER / self.optics.cell_um) + middle_column
        height, width, colours = boxes.shape
        inside = min(row.min(), column.min()) >= 0
        if not (inside and row.max() < height - 1 and column.max() < width - 1):
            raise ValueError("the mask is smaller than the beam")
        i, j = row.astype(int), column.astype(int)
        p, q = row - i, column - j
        values, at = boxes.ravel(), (i * width + j) * colours + self.filtered
        above = (1 - q) * values[at] + q * values[at + colours]
        at += width * colours
        below = (1 - q) * values[at] + q * values[at + colours]
        return (1 - p) * above + p * below


def _blurred(fine: np.ndarray, deviation: float) -> np.ndarray:
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
    return Bench(bench.cells, bench.size, seed=bench.seed, **keep)
