"""The paper's Figures 5, 6, 7, 9 and 10, and the masks of Figure 8, drawn from cells and scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emmc_rig.model.masks import cfa_tile
from emmc_rig.pages.display import DisplayCurve
from emmc_rig.pages.drawing import FAINT, INK, save_publication
from emmc_rig.pages.pictures import Pictures, Piece, detailed_pieces, epipolar_lines, pictures_of
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cell_sweep import TablesSweep
from emmc_rig.study.tables.cells import (
    MASK_TITLES,
    MASKS,
    METHOD_TITLES,
    SCENARIOS,
    Capture,
    Cell,
    Part,
    cells_of,
    scenes_of,
)
from emmc_rig.study.tables.shots import Sensors, Shots, demosaiced_rggb

Array = NDArray[np.floating]
Codes = NDArray[np.uint8]
TILE_PX, GAP_PX, MARGIN_PX, DPI = 400, 8, 16, 100
TITLE_PX, HEAD_PX, NOTE_PX = 44, 44, 26
FRAMES = ((255, 176, 0), (0, 190, 255))


@dataclass(frozen=True)
class Tile:
    """A picture (y, x, 3) of screen codes with its pieces, each from a picture of its own.

    title: its first line is bold. boxed: pieces to frame in the whole picture.
    """

    title: str
    whole: Codes
    pieces: tuple[Codes, ...] = ()
    boxed: tuple[Piece, ...] = ()


def screen(picture: Array, curve: DisplayCurve) -> Codes:
    """Return screen codes (y, x, 3) of a linear picture (y, x, 3) or (y, x)."""
    return curve.encode(picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=-1))


def composed(tile: Tile, width_px: int = TILE_PX) -> Codes:
    """Return the tile as one picture of a width: the whole, the pieces in a row below."""
    height, width = tile.whole.shape[:2]
    scale = width_px / width
    whole: NDArray = _resized(tile.whole, width_px, round(height * scale))
    for piece, colour in zip(tile.boxed, FRAMES, strict=False):
        corner = round(piece.x * scale), round(piece.y * scale)
        other = round((piece.x + piece.side) * scale), round((piece.y + piece.side) * scale)
        whole = cv2.rectangle(whole, corner, other, (0, 0, 0), 4)
        whole = cv2.rectangle(whole, corner, other, colour, 2)
    if not tile.pieces:
        return np.asarray(whole, np.uint8)
    each = (width_px - GAP_PX * (len(tile.pieces) - 1)) // len(tile.pieces)
    row = np.full((each, width_px, 3), 255, np.uint8)
    for i, piece in enumerate(tile.pieces):
        left = i * (each + GAP_PX)
        row[:, left : left + each] = cv2.resize(
            piece, (each, each), interpolation=cv2.INTER_NEAREST_EXACT
        )
    gap = np.full((GAP_PX, width_px, 3), 255, np.uint8)
    return np.concatenate([whole, gap, row]).astype(np.uint8)


def _resized(picture: Codes, width: int, height: int) -> Codes:
    smaller = width < picture.shape[1]
    how = cv2.INTER_AREA if smaller else cv2.INTER_NEAREST_EXACT
    return cv2.resize(picture, (width, height), interpolation=how).astype(np.uint8)


def write_mosaic(
    path: Path,
    title: str,
    rows: Sequence[tuple[str, Sequence[Tile | None]]],
    note: str = "",
    tile_px: int = TILE_PX,
) -> None:
    """Write rows of tiles, each row under its heading if any, as PNG and beside it as PDF."""
    columns = max(len(tiles) for _, tiles in rows)
    pictures = [[t and composed(t, tile_px) for t in tiles] for _, tiles in rows]
    heights = [max(p.shape[0] for p in line if p is not None) for line in pictures]
    width = 2 * MARGIN_PX + columns * tile_px + (columns - 1) * MARGIN_PX
    height = TITLE_PX + (NOTE_PX if note else 0) + MARGIN_PX
    for (heading, _), tall in zip(rows, heights, strict=True):
        height += (NOTE_PX if heading else 0) + HEAD_PX + tall + MARGIN_PX
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")

    def write(x: float, y: float, text: str, size: float, colour: str = INK, weight="normal"):
        figure.text(
            x / width, 1 - y / height, text, fontsize=size, color=colour, weight=weight,
            va="top", ha="left",
        )  # fmt: skip

    write(MARGIN_PX, 12, title, 14, weight="bold")
    y = TITLE_PX
    if note:
        write(MARGIN_PX, y - 4, note, 9.5, FAINT)
        y += NOTE_PX
    for (heading, tiles), line, tall in zip(rows, pictures, heights, strict=True):
        if heading:
            write(MARGIN_PX, y + 4, heading, 11.5, weight="bold")
            y += NOTE_PX
        for i, (tile, picture) in enumerate(zip(tiles, line, strict=True)):
            if tile is None or picture is None:
                continue
            x = MARGIN_PX + i * (tile_px + MARGIN_PX)
            first, _, second = tile.title.partition("\n")
            write(x, y + 2, first, 10.5, weight="bold")
            write(x, y + 22, second, 10, FAINT)
            top = y + HEAD_PX
            axes = figure.add_axes(
                (
                    x / width,
                    1 - (top + picture.shape[0]) / height,
                    tile_px / width,
                    picture.shape[0] / height,
                )
            )
            axes.imshow(picture, interpolation="none", aspect="auto")
            axes.set_axis_off()
        y += HEAD_PX + tall + MARGIN_PX
    figure.savefig(path, format="png", dpi=DPI)
    save_publication(figure, path.with_suffix(".pdf"), f"{title}. {note}")


PIECE_SHARE, LEAST_PIECE_PX = 0.16, 28
EPI_PX, EPI_ROW_PX = 80, 3
MASK_CELLS = 24


def draw_figures(folder: Path, run: TablesSweep, results: Mapping[Cell, dict]) -> dict[str, Path]:
    """Write the chosen figures as PNG; return the files by part. Those without cells are left out.

    folder: exists.
    """
    written = {}
    for part in run.parts:
        draw = _DRAW.get(part.name)
        if draw is None or not all(cell in results for cell in cells_of(part, run.library.names)):
            continue
        path = folder / f"{part.name}.png"
        draw(path, part, run, results)
        written[part.name] = path
    return written


def _name(capture: Capture) -> str:
    name = f"({capture.scenario}) {SCENARIOS[capture.scenario]} × {capture.shots}"
    return f"{name}, demosaiced first" if capture.demosaiced else name


def _db(result: Mapping, cell: Cell) -> str:
    text = f"{result['psnr_db']:.2f} dB"
    printed = cell.paper_psnr_db
    return text if printed is None else f"{text} (paper: {printed:.2f})"


class _Seen:
    """The scene that a figure shows: its light field, true pictures, screen curve and pieces."""

    def __init__(self, part: Part, run: TablesSweep, corner: bool = False, pieces: int = 1):
        self.scene = scenes_of(part, run.library.names)[0]
        self.run = run
        self.truth = run.truth(Cell(self.scene, part.captures[0], ""))
        self.lines = epipolar_lines(self.truth)
        self.true = pictures_of(self.truth, self.lines)
        picture = self.true.corner if corner else self.true.centre
        self.curve = DisplayCurve.fitted_to(self.true.centre)
        side = max(LEAST_PIECE_PX, round(PIECE_SHARE * picture.shape[1]))
        self.pieces = detailed_pieces(picture, side, pieces)

    def kept(self, cell: Cell) -> Pictures:
        """Return the pictures that the sweep has left of a cell."""
        found = Pictures.load(self.run.picture(cell))
        assert found is not None, "the sweep leaves pictures for every cell of a figure"
        return found

    def titled(self, capture: Capture, method: str, results: Mapping[Cell, dict]):
        """Return a cell's title with its PSNR, and its pictures."""
        cell = Cell(self.scene, capture, method)
        return f"{_name(capture)}\n{_db(results[cell], cell)}", self.kept(cell)

    def corner(self, title: str, pictures: Pictures) -> Tile:
        """Return the top-left view with the piece from it and from the centre view."""
        (piece,) = self.pieces
        corner, centre = screen(pictures.corner, self.curve), screen(pictures.centre, self.curve)
        return Tile(title, corner, (piece.of(corner), piece.of(centre)), (piece,))

    def centre(self, title: str, picture: Array) -> Tile:
        """Return the centre view with all pieces."""
        codes = screen(picture, self.curve)
        cut = tuple(piece.of(codes) for piece in self.pieces)
        return Tile(title, codes, cut, tuple(self.pieces))


def _figure_5(path: Path, part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> None:
    seen, sensors = _Seen(part, run, corner=True), Sensors(run.settings.seed)
    scene, truth, (piece,) = seen.scene, seen.truth, seen.pieces
    tiles: list[Tile | None] = []
    # What reaches the sensor in the same total time, relative to one CFA shot.
    shown: list[tuple[str, Shots, Array, float]] = []
    for capture in part.captures:
        shots = sensors.take(capture, truth, scene)
        shown.append((_name(capture), shots, *_as_picture(capture, shots)))
        if capture.scenario == "ii":
            interpolated = demosaiced_rggb(shots.frames[0]).transpose(1, 2, 0)
            shown.append(("(ii) demosaiced, to compare", shots, interpolated, 1.0))
    white = next(p for name, _, p, _ in shown if "mono" in name)
    curve = DisplayCurve.fitted_to(white)
    for name, shots, picture, light in shown:
        scenario = name[1 : name.index(")")]
        caption = "" if "demosaiced" in name else f"sensor PSNR {shots.sensor_psnr_db:.2f} dB"
        if paper.known_as(scene) == "dragons" and caption:
            printed = paper.SENSOR_PSNR_DB.get(scenario)
            caption += f" (paper: {'over 50' if printed is None else f'{printed:.2f}'})"
        tiles.append(
            Tile(
                f"{name}\n{caption}",
                screen(picture * light, curve),
                (_stretched(piece.of(picture)),),
                (piece,),
            )
        )
    write_mosaic(
        path,
        f"{part.title}: {scene}",
        [("", tiles)],
        "Above in true proportion of the light collected, below a piece with its contrast "
        "stretched. (i) and (iii) share the time among three shots; of (iii) the first is shown.",
    )


def _as_picture(capture: Capture, shots: Shots) -> tuple[Array, float]:
    """Return frames as a picture (y, x, 3), and the light they collected against a CFA shot."""
    if capture.scenario == "i":
        return shots.frames.transpose(1, 2, 0), 1 / 3
    frame = shots.frames[0]
    if capture.scenario == "iii":
        return np.repeat(frame[..., None], 3, axis=-1), 1.0
    tile = cfa_tile("rggb")
    rows, columns = frame.shape
    seen = tile[np.arange(rows) % 2][:, np.arange(columns) % 2]
    return frame[..., None] * seen, 1.0


def _stretched(picture: Array) -> NDArray[np.uint8]:
    """Return screen codes from the darkest to the brightest percents."""
    low, high = np.percentile(picture[picture > 0] if (picture > 0).any() else picture, [1, 99])
    scaled = np.clip((picture - low) / max(float(high - low), 1e-6), 0, 1)
    return (np.sqrt(scaled) * 255 + 0.5).astype(np.uint8)


def _figure_6(path: Path, part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> None:
    seen, (method,), rows = _Seen(part, run, corner=True), part.methods, []
    for noisy, heading in ((False, "Noise-free"), (True, "With sensor noise")):
        captures = [capture for capture in part.captures if capture.noisy == noisy]
        tiles = [seen.corner(*seen.titled(capture, method, results)) for capture in captures]
        rows.append((heading, [seen.corner("true\n", seen.true), *tiles]))
    write_mosaic(
        path,
        f"{part.title}: {seen.scene}",
        rows,
        "Top-left view; below, the framed piece of it, and the same place in the centre view.",
        tile_px=320,
    )


def _figure_7(path: Path, part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> None:
    seen, (capture,) = _Seen(part, run), part.captures
    scene, (y, x), true, curve = seen.scene, seen.lines, seen.true, seen.curve
    length = min(EPI_PX, *true.centre.shape[:2])
    left, top = (_busiest(epi, length) for epi in (true.across, true.down))

    def strips(pictures: Pictures, name: str) -> list[Tile | None]:
        return [
            Tile(
                f"{name}\n{line}",
                np.repeat(screen(epi[:, start : start + length], curve), EPI_ROW_PX, axis=0),
            )
            for epi, start, line in (
                (pictures.across, left, f"row {y} (orange), all u downwards"),
                (pictures.down, top, f"column {x} (blue), all v downwards"),
            )
        ]

    def marked(pictures: Pictures, name: str) -> Tile:
        view = screen(pictures.centre, curve).copy()
        thick = max(1, view.shape[1] // 300)
        cv2.line(view, (left, y), (left + length - 1, y), FRAMES[0], thick)
        cv2.line(view, (x, top), (x, top + length - 1), FRAMES[1], thick)
        return Tile(f"{name}\ncentre view with the two lines", view)

    shown = {"true": true}
    for method in part.methods:
        cell = Cell(scene, capture, method)
        shown[f"{METHOD_TITLES[method]}, {_db(results[cell], cell)}"] = seen.kept(cell)
    named = list(shown.items())
    write_mosaic(
        path,
        f"{part.title}: {scene}",
        [
            ("", [marked(pictures, name) for name, pictures in (named[0], named[2])]),
            *(("", strips(pictures, name)) for name, pictures in named),
        ],
        "A point's slope is its disparity.",
        tile_px=480,
    )


def _busiest(epi: Array, width: int) -> int:
    """Return where the piece of an epipolar image begins whose views differ most."""
    change = np.abs(epi[-1] - epi[0]).mean(axis=-1)
    width = min(width, change.size)
    sums = np.convolve(change, np.ones(width), "valid")
    return int(sums.argmax())


def _figure_8(path: Path, part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> None:
    seen, (method,) = _Seen(part, run, corner=True), part.pictured
    scene, curve, (piece,) = seen.scene, seen.curve, seen.pieces
    codes = screen(seen.true.corner, curve)
    tiles: list[Tile | None] = [Tile("true\n", codes, (piece.of(codes),), (piece,))]
    for capture in part.captures:
        cell = Cell(scene, capture, method)
        found = screen(seen.kept(cell).corner, curve)
        cells = MASKS[capture.mask].draw(1, MASK_CELLS, MASK_CELLS, 1.0)[0]
        pattern = (cells * 255 + 0.5).astype(np.uint8)
        title = f"{MASK_TITLES[capture.mask]}\n{results[cell]['psnr_db']:.2f} dB"
        tiles.append(Tile(title, found, (pattern, piece.of(found)), (piece,)))
    write_mosaic(
        path,
        f"{part.title}: {scene}, {METHOD_TITLES[method]}",
        [("", tiles)],
        f"Top-left view; below, {MASK_CELLS}x{MASK_CELLS} cells of the mask, and the framed piece.",
        tile_px=320,
    )


def _figure_9(path: Path, part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> None:
    seen, rows = _Seen(part, run, pieces=2), []
    for method in part.methods:
        tiles = [seen.centre("true\n", seen.true.centre)]
        for capture in part.captures:
            title, pictures = seen.titled(capture, method, results)
            tiles.append(seen.centre(title, pictures.centre))
        rows.append((METHOD_TITLES[method], tiles))
    note = "Centre view, noise-free; below, the framed pieces."
    write_mosaic(path, f"{part.title}: {seen.scene}", rows, note, tile_px=300)


def _figure_10(path: Path, part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> None:
    seen, (method,) = _Seen(part, run, pieces=2), part.methods
    truth, true = seen.truth, seen.true.centre
    found: dict[bool, list[Tile | None]] = {False: [], True: []}
    for capture in part.captures:
        title, pictures = seen.titled(capture, method, results)
        several = capture.shots > (3 if capture.scenario == "i" else 1)
        found[several].append(seen.centre(title, pictures.centre))
    small = truth[2, 2].reshape(truth.shape[2] // 2, 2, truth.shape[3] // 2, 2, 3).mean((1, 3))
    large = cv2.resize(small, true.shape[1::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    rows = [
        ("One image", [seen.centre("true\n", true), *found[False]]),
        ("Four images", [seen.centre("true, at the pixels' size\n", large), *found[True]]),
    ]
    note = "Centre view, noise-free, one pixel sums 2x2 samples; below, the framed pieces."
    write_mosaic(path, f"{part.title}: {seen.scene}", rows, note, tile_px=340)


_DRAW: dict[str, Callable[[Path, Part, TablesSweep, Mapping[Cell, dict]], None]] = {
    "figure5": _figure_5,
    "figure6": _figure_6,
    "figure7": _figure_7,
    "figure8": _figure_8,
    "figure9": _figure_9,
    "figure10": _figure_10,
}
