"""Figures for papers of tiles in rows: pictures and maps with close-ups and epipolar images below.

Every picture is embedded at its own pixels; text and lines stay vectors.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from emmc_rig.pages.display import DisplayCurve
from emmc_rig.pages.drawing import FAINT, INK, save_publication
from emmc_rig.pages.pictures import Piece
from emmc_rig.version import __version__

WIDTH_IN = 7.16
"""Of a figure across both columns of an IEEE page."""
EDGE_IN, GAP_IN, LABEL_IN, BAR_IN, STRIP_IN = 0.01, 0.06, 0.2, 0.45, 0.3
TICK_IN = 0.05
"""Half a figure at the lower end of a scale, which stands at the edge."""
TEXT_PT, LINE_IN = 7.5, 0.13
LETTER_PT = 0.55 * TEXT_PT
"""Mean width of a letter of a title."""
FRAMES = ("#ffb000", "#00beff", "#ff5d8f", "#7ed957")
"""Colours of the close-ups' frames, in order."""


@dataclass(frozen=True)
class CloseUp:
    """A square (y, x, 3) of screen codes in a frame. piece: where the picture is framed, if so."""

    codes: NDArray
    colour: str = ""
    piece: Piece | None = None


@dataclass(frozen=True)
class Strip:
    """An epipolar image (view, place, 3) of screen codes. ends: of its line, two (y, x)."""

    codes: NDArray
    ends: tuple[tuple[int, int], tuple[int, int]]
    colour: str = "white"


@dataclass(frozen=True)
class Scale:
    """The ends and the colours of a map."""

    low: float
    high: float
    colours: str


@dataclass(frozen=True)
class Tile:
    """One picture with what stands above and below it.

    picture: screen codes (y, x, 3), or with a scale a map (y, x); None writes that there is none.
    bar: whether the scale is drawn to its right.
    """

    title: str
    picture: NDArray | None
    close_ups: Sequence[CloseUp] = ()
    strips: Sequence[Strip] = ()
    scale: Scale | None = None
    bar: bool = False


@dataclass(frozen=True)
class Row:
    """Tiles side by side, None for an empty place. label: to their left."""

    tiles: Sequence[Tile | None]
    label: str = ""


@dataclass(frozen=True)
class PaperFigure:
    """The figure, its caption with where everything came from, and PSNR and SSIM by column."""

    figure: Figure
    caption: str
    measured: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def save(self, folder: Path, name: str = "figure") -> None:
        """Write NAME.pdf, .svg, .png, and the caption as NAME.txt, into a folder."""
        for ending in ("pdf", "svg", "png"):
            save_publication(self.figure, folder / f"{name}.{ending}", self.caption)
        text = "\n".join(textwrap.wrap(self.caption, 100, break_on_hyphens=False))
        (folder / f"{name}.txt").write_text(text + "\n", encoding="utf-8")


def draw_tiles(
    rows: Sequence[Row], width_in: float = WIDTH_IN, figure: Figure | None = None
) -> Figure:
    """Lay rows of tiles out in columns of one width; figure: an empty one to draw into."""
    return _Sheet(rows, width_in, figure or Figure()).figure


def caption_of(
    sentences: Sequence[str], curve: DisplayCurve, pieces: Sequence[Piece], sources: Sequence[str]
) -> str:
    """Return a caption: what is seen, where the close-ups are, the screen's curve, the sources."""
    close_ups = []
    if pieces:
        side = pieces[0].side
        middles = ", ".join(f"({one.y + side // 2}, {one.x + side // 2})" for one in pieces)
        close_ups = [f"Close-ups of {side}x{side} pixels around (y, x) = {middles}."]
    shown = f"{curve.gain:.3g} x"
    if abs(curve.gamma - 1) >= 0.005:
        shown = f"({shown})^(1/{curve.gamma:.3g})"
    return " ".join([
        *sentences,
        *close_ups,
        f"Linear values x are shown as {shown}, cut at 1.",
        *(f"{one}." for one in sources),
        f"Drawn by emmc-rig {__version__}.",
    ])  # fmt: skip


class _Sheet:
    """Axes placed by the inch, x and y from the top left."""

    def __init__(self, rows: Sequence[Row], width_in: float, figure: Figure) -> None:
        columns = max(len(row.tiles) for row in rows)
        bars = [
            any(tile.bar for row in rows for tile in row.tiles[at : at + 1] if tile)
            for at in range(columns)
        ]
        left = LABEL_IN if any(row.label for row in rows) else EDGE_IN
        room = width_in - EDGE_IN - left - (columns - 1) * GAP_IN - sum(bars) * BAR_IN
        self.wide, self.width = room / columns, width_in
        heights = [self._heights(row) for row in rows]
        self.height = sum(map(sum, heights)) + (len(rows) - 1) * 2 * GAP_IN + EDGE_IN
        if any(tile and tile.bar for tile in rows[-1].tiles):
            self.height += TICK_IN
        self.figure = figure
        figure.set_size_inches(self.width, self.height)
        y = 0.0
        for row, (title, picture, below) in zip(rows, heights, strict=True):
            if row.label:
                self._text(LABEL_IN / 2, y + title + picture / 2, row.label, rotation=90)
            x = left
            for tile, bar in zip(row.tiles, bars, strict=False):
                if tile:
                    self._tile(tile, x, y, title, picture)
                x += self.wide + GAP_IN + bar * BAR_IN
            y += title + picture + below + 2 * GAP_IN

    def _title(self, tile: Tile) -> str:
        """Return a title in lines no wider than a column."""
        letters = max(8, int(self.wide * 72 / LETTER_PT))
        return "\n".join(
            line for one in tile.title.split("\n") for line in textwrap.wrap(one, letters)
        )

    def _heights(self, row: Row) -> tuple[float, float, float]:
        """Return the heights of the titles, the pictures and what stands below, inches."""
        tiles = [tile for tile in row.tiles if tile]
        lines = max(len(self._title(tile).split("\n")) if tile.title else 0 for tile in tiles)
        pictures = [one.picture.shape for one in tiles if one.picture is not None]
        below = [
            (GAP_IN + self._side(tile) if tile.close_ups else 0)
            + len(tile.strips) * (GAP_IN + STRIP_IN)
            for tile in tiles
        ]
        return (
            lines * LINE_IN + (GAP_IN if lines else 0),
            self.wide * max(y / x for y, x, *_ in pictures),
            max(below),
        )

    def _side(self, tile: Tile) -> float:
        count = len(tile.close_ups)
        return (self.wide - GAP_IN * (count - 1)) / count

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

    def _tile(self, tile: Tile, x: float, y: float, title: float, tall: float) -> None:
        if tile.title:
            self._text(x + self.wide / 2, y + title - GAP_IN / 2, self._title(tile), va="bottom")
        y += title
        if tile.bar and tile.scale:
            self._bar(tile.scale, x + self.wide + GAP_IN, y, tall)
        if tile.picture is None:
            self._text(x + self.wide / 2, y + tall / 2, "none", color=FAINT)
            return
        height, width = tile.picture.shape[:2]
        axes = self._axes(x, y, self.wide, self.wide * height / width)
        look = _look(tile.scale) if tile.scale else {}
        axes.imshow(tile.picture, interpolation="none", aspect="auto", **look)
        y += tall + GAP_IN
        side = self._side(tile) if tile.close_ups else 0.0
        for at, one in enumerate(tile.close_ups):
            if one.piece:
                axes.add_patch(
                    Rectangle(
                        (one.piece.x - 0.5, one.piece.y - 0.5), one.piece.side, one.piece.side,
                        fill=False, edgecolor=one.colour, linewidth=0.8,
                    )
                )  # fmt: skip
            small = self._axes(x + at * (side + GAP_IN), y, side, side)
            small.imshow(one.codes, interpolation="none")
            small.spines[:].set(visible=bool(one.colour), color=one.colour or INK, linewidth=1.2)
        y += side + GAP_IN if side else 0
        for strip in tile.strips:
            down, across = zip(*strip.ends, strict=True)
            axes.plot(across, down, color=strip.colour, linewidth=0.8, linestyle=":")
            drawn = self._axes(x, y, self.wide, STRIP_IN)
            drawn.imshow(strip.codes, interpolation="none", aspect="auto")
            drawn.spines[:].set(visible=True, color=strip.colour)
            y += STRIP_IN + GAP_IN
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))

    def _bar(self, scale: Scale, x: float, y: float, tall: float) -> None:
        axes = self._axes(x, y, 0.08, tall)
        colours = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
        self.figure.colorbar(colours, cax=axes).outline.set_linewidth(0.4)
        axes.tick_params(labelsize=6, width=0.4, length=2, pad=1)


def _look(scale: Scale) -> dict[str, Any]:
    return {"cmap": scale.colours, "vmin": scale.low, "vmax": scale.high}
