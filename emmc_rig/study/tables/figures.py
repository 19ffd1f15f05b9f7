"""The paper's Figures 5, 6, 7, 9 and 10, and the masks of Figure 8, drawn from cells and scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.masks import cfa_tile
from emmc_rig.pages.display import DisplayCurve
from emmc_rig.pages.paper_figure import (
    FRAMES,
    CloseUp,
    PaperFigure,
    Row,
    Strip,
    Tile,
    caption_of,
    draw_tiles,
)
from emmc_rig.pages.pictures import Pictures, detailed_pieces, epipolar_lines, pictures_of
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
from reconstruction.methods import METHODS

Array = NDArray[np.floating]
Codes = NDArray[np.uint8]
PIECE_SHARE, LEAST_PIECE_PX = 0.16, 28
EPI_PX = 80
"""Of the pieces of Figure 7's lines."""
MASK_CELLS = 24


def draw_figures(
    folder: Path, run: TablesSweep, results: Mapping[Cell, dict]
) -> dict[str, PaperFigure]:
    """Write the chosen figures as PDF, SVG, PNG and caption; return them by part.

    Those without cells are left out. folder: exists.
    """
    drawn = {}
    for part in run.parts:
        draw = _DRAW.get(part.name)
        if draw and all(cell in results for cell in cells_of(part, run.library.names)):
            drawn[part.name] = draw(part, run, results)
            drawn[part.name].save(folder, part.name)
    return drawn


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
        self.part, self.run = part, run
        self.scene = scenes_of(part, run.library.names)[0]
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
        corner, centre = (self.curve.encode(one) for one in (pictures.corner, pictures.centre))
        return Tile(title, corner, [
            CloseUp(piece.of(corner), FRAMES[0], piece), CloseUp(piece.of(centre), FRAMES[0]),
        ])  # fmt: skip

    def centre(self, title: str, picture: Array) -> Tile:
        """Return the centre view with all pieces."""
        codes = self.curve.encode(picture)
        framed = zip(self.pieces, FRAMES, strict=False)
        return Tile(title, codes, [CloseUp(one.of(codes), colour, one) for one, colour in framed])

    def drawn(
        self,
        rows: Sequence[Row],
        *says: str,
        curve: DisplayCurve | None = None,
        pieces: bool = True,
    ) -> PaperFigure:
        """Return the figure with its caption; curve: of the pictures, if not the scene's."""
        part, run, scene = self.part, self.run, self.scene
        size = "x".join(str(n) for n in self.truth.shape[2:4])
        learned = (
            run.source.label(scene, part.captures[0].binning)
            for method in part.pictured
            if METHODS[method].needs_dictionary
        )
        sources = [
            f"Scene {run.library.specs[scene]}, {size} pixels, seed {run.settings.seed}",
            *(f"Dictionary {one}" for one in dict.fromkeys(learned)),
        ]
        caption = caption_of(
            [f"{part.title}: {scene}.", *says], curve or self.curve,
            self.pieces if pieces else [], sources,
        )  # fmt: skip
        return PaperFigure(draw_tiles(rows), caption)


def _figure_5(part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> PaperFigure:
    seen, sensors = _Seen(part, run, corner=True), Sensors(run.settings.seed)
    scene, truth, (piece,) = seen.scene, seen.truth, seen.pieces
    tiles = []
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
        close_up = CloseUp(_stretched(piece.of(picture)), FRAMES[0], piece)
        tiles.append(Tile(f"{name}\n{caption}", curve.encode(picture * light), [close_up]))
    return seen.drawn(
        [Row(tiles)],
        "Above in true proportion of the light collected, below a piece with its contrast "
        "stretched. (i) and (iii) share the time among three shots; of (iii) the first is shown.",
        curve=curve,
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


def _stretched(picture: Array) -> Codes:
    """Return screen codes from the darkest to the brightest percents."""
    low, high = np.percentile(picture[picture > 0] if (picture > 0).any() else picture, [1, 99])
    scaled = np.clip((picture - low) / max(float(high - low), 1e-6), 0, 1)
    return (np.sqrt(scaled) * 255 + 0.5).astype(np.uint8)


def _figure_6(part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> PaperFigure:
    seen, (method,), rows = _Seen(part, run, corner=True), part.methods, []
    for noisy, label in ((False, "noise-free"), (True, "with sensor noise")):
        captures = [capture for capture in part.captures if capture.noisy == noisy]
        tiles = [seen.corner(*seen.titled(capture, method, results)) for capture in captures]
        rows.append(Row([seen.corner("true", seen.true), *tiles], label))
    return seen.drawn(
        rows, "Top-left view; below, the framed piece of it, and the same place in the centre view."
    )


def _figure_7(part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> PaperFigure:
    seen, (capture,) = _Seen(part, run), part.captures
    (y, x), true, curve = seen.lines, seen.true, seen.curve
    length = min(EPI_PX, *true.centre.shape[:2])
    left, top = (_busiest(epi, length) for epi in (true.across, true.down))

    def tile(title: str, pictures: Pictures) -> Tile:
        across, down = (
            curve.encode(epi[:, start : start + length])
            for epi, start in ((pictures.across, left), (pictures.down, top))
        )
        return Tile(title, curve.encode(pictures.centre), (), [
            Strip(across, ((y, left), (y, left + length - 1)), FRAMES[0]),
            Strip(down, ((top, x), (top + length - 1, x)), FRAMES[1]),
        ])  # fmt: skip

    tiles = [tile("true", true)]
    for method in part.methods:
        cell = Cell(seen.scene, capture, method)
        tiles.append(tile(f"{METHOD_TITLES[method]}\n{_db(results[cell], cell)}", seen.kept(cell)))
    return seen.drawn(
        [Row(tiles)],
        f"Centre view with two lines; below, what all views have along them: row {y}, all u "
        f"downwards, and column {x}, all v downwards. A point's slope is its disparity.",
        pieces=False,
    )


def _busiest(epi: Array, width: int) -> int:
    """Return where the piece of an epipolar image begins whose views differ most."""
    change = np.abs(epi[-1] - epi[0]).mean(axis=-1)
    width = min(width, change.size)
    sums = np.convolve(change, np.ones(width), "valid")
    return int(sums.argmax())


def _figure_8(part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> PaperFigure:
    seen, (method,) = _Seen(part, run, corner=True), part.pictured
    (piece,) = seen.pieces
    tiles = [seen.corner("true", seen.true)]
    for capture in part.captures:
        cell = Cell(seen.scene, capture, method)
        found = seen.curve.encode(seen.kept(cell).corner)
        cells = MASKS[capture.mask].draw(1, MASK_CELLS, MASK_CELLS, 1.0)[0]
        pattern = (cells * 255 + 0.5).astype(np.uint8)
        tiles.append(
            Tile(f"{MASK_TITLES[capture.mask]}\n{results[cell]['psnr_db']:.2f} dB", found, [
                CloseUp(pattern), CloseUp(piece.of(found), FRAMES[0], piece),
            ])
        )  # fmt: skip
    return seen.drawn(
        [Row(tiles)],
        f"By {METHOD_TITLES[method]}. Top-left view; below, {MASK_CELLS}x{MASK_CELLS} cells of the "
        "mask, and the framed piece; of the true view, that piece there and in the centre view.",
    )


def _figure_9(part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> PaperFigure:
    seen, rows = _Seen(part, run, pieces=2), []
    for method in part.methods:
        tiles = [seen.centre("true", seen.true.centre)]
        for capture in part.captures:
            title, pictures = seen.titled(capture, method, results)
            tiles.append(seen.centre(title, pictures.centre))
        rows.append(Row(tiles, METHOD_TITLES[method]))
    return seen.drawn(rows, "Centre view, noise-free; below, the framed pieces.")


def _figure_10(part: Part, run: TablesSweep, results: Mapping[Cell, dict]) -> PaperFigure:
    seen, (method,) = _Seen(part, run, pieces=2), part.methods
    truth, true = seen.truth, seen.true.centre
    found: dict[bool, list[Tile]] = {False: [], True: []}
    for capture in part.captures:
        title, pictures = seen.titled(capture, method, results)
        several = capture.shots > (3 if capture.scenario == "i" else 1)
        found[several].append(seen.centre(title, pictures.centre))
    small = truth[2, 2].reshape(truth.shape[2] // 2, 2, truth.shape[3] // 2, 2, 3).mean((1, 3))
    large = cv2.resize(small, true.shape[1::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    rows = [
        Row([seen.centre("true", true), *found[False]], "one image"),
        Row([seen.centre("true, at the pixels' size", large), *found[True]], "four images"),
    ]
    return seen.drawn(
        rows, "Centre view, noise-free, one pixel sums 2x2 samples; below, the framed pieces."
    )


_DRAW: dict[str, Callable[[Part, TablesSweep, Mapping[Cell, dict]], PaperFigure]] = {
    "figure5": _figure_5,
    "figure6": _figure_6,
    "figure7": _figure_7,
    "figure8": _figure_8,
    "figure9": _figure_9,
    "figure10": _figure_10,
}
