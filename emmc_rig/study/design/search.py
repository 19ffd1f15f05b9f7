"""The search: masks that a bench can mount and a maker can print, ordered by theory.

Theory takes a second a candidate, so coordinate descent goes through every value of one property at
a time until none is better. The best are then swept through what the maker misses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.progress import Watcher
from emmc_rig.study.design.bench import DesignBench, Family, Maker
from emmc_rig.study.design.expected import SIZE, Expected, expected
from emmc_rig.study.design.printed import Print, printed_psi

MASK = "mask"
STEPS_CELLS = ((1.5, 0.0), (0.0, 1.5), (1.5, 0.5), (3.5, 2.5), (7.5, 4.5))
"""From shot to shot (x, y): by odd halves, so that a pixel's edges fall elsewhere in the cells."""
FURTHER_CELLS = (7.5, 4.5)
"""To a further shot of a camera with one, as of the shipped ones."""
RGBW_SHARE = 0.5
"""Of each colour that an RGBW mask lets through."""
SEED = 1


PROPERTIES = (("cell_um", "distance_mm"), ("family", "open_share"), ("step_cells",))
"""What the descent changes together: the shadow's shift from view to view, in cells, is of cell and
distance both."""
FINALISTS = 3
"""Candidates whose manufacturing errors are swept."""
AS_DESIGNED = Print()


@dataclass(frozen=True)
class Candidate:
    """One mask. step_cells: (x, y), its motion from shot to shot; (0, 0) for one shot."""

    family: Family
    open_share: float
    cell_um: float
    distance_mm: float
    step_cells: tuple[float, float] = (0.0, 0.0)

    @property
    def label(self) -> str:
        """In words."""
        step = f", moved by {self.step_cells[0]:g} x {self.step_cells[1]:g} cells"
        return (
            f"{self.family}, {self.open_share:.0%} open, cells of {self.cell_um:g} um at "
            f"{self.distance_mm:g} mm{step if any(self.step_cells) else ''}"
        )

    def camera(self, bench: DesignBench) -> Camera:
        """Return the bench's camera with this mask."""
        pattern: dict[str, object] = {"kind": self.family, "seed": SEED}
        if self.family == "random_binary":
            pattern["open_probability"] = self.open_share
        mask = {"distance_mm": self.distance_mm, "cell_um": self.cell_um, "pattern": pattern}
        x, y = (step * self.cell_um for step in self.step_cells)
        middle = (bench.shots - 1) / 2
        shots = [
            {"offset_um": {MASK: ((shot - middle) * x, (shot - middle) * y)} if x or y else {}}
            for shot in range(bench.shots)
        ]
        more = (bench.shots * x, bench.shots * y)
        if bench.shots == 1:
            more = tuple(step * self.cell_um for step in FURTHER_CELLS)
        return Camera.model_validate(
            {
                "title": self.label,
                "reference": "emmc-rig design",
                "views": bench.views,
                "lens": bench.lens.model_dump(),
                "sensor": bench.sensor.model_dump(),
                "masks": {MASK: mask},
                "shots": shots,
                "more_shots_step_um": {MASK: more},
                "total_exposure_s": bench.total_exposure_s,
            }
        )

    def is_within(self, bench: DesignBench) -> bool:
        """Return whether the stage reaches all its shots."""
        return all(
            (bench.shots - 1) * step * self.cell_um <= travel_um
            for step, travel_um in zip(self.step_cells, bench.stage_travel_um, strict=True)
        )


def candidates(bench: DesignBench) -> list[Candidate]:
    """Return every mask there is to choose from; raises AppError where there is none."""
    shares: dict[Family, tuple[float, ...]] = {
        "random_rgbw": (RGBW_SHARE,),
        "random_binary": bench.open_shares,
    }
    patterns: list[tuple[Family, float]] = [
        (family, share) for family in bench.printed_families for share in shares[family]
    ]
    steps = STEPS_CELLS if bench.shots > 1 else ((0.0, 0.0),)
    every = [
        Candidate(family, share, cell_um, distance_mm, step)
        for (family, share), cell_um, distance_mm, step in product(
            patterns, bench.tried_cells_um, bench.distances_mm, steps
        )
    ]
    within = [mask for mask in every if mask.is_within(bench)]
    if not within:
        raise AppError(
            "no mask is left to choose from: let the maker print a family, smaller cells, or give "
            "the stage more travel"
        )
    return within


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

    ideal_db: PSNR expected of the winner if light did not diffract.
    """

    tried: tuple[tuple[Candidate, Expected], ...]
    held: tuple[Held, ...]
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
    """Return the masks tried and the finalists; raises AppError where no mask can be chosen."""
    every = candidates(bench)
    watcher.begin("expected error of each mask, by theory", None)
    tried: dict[Candidate, Expected] = {}

    def score(candidate: Candidate) -> float:
        if candidate not in tried:
            tried[candidate] = _expected(bench, candidate, AS_DESIGNED)
            watcher.step(candidate.label)
        return tried[candidate].psnr_db

    best = every[len(every) // 2]
    while True:
        before = score(best)
        for changed in PROPERTIES:
            best = max((best, *_beside(best, every, changed)), key=score)
        if score(best) <= before:
            break
    ordered = sorted(tried.items(), key=lambda item: -item[1].psnr_db)
    watcher.begin("manufacturing errors", FINALISTS)
    held = []
    for candidate, _ in ordered[:FINALISTS]:
        errors = prints(bench.maker).items()
        figures = {name: _expected(bench, candidate, how).psnr_db for name, how in errors}
        held.append(Held(candidate, figures))
        watcher.step(candidate.label)
    held.sort(key=lambda finalist: -finalist.worst_db)
    ideal = _expected(bench, held[0].candidate, Print(diffraction=False))
    return Search(tuple(ordered), tuple(held), ideal.psnr_db)


def _beside(at: Candidate, every: Sequence[Candidate], changed: Sequence[str]) -> list[Candidate]:
    """Return the candidates that differ from one by these properties alone."""
    same = [name for name in at.__dataclass_fields__ if name not in changed]
    return [mask for mask in every if all(getattr(mask, n) == getattr(at, n) for n in same)]


def _expected(bench: DesignBench, candidate: Candidate, how: Print) -> Expected:
    camera = candidate.camera(bench)
    return expected(camera, printed_psi(camera, SIZE, how), bench.disparities_px)


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
