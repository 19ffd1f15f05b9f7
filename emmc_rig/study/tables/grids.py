"""Tables II, III, IV, Figures 6 and 8 as grids: ours beside the paper's, for screen and page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import (
    MASK_TITLES,
    METHOD_TITLES,
    SCENARIOS,
    Capture,
    Cell,
    Part,
    scenes_of,
)

Results = Mapping[Cell, Mapping]
MEAN = "mean"


@dataclass(frozen=True)
class Pair:
    """PSNR in dB, ours and the paper's; None where there is none."""

    ours: float | None
    paper: float | None


@dataclass(frozen=True)
class Line:
    """One line of a grid; `mean` for those that summarise scenes."""

    heads: tuple[str, ...]
    pairs: tuple[Pair, ...]
    mean: bool = False

    def shown_heads(self, before: Line | None) -> list[str]:
        """Return the heads, empty where they are those of the line before."""
        same = () if not before else before.heads
        return [
            "" if same[: i + 1] == self.heads[: i + 1] else head
            for i, head in enumerate(self.heads)
        ]


@dataclass(frozen=True)
class Grid:
    """One table. heads: what the first columns of each line say. columns: the captures."""

    name: str
    title: str
    heads: tuple[str, ...]
    columns: tuple[str, ...]
    lines: tuple[Line, ...]


def grids(parts: Sequence[Part], results: Results, scenes: Sequence[str]) -> list[Grid]:
    """Return the grids of the parts; cells that were not measured stay empty."""
    return [_grid(part, results, scenes) for part in parts]


def pair_of(results: Results, cell: Cell) -> Pair:
    """Return a cell's pair."""
    found = results.get(cell)
    return Pair(None if found is None else found["psnr_db"], cell.paper_psnr_db)


def mean_pair(pairs: Iterable[Pair]) -> Pair:
    """Return the means over scenes: of ours that exist, of the paper's if it has them all."""
    listed = list(pairs)
    ours = [pair.ours for pair in listed if pair.ours is not None]
    theirs = [pair.paper for pair in listed if pair.paper is not None]
    return Pair(
        float(np.mean(ours)) if ours else None,
        float(np.mean(theirs)) if theirs and len(theirs) == len(listed) else None,
    )


def _lines(
    results: Results,
    scenes: Sequence[str],
    rows: Rows,
) -> list[Line]:
    """Return lines for every scene, then means, then the paper's own means where scenes differ.

    rows: heads that follow the scene, captures of the columns, methods.
    """
    lines = []
    for scene in [*scenes, MEAN]:
        for heads, captures, methods in rows:
            for method in methods:
                columns = [
                    [pair_of(results, Cell(name, capture, method)) for capture in captures]
                    for name in (scenes if scene == MEAN else [scene])
                ]
                pairs = tuple(mean_pair(column) for column in zip(*columns, strict=True))
                heading = (scene, *heads, METHOD_TITLES[method])
                lines.append(Line(heading, pairs, scene == MEAN))
    if len(scenes) == 1:
        lines = [line for line in lines if not line.mean]
    return lines


def _papers_means(part: Part, rows: Rows) -> list[Line]:
    """Return the paper's means over all its scenes of a part."""
    scenes = scenes_of(part, list(paper.TITLES))
    lines = []
    for heads, captures, methods in rows:
        for method in methods:
            printed = [
                [Cell(scene, capture, method).paper_psnr_db for scene in scenes]
                for capture in captures
            ]
            known = [[value for value in column if value is not None] for column in printed]
            if any(known):
                pairs = (Pair(None, float(np.mean(some)) if some else None) for some in known)
                heading = (f"paper's {len(scenes)}", *heads, METHOD_TITLES[method])
                lines.append(Line(heading, tuple(pairs), True))
    return lines


Rows = list[tuple[tuple[str, ...], Sequence[Capture], Sequence[str]]]


def _rows(part: Part) -> tuple[tuple[str, ...], tuple[str, ...], list[Rows]]:
    """Return what heads the lines of a part, its columns, and its rows, in one block or several."""
    every = part.captures
    if part.name == "table2":
        kinds = {"noise-free": False, "noisy": True}
        blocks: list[Rows] = [
            [((title,), [c for c in every if c.noisy == noisy], part.methods)]
            for title, noisy in kinds.items()
        ]
        return ("noise",), _names([c for c in every if not c.noisy]), blocks
    if part.name == "table4":
        rows: Rows = [
            ((f"({one}) {title}",), [c for c in every if c.scenario == one], part.methods)
            for one, title in SCENARIOS.items()
        ]
        return ("sensor",), ("1 (RGB 3)", "2 (RGB 6)", "3 (RGB 9)", "4 (RGB 12)"), [rows]
    columns = _names(every)
    if part.name == "figure8":
        columns = tuple(MASK_TITLES[c.mask] for c in every)
    return (), columns, [[((), every, part.methods)]]


def _grid(part: Part, results: Results, scenes: Sequence[str]) -> Grid:
    shown = scenes_of(part, scenes)
    # Of Table II the paper's means are those of its four scenes, given or not; Figure 8 has none.
    same = part.name == "table2" and all(paper.known_as(one) in paper.SYNTHETIC for one in shown)
    heads, columns, blocks = _rows(part)
    lines: list[Line] = []
    for rows in blocks:
        lines += _lines(results, shown, rows)
        if part.name.startswith("table") and not same:
            lines += _papers_means(part, rows)
    return Grid(part.name, part.title, ("scene", *heads, "method"), columns, tuple(lines))


def _names(captures: Sequence[Capture]) -> tuple[str, ...]:
    return tuple(
        f"({c.scenario}) {SCENARIOS[c.scenario]} × {c.shots}"
        + (", demosaiced first" if c.demosaiced else "")
        for c in captures
    )
