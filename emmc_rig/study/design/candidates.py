"""Masks that a bench can mount and a maker can print, each as a camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.study.design.bench import DesignBench, Family

MASK = "mask"
STEPS_CELLS = ((1.5, 0.0), (0.0, 1.5), (1.5, 0.5), (3.5, 2.5), (7.5, 4.5))
"""From shot to shot (x, y): by odd halves, so that a pixel's edges fall elsewhere in the cells."""
FURTHER_CELLS = (7.5, 4.5)
"""To a further shot of a camera with one, as of the shipped ones."""
RGBW_SHARE = 0.5
"""Of each colour that an RGBW mask lets through."""
SEED = 1


@dataclass(frozen=True)
class Candidate:
    """One mask. step_cells: (x, y) by which it moves from shot to shot, (0, 0) for one shot."""

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


@dataclass(frozen=True)
class Choices:
    """The values that each property of a candidate may take."""

    patterns: tuple[tuple[Family, float], ...]
    cells_um: tuple[float, ...]
    distances_mm: tuple[float, ...]
    steps_cells: tuple[tuple[float, float], ...]

    def fits(self, bench: DesignBench, candidate: Candidate) -> bool:
        """Return whether the stage reaches all its shots."""
        return all(
            (bench.shots - 1) * step * candidate.cell_um <= travel_um
            for step, travel_um in zip(candidate.step_cells, bench.stage_travel_um, strict=True)
        )

    def every(self, bench: DesignBench) -> Iterator[Candidate]:
        """Yield every candidate that fits."""
        axes = product(self.patterns, self.cells_um, self.distances_mm, self.steps_cells)
        for (family, share), cell_um, distance_mm, step in axes:
            candidate = Candidate(family, share, cell_um, distance_mm, step)
            if self.fits(bench, candidate):
                yield candidate


def choices(bench: DesignBench) -> Choices:
    """Return what there is to choose from; raises AppError where nothing is left."""
    shares: dict[Family, tuple[float, ...]] = {
        "random_rgbw": (RGBW_SHARE,),
        "random_binary": bench.open_shares,
    }
    patterns: tuple[tuple[Family, float], ...] = tuple(
        (family, share) for family in bench.printed_families for share in shares[family]
    )
    steps = STEPS_CELLS if bench.shots > 1 else ((0.0, 0.0),)
    found = Choices(patterns, bench.tried_cells_um, bench.distances_mm, steps)
    if not any(found.every(bench)):
        raise AppError(
            "no mask is left to choose from: let the maker print a family, smaller cells, or give "
            "the stage more travel"
        )
    return found
