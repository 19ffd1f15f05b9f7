"""Figure of results for a paper: views, close-ups, epipolar images and maps, side by side.

Every picture is embedded at its own pixels; text and lines stay vectors. Results are columns under
each other's scale; of a single result the maps stand to the right of the view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.files.formats import Export
from emmc_rig.model.lightfield import epi_horizontal, psnr_db, ssim
from emmc_rig.pages.display import DisplayCurve, finite, round_up, three_colours
from emmc_rig.pages.paper_figure import (
    FRAMES,
    WIDTH_IN,
    CloseUp,
    PaperFigure,
    Row,
    Scale,
    Strip,
    Tile,
    caption_of,
    draw_tiles,
)
from emmc_rig.pages.pictures import Piece, detailed_pieces, epipolar_lines

Array = NDArray[np.floating]
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
    line, _ = epipolar_lines(reference)
    height, width = reference.shape[2:4]

    def tile(title: str, light_field: Array) -> Tile:
        codes = three_colours(curve.encode(light_field[view]))
        strip = three_colours(curve.encode(epi_horizontal(light_field, view[0], line)))
        return Tile(
            title,
            codes,
            [CloseUp(one.of(codes), FRAMES[k % len(FRAMES)], one) for k, one in enumerate(pieces)],
            [Strip(strip, ((line, 0), (line, width - 1)))],
        )

    shown = [tile(title, one.light_field) for title, one in zip(titles, columns, strict=True)]
    maps = _maps(results, view, truth)
    if len(columns) == 1:
        beside = [replace(row.tiles[0], title=row.label, bar=True) for row in maps if row.tiles[0]]
        rows = [Row([*shown, *beside])]
    else:
        before = [None] * (len(columns) - len(results))
        rows = [Row(shown), *(Row([*before, *row.tiles], row.label) for row in maps)]
    sentences = [
        f"View {view} of {reference.shape[0]}x{reference.shape[1]}, {height}x{width} pixels.",
        f"Epipolar plane image of row {line} (dotted), all views of a row downwards.",
    ]
    if measured:
        sentences.append(
            "Error: root mean square over colours, of this view. PSNR and SSIM are of all views, "
            "peak 1."
        )
    sources = [
        f"{name}: {_source(one)}"
        for name, one in zip(names, columns, strict=True)
        if one.title != "true"
    ]
    caption = caption_of(sentences, curve, pieces, sources)
    return PaperFigure(draw_tiles(rows, settings.width_in, figure), caption, measured)


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


def _maps(results: Sequence[Export], view: tuple[int, int], truth: Array | None) -> list[Row]:
    """Return a row for every map that any result has; error and deviation share one scale."""
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
    rows = []
    for label, maps, scale in (
        ("error", errors, Scale(0, top, "magma")),
        ("stated standard deviation", deviations, Scale(0, top, "magma")),
        ("disparity, px per view", disparities, Scale(low, high, "viridis")),
    ):
        if any(values is not None for values in maps):
            tiles = [Tile("", values, scale=scale) for values in maps]
            rows.append(Row([*tiles[:-1], replace(tiles[-1], bar=True)], label))
    return rows


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
