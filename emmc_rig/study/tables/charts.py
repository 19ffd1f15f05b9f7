"""The tables as charts: ours solid, the paper's faint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from emmc_rig.pages.drawing import FAINT, INK, save_svg, sheet, titled
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
    measured: Measured,
    scenes: Sequence[str],
    capture: Capture,
    method: str,
    what: str = "psnr_db",
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
        axes.set_xlabel("images: shots, or full-colour images of (i)", color=FAINT, fontsize=9)
        titled(axes, f"TV-Dict, {title}, noise-free")
    panels[-1].plot([], [], "--", color=FAINT, alpha=0.6, label="the paper's 7 scenes")
    panels[-1].legend(fontsize=8.5, frameon=False, labelcolor=INK)
    return figure


def _noise(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    part = PARTS["table2"]
    shown = scenes_of(part, scenes)
    printed = printed_figures()
    theirs = scenes_of(part, list(paper.TITLES))
    captures = part.captures
    if all(mean_db(measured, shown, c, "tv-dict") is None for c in captures):
        return None
    figure, panels = sheet(2, 4.2)
    for axes, source, names, title in (
        (panels[0], measured, shown, "Ours, TV-Dict"),
        (panels[1], printed, theirs, "The paper, TV-Dict"),
    ):
        low = []
        for i, (scenario, sensor) in enumerate(SCENARIOS.items()):
            for capture in captures:
                value = mean_db(source, names, capture, "tv-dict")
                if capture.scenario == scenario and value is not None:
                    low.append(value)
                    at = i + (0.2 if capture.noisy else -0.2)
                    axes.bar(
                        at, value, 0.37, color=COLOURS[scenario], alpha=0.5 if capture.noisy else 1
                    )
                    axes.text(at, value, f"{value:.1f}", ha="center", va="bottom", fontsize=8)
            del sensor
        axes.set_xticks(
            range(3), [f"({scenario}) {sensor}" for scenario, sensor in SCENARIOS.items()]
        )
        axes.set_ylim(np.floor(min(low)) - 2, np.ceil(max(low)) + 1)
        titled(axes, title)
    panels[0].set_xlabel("full: noise-free, pale: noisy", color=FAINT, fontsize=9)
    panels[1].set_xlabel("full: noise-free, pale: noisy", color=FAINT, fontsize=9)
    return figure


def _colour(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    shown = scenes_of(PARTS["table3"], scenes)
    captures = [c for c in PARTS["table3"].captures if c.shots < 3 or c.scenario != "ii"]
    values = {
        what: [mean_db(measured, shown, c, "tv-dict", what) for c in captures]
        for what in ("luma_psnr_db", CHROMA)
    }
    if any(value is None for column in values.values() for value in column):
        return None
    figure, (axes,) = sheet(1, 6.4)
    at = np.arange(len(captures))
    levels = [[v for v in column if v is not None] for column in values.values()]
    for shift, level, colour, label in (
        (-0.2, levels[0], "#7a869a", "brightness"),
        (0.2, levels[1], "#c2410c", "colour (mean of two chrominances)"),
    ):
        axes.bar(at + shift, level, 0.37, color=colour, label=label)
        for x, value in zip(at + shift, level, strict=True):
            axes.text(x, value, f"{value:.1f}", ha="center", va="bottom", fontsize=8)
    axes.set_xticks(at, [f"({c.scenario}) {SCENARIOS[c.scenario]} × {c.shots}" for c in captures])
    axes.set_ylim(np.floor(min(map(min, levels))) - 2, np.ceil(max(map(max, levels))) + 3)
    axes.legend(fontsize=8.5, frameon=False, labelcolor=INK, loc="upper left", ncols=2)
    titled(axes, "TV-Dict, Table III's scenes, noise-free")
    return figure


def _masks(measured: Measured, scenes: Sequence[str]) -> Figure | None:
    part = PARTS["figure8"]
    shown = scenes_of(part, scenes)
    found = {
        method: [mean_db(measured, shown, c, method) for c in part.captures] for method in METHODS
    }
    found = {m: [v for v in values if v is not None] for m, values in found.items()}
    found = {m: values for m, values in found.items() if len(values) == len(part.captures)}
    if not found:
        return None
    figure, (axes,) = sheet(1, 6.4)
    at = np.arange(len(part.captures))
    width = 0.8 / len(found)
    for i, (method, values) in enumerate(found.items()):
        x = at + (i - (len(found) - 1) / 2) * width
        axes.bar(x, values, width * 0.93, color=METHOD_COLOURS[method], label=METHOD_TITLES[method])
        for place, value in zip(x, values, strict=True):
            axes.text(place, value, f"{value:.1f}", ha="center", va="bottom", fontsize=8)
    axes.set_xticks(at, [MASK_TITLES[c.mask] for c in part.captures])
    levels = [value for values in found.values() for value in values]
    axes.set_ylim(np.floor(min(levels)) - 2, np.ceil(max(levels)) + 2)
    axes.legend(fontsize=8.5, frameon=False, labelcolor=INK, ncols=3, loc="upper left")
    titled(axes, "One noisy CFA shot, Table II's scenes")
    return figure
