"""The methods by name, and one call for all.

Every module of this package offers methods in its METHODS, and so does a module that another
distribution names by an entry point of the group `emmc_rig.methods`.
"""

from __future__ import annotations

import dataclasses
import pkgutil
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, TypeVar

from pydantic import Field, create_model

from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.errors import nearest_of
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from reconstruction.adaptive.film import Film, FilmSettings
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.dictionary import Dictionary
from reconstruction.errors import ReconstructionError
from reconstruction.inputs import checked_inputs
from reconstruction.method import Given, Method
from reconstruction.result import Progress, Reconstruction
from reconstruction.screening import screened
from reconstruction.sparse import PatchEstimates, SparseSettings
from reconstruction.tv import TVSettings

Part = TypeVar("Part", bound=Settings)
DEFAULT_METHOD = "adaptive"
ENTRY_POINTS = "emmc_rig.methods"


def offered() -> Iterator[Method]:
    """Yield the methods of the modules here, and of those that entry points name."""
    for module in pkgutil.iter_modules(__path__):
        yield from import_module(f"{__name__}.{module.name}").METHODS
    for entry in entry_points(group=ENTRY_POINTS):
        yield from entry.load().METHODS


METHODS = {method.name: method for method in sorted(offered(), key=lambda one: one.name)}


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


if TYPE_CHECKING:
    MethodSettings = ShippedSettings
else:
    _own = {one.part: (one.settings, one.settings()) for one in METHODS.values()}
    _own = {part: kind for part, kind in _own.items() if part not in ShippedSettings.model_fields}
    MethodSettings = create_model("MethodSettings", __base__=ShippedSettings, **_own)


def installed_methods() -> tuple[str, ...]:
    """Return the names of the methods that can run here: all, but for extras not installed."""
    return tuple(name for name, method in METHODS.items() if method.installed)


def film_methods() -> tuple[str, ...]:
    """Return the names of the methods that take scenes that move: films, and shots."""
    return tuple(name for name, method in METHODS.items() if method.films)


def find_method(name: str) -> Method:
    """Return a method by name; raises ReconstructionError naming the nearest."""
    if name in METHODS:
        return METHODS[name]
    raise ReconstructionError(f"no method '{name}': {nearest_of(name, METHODS)}")


@one_blas_thread()
def reconstruct(
    name: str,
    psi: ImagingMatrix,
    frames: Frames,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    estimates: PatchEstimates | None = None,
    film: Film | None = None,
    moving: bool = False,
) -> Reconstruction:
    """Return the light field that the method called `name` estimates.

    All readings count by one deviation, `frames.noise_sigma`: that of a single reading follows from
    the reading itself, and is least where noise made that small.
    estimates: what `estimate_patches` found from the same inputs, for `dict-...` and `tv-dict` to
    go on from. film: that the frames, of one shot, are the next one of: `Film()` before the first,
    then `film` of the result before. moving: see `Given`. Raises ReconstructionError for a method
    that is not known or takes no films, a dictionary that is missing, and inputs that do not fit
    each other.
    """
    method = find_method(name)
    if (film is not None or moving) and not method.films:
        able = ", ".join(film_methods())
        raise ReconstructionError(f"'{name}' takes no films: choose one of {able}")
    settings = settings or MethodSettings()
    frames = frames.of_one_deviation()
    given = Given(psi, frames, dictionary, on_step, estimates, film, moving)
    if not settings.screening:
        return method.solve(given, settings)
    started = time.perf_counter()
    seen = screened(psi, checked_inputs(psi, frames))
    took = time.perf_counter() - started
    given = dataclasses.replace(given, frames=seen.frames)
    result = method.solve(given, settings)
    return dataclasses.replace(result, seconds=result.seconds + took, screening=seen.notes)
