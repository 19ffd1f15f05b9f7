"""A method of reconstruction as an object: assumptions, cost, settings, solve, sensitivities.

`ShippedSettings` holds the settings of the shipped methods together; a method of another
distribution adds its own part when it is read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import TypeVar

import numpy as np
from pydantic import Field

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.adaptive.film import Film, FilmSettings
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.reconstruction.sparse import PatchEstimates, SparseSettings
from emmc_rig.reconstruction.tv import TVSettings

Part = TypeVar("Part", bound=Settings)


class BlockSettings(Settings):
    """The grid of blocks of a large light field, see `reconstruction.tiles`: part of the method."""

    whole: int = Field(
        default=2**19, ge=1, description="samples up to which a light field is one block"
    )
    side: int = Field(default=384, ge=16, description="rows and columns of a block, at most")
    blend: int = Field(
        default=16, ge=1, description="samples to both sides over which neighbours are averaged"
    )


class ShippedSettings(Settings):
    """Settings of every method; each takes its own part.

    screening: whether frames are screened first, see `reconstruction.screening`.
    """

    screening: bool = True
    blocks: BlockSettings = Field(default_factory=BlockSettings)
    tv: TVSettings = Field(default_factory=TVSettings)
    sparse: SparseSettings = Field(default_factory=SparseSettings)
    adaptive: AdaptiveSettings = Field(default_factory=AdaptiveSettings)
    film: FilmSettings = Field(default_factory=FilmSettings)

    def of(self, kind: type[Part]) -> Part:
        """Return the part of a type: a method's own, which no field above names."""
        return next(part for _, part in self if type(part) is kind)


@dataclass(frozen=True, eq=False)
class Given:
    """The inputs of a method.

    frames: screened; NumPy takes them as their readings. dictionary: for methods that need one.
    estimates: of `estimate_patches` from the same inputs, to go on from. film: that frames are the
    next one of, see `reconstruction.adaptive.film`. moving: whether the scene moved between the
    shots; then the light field is that at the time of the first one.
    """

    psi: Psi
    frames: Frames
    dictionary: Dictionary | None
    on_step: Callable[[Progress], None] | None
    estimates: PatchEstimates | None = None
    film: Film | None = None
    moving: bool = False

    def of_first_shot(self) -> Given:
        """Return the same of the first shot alone."""
        return replace(self, psi=self.psi.of_shots([0]), frames=self.frames.cut(np.s_[:1,]))

    def needed_dictionary(self, method: str) -> Dictionary:
        """Return the dictionary; raises ReconstructionError when there is none."""
        if self.dictionary is None:
            raise ReconstructionError(
                f"'{method}' needs a dictionary: give lambertian, or the file of one"
            )
        return self.dictionary


@dataclass(frozen=True)
class Sensitivity:
    """How much a method tolerates faults of a capture: factors on the verdict's limits.

    psi: on the limits for an error of Psi. It is 1 for total variation; methods that assume more
    about the light field lose 3 dB sooner.
    bad_pixels: on the limits for single wrong readings; total variation tolerates twice as many.
    """

    psi: float = 0.7
    bad_pixels: float = 1.0


def _no_patches(psi: Psi, settings: ShippedSettings) -> None:
    return None


@dataclass(frozen=True, eq=False)
class Method:
    """A method of reconstruction, as a module of `reconstruction.methods` offers it.

    name: as `emmc_rig.reconstruct` takes it. title: a line that names the method.
    assumes, cost, when: for people: the assumption about light fields, the cost in seconds, and the
    captures for which to use the method.
    solve: a function of the inputs (`Given`) and the settings of all methods, which returns a
    `Reconstruction`.
    part, settings: name and type of its own part of the settings.
    needs_dictionary: whether the inputs need a dictionary.
    films: whether it takes scenes that move: films, frame after frame, and shots.
    sensitivity: factors on the verdict's limits.
    package: the package it needs beyond the core installation, None: none. Such a method is
    learned, for some numbers of views only.
    factor: its seconds over those of the method with factor 1. A time budget chooses the largest
    factor that fits, so the costlier method has to be the more accurate. None: a budget does not
    choose this method.
    scout: for light fields in blocks, the method whose disparities set the overlap of blocks; None:
    the overlap does not depend on disparities.
    patches: a function of Psi and settings, which returns the sparse patches that this method
    averages with, or None.
    """

    name: str
    title: str
    assumes: str
    cost: str
    when: str
    solve: Callable[[Given, ShippedSettings], Reconstruction]
    part: str
    settings: type[Settings]
    needs_dictionary: bool = False
    films: bool = False
    sensitivity: Sensitivity = field(default_factory=Sensitivity)
    package: str | None = None
    factor: float | None = None
    scout: str | None = None
    patches: Callable[[Psi, ShippedSettings], SparseSettings | None] = _no_patches

    @property
    def installed(self) -> bool:
        """Whether the package that it needs is installed."""
        return self.package is None or find_spec(self.package) is not None


def cost_words(one_shot_s: float, three_shots_s: float) -> str:
    """Return what a method costs, in words, by its seconds on 5x5 views of 64x80 pixels.

    The shipped methods state the medians over seven real scenes on two cores in
    docs/results/chart-group-a-64x80.csv, which `emmc-rig chart --size 64x80` measures.
    """
    return f"about {one_shot_s:g} s for 64x80 pixels from one shot, {three_shots_s:g} s from three"
