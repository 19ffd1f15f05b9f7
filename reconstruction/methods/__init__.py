"""The methods by name, and one call for all.

Every module of this package offers methods in its METHODS, and so does a module that another
distribution names by an entry point of the group `emmc_rig.methods`.
"""

from __future__ import annotations

import dataclasses
import pkgutil
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from pydantic import create_model

from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.compiling import compiling_s, running_s
from emmc_rig.model.errors import nearest_of
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.method import Given, Method, ShippedSettings
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.reconstruction.screening import screened
from emmc_rig.reconstruction.sparse import PatchEstimates

DEFAULT_METHOD = "adaptive"
ENTRY_POINTS = "emmc_rig.methods"


def offered() -> Iterator[Method]:
    """Yield the methods of the modules here, and of those that entry points name."""
    for module in pkgutil.iter_modules(__path__):
        yield from import_module(f"{__name__}.{module.name}").METHODS
    for entry in entry_points(group=ENTRY_POINTS):
        yield from entry.load().METHODS


METHODS = {method.name: method for method in sorted(offered(), key=lambda method: method.name)}


if TYPE_CHECKING:
    MethodSettings = ShippedSettings
else:
    _own = {method.part: (method.settings, method.settings()) for method in METHODS.values()}
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
    psi: Psi,
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
    the reading itself, and is least where noise made that small. estimates: what `estimate_patches`
    found from the same inputs, for `dict-...` and `tv-dict` to go on from. film: continued by these
    frames, of one shot: `Film()` before the first frame, then `film` of the last result. moving:
    see `Given`. Raises ReconstructionError for an unknown method, a method that takes no films, a
    missing dictionary, and inputs of shapes that disagree.
    """
    method = find_method(name)
    if (film is not None or moving) and not method.films:
        able = ", ".join(film_methods())
        raise ReconstructionError(f"'{name}' takes no films: choose one of {able}")
    settings = settings or MethodSettings()
    frames = frames.of_one_deviation()
    given = Given(psi, frames, dictionary, on_step, estimates, film, moving)
    started, compiling, notes = running_s(), compiling_s(), ()
    if settings.screening:
        seen = screened(psi, checked_inputs(psi, frames))
        given = dataclasses.replace(given, frames=seen.frames)
        notes = seen.notes
    result = method.solve(given, settings)
    return dataclasses.replace(
        result, seconds=running_s() - started, compiling_seconds=compiling_s() - compiling,
        screening=notes or result.screening,
    )  # fmt: skip
