"""Charts of one look: axes without clutter, and SVG files that are equal for equal content."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT, LINE, ACCENT = "#17202c", "#5b6776", "#dde2e9", "#1d5a9e"
SALT = "emmc-rig"


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
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
        one.spines[["left", "bottom"]].set_color(LINE)
        one.tick_params(colors=FAINT, labelsize=9)
        one.grid(axis="y", color=LINE, linewidth=0.7)
        one.set_axisbelow(True)
    for one in axes[::columns]:
        one.set_ylabel(label, color=FAINT, fontsize=9)
    return figure, axes


def titled(axes: Axes, title: str) -> None:
    """Give a panel its title."""
    axes.set_title(title, loc="left", fontsize=10.5, color=INK, weight="bold")


def save_svg(figure: Figure, path: Path) -> Path:
    """Write a figure as SVG without date and random names; return its path."""
    with matplotlib.rc_context({"svg.hashsalt": SALT}):
        figure.savefig(path, format="svg", metadata={"Date": None})
    return path
