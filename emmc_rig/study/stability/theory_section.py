"""Theory beside measurement as charts, tables and words: where it predicts the break, where not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from scipy.stats import spearmanr

from emmc_rig.pages.drawing import COLOURS, FAINT, INK, legend_below, save_drawing, sheet, titled
from emmc_rig.pages.page import Section, embedded, fragment, number
from emmc_rig.study.stability.curves import Span, below_best, known_levels, span_words, strength_at
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.stability.stability_page import shown
from emmc_rig.study.trial import Fault

BOUND, FOUND, ORACLE = "bound_db", "found_db", "oracle_db"
DRAWN_AS = {
    BOUND: ("bound, disparity known", INK, (0, (4, 2))),
    FOUND: ("bound, disparity to be found", FAINT, (0, (1.5, 1.5))),
    ORACLE: ("oracle, measured", INK, "-"),
}
FIGURES = {
    "ray_coherence": ("coherence of neighbouring rays", False),
    "spot_coherence": ("coherence of spots 1 px of disparity apart", False),
    "condition": ("condition number at one disparity", False),
    "condition_of_two": ("condition number of two disparities", False),
    "unexplained": ("share of one disparity that another does not explain", True),
    "least_squares_gain": ("noise gain, least squares", False),
    "gain": ("noise gain, posterior", False),
    "degrees": ("degrees of freedom that frames determine", True),
    "crb_px": ("Cramer-Rao bound of disparity, px", False),
    "zzb_px": ("Ziv-Zakai bound of disparity, px", False),
    FOUND: ("bound of PSNR, disparity to be found", True),
    BOUND: ("bound of PSNR, disparity known", True),
}
"""What theory says of a camera, and whether more is better."""
TheoryFigures = Mapping[Point, Mapping[str, float | None]]
NEAR = 2.0
"""Factor between a predicted and a measured breaking point that counts as predicted."""
CLOSE_PLACES = 0.5
"""Likewise where strengths are no ratios: of a step between two of them."""
LEAST_SPREAD_DB = 0.5


@dataclass(frozen=True, eq=False)
class Compared:
    """One fault on one scene. levels: by the name of a curve, dB, None where there is none."""

    scene: str
    fault: Fault
    strengths: tuple[float, ...]
    levels: Mapping[str, tuple[float | None, ...]]
    methods: tuple[str, ...]


def compared(points: TheoryFigures, methods: Sequence[str]) -> list[Compared]:
    """Return the points fault by fault."""
    found = []
    for scene, name in dict.fromkeys((point.scene_name, str(point.fault)) for point in points):
        some = [one for one in points if (one.scene_name, one.fault) == (scene, name)]
        keys = (*FIGURES, ORACLE, *(f"{method}_db" for method in methods))
        levels = {key: tuple(points[one].get(key) for one in some) for key in keys}
        strengths = tuple(one.strength for one in some)
        found.append(Compared(scene, FAULTS[name], strengths, levels, tuple(methods)))
    return found


def rank_correlation(one: Sequence[float | None], other: Sequence[float | None]) -> float | None:
    """Return Spearman's correlation; infinite values count as larger than all (None: infinite).

    None where fewer than three pairs are known, or one of the two does not vary.
    """
    pairs = [(a, b) for a, b in zip(one, other, strict=True) if a is not None and b is not None]
    first, second = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
    if len(pairs) < 3 or min(len(set(first)), len(set(second))) < 2:
        return None
    return float(spearmanr(first, second)[0])  # pyright: ignore[reportArgumentType]


def _place(span: Span | None) -> tuple[float | None, float | None]:
    return (0.0, 0.0) if span is None else (span.low, span.high)


def agreement(one: Compared, method: str) -> str:
    """Return whether the bound breaks where a method does, in words."""
    measured, expected = (
        below_best(one.levels[key], one.fault.whole) for key in (f"{method}_db", BOUND)
    )
    if measured is None:
        return "not measured"
    words = []
    for end, found, wanted in zip(("low", "high"), _place(measured), _place(expected), strict=True):
        if found is None and wanted is None:
            continue
        if found is None or wanted is None:
            words.append("method only" if wanted is None else "theory only")
        else:
            words.append(_apart(one, found, wanted, end))
    return "; ".join(words) or "neither breaks"


def _apart(one: Compared, found: float, wanted: float, end: str) -> str:
    """Return how a method's breaking place compares with the predicted one."""
    here, there = (strength_at(one.strengths, place) for place in (found, wanted))
    if one.fault.whole or min(here, there) <= 0:
        near, factor = abs(found - wanted) <= CLOSE_PLACES, ""
    else:
        ratio = max(here, there) / min(here, there)
        near, factor = ratio <= NEAR, f" (factor {ratio:.1f})"
    if near:
        return f"predicted{factor}"
    earlier = found < wanted if end == "high" else found > wanted
    return f"method {'sooner' if earlier else 'later'}{factor}"


def breaking(one: Compared, method: str) -> dict:
    """Return where bound, oracle and a method break, and whether the bound predicts the method."""
    levels = {"bound": one.levels[BOUND], "oracle": one.levels[ORACLE]}
    levels["measured"] = one.levels[f"{method}_db"]
    spans = {
        key: span_words(below_best(some, one.fault.whole), one.strengths)
        for key, some in levels.items()
    }
    return {
        "scene": one.scene,
        "fault": one.fault.name,
        "method": method,
        **spans,
        "judged": agreement(one, method),
        "rank_correlation": rank_correlation(levels["bound"], levels["measured"]),
    }


def is_predicted(words: str) -> bool:
    """Return whether an agreement in words is one."""
    return not any(word in words for word in ("sooner", "later", "only", "not measured"))


def draw_theory(some: Sequence[Compared], path: Path) -> Path:
    """Write a panel a fault as SVG and PNG; return the SVG's path."""
    figure, axes = sheet(len(some), 3.9, 2.75, columns=min(3, len(some)))
    colours = dict(zip(some[0].methods, COLOURS, strict=False))
    for panel, one in zip(axes, some, strict=True):
        _panel(panel, one, colours)
    lines = [
        Line2D([], [], color=colour, linestyle=style) for _, colour, style in DRAWN_AS.values()
    ]
    lines += [Line2D([], [], color=colours[name], marker="o", markersize=4) for name in colours]
    names = [*(name for name, _, _ in DRAWN_AS.values()), *colours]
    legend_below(figure, lines, names, 5)
    return save_drawing(figure, path)


def _panel(axes: Axes, one: Compared, colours: Mapping[str, str]) -> None:
    for key, (_, colour, style) in DRAWN_AS.items():
        places, levels = known_levels(one.levels[key])
        axes.plot(places, levels, color=colour, linestyle=style, linewidth=1.3, zorder=2)
    for method, colour in colours.items():
        places, levels = known_levels(one.levels[f"{method}_db"])
        axes.plot(places, levels, "-o", color=colour, linewidth=1.5, markersize=3.6, zorder=3)
    axes.set_xticks(range(len(one.strengths)), [shown(strength) for strength in one.strengths])
    axes.tick_params(labelsize=7.5)
    titled(axes, one.fault.title, one.fault.unit)


def theory_sections(points: TheoryFigures, methods: Sequence[str], folder: Path) -> list[Section]:
    """Return a section for each scene, its chart written into a folder."""
    sections = []
    every = compared(points, methods)
    for scene in dict.fromkeys(one.scene for one in every):
        some = [one for one in every if one.scene == scene]
        picture = draw_theory(some, folder / f"theory-{scene}.svg")
        body = fragment(
            "theory.html",
            scene=scene,
            picture=embedded(picture),
            breaks=_breaks_table(some),
            summary=_summary(some),
            methods=methods,
            ranks=_ranks_table(some),
            figures=_figures_table(some),
        )
        sections.append(Section(f"theory-{scene}", f"Theory beside it, {scene}", body))
    return sections


Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Heads of the columns, and rows."""


def _breaks_table(some: Sequence[Compared]) -> Table:
    methods = some[0].methods
    heads = ["Fault", "Unit", "Bound", "Oracle"]
    for method in methods:
        heads += [method, "agreement", "rank correlation"]
    rows = []
    for one in some:
        found = [breaking(one, method) for method in methods]
        row = [one.fault.title, one.fault.unit, found[0]["bound"], found[0]["oracle"]]
        for each in found:
            row += [each["measured"], each["judged"], number(each["rank_correlation"], "+.2f")]
        rows.append(row)
    return heads, rows


def oracle_offset(some: Sequence[Compared]) -> tuple[float, float]:
    """Return mean and root mean square of the oracle's PSNR less the bound's, dB."""
    apart = [
        found - bound
        for one in some
        for found, bound in zip(one.levels[ORACLE], one.levels[BOUND], strict=True)
        if found is not None and bound is not None
    ]
    return float(np.mean(apart)), float(np.sqrt(np.mean(np.square(apart))))


def _summary(some: Sequence[Compared]) -> list[str]:
    mean, root = oracle_offset(some)
    lines = [
        f"The oracle lies {mean:+.2f} dB from the bound on average (root mean square {root:.2f} "
        "dB): what the scene's surfaces, edges and occlusions differ by from Gaussian textures on "
        "planes."
    ]
    for method in some[0].methods:
        verdicts = {one.fault.title: agreement(one, method) for one in some}
        missed = [
            f"{title.lower()} ({verdict})"
            for title, verdict in verdicts.items()
            if not is_predicted(verdict)
        ]
        agreed = len(verdicts) - len(missed)
        lines.append(
            f"{method}: the bound says where it breaks, or that it does not, for {agreed} of "
            f"{len(verdicts)} faults; not for: {', '.join(missed) or 'none'}."
        )
    return lines


def _ranks(some: Sequence[Compared], key: str, method: str) -> list[float | None]:
    """Return the rank correlation of a figure with a method's PSNR, for each fault."""
    found = []
    for one in some:
        levels = one.levels[f"{method}_db"]
        known = [level for level in levels if level is not None]
        varied = len(known) > 2 and max(known) - min(known) > LEAST_SPREAD_DB
        values = [math.inf if value is None else value for value in one.levels[key]]
        found.append(rank_correlation(values, levels) if varied else None)
    return found


def _mean(ranks: Sequence[float | None], more: bool) -> float | None:
    known = [rank if more else -rank for rank in ranks if rank is not None]
    return float(np.mean(known)) if known else None


def _ranks_table(some: Sequence[Compared]) -> Table:
    methods = some[0].methods
    heads = ["Figure", "better is", "on the whole", *(one.fault.title for one in some)]
    rows = []
    for key, (title, more) in FIGURES.items():
        ranks = [_ranks(some, key, method) for method in methods]
        means = " / ".join(number(_mean(one, more), "+.2f") for one in ranks)
        cells = [
            " / ".join(number(rank, "+.2f") for rank in both) for both in zip(*ranks, strict=True)
        ]
        rows.append([title, "more" if more else "less", means, *cells])
    return heads, rows


def _figures_table(some: Sequence[Compared]) -> Table:
    names = [
        "degrees", "gain", "least_squares_gain", "condition", "condition_of_two", "unexplained",
        "spot_coherence", "ray_coherence", "crb_px", "zzb_px",
    ]  # fmt: skip
    heads = ["Fault", "Strength", *(FIGURES[name][0] for name in names)]
    rows = []
    for one in some:
        for i, strength in enumerate(one.strengths):
            values = [one.levels[name][i] for name in names]
            cells = ["∞" if value is None else f"{value:.3g}" for value in values]
            rows.append([one.fault.title, f"{strength:g} {one.fault.unit}", *cells])
    return heads, rows
