"""How charts look: thin axes, few lines, the page's colours."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT, LINE, ACCENT = "#17202c", "#5b6776", "#dde2e9", "#1d5a9e"


def sheet(panels: int, wide: float = 4.6) -> tuple[Figure, list[Axes]]:
    """Return a figure of `panels` axes side by side, each `wide` inches."""
    figure = Figure(figsize=(wide * panels, 3.5), layout="constrained")
    axes = [figure.add_subplot(1, panels, i + 1) for i in range(panels)]
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
        one.spines[["left", "bottom"]].set_color(LINE)
        one.tick_params(colors=FAINT, labelsize=9)
        one.grid(axis="y", color=LINE, linewidth=0.7)
        one.set_axisbelow(True)
    return figure, axes


def title_of(axes: Axes, text: str) -> None:
    """Set the title of one panel."""
    axes.set_title(text, loc="left", fontsize=10.5, color=INK, weight="bold")
