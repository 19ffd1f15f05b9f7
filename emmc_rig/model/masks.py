"""Mask patterns and colour filter tiles: settings in, arrays of transmittance out.

A drawn mask has shape (frame, row, column, colour), float32 in [0, 1]; rows grow with y, columns
with x. A pattern with several frames (a programmable aperture, a pattern redrawn for every shot)
shows frame s in shot s. Reference numbers are those of the paper.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from emmc_rig.model.decoding.stored import light_of, read_codes
from emmc_rig.model.errors import CameraError
from emmc_rig.model.settings import Settings

FILTERS = {"R": (1, 0, 0), "G": (0, 1, 0), "B": (0, 0, 1), "W": (1, 1, 1)}
CFA = {
    "mono": ("W",),
    "rggb": ("RG", "GB"),
    "grbg": ("GR", "BG"),
    "gbrg": ("GB", "RG"),
    "bggr": ("BG", "GR"),
    "quad-bayer": ("RRGG", "RRGG", "GGBB", "GGBB"),
    "rgbw": ("RG", "BW"),
    "x-trans": ("GBGGRG", "RGRBGB", "GBGGRG", "GRGGBG", "BGBRGR", "GRGGBG"),
}


def cfa_tile(cfa: str | tuple[str, ...]) -> NDArray[np.float32]:
    """Return a colour filter tile as transmittance (row, column, colour); names are keys of CFA."""
    rows = CFA.get(cfa.lower()) if isinstance(cfa, str) else cfa
    if rows is None:
        raise CameraError(f"unknown CFA '{cfa}': use one of {', '.join(CFA)} or a list of rows")
    if not rows or any(len(row) != len(rows[0]) for row in rows) or not rows[0]:
        raise CameraError(f"CFA tile {list(rows)}: every row needs the same number of filters")
    unknown = set("".join(rows)) - set(FILTERS)
    if unknown:
        raise CameraError(f"CFA tile {list(rows)}: filter '{unknown.pop()}' is not one of R G B W")
    return np.array([[FILTERS[letter] for letter in row] for row in rows], dtype=np.float32)


def fiducial_marks() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the fiducials of a designed mask, one ring and one cross, (9, 9) cells, 1 where open.

    The ring is the top left one of four: a turned or mirrored mask shows.
    """
    cross = np.ones((9, 9), dtype=np.uint8)
    cross[4, 1:-1] = cross[1:-1, 4] = 0
    ring = np.ones_like(cross)
    ring[1:-1, 1:-1] = 0
    ring[2:-2, 2:-2] = 1
    return ring, cross


class Pattern(Settings):
    """A mask pattern; `draw` makes its cells."""

    def frame_count(self, shots: int) -> int:
        """Return how many different frames the pattern shows over `shots` shots."""
        return 1

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the cells (frame, row, column, colour) in [0, 1]."""
        raise NotImplementedError

    def beside(self, folder: Path) -> Pattern:
        """Return the pattern with its files looked up from a folder."""
        return self


def _grey(cells: NDArray[np.float64] | NDArray[np.bool_]) -> NDArray[np.float32]:
    return np.repeat(np.asarray(cells, dtype=np.float32)[..., None], 3, axis=-1)


class Open(Pattern):
    """No mask: everything passes."""

    kind: Literal["open"]

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return ones."""
        return np.ones((frames, rows, columns, 3), dtype=np.float32)


class Pinhole(Pattern):
    """One open square in an opaque plate; `at_cells` (x, y) from the middle, `side_cells` wide."""

    kind: Literal["pinhole"]
    at_cells: tuple[float, float] = (0, 0)
    side_cells: float = Field(default=1, gt=0)

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the plate; cells cut by the edge of the hole pass their open share."""

        def share(count: int, centre: float) -> NDArray[np.float64]:
            edges = np.arange(count + 1) - count / 2 - centre
            inside = np.clip(edges, -self.side_cells / 2, self.side_cells / 2)
            return np.asarray(np.diff(inside), dtype=np.float64)

        hole = np.outer(share(rows, self.at_cells[1]), share(columns, self.at_cells[0]))
        return np.repeat(_grey(hole)[None], frames, axis=0)


class _Random(Pattern):
    seed: int = Field(default=0, ge=0)
    redraw: bool = Field(default=False, description="draw a new pattern for every shot")

    def frame_count(self, shots: int) -> int:
        """Return one frame, or one a shot."""
        return shots if self.redraw else 1

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return `frames` patterns, drawn outward from the middle.

        Row r of frame s has the random stream (seed, s, r) of its own, counted from the middle
        as its cells are: a larger plate is the same plate with more cells around it.
        """
        cells = np.empty((frames, rows, columns, 3), dtype=np.float32)
        for frame in range(frames):
            for index, row in enumerate(_outward(rows)):
                rng = np.random.default_rng([self.seed, frame, index])
                cells[frame, row, _outward(columns)] = self._row(rng, columns)
        return cells

    def _row(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        """Return `count` cells, (count, colour); the first of more are the same."""
        raise NotImplementedError


def _outward(count: int) -> NDArray[np.intp]:
    """Return the indices 0 to count - 1 from the middle outward, to both sides in turn."""
    return np.argsort(np.abs(np.arange(count) - count // 2 + 0.25), kind="stable")


class RandomRGBW(_Random):
    """Each cell is a red, green, blue or clear filter with equal probability [21]."""

    kind: Literal["random_rgbw"]

    def _row(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        return np.array(list(FILTERS.values()), np.float32)[rng.integers(4, size=count)]


class RandomBinary(_Random):
    """Each cell is open with the given probability [31]."""

    kind: Literal["random_binary"]
    open_probability: float = Field(default=0.5, gt=0, le=1)

    def _row(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        return _grey(rng.random(count) < self.open_probability)


class UniformColour(_Random):
    """Each colour of each cell uniform in [0, 1] (paper, Figure 8c)."""

    kind: Literal["uniform_colour"]

    def _row(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        return rng.random((count, 3), dtype=np.float32)


class GaussianColour(_Random):
    """Each colour of each cell normal, clipped to [0, 1] (paper, Figure 8d)."""

    kind: Literal["gaussian_colour"]
    mean: float = Field(default=0.5, ge=0, le=1)
    deviation: float = Field(default=0.2, ge=0)

    def _row(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        cells = rng.normal(self.mean, self.deviation, (count, 3))
        return np.clip(cells, 0, 1).astype(np.float32)


class GaussianMonochrome(_Random):
    """Each cell a grey, normal, clipped to [0, 1] [17]."""

    kind: Literal["gaussian_monochrome"]
    mean: float = Field(default=0.5, ge=0, le=1)
    deviation: float = Field(default=0.2, ge=0)

    def _row(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        return _grey(np.clip(rng.normal(self.mean, self.deviation, count), 0, 1))


class Sinusoids(Pattern):
    """A sum of cosines (1 + mean of cos(2 pi (fx x + fy y))) / 2, sampled at the cell centres."""

    kind: Literal["sinusoids"]
    cycles_per_mm: tuple[tuple[float, float], ...] = Field(min_length=1)

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the pattern, its phase 0 at the middle of the mask."""
        y_mm = ((np.arange(rows) - (rows - 1) / 2) * cell_um * 1e-3)[:, None]
        x_mm = ((np.arange(columns) - (columns - 1) / 2) * cell_um * 1e-3)[None, :]
        waves = [np.cos(2 * np.pi * (fx * x_mm + fy * y_mm)) for fx, fy in self.cycles_per_mm]
        return np.repeat(_grey((1 + np.mean(waves, axis=0)) / 2)[None], frames, axis=0)


def mura_tile(prime: int) -> NDArray[np.float64]:
    """Return the modified uniformly redundant array of side `prime` (0 or 1), flat in spectrum.

    Source: Gottesman & Fenimore, Applied Optics 28 (1989) 4344.
    """
    residues = {(k * k) % prime for k in range(1, prime)}
    sign = np.array([1 if k in residues else -1 for k in range(prime)])
    tile = (np.outer(sign, sign) > 0).astype(float)
    tile[0, :] = 0
    tile[1:, 0] = 1
    return tile


class Mura(Pattern):
    """A broadband mask: the modified uniformly redundant array of a prime side, repeated."""

    kind: Literal["mura"]
    prime: int = Field(default=5, ge=3, le=997)

    @model_validator(mode="after")
    def _is_prime(self) -> Mura:
        if any(self.prime % k == 0 for k in range(2, int(self.prime**0.5) + 1)):
            raise ValueError(f"a MURA needs a prime side, {self.prime} is not prime")
        return self

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the tile repeated, its first cell at the mask's corner."""
        return np.repeat(_repeat(_grey(mura_tile(self.prime)), rows, columns)[None], frames, axis=0)


def _repeat(tile: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    return tile[np.arange(rows) % tile.shape[0]][:, np.arange(columns) % tile.shape[1]]


def _as_frames(cells: object, ndim: int) -> NDArray[np.float32]:
    """Return nested lists as (frame, row, column, colour); `ndim` says which axes they have."""
    try:
        array = np.asarray(cells, dtype=np.float32)
    except (TypeError, ValueError) as fault:
        raise ValueError("rows of different lengths, or cells that are not numbers") from fault
    if array.ndim == ndim:
        array = np.repeat(array[..., None], 3, axis=-1)
    if array.ndim != ndim + 1 or array.shape[-1] != 3 or array.size == 0:
        raise ValueError(f"expected a {ndim}-dimensional array of greys or of RGB triples")
    if not np.isfinite(array).all() or array.min() < 0 or array.max() > 1:
        raise ValueError("transmittance must lie in [0, 1]")
    return array


class _Cells(Pattern):
    cells: list

    @model_validator(mode="after")
    def _is_array(self) -> _Cells:
        _as_frames(self.cells, 2)
        return self


class Tile(_Cells):
    """Any user tile, repeated over the mask: rows of greys or of RGB triples."""

    kind: Literal["tile"]

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the tile repeated, its first cell at the mask's corner."""
        tile = _repeat(_as_frames(self.cells, 2), rows, columns)
        return np.repeat(tile[None], frames, axis=0)


class Sequence(Pattern):
    """A programmable aperture: `regions` lists its frames (rows of greys or RGB triples), or
    `scan` (columns, rows) opens one cell after the other [27]."""

    kind: Literal["sequence"]
    regions: list | None = None
    scan: tuple[int, int] | None = None

    @model_validator(mode="after")
    def _has_one(self) -> Sequence:
        if (self.regions is None) == (self.scan is None):
            raise ValueError("give either 'regions' or 'scan'")
        if self.regions is not None:
            _as_frames(self.regions, 3)
        elif min(self.scan or (0,)) < 1:
            raise ValueError("'scan' needs at least one column and one row")
        return self

    def _cells(self) -> NDArray[np.float32]:
        if self.scan is not None:
            columns, rows = self.scan
            return _grey(np.eye(rows * columns).reshape(-1, rows, columns))
        return _as_frames(self.regions, 3)

    def frame_count(self, shots: int) -> int:
        """Return the length of the sequence."""
        return len(self._cells())

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return all frames of the sequence, as large as they are given."""
        return self._cells()


class Parameters(_Cells):
    """A mask given cell by cell, for instance learned [34]: rows of greys or of RGB triples."""

    kind: Literal["parameters"]

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the cells as they are given."""
        return np.repeat(_as_frames(self.cells, 2)[None], frames, axis=0)


class Picture(Pattern):
    """A picture file, one pixel a cell; repeated when `repeat`, else it must cover the beam."""

    kind: Literal["picture"]
    path: Path
    repeat: bool = False

    def beside(self, folder: Path) -> Picture:
        """Return the pattern with its picture looked up from a folder."""
        return self.model_copy(update={"path": folder / self.path})

    def draw(self, frames: int, rows: int, columns: int, cell_um: float) -> NDArray[np.float32]:
        """Return the picture scaled to [0, 1]; raises CameraError when it cannot be read."""
        cells = light_of(*read_codes(self.path, CameraError))
        if not (cells.min() >= 0 and cells.max() <= 1):
            raise CameraError(f"{self.path}: transmittances beyond 0 to 1, or no numbers")
        if self.repeat:
            cells = _repeat(cells, rows, columns)
        return np.repeat(cells[None], frames, axis=0)


AnyPattern = Annotated[
    Open
    | Pinhole
    | RandomRGBW
    | RandomBinary
    | UniformColour
    | GaussianColour
    | GaussianMonochrome
    | Sinusoids
    | Mura
    | Tile
    | Sequence
    | Parameters
    | Picture,
    Field(discriminator="kind"),
]
