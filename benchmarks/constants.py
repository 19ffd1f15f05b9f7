"""No tuned constant of `adaptive` sits on an edge: twice and half of each cost little.

Constants are numbers in capitals at the top of the modules of `reconstruction.adaptive`, and the
numbers among its settings. Those that compiled kernels use are left out: frozen with the kernel.
"""

from __future__ import annotations

import ast
import inspect
import pkgutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

import lab
from pydantic import ValidationError

from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.study.trial import Capture, trial_of

NO_EFFECT = ("method", "models", "planning", "uncertainty")
"""Modules whose constants change advice, maps and deviation, but not the light field."""
UNCHANGED = "as it is"


def modules() -> dict[str, ModuleType]:
    """Return the modules whose constants are scaled, by their short names."""
    package = import_module("emmc_rig.reconstruction.adaptive")
    names = [found.name for found in pkgutil.iter_modules(package.__path__)]
    return {n: import_module(f"{package.__name__}.{n}") for n in names if n not in NO_EFFECT}


def constants() -> dict[str, object]:
    """Return the constants by name, such as "search.JUMP", and the settings, "settings.jump"."""
    found, kernels = {}, set()
    for module in modules().values():
        for value in vars(module).values():
            if hasattr(value, "py_func"):
                kernels |= set(value.py_func.__code__.co_names)
    for short, module in modules().items():
        for node in ast.parse(inspect.getsource(module)).body:
            for target in getattr(node, "targets", ()):
                for name in ast.walk(target):
                    if isinstance(name, ast.Name) and name.id.isupper() and name.id not in kernels:
                        found[f"{short}.{name.id}"] = getattr(module, name.id)
    settings = AdaptiveSettings()
    found |= {f"settings.{name}": value for name, value in settings}
    found |= {f"settings.texture.{name}": value for name, value in settings.texture}
    return {name: value for name, value in found.items() if is_number(value)}


def is_number(value: object) -> bool:
    """Return whether a constant can be scaled: a number, or several."""
    if isinstance(value, tuple):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def times(value, factor: float):
    """Return a value times a factor; a whole number stays one, at least 1."""
    if isinstance(value, tuple):
        return tuple(times(each, factor) for each in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@contextmanager
def scaled(name: str, factor: float) -> Iterator[AdaptiveSettings]:
    """Yield the settings; until the block ends modules use the constant times the factor."""
    place, _, last = name.rpartition(".")
    value = None if name == UNCHANGED else times(constants()[name], factor)
    if name == UNCHANGED:
        yield AdaptiveSettings()
    elif place.startswith("settings"):
        changed = {last: value}
        yield AdaptiveSettings.model_validate(
            {"texture": changed} if place.endswith("texture") else changed
        )
    else:
        was = getattr(modules()[place], last)
        # Modules import names from each other: each has its own.
        users = [m for m in modules().values() if getattr(m, last, None) is was]
        try:
            for module in users:
                setattr(module, last, value)
            yield AdaptiveSettings()
        finally:
            for module in users:
                setattr(module, last, was)


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, constant: str, factor: float
) -> dict:
    """Return the PSNR of a scene with a scaled constant; empty for a value that settings refuse."""
    given = trial_of(Capture(scene, camera, size, seed))
    try:
        with scaled(constant, factor) as settings:
            result = reconstruct_adaptive(given.psi, given.frames, settings)
    except ValidationError:
        return {"psnr_db": None}
    return {"psnr_db": given.psnr_db(result.light_field)}


def main() -> None:
    """Measure twice and half of every constant on every scene."""
    parser = lab.arguments(__doc__, size="64x64")
    parser.add_argument("--constant", action="append", help="may repeat; default: all")
    args = lab.parsed(parser)
    names = args.constant or list(constants())[: 1 if args.smallest else None]
    choices = [(UNCHANGED, 1.0), *((name, factor) for name in names for factor in (2.0, 0.5))]
    points = lab.points(args, ({"constant": name, "factor": by} for name, by in choices))
    rows = lab.measured(points, measure, "constants", args)
    rows["psnr_db"] = rows["psnr_db"].replace("", None).astype(float)
    table = rows.pivot_table("psnr_db", ["constant", "factor"], "scene")
    costs = table.loc[(UNCHANGED, 1.0)] - table.drop(index=(UNCHANGED, 1.0))
    summary = costs.agg(["mean", "max"], axis=1).sort_values("mean", ascending=False)
    axes = summary["mean"].head(20).plot.barh(xlabel="dB lost, mean over scenes", ylabel="")
    lab.finished(summary.reset_index(), axes, "constants", args)


if __name__ == "__main__":
    main()
