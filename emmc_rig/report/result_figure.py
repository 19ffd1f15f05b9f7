"""Figure of results for a paper: views, close-ups, epipolar images and maps, side by side.

Every picture is embedded at its own pixels; text and lines stay vectors. Results are columns, maps
rows under each other's scale; of a single result the maps stand to the right of the view, and its
epipolar image under them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.formats.format import Export
from emmc_rig.model.lightfield import epi_horizontal, psnr_db, ssim
from emmc_rig.model.view_axes import picture_name, place_name, shows_parallax
from emmc_rig.report.display import DisplayCurve, ends, finite, round_up, three_colours
from emmc_rig.report.drawing import FAINT, INK, save_publication
from emmc_rig.version import __version__

Array = NDArray[np.floating]
WIDTH_IN = 7.16
"""Of a figure across both columns of an IEEE page."""
EDGE_IN, GAP_IN, LABEL_IN, BAR_IN, STRIP_IN = 0.01, 0.06, 0.28, 0.45, 0.4
BAR_WIDE_IN = 0.08
TICK_IN = 0.05
"""Half a figure at the lower end of a scale, which stands at the edge."""
TEXT_PT, LINE_IN = 7.5, 0.13
LETTER_PT = 0.55 * TEXT_PT
"""Mean width of a letter of a title."""
FRAMES = ("#ffb000", "#00beff", "#ff5d8f", "#7ed957")
"""Colours of the close-ups' frames, in order."""
CLOSE_UP_SHARE = 0.16
LEAST_RANGE_PX = 0.1
"""Of disparities: a map with less is one colour, and its value stands in the caption instead."""
SCALE_SHARE = 0.25
"""Of the picture's width, which the scale bar does not exceed."""


@dataclass(frozen=True)
class Piece:
    """A square of a picture to enlarge."""

    y: int
    x: int
    side: int

    def of(self, picture: NDArray) -> NDArray:
        """Cut it out of (y, x, c)."""
        return picture[self.y : self.y + self.side, self.x : self.x + self.side]


@dataclass(frozen=True)
class FigureSettings:
    """What is shown of each result.

    view: its row and column (default: the centre). at: centres (y, x) of the close-ups, pixels
    (default: two with many edges). side_px: of a close-up. width_in: of the figure.
    """

    view: tuple[int, int] | None = None
    at: Sequence[tuple[int, int]] = ()
    side_px: int | None = None
    width_in: float = WIDTH_IN


@dataclass(frozen=True)
class PaperFigure:
    """The figure, its caption with where everything came from, and PSNR and SSIM by column."""

    figure: Figure
    caption: str
    measured: Mapping[str, Mapping[str, float]]

    def save(self, folder: Path) -> None:
        """Write figure.pdf, .svg, .png, and the caption as figure.txt, into a folder."""
        for ending in ("pdf", "svg", "png"):
            save_publication(self.figure, folder / f"figure.{ending}", self.caption)
        text = "\n".join(textwrap.wrap(self.caption, 100, break_on_hyphens=False))
        (folder / "figure.txt").write_text(text + "\n", encoding="utf-8")


@dataclass(frozen=True)
class _Maps:
    """A map (y, x) of every result, None for a result without, and their common scale."""

    label: str
    values: Sequence[Array | None]
    low: float
    high: float
    colours: str


def draw_results(
    results: Sequence[Export],
    settings: FigureSettings | None = None,
    figure: Figure | None = None,
) -> PaperFigure:
    """Draw results of one capture side by side; the first one's truth, if any, comes before them.

    figure: an empty one to draw into, for instance of a window. Raises AppError where they differ
    in shape, WrongUsageError for places outside the picture.
    """
    settings = settings or FigureSettings()
    truth = results[0].truth
    axes = results[0].view_axes
    true = [] if truth is None else [Export("true", "", truth, view_axes=axes)]
    columns = [*true, *results]
    reference = columns[0].light_field
    for result in results:
        if result.light_field.shape != reference.shape:
            raise AppError(
                f"{result.title} has shape {result.light_field.shape}, {results[0].title} has "
                f"{reference.shape}: name results of one capture"
            )
    if any(result.view_axes != axes for result in results):
        raise AppError(
            "views are angles of one result, bands or times of another: name results of one capture"
        )
    parallax, (rows_of_views, columns_of_views) = shows_parallax(axes), reference.shape[:2]
    view = _view(reference, settings.view)
    pieces = _pieces(reference[view], settings)
    curve = DisplayCurve.fitted_to(reference)
    names = _names(columns)
    measured = {} if truth is None else {
        name: {"psnr_db": psnr_db(shown.light_field, truth), "ssim": ssim(shown.light_field, truth)}
        for name, shown in zip(names[1:], results, strict=True)
    }  # fmt: skip
    titles = [
        f"{name}\n{measured[name]['psnr_db']:.2f} dB, SSIM\u00a0{measured[name]['ssim']:.3f}"
        if name in measured
        else name
        for name in names
    ]
    line, _ = epipolar_lines(reference)
    maps, flat_px = _maps(results, view, truth)
    beside = maps if len(columns) == 1 else []
    titles += [drawn.label for drawn in beside]
    rows, bars = (0, len(maps)) if beside else (len(maps), 1 if maps and truth is None else 0)
    sheet = _Sheet(
        figure or Figure(), settings.width_in, titles, len(pieces), rows, bars, reference.shape,
        bool(beside),
    )  # fmt: skip
    for at, column in enumerate(columns):
        shown = column.light_field
        codes, strip = (
            three_colours(curve.encode(picture))
            for picture in (shown[view], epi_horizontal(shown, view[0], line))
        )
        sheet.picture(at, codes, pieces, line)
        sheet.strip(at, strip, line, parallax)
    sheet.scale_bar(reference.shape[3])
    for at, drawn in enumerate(beside, 1):
        sheet.map(at, 0, drawn.values[0], drawn)
        sheet.bar(at, 0, drawn)
    for row, drawn in enumerate(maps if not beside else [], 1):
        for at, values in enumerate(drawn.values, len(columns) - len(results)):
            sheet.map(at, row, values, drawn)
        if truth is None:
            sheet.label(row, drawn.label)
            sheet.bar(len(columns) - 1, row, drawn)
        else:
            sheet.key(row, drawn)
    sources = [
        f"{name}: {_source(column)}."
        for name, column in zip(names, columns, strict=True)
        if column.title != "true"
    ]
    formula = f"{curve.gain:.3g} x"
    if abs(curve.gamma - 1) >= 0.005:
        formula = f"({formula})^(1/{curve.gamma:.3g})"
    name, picture = place_name(axes, (rows_of_views, columns_of_views), view), picture_name(axes)
    caption = " ".join([
        f"{name[0].upper()}{name[1:]} of {rows_of_views}x{columns_of_views}, "
        f"{reference.shape[2]}x{reference.shape[3]} pixels.",
        f"Epipolar image of row {line} (dotted): that row of every view (v, u) of v = {view[0]}, u "
        "downwards; its slopes are disparities." if parallax
        else f"Row {line} (dotted) of every {picture}, downwards.",
        *([] if flat_px is None else
          [f"Disparity is {flat_px:.2f} px per view everywhere, to {LEAST_RANGE_PX} px."]),
        *([f"Error: root mean square over colours, of this {picture}. PSNR and SSIM are of all "
           f"{picture}s, peak 1."] if measured else []),
        f"Close-ups of {pieces[0].side}x{pieces[0].side} pixels around (y, x) = "
        + ", ".join(f"({p.y + p.side // 2}, {p.x + p.side // 2})" for p in pieces) + ".",
        f"Linear values x are shown as {formula}, cut at 1.",
        *sources,
        f"Drawn by emmc-rig {__version__}.",
    ])  # fmt: skip
    return PaperFigure(sheet.figure, caption, measured)


class _Sheet:
    """Axes in columns of one width, placed by the inch from the top left.

    titles: of all columns. close_ups: below each picture. rows: of maps below. bars: columns with a
    scale to their right, the last ones. shape: of light fields. beside: maps stand to the right of
    the only picture, over its epipolar image.
    """

    def __init__(
        self,
        figure: Figure,
        width_in: float,
        titles: Sequence[str],
        close_ups: int,
        rows: int,
        bars: int,
        shape: Sequence[int],
        beside: bool,
    ) -> None:
        self.left = EDGE_IN if beside else LABEL_IN
        self.bars, self.beside = bars, beside
        gaps_in = (len(titles) - 1) * GAP_IN + bars * BAR_IN
        self.wide = (width_in - EDGE_IN - self.left - gaps_in) / len(titles)
        self.tall = self.wide * shape[2] / shape[3]
        self.side = (self.wide - GAP_IN * (close_ups - 1)) / close_ups
        letters = max(8, int(self.wide * 72 / LETTER_PT))
        wrapped = [
            "\n".join(line for text in title.split("\n") for line in textwrap.wrap(text, letters))
            for title in titles
        ]
        self.top = GAP_IN + LINE_IN * (1 + max(title.count("\n") for title in wrapped))
        strip = 0 if beside else STRIP_IN + GAP_IN
        self.below = self.tall + self.side + strip + 3 * GAP_IN
        height = self.top + self.below + rows * (self.tall + 2 * GAP_IN) + EDGE_IN
        self.width, self.height = width_in, height + TICK_IN
        self.figure = figure
        figure.set_size_inches(self.width, self.height)
        for at, title in enumerate(wrapped):
            x = self._x(at) + self.wide / 2
            self._text(x, self.top - GAP_IN / 2, title, va="bottom")

    def picture(self, at: int, codes: NDArray, pieces: Sequence[Piece], line: int) -> None:
        """Draw screen codes (y, x, 3) into a column, with its pieces below."""
        x, y = self._x(at), self.top
        axes = self._axes(x, y, self.wide, self.tall)
        axes.imshow(codes, interpolation="none", aspect="auto")
        y += self.tall + GAP_IN
        for k, piece in enumerate(pieces):
            colour = FRAMES[k % len(FRAMES)]
            axes.add_patch(
                Rectangle(
                    (piece.x - 0.5, piece.y - 0.5), piece.side, piece.side,
                    fill=False, edgecolor=colour, linewidth=0.8,
                )
            )  # fmt: skip
            close = self._axes(x + k * (self.side + GAP_IN), y, self.side, self.side)
            close.imshow(piece.of(codes), interpolation="none")
            close.spines[:].set(visible=True, color=colour, linewidth=1.2)
        axes.axhline(line, color="white", linewidth=0.8, linestyle=":")

    def strip(self, at: int, codes: NDArray, line: int, parallax: bool) -> None:
        """Draw the row of each view, (view, x, 3), with its name, once."""
        name = "view u" if parallax else "view"
        x, y, wide, tall = self._x(at), self.top + self.tall + GAP_IN, self.wide, STRIP_IN
        if self.beside:
            x = self._x(1)
            wide, tall = self.width - EDGE_IN - x, self.side - LINE_IN - GAP_IN
            words = "epipolar image" if parallax else "views"
            self._text(x + wide / 2, y + LINE_IN / 2, f"{words} of row {line}, {name} downwards")
            y += LINE_IN + GAP_IN
        else:
            y += self.side + GAP_IN
            if at == 0:
                self._text(LABEL_IN / 2, y + tall / 2, name, rotation=90)
        axes = self._axes(x, y, wide, tall)
        axes.imshow(codes, interpolation="none", aspect="auto")

    def scale_bar(self, width_px: int) -> None:
        """Draw a length of so many pixels into the first picture."""
        fits = [
            n * 10**k for k in range(5) for n in (1, 2, 5) if n * 10**k <= SCALE_SHARE * width_px
        ]
        length = max(fits, default=1)
        axes = self.figure.axes[0]
        outline = [withStroke(linewidth=1.5, foreground="black")]
        start, y = 0.04 * width_px, 0.06
        across = axes.get_xaxis_transform()
        axes.plot(
            [start, start + length], [y, y], color="white", linewidth=1.5, transform=across,
            path_effects=[withStroke(linewidth=2.5, foreground="black")], solid_capstyle="butt",
        )  # fmt: skip
        axes.text(
            start + length / 2, y + 0.02, f"{length} px", color="white", fontsize=6, ha="center",
            va="bottom", transform=across, path_effects=outline,
        )  # fmt: skip

    def map(self, at: int, row: int, values: Array | None, of: _Maps) -> None:
        """Draw a map into a column; row: below the pictures, 0 beside them."""
        x, y = self._x(at), self._y(row)
        if values is None:
            self._text(x + self.wide / 2, y + self.tall / 2, "none", color=FAINT)
            return
        axes = self._axes(x, y, self.wide, self.tall)
        axes.imshow(
            values, cmap=of.colours, vmin=of.low, vmax=of.high, interpolation="none", aspect="auto"
        )

    def bar(self, at: int, row: int, of: _Maps) -> None:
        """Draw the scale of a map to the right of a column."""
        self._bar(self._x(at) + self.wide + GAP_IN, row, of)

    def key(self, row: int, of: _Maps) -> None:
        """Write what a row of maps shows into its first column, and draw the scale there."""
        right = self._x(0) + self.wide - BAR_WIDE_IN
        self._bar(right, row, of).yaxis.set_ticks_position("left")
        wide = right - BAR_IN + BAR_WIDE_IN
        letters = max(8, int(wide * 72 / LETTER_PT))
        words = textwrap.fill(of.label, letters, break_long_words=False)
        self._text(wide / 2, self._y(row) + self.tall / 2, words)

    def label(self, row: int, text: str) -> None:
        """Write what a row of maps shows to its left."""
        words = textwrap.fill(text, max(8, int(self.tall * 72 / LETTER_PT)))
        self._text(LABEL_IN / 2, self._y(row) + self.tall / 2, words, rotation=90)

    def _bar(self, x: float, row: int, of: _Maps) -> Axes:
        axes = self._axes(x, self._y(row), BAR_WIDE_IN, self.tall)
        colours = ScalarMappable(Normalize(of.low, of.high), of.colours)
        self.figure.colorbar(colours, cax=axes).outline.set_linewidth(0.4)
        axes.tick_params(labelsize=6, width=0.4, length=2, pad=1)
        return axes

    def _x(self, at: int) -> float:
        bars_before = max(at - 1, 0) if self.bars > 1 else 0
        return self.left + at * (self.wide + GAP_IN) + bars_before * BAR_IN

    def _y(self, row: int) -> float:
        return self.top + (row and self.below + (row - 1) * (self.tall + 2 * GAP_IN))

    def _axes(self, x: float, y: float, wide: float, tall: float) -> Axes:
        axes = self.figure.add_axes((
            x / self.width, 1 - (y + tall) / self.height, wide / self.width, tall / self.height,
        ))  # fmt: skip
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        return axes

    def _text(self, x: float, y: float, text: str, **more: Any) -> None:
        self.figure.text(
            x / self.width, 1 - y / self.height, text,
            **{"fontsize": TEXT_PT, "color": INK, "ha": "center", "va": "center", **more},
        )  # fmt: skip


def _view(light_field: Array, chosen: tuple[int, int] | None) -> tuple[int, int]:
    rows, columns = light_field.shape[:2]
    view = chosen or (rows // 2, columns // 2)
    if not (0 <= view[0] < rows and 0 <= view[1] < columns):
        raise WrongUsageError(
            f"view {view[0]},{view[1]}: there are {rows}x{columns} views, counted from 0"
        )
    return view


def _pieces(picture: Array, settings: FigureSettings) -> list[Piece]:
    """Return the close-ups; those near the border are moved inside."""
    height, width = picture.shape[:2]
    side = settings.side_px or max(8, round(CLOSE_UP_SHARE * width))
    if side > min(height, width):
        raise WrongUsageError(f"side {side}: the pictures have only {height}x{width} pixels")
    for y, x in settings.at:
        if not (0 <= y < height and 0 <= x < width):
            raise WrongUsageError(
                f"at {y},{x}: the pictures have {height}x{width} pixels, counted from 0"
            )
    corners = [
        (min(max(y - side // 2, 0), height - side), min(max(x - side // 2, 0), width - side))
        for y, x in settings.at
    ]
    return [Piece(y, x, side) for y, x in corners] or detailed_pieces(picture, side, 2)


def _maps(
    results: Sequence[Export], view: tuple[int, int], truth: Array | None
) -> tuple[list[_Maps], float | None]:
    """Return every map that half of the results have; error and deviation share one scale.

    The second is the disparity, px per view, where it is the same everywhere: no map shows that.
    """
    errors = [
        None if truth is None
        else np.sqrt(np.mean((finite(result.light_field[view]) - truth[view]) ** 2, axis=-1))
        for result in results
    ]  # fmt: skip
    deviations = [None if result.sigma is None else result.sigma[view] for result in results]
    disparities = [
        result.disparity if shows_parallax(result.view_axes) else None for result in results
    ]
    top = round_up(ends([*errors, *deviations])[1])
    low, high = ends(disparities)
    every = [
        _Maps("error", errors, 0, top, "magma"),
        _Maps("estimated deviation", deviations, 0, top, "magma"),
        _Maps("disparity, px per view", disparities, low, high, "viridis"),
    ]
    known = [
        drawn for drawn in every
        if 2 * sum(values is not None for values in drawn.values) >= len(results)
    ]  # fmt: skip
    if known and known[-1].values is disparities and high - low < LEAST_RANGE_PX:
        return known[:-1], (low + high) / 2
    return known, None


def _names(columns: Sequence[Export]) -> list[str]:
    """Return the methods' names, with the folder's where two are of one method."""
    methods = [str(column.metrics.get("method", column.title)) for column in columns]
    return [
        method if methods.count(method) == 1 else f"{method} ({column.title})"
        for method, column in zip(methods, columns, strict=True)
    ]


def _source(column: Export) -> str:
    """Return where a result came from: what metrics.json says of it."""
    known = column.metrics
    said = [str(known[key]) for key in ("scene", "camera") if known.get(key)]
    if known.get("psi_sha256"):
        said.append(f"Psi {str(known['psi_sha256'])[:12]}")
    verdict = known.get("verdict")
    if isinstance(verdict, Mapping):
        said.append(f"verdict: {verdict.get('level')}")
    if known.get("command"):
        said.append(f"by: {known['command']}")
    return "; ".join(said) or column.caption or column.title


def epipolar_lines(truth: Array) -> tuple[int, int]:
    """Return the row and the column (y, x) along which the outer views differ most.

    Epipolar images through them show slopes. They lie in the middle three fifths of the picture.
    """
    across = np.abs(truth[truth.shape[0] // 2, -1] - truth[truth.shape[0] // 2, 0])
    down = np.abs(truth[-1, truth.shape[1] // 2] - truth[0, truth.shape[1] // 2])
    found = []
    for difference, axis in ((across, 0), (down, 1)):
        inner = difference[tuple(slice(n // 5, n - n // 5) for n in difference.shape[:2])].mean(
            axis=(1 - axis, 2)
        )
        found.append(int(inner.argmax()) + difference.shape[axis] // 5)
    return found[0], found[1]


def detailed_pieces(picture: Array, side: int, count: int = 1) -> list[Piece]:
    """Return the squares of a picture (y, x, c) with most edges and colour, away from each other.

    The border of the picture, which other views do not show, is excluded.
    """
    height, width = picture.shape[:2]
    side = min(side, height, width)
    grey = picture.mean(axis=-1, dtype=np.float32)
    slope_y, slope_x = np.gradient(grey)
    spread = np.abs(picture - grey[..., None]).mean(axis=-1)
    interest = np.minimum(np.hypot(slope_y, slope_x), 0.2) + 0.5 * np.abs(np.gradient(spread)[0])
    sums = cv2.boxFilter(interest.astype(np.float32), -1, (side, side), anchor=(0, 0))
    sums = sums[: height - side + 1, : width - side + 1].copy()
    border = [min((length - side) // 2, length // 12) for length in (height, width)]
    inside = np.zeros(sums.shape, dtype=bool)
    inside[border[0] : height - side + 1 - border[0], border[1] : width - side + 1 - border[1]] = 1
    sums[~inside] = -1
    found = []
    for _ in range(count):
        y, x = np.unravel_index(int(sums.argmax()), sums.shape)
        found.append(Piece(int(y), int(x), side))
        sums[max(0, y - side) : y + side, max(0, x - side) : x + side] = -1
    return found
