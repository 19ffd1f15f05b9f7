"""Charts of one look: axes without clutter, and SVG files that are equal for equal content."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

INK, FAINT, LINE, ACCENT = "#17202c", "#5b6776", "#dde2e9", "#1d5a9e"
COLOURS = (
    "#1d5a9e", "#c2410c", "#18794e", "#7c3aed", "#b45309", "#0e7490", "#be185d", "#4d7c0f",
    "#475569", "#9f1239",
)  # fmt: skip
"""Of lines and marks that belong to one method."""
LEGEND = {"fontsize": 8.5, "frameon": False, "labelcolor": INK}
FONTS: dict[Any, Any] = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "emmc-rig"}
"""Journals want TrueType in a PDF. SVG cannot embed the font, so that its letters are outlines."""
PUBLICATION_DPI = 300


def sheet(
    panels: int,
    wide: float = 4.6,
    high: float = 3.5,
    label: str = "PSNR, dB",
    columns: int | None = None,
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels, each `wide` x `high` inches, side by side or in so many columns.

    label: of the y axes that are leftmost.
    """
    columns = columns or panels
    rows = -(-panels // columns)
    figure = Figure(figsize=(wide * columns, high * rows), layout="constrained")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.spines[["left", "bottom"]].set_color(LINE)
        panel.tick_params(colors=FAINT, labelsize=9)
        panel.grid(axis="y", color=LINE, linewidth=0.7)
        panel.set_axisbelow(True)
    for panel in axes[::columns]:
        panel.set_ylabel(label, color=FAINT, fontsize=9)
    return figure, axes


def titled(axes: Axes, title: str, across: str = "") -> None:
    """Give a panel its title, and its horizontal axis a label."""
    axes.set_title(title, loc="left", fontsize=10.5, color=INK, weight="bold")
    if across:
        axes.set_xlabel(across, color=FAINT, fontsize=9)


def plain_log_ticks(axes: Axes) -> None:
    """Label the ticks of a logarithmic x axis as 1, 2, 5, 10, ... without powers."""
    axis = axes.xaxis
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_below(figure: Figure, lines: Iterable[Any], names: Iterable[str], columns: int) -> None:
    """Put a legend of all panels below them, in as many columns as fit."""
    columns = max(1, min(columns, int(figure.get_figwidth() / 2)))
    figure.legend(list(lines), list(names), loc="outside lower center", ncols=columns, **LEGEND)


def colours_of(methods: Iterable[str]) -> dict[str, str]:
    """Return a colour for each method, in the order in which they are first met."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(dict.fromkeys(methods))}


def svg_of(figure: Figure) -> bytes:
    """Return a figure as SVG without date and random names."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(FONTS):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def save_publication(figure: Figure, path: Path, about: str) -> None:
    """Write a figure as PDF, SVG or PNG, by the ending; about: its description, inside the file."""
    metadata: dict[str, dict[str, Any]] = {
        ".pdf": {"Subject": about, "CreationDate": None},
        ".svg": {"Description": about, "Date": None},
        ".png": {"Description": about},
    }
    with matplotlib.rc_context(FONTS):
        figure.savefig(path, metadata=metadata[path.suffix], dpi=PUBLICATION_DPI)


def save_drawing(figure: Figure, path: Path) -> Path:
    """Write a figure as SVG without date and random names; return its path."""
    path.write_bytes(svg_of(figure))
    return path
