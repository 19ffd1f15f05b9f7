"""The search: coordinate descent over what can be mounted and printed, then what the maker misses.

Theory takes a second a candidate, so the descent goes through every value of one property at a
time until none is better; all that were tried make the chart of light against error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

from emmc_rig.progress import Watcher
from emmc_rig.study.design.bench import DesignBench, Maker
from emmc_rig.study.design.candidates import Candidate, Choices, choices
from emmc_rig.study.design.expected import SIZE, Bounds, Expected, bounds, expected
from emmc_rig.study.design.printed import Print, printed_psi

FINALISTS = 3
"""Candidates whose manufacturing errors are swept."""
AS_DESIGNED = Print()


@dataclass(frozen=True)
class Held:
    """A finalist under the maker's errors: PSNR expected, by the error's name, dB."""

    candidate: Candidate
    psnr_db: Mapping[str, float]

    @property
    def worst_db(self) -> float:
        """Of all errors."""
        return min(self.psnr_db.values())


@dataclass(frozen=True)
class Search:
    """tried: every candidate with what theory expects; best first. held: the finalists, best first.

    bounds: of the winner. ideal_db: PSNR expected of it if light did not diffract.
    """

    tried: tuple[tuple[Candidate, Expected], ...]
    held: tuple[Held, ...]
    bounds: Bounds
    ideal_db: float

    @property
    def winner(self) -> Candidate:
        """The finalist that is best when the maker misses."""
        return self.held[0].candidate

    @property
    def expected(self) -> Expected:
        """What theory expects of the winner."""
        return dict(self.tried)[self.winner]


def search(bench: DesignBench, watcher: Watcher) -> Search:
    """Return what was tried and what holds; raises AppError where nothing can be chosen."""
    offered = choices(bench)
    watcher.begin("expected error of each mask, by theory", None)
    tried: dict[Candidate, Expected] = {}

    def score(candidate: Candidate) -> float:
        if candidate not in tried:
            camera = candidate.camera(bench)
            psi = printed_psi(camera, SIZE, AS_DESIGNED)
            tried[candidate] = expected(camera, psi, bench.disparities_px)
            watcher.step(candidate.label)
        return tried[candidate].psnr_db

    every = list(offered.every(bench))
    best = every[len(every) // 2]
    while True:
        before = score(best)
        for beside in _beside(offered, bench):
            best = max((best, *beside(best)), key=score)
        if score(best) <= before:
            break
    ordered = sorted(tried.items(), key=lambda item: -item[1].psnr_db)
    watcher.begin("manufacturing errors", FINALISTS)
    held = []
    for candidate, _ in ordered[:FINALISTS]:
        held.append(_held(bench, candidate))
        watcher.step(candidate.label)
    held.sort(key=lambda one: -one.worst_db)
    winner = held[0].candidate.camera(bench)
    found = bounds(winner, printed_psi(winner, SIZE, AS_DESIGNED), bench.disparities_px)
    ideal_db = _psnr_db(bench, held[0].candidate, Print(diffraction=False))
    return Search(tuple(ordered), tuple(held), found, ideal_db)


def _beside(
    offered: Choices, bench: DesignBench
) -> Iterator[Callable[[Candidate], Sequence[Candidate]]]:
    """Yield, for each property, what returns the candidates that differ by it alone.

    Cell and distance are one: the shadow's shift from view to view, in cells, is of both.
    """

    def fitting(some: Iterator[Candidate]) -> Sequence[Candidate]:
        return [one for one in some if offered.fits(bench, one)]

    yield lambda at: fitting(
        replace(at, cell_um=cell_um, distance_mm=distance_mm)
        for cell_um, distance_mm in product(offered.cells_um, offered.distances_mm)
    )
    yield lambda at: fitting(
        replace(at, family=family, open_share=share) for family, share in offered.patterns
    )
    yield lambda at: fitting(replace(at, step_cells=step) for step in offered.steps_cells)


def prints(maker: Maker) -> dict[str, Print]:
    """Return the maker's errors, one at a time and all together, by name."""
    off = maker.over_etch_um
    return {
        "as designed": Print(),
        f"edges soft by {maker.edge_um:g} um": Print(edge_um=maker.edge_um),
        f"over-etched by {off:g} um": Print(over_etch_um=off),
        f"under-etched by {off:g} um": Print(over_etch_um=-off),
        f"layer {maker.thickness_um:g} um thick": Print(thickness_um=maker.thickness_um),
        "all, over-etched": Print(maker.edge_um, off, maker.thickness_um),
        "all, under-etched": Print(maker.edge_um, -off, maker.thickness_um),
    }


def _held(bench: DesignBench, candidate: Candidate) -> Held:
    figures = {name: _psnr_db(bench, candidate, how) for name, how in prints(bench.maker).items()}
    return Held(candidate, figures)


def _psnr_db(bench: DesignBench, candidate: Candidate, how: Print) -> float:
    camera = candidate.camera(bench)
    return expected(camera, printed_psi(camera, SIZE, how), bench.disparities_px).psnr_db


def pareto(tried: Sequence[tuple[Candidate, Expected]]) -> list[tuple[Candidate, Expected]]:
    """Return those that no other beats in both light and PSNR, the darkest first."""
    front: list[tuple[Candidate, Expected]] = []
    for one in sorted(tried, key=lambda item: (-item[1].light, -item[1].psnr_db)):
        if not front or one[1].psnr_db > front[-1][1].psnr_db:
            front.append(one)
    return front[::-1]
