"""What a bench has and what a mask maker prints: the frozen start of a design."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Lens, Positive, Sensor
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.settings import Settings, validated

Family = Literal["random_rgbw", "random_binary"]
MOST_PITCHES = 40
"""Samples that a cell may be wide: every view of a pixel then sees the same cell, at any shift."""
WIDEST_PX = 8.0
"""Half the side of a periodic block: a disparity that carries a texture further says nothing."""
LEAST_STEP_CELLS = 1.5
"""Between two shots: by less, both see mostly the same cells."""


class Maker(Settings):
    """What the mask maker prints, and by how much it misses."""

    smallest_cell_um: Positive = Field(default=24.0, description="side of the smallest square cell")
    grid_um: float = Field(default=0.5, gt=0, description="edges lie on multiples of it")
    colours: bool = Field(default=True, description="prints red, green and blue filters")
    edge_um: float = Field(default=1.0, ge=0, description="deviation of a soft or rough edge")
    over_etch_um: float = Field(default=1.0, ge=0, description="by which an edge may be off")
    thickness_um: float = Field(default=2.0, ge=0, description="of the opaque or coloured layer")


class DesignBench(Settings):
    """The bench: parts that are mounted, masks that fit, and the scene to see.

    cells_um: sides to try (default: from the smallest printable to three times that).
    size: of the pictures, samples; the mask file covers them at every shot.
    """

    views: tuple[int, int] = (5, 5)
    lens: Lens = Lens()
    sensor: Sensor = Sensor(cfa="rggb")
    maker: Maker = Maker()
    families: tuple[Family, ...] = Field(default=("random_rgbw", "random_binary"), min_length=1)
    cells_um: tuple[Positive, ...] = ()
    distances_mm: tuple[Positive, ...] = Field(default=(0.06, 0.12, 0.24), min_length=1)
    open_shares: tuple[float, ...] = Field(default=(0.3, 0.5, 0.7), min_length=1)
    stage_travel_um: tuple[float, float] = (2000.0, 2000.0)
    shots: int = Field(default=1, ge=1, le=16)
    total_exposure_s: Positive = 0.05
    disparities_px: tuple[float, float] = (-1.0, 1.0)
    size: Annotated[tuple[int, int], Field(description="rows, columns")] = (192, 256)

    @model_validator(mode="after")
    def _can_be_built(self) -> DesignBench:
        smallest, pitch_um = self.maker.smallest_cell_um, self.sensor.sample_pitch_um
        for cell_um in (smallest, *self.cells_um):
            if cell_um > MOST_PITCHES * pitch_um:
                raise ValueError(
                    f"a cell of {cell_um:g} um is over {MOST_PITCHES} samples wide: lengths of "
                    "cells and samples are in um, distances in mm"
                )
        for cell_um in self.cells_um:
            if cell_um < smallest:
                raise ValueError(
                    f"a cell of {cell_um:g} um cannot be printed: maker.smallest_cell_um is "
                    f"{smallest:g}"
                )
        for distance_mm in self.distances_mm:
            if distance_mm >= self.lens.distance_mm:
                raise ValueError(
                    f"a mask at {distance_mm:g} mm is not between sensor and lens "
                    f"({self.lens.distance_mm:g} mm): distances are in mm"
                )
        if not all(0 < share <= 1 for share in self.open_shares):
            raise ValueError("open_shares are shares of the mask's area: above 0, at most 1")
        low, high = self.disparities_px
        if not -WIDEST_PX <= low < high <= WIDEST_PX:
            raise ValueError(
                f"disparities_px: the least, then the greatest, within +-{WIDEST_PX:g} samples a "
                f"view; not {low:g} and {high:g}"
            )
        if "random_rgbw" in self.families and not self.maker.colours and len(self.families) == 1:
            raise ValueError("random_rgbw cannot be printed: maker.colours is false")
        if self.sensor.binning != 1:
            raise ValueError("sensor.binning: a design is for pixels of one sample, write 1")
        if min(self.size) < 32:
            raise ValueError("size: at least 32 rows and 32 columns")
        if min(self.stage_travel_um) < 0:
            raise ValueError("stage_travel_um: at least 0")
        needed = (self.shots - 1) * LEAST_STEP_CELLS * smallest
        if max(self.stage_travel_um) < needed:
            raise ValueError(
                f"stage_travel_um: {self.shots} shots of the smallest cell need {needed:g} um "
                f"along x or y, the stage has {max(self.stage_travel_um):g}: take fewer shots"
            )
        return self

    @property
    def printed_families(self) -> tuple[Family, ...]:
        """The pattern families that the maker prints."""
        return tuple(
            family for family in self.families if self.maker.colours or family != "random_rgbw"
        )

    @property
    def tried_cells_um(self) -> tuple[float, ...]:
        """The sides of cells to try, on the maker's grid, the smallest first."""
        grid_um, smallest = self.maker.grid_um, self.maker.smallest_cell_um
        sides = self.cells_um or tuple(smallest * factor for factor in (1, 1.5, 2, 3))
        on_grid = {max(1, round(side / grid_um)) * grid_um for side in sides}
        return tuple(sorted(side for side in on_grid if side >= smallest - grid_um / 2))


def load_bench(path: Path | None) -> DesignBench:
    """Return the bench of a YAML file, or the default one; raises AppError with one line."""
    if path is None:
        return DesignBench()
    return validated(DesignBench, read_yaml(path, AppError), str(path), AppError)
