"""The tables as charts: ours solid, the paper's faint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emmc_rig.pages.drawing import FAINT, LEGEND, save_svg, sheet, titled
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import (
    MASK_TITLES,
    METHOD_TITLES,
    METHODS,
    PARTS,
    SCENARIOS,
    Capture,
    scenes_of,
)
from emmc_rig.study.tables.findings import CHROMA, Measured, SceneFigures, printed_figures

COLOURS = {"i": "#1d5a9e", "ii": "#18794e", "iii": "#b45309"}
METHOD_COLOURS = {"dict-admm": "#7a869a", "tv-dict": "#1d5a9e", "tv": "#18794e"}


def mean_db(
    measured: Measured, scenes: Sequence[str], capture: Capture, method: str, what: str = "psnr_db"
) -> float | None:
    """Return the mean of a figure over the scenes that have it; None without any."""
    values = []
    for scene in scenes:
        try:
            values.append(SceneFigures(measured, scene)(capture, method, what))
        except KeyError:
            continue
    return float(np.mean(values)) if values else None


def draw_charts(folder: Path, measured: Measured, scenes: Sequence[str]) -> dict[str, Path]:
    """Write the charts whose cells were measured as SVG; return their titles and files."""
    written = {}
    for name, title, draw in (
        ("chart-shots", "More shots", _shots),
        ("chart-noise", "What noise costs", _noise),
        ("chart-colour", "Brightness and colour", _colour),
        ("chart-masks", "Masks under noise", _masks),
    ):
        figure = draw(measured, scenes)
        if figure is not None:
            written[title] = save_svg(figure, folder / f"{name}.svg")
    return written


def _shots(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    shown = [
        (name, title)
        for name, title in (("table3", "r = 1"), ("table4", "r = 1/4"))
        if any(
            mean_db(measured, scenes_of(PARTS[name], scenes), capture, "tv-dict") is not None
            for capture in PARTS[name].captures
        )
    ]
    if not shown:
        return None
    figure, panels = sheet(len(shown))
    printed = printed_figures()
    for axes, (name, title) in zip(panels, shown, strict=True):
        part = PARTS[name]
        theirs = scenes_of(part, list(paper.TITLES))
        for scenario, sensor in SCENARIOS.items():
            captures = [c for c in part.captures if c.scenario == scenario]
            # A full-colour image counts as one acquisition, as in the paper.
            count = [c.shots // 3 if scenario == "i" else c.shots for c in captures]
            for source, names, style, label in (
                (measured, scenes_of(part, scenes), "-o", f"({scenario}) {sensor}"),
                (printed, theirs, "--", None),
            ):
                values = [mean_db(source, names, c, "tv-dict") for c in captures]
                points = [(n, v) for n, v in zip(count, values, strict=True) if v is not None]
                if points:
                    axes.plot(
                        *zip(*points, strict=True),
                        style if len(points) > 1 or style == "-o" else "x",
                        color=COLOURS[scenario],
                        alpha=1 if source is measured else 0.4,
                        label=label,
                        markersize=5,
                    )
        axes.set_xticks(range(1, 5 if name == "table4" else 4))
        across = "images: shots, or full-colour images of (i)"
        titled(axes, f"TV-Dict, {title}, noise-free", across)
    panels[-1].plot([], [], "--", color=FAINT, alpha=0.6, label="the paper's 7 scenes")
    panels[-1].legend(**LEGEND)
    return figure


def _bars(
    axes: Axes, groups: Sequence[tuple[Sequence[float], Sequence[float], dict[str, Any]]],
    width: float, room: float = 2,
) -> None:  # fmt: skip
    """Draw groups of bars (places, values, look) that say their values; room: above them, dB."""
    for at, values, look in groups:
        axes.bar_label(axes.bar(at, values, width, **look), fmt="%.1f", fontsize=8)
    levels = [value for _, values, _ in groups for value in values]
    axes.set_ylim(np.floor(min(levels)) - 2, np.ceil(max(levels)) + room)


def _noise(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    part = PARTS["table2"]
    shown = scenes_of(part, scenes)
    if all(mean_db(measured, shown, c, "tv-dict") is None for c in part.captures):
        return None
    figure, panels = sheet(2, 4.2)
    theirs = scenes_of(part, list(paper.TITLES))
    for axes, source, names, title in (
        (panels[0], measured, shown, "Ours, TV-Dict"),
        (panels[1], printed_figures(), theirs, "The paper, TV-Dict"),
    ):
        groups = []
        for i, scenario in enumerate(SCENARIOS):
            for capture in (c for c in part.captures if c.scenario == scenario):
                value = mean_db(source, names, capture, "tv-dict")
                if value is not None:
                    look = {"color": COLOURS[scenario], "alpha": 0.5 if capture.noisy else 1}
                    groups.append(([i + (0.2 if capture.noisy else -0.2)], [value], look))
        _bars(axes, groups, 0.37, room=1)
        axes.set_xticks(range(3), [f"({one}) {sensor}" for one, sensor in SCENARIOS.items()])
        titled(axes, title, "full: noise-free, pale: noisy")
    return figure


def _colour(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    shown = scenes_of(PARTS["table3"], scenes)
    captures = [c for c in PARTS["table3"].captures if c.shots < 3 or c.scenario != "ii"]
    at, groups = np.arange(len(captures)), []
    for what, shift, colour, label in (
        ("luma_psnr_db", -0.2, "#7a869a", "brightness"),
        (CHROMA, 0.2, "#c2410c", "colour (mean of two chrominances)"),
    ):
        values = [mean_db(measured, shown, c, "tv-dict", what) for c in captures]
        known = [value for value in values if value is not None]
        if len(known) < len(captures):
            return None
        groups.append((at + shift, known, {"color": colour, "label": label}))
    figure, (axes,) = sheet(1, 6.4)
    _bars(axes, groups, 0.37, room=3)
    axes.set_xticks(at, [f"({c.scenario}) {SCENARIOS[c.scenario]} × {c.shots}" for c in captures])
    axes.legend(**LEGEND, loc="upper left", ncols=2)
    titled(axes, "TV-Dict, Table III's scenes, noise-free")
    return figure


def _masks(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    captures = PARTS["figure8"].captures
    shown = scenes_of(PARTS["figure8"], scenes)
    found = {}
    for method in METHODS:
        values = [mean_db(measured, shown, capture, method) for capture in captures]
        known = [value for value in values if value is not None]
        if len(known) == len(captures):
            found[method] = known
    if not found:
        return None
    figure, (axes,) = sheet(1, 6.4)
    at, width = np.arange(len(captures)), 0.8 / len(found)
    groups = []
    for i, (method, values) in enumerate(found.items()):
        look = {"color": METHOD_COLOURS[method], "label": METHOD_TITLES[method]}
        groups.append((at + (i - (len(found) - 1) / 2) * width, values, look))
    _bars(axes, groups, width * 0.93)
    axes.set_xticks(at, [MASK_TITLES[c.mask] for c in captures])
    axes.legend(**LEGEND, ncols=3, loc="upper left")
    titled(axes, "One noisy CFA shot, Table II's scenes")
    return figure
