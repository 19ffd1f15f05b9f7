"""Figure of results for a paper: views, close-ups, epipolar images and maps, side by side.

Every picture is embedded at its own pixels; text and lines stay vectors. Results are columns under
each other's scale; of a single result the maps stand to the right of the view.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.files.formats import Export
from emmc_rig.model.lightfield import epi_horizontal, psnr_db, ssim
from emmc_rig.pages.display import DisplayCurve, finite, round_up, three_colours
from emmc_rig.pages.drawing import FAINT, INK, save_publication
from emmc_rig.pages.pictures import Piece, detailed_pieces, epipolar_lines
from emmc_rig.version import __version__

Array = NDArray[np.floating]
WIDTH_IN = 7.16
"""Of a figure across both columns of an IEEE page."""
GAP_IN, LABEL_IN, BAR_IN, TITLE_IN, EPI_IN = 0.06, 0.2, 0.45, 0.34, 0.3
FRAMES = ("#ffb000", "#00beff", "#ff5d8f", "#7ed957")
"""Colours of the close-ups' frames, in order."""
CLOSE_UP_SHARE = 0.16
LEAST_RANGE_PX = 0.1
"""Of a scale of disparities, where a result is one plane."""


@dataclass(frozen=True)
class FigureSettings:
    """What is shown of each result.

    view: its row and column (default: the centre one). at: centres (y, x) of the close-ups, pixels
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
        """Write figure.pdf, figure.svg, figure.png and caption.txt into a folder."""
        for ending in ("pdf", "svg", "png"):
            save_publication(self.figure, folder / f"figure.{ending}", self.caption)
        text = "\n".join(textwrap.wrap(self.caption, 100, break_on_hyphens=False))
        (folder / "caption.txt").write_text(text + "\n", encoding="utf-8")


@dataclass(frozen=True)
class _Map:
    """One kind of map, one per result; None where a result has no such map."""

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
    columns = list(results) if truth is None else [Export("true", "", truth), *results]
    reference = columns[0].light_field
    for one in results:
        if one.light_field.shape != reference.shape:
            raise AppError(
                f"{one.title} has shape {one.light_field.shape}, {results[0].title} has "
                f"{reference.shape}: name results of one capture"
            )
    view = _view(reference, settings.view)
    pieces = _pieces(reference[view], settings)
    curve = DisplayCurve.fitted_to(reference)
    line, _ = epipolar_lines(reference)
    names = _names(columns)
    measured = {} if truth is None else {
        name: {"psnr_db": psnr_db(one.light_field, truth), "ssim": ssim(one.light_field, truth)}
        for name, one in zip(names[1:], results, strict=True)
    }  # fmt: skip
    titles = [
        f"{name}\n{measured[name]['psnr_db']:.2f} dB, SSIM {measured[name]['ssim']:.3f}"
        if name in measured
        else name
        for name in names
    ]
    maps = _maps(results, view, truth)
    sheet = _Sheet(
        figure or Figure(), len(columns), reference.shape[2:4], len(pieces), len(maps),
        settings.width_in,
    )  # fmt: skip
    for at, (title, one) in enumerate(zip(titles, columns, strict=True)):
        sheet.pictures(at, title, one.light_field, view, pieces, line, curve)
    for row, one in enumerate(maps):
        sheet.map(row, one)
    side, (_, _, height, width, _) = pieces[0].side, reference.shape
    sentences = [
        f"View {view} of {reference.shape[0]}x{reference.shape[1]}, {height}x{width} pixels.",
        f"Close-ups of {side}x{side} pixels around (y, x) = "
        + ", ".join(f"({one.y + side // 2}, {one.x + side // 2})" for one in pieces) + ".",
        f"Epipolar plane image of row {line} (dotted), all views of a row downwards.",
        f"Linear values x are shown as ({curve.gain:.3g} x)^(1/{curve.gamma:.3g}), cut at 1.",
        *(["Error: root mean square over colours, of this view. PSNR and SSIM are of all views, "
           "peak 1."] if measured else []),
        *(f"{name}: {_source(one)}." for name, one in zip(names, columns, strict=True)
          if one.title != "true"),
        f"Drawn by emmc-rig {__version__}.",
    ]  # fmt: skip
    return PaperFigure(sheet.figure, " ".join(sentences), measured)


class _Sheet:
    """Axes placed by the inch: columns of pictures, maps under them, or beside a single one."""

    def __init__(
        self, figure: Figure, columns: int, size: tuple[int, ...], close_ups: int, maps: int,
        width_in: float,
    ) -> None:  # fmt: skip
        self.columns, self.beside = columns, columns == 1
        across = columns + (maps if self.beside else 0)
        bars = maps if self.beside else min(maps, 1)
        self.wide = (width_in - LABEL_IN - (across - 1) * GAP_IN - bars * BAR_IN) / across
        self.tall = self.wide * size[0] / size[1]
        self.close = (self.wide - GAP_IN * (close_ups - 1)) / close_ups
        self.below = TITLE_IN + self.tall + self.close + EPI_IN + 3 * GAP_IN
        self.width = width_in
        self.height = self.below + (0 if self.beside else maps * (self.tall + 2 * GAP_IN))
        self.figure = figure
        figure.set_size_inches(self.width, self.height)

    def axes(self, x: float, y: float, wide: float, tall: float) -> Axes:
        """Return axes without ticks, x and y inches from the top left."""
        axes = self.figure.add_axes((
            x / self.width, 1 - (y + tall) / self.height, wide / self.width, tall / self.height,
        ))  # fmt: skip
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        return axes

    def text(self, x: float, y: float, text: str, **more: Any) -> None:
        """Write text, x and y inches from the top left."""
        self.figure.text(
            x / self.width, 1 - y / self.height, text,
            **{"fontsize": 7.5, "color": INK, "ha": "center", "va": "center", **more},
        )  # fmt: skip

    def pictures(
        self, column: int, title: str, light_field: Array, view: tuple[int, int],
        pieces: Sequence[Piece], line: int, curve: DisplayCurve,
    ) -> None:  # fmt: skip
        """Draw a view, its close-ups and an epipolar image from the top down."""
        x, y = LABEL_IN + column * (self.wide + GAP_IN), TITLE_IN
        codes = three_colours(curve.encode(light_field[view]))
        self.text(x + self.wide / 2, y / 2, title)
        axes = self.axes(x, y, self.wide, self.tall)
        axes.imshow(codes, interpolation="none", aspect="auto")
        axes.axhline(line, color="white", linewidth=0.6, linestyle=":")
        y += self.tall + GAP_IN
        for at, piece in enumerate(pieces):
            colour = FRAMES[at % len(FRAMES)]
            axes.add_patch(
                Rectangle(
                    (piece.x - 0.5, piece.y - 0.5), piece.side, piece.side,
                    fill=False, edgecolor=colour, linewidth=0.8,
                )
            )  # fmt: skip
            small = self.axes(x + at * (self.close + GAP_IN), y, self.close, self.close)
            small.imshow(piece.of(codes), interpolation="none")
            small.spines[:].set(visible=True, color=colour, linewidth=1.2)
        y += self.close + GAP_IN
        lines = curve.encode(epi_horizontal(light_field, view[0], line))
        self.axes(x, y, self.wide, EPI_IN).imshow(
            three_colours(lines), interpolation="none", aspect="auto"
        )

    def map(self, row: int, shown: _Map) -> None:
        """Draw a map of every result that has it, with one scale; results are the last columns."""
        y = TITLE_IN if self.beside else self.below + row * (self.tall + 2 * GAP_IN)
        x = LABEL_IN + (row * BAR_IN + (1 + row) * (self.wide + GAP_IN) if self.beside else 0)
        if self.beside:
            self.text(x + self.wide / 2, y / 2, shown.label)
        else:
            self.text(LABEL_IN / 2, y + self.tall / 2, shown.label, rotation=90)
            x += (self.columns - len(shown.values)) * (self.wide + GAP_IN)
        drawn = None
        for values in shown.values:
            if values is None:
                self.text(x + self.wide / 2, y + self.tall / 2, "none", color=FAINT)
            else:
                drawn = self.axes(x, y, self.wide, self.tall).imshow(
                    values, cmap=shown.colours, vmin=shown.low, vmax=shown.high,
                    interpolation="none", aspect="auto",
                )  # fmt: skip
            x += self.wide + GAP_IN
        assert drawn is not None, "a map that no column has is not drawn"
        scale = self.axes(x, y, 0.08, self.tall)
        self.figure.colorbar(drawn, cax=scale).outline.set_linewidth(0.4)
        scale.tick_params(labelsize=6, width=0.4, length=2, pad=1)


def _view(light_field: Array, chosen: tuple[int, int] | None) -> tuple[int, int]:
    rows, columns = light_field.shape[:2]
    view = chosen or (rows // 2, columns // 2)
    if not (0 <= view[0] < rows and 0 <= view[1] < columns):
        raise WrongUsageError(f"--view {view[0]},{view[1]}: there are {rows}x{columns} views")
    return view


def _pieces(picture: Array, settings: FigureSettings) -> list[Piece]:
    """Return the close-ups; those near the border are moved inside."""
    height, width = picture.shape[:2]
    side = settings.side_px or max(8, round(CLOSE_UP_SHARE * width))
    if side > min(height, width):
        raise WrongUsageError(f"--side {side}: the pictures have {height}x{width} pixels")
    for y, x in settings.at:
        if not (0 <= y < height and 0 <= x < width):
            raise WrongUsageError(f"--at {y},{x}: the pictures have {height}x{width} pixels")
    corners = [
        (min(max(y - side // 2, 0), height - side), min(max(x - side // 2, 0), width - side))
        for y, x in settings.at
    ]
    return [Piece(y, x, side) for y, x in corners] or detailed_pieces(picture, side, 2)


def _maps(results: Sequence[Export], view: tuple[int, int], truth: Array | None) -> list[_Map]:
    """Return the maps that any result has; error and deviation share one scale."""
    errors = [
        None if truth is None
        else np.sqrt(np.mean((finite(one.light_field[view]) - truth[view]) ** 2, axis=-1))
        for one in results
    ]  # fmt: skip
    deviations = [None if one.sigma is None else one.sigma[view] for one in results]
    disparities = [one.disparity for one in results]
    top = round_up(_ends([*errors, *deviations])[1])
    low, high = _ends(disparities)
    if high - low < LEAST_RANGE_PX:
        low, high = low - LEAST_RANGE_PX / 2, high + LEAST_RANGE_PX / 2
    maps = [
        _Map("error", errors, 0, top, "magma"),
        _Map("stated standard deviation", deviations, 0, top, "magma"),
        _Map("disparity, px per view", disparities, low, high, "viridis"),
    ]
    return [one for one in maps if any(values is not None for values in one.values)]


def _ends(maps: Sequence[Array | None]) -> tuple[float, float]:
    """Return what 1 and 99 % of the finite values lie below; 0 and 1 where there is none."""
    good = [values[np.isfinite(values)] for values in maps if values is not None]
    if not any(values.size for values in good):
        return 0.0, 1.0
    low, high = (float(end) for end in np.percentile(np.concatenate(good), (1, 99)))
    return low, max(high, low + 1e-6)


def _names(columns: Sequence[Export]) -> list[str]:
    """Return the methods' names, with the folder's where two are of one method."""
    methods = [str(one.metrics.get("method", one.title)) for one in columns]
    return [
        method if methods.count(method) == 1 else f"{method} ({one.title})"
        for method, one in zip(methods, columns, strict=True)
    ]


def _source(one: Export) -> str:
    """Return where a result came from: what metrics.json says of it."""
    known = one.metrics
    said = [str(known[key]) for key in ("scene", "camera") if known.get(key)]
    if known.get("psi_sha256"):
        said.append(f"Psi {str(known['psi_sha256'])[:12]}")
    verdict = known.get("verdict")
    if isinstance(verdict, Mapping):
        said.append(f"verdict: {verdict.get('level')}")
    if known.get("command"):
        said.append(f"by: {known['command']}")
    return "; ".join(said) or one.caption or one.title
