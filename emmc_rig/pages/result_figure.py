"""One figure of a reconstruction: centre view, epipolar image, disparity and deviation."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emmc_rig.model.lightfield import centre_view, epi_horizontal
from emmc_rig.pages.pictures import epipolar_lines

Array = NDArray[np.floating]
PANEL_IN = 3.4


def draw_result(
    figure: Figure, light_field: Array, disparity: Array | None, sigma: Array | None
) -> None:
    """Draw a light field (v, u, y, x, c) and its maps, where there are any, into a figure.

    disparity: (y, x), pixels per view step. sigma: (v, u, y, x), drawn for the centre view. The
    epipolar image stacks one row of pixels as the centre row of views shows it: the slope of its
    lines is the disparity.
    """
    row, _ = epipolar_lines(light_field)
    middle = light_field.shape[0] // 2, light_field.shape[1] // 2
    maps = [
        ("disparity, px per view", disparity, "viridis"),
        ("standard deviation", None if sigma is None else sigma[middle], "magma"),
    ]
    shown = [(title, values, colours) for title, values, colours in maps if values is not None]
    figure.set_size_inches(PANEL_IN * (1 + 1.15 * len(shown)), PANEL_IN * 1.1)
    grid = figure.add_gridspec(2, 1 + len(shown), height_ratios=(5, 1))
    view = figure.add_subplot(grid[0, 0])
    view.imshow(np.clip(centre_view(light_field), 0, 1))
    view.axhline(row, color="white", linewidth=0.7, linestyle=":")
    view.set_title("centre view", fontsize=10)
    lines = figure.add_subplot(grid[1, :])
    lines.imshow(np.clip(epi_horizontal(light_field, middle[0], row), 0, 1), aspect="auto")
    lines.set_title(f"epipolar image of row {row}", fontsize=10)
    panels = [view, lines]
    for column, (title, values, colours) in enumerate(shown, 1):
        axes = figure.add_subplot(grid[0, column])
        low, high = np.percentile(values[np.isfinite(values)], (1, 99))
        drawn = axes.imshow(values, cmap=colours, vmin=float(low), vmax=float(high))
        axes.set_title(title, fontsize=10)
        figure.colorbar(drawn, ax=axes, shrink=0.7)
        panels.append(axes)
    for axes in panels:
        axes.set_xticks([])
        axes.set_yticks([])
