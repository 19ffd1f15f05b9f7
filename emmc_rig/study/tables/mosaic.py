"""Pictures side by side: each a whole view with enlarged pieces below, under a title."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emmc_rig.pages.display import DisplayCurve
from emmc_rig.pages.drawing import FAINT, INK, save_publication
from emmc_rig.pages.pictures import Piece

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
