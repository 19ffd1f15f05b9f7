"""What twice and half of each tuned constant of the adaptive method costs, in dB.

The constants are found, not listed: numbers in capitals at the top of the modules of
`reconstruction.adaptive`, and the numbers among its settings. Those that compiled kernels use are
left out: they are frozen with the kernel.
"""

from __future__ import annotations

import ast
import inspect
import pkgutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from pydantic import ValidationError

import reconstruction.adaptive
from emmc_rig.files.folders import result_folder
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures
from emmc_rig.study.sweep import NotApplicableError, Results, Sweep, csv_text
from emmc_rig.study.trial import Setup, Trial, trial_of
from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.settings import AdaptiveSettings
from simulators.scenes import SCENES

FACTORS = (2.0, 0.5)
ELSEWHERE = ("method", "models", "planning", "uncertainty")
"""Modules whose constants change advice, maps and deviation, but not the light field."""
Value = float | tuple[float, ...]


@dataclass(frozen=True)
class Constant:
    """A number, or several that are scaled together, of a module, or of its settings.

    module: its name within `reconstruction.adaptive`; for settings "settings" and
    "settings.texture".
    """

    module: str
    name: str
    value: Value

    @property
    def label(self) -> str:
        """Return how a table calls it."""
        return f"{self.module}.{self.name}"

    @property
    def is_setting(self) -> bool:
        """Return whether it is a setting."""
        return self.module.startswith("settings")


@dataclass(frozen=True)
class Scaled:
    """A capture reconstructed with a constant times a factor; None: with all as they are."""

    capture: int
    constant: Constant | None = None
    factor: float = 1.0

    @property
    def label(self) -> str:
        """Return the trial in words."""
        return "as it is" if self.constant is None else f"{self.factor:g} x {self.constant.label}"


@dataclass(frozen=True)
class Cost(Figures):
    """A constant, and the PSNR lost with a factor: on average over captures, the standard error of
    that (0 of one capture), and at most."""

    constant: str
    value: str
    factor: float
    mean_db: float
    error_db: float
    worst_db: float


def _modules() -> list[ModuleType]:
    package = reconstruction.adaptive
    return [
        import_module(f"{package.__name__}.{one.name}")
        for one in pkgutil.iter_modules(package.__path__)
        if one.name not in ELSEWHERE
    ]


def _is_number(value: object) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(map(_is_number, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _compiled(module: ModuleType) -> set[str]:
    """Return the names that the compiled functions of a module use."""
    kernels = [getattr(value, "py_func", None) for value in vars(module).values()]
    return {name for kernel in kernels if kernel for name in kernel.__code__.co_names}


@cache
def constants() -> tuple[Constant, ...]:
    """Return the constants and numerical settings of the adaptive method."""
    found, frozen = [], set().union(*map(_compiled, _modules()))
    for module in _modules():
        short = module.__name__.rpartition(".")[2]
        for node in ast.parse(inspect.getsource(module)).body:
            names = [
                name.id
                for target in getattr(node, "targets", ())
                for name in ast.walk(target)
                if isinstance(name, ast.Name) and name.id.isupper() and name.id not in frozen
            ]
            found += [
                Constant(short, name, value)
                for name in names
                if not name.startswith("_") and _is_number(value := getattr(module, name))
            ]
    settings = AdaptiveSettings()
    for module, part in (("settings", settings), ("settings.texture", settings.texture)):
        found += [Constant(module, name, value) for name, value in part if _is_number(value)]
    return tuple(found)


def _times(value: Value, factor: float) -> Value:
    if isinstance(value, tuple):
        return tuple(_times(one, factor) for one in value)  # type: ignore[return-value]
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@contextmanager
def _with(constant: Constant | None, factor: float) -> Iterator[AdaptiveSettings]:
    """Yield the settings with a constant times a factor, which modules use until the block ends.

    Raises NotApplicableError where it may not have that value, or is a whole number that stays.
    """
    if constant is None:
        yield AdaptiveSettings()
        return
    value = _times(constant.value, factor)
    if value == constant.value:
        raise NotApplicableError(f"{constant.label} stays {value}")
    if constant.is_setting:
        own = {constant.name: value}
        within = own if constant.module == "settings" else {"texture": own}
        try:
            changed = AdaptiveSettings.model_validate(within)
        except ValidationError as why:
            raise NotApplicableError(f"{constant.label} may not be {value}") from why
        yield changed
        return
    home = import_module(f"{reconstruction.adaptive.__name__}.{constant.module}")
    was = getattr(home, constant.name)
    # Modules import names from each other: each has its own.
    users = [one for one in _modules() if getattr(one, constant.name, None) is was]
    try:
        for one in users:
            setattr(one, constant.name, value)
        yield AdaptiveSettings()
    finally:
        for one in users:
            setattr(one, constant.name, was)


@dataclass
class ConstantSweep(Sweep[Scaled]):
    """The PSNR of captures with a constant scaled; settings: the captures, a tuple of Setup."""

    journal = "constants.jsonl"
    noun = "captures"
    stage = "reconstruct"
    revision = 1

    def inputs(self, point: Scaled) -> dict[str, object]:
        """Return everything that a trial depends on, as plain data."""
        given: Setup = self.settings[point.capture]
        return {
            "camera": given.camera.model_dump(mode="json"),
            "scene": given.scene,
            "sum": float(np.sum(self.trials[point.capture].truth, dtype=np.float64)),
            "size": given.size,
            "seed": given.seed,
            "constants": {one.label: one.value for one in constants()},
            "constant": point.label,
        }

    @cached_property
    def trials(self) -> list[Trial]:
        """What is reconstructed."""
        return [trial_of(one) for one in self.settings]

    def measured(self, points: Sequence[Scaled], watcher: Watcher) -> Results:
        """Yield the PSNR of each point."""
        for point in points:
            given = self.trials[point.capture]
            with _with(point.constant, point.factor) as settings:
                result = reconstruct_adaptive(
                    given.psi, given.readings, given.noise_sigma, settings, given.usable
                )
            yield {"psnr_db": given.psnr_db(result.light_field)}


def constant_costs(
    captures: Sequence[Setup], folder: Path, watcher: Watcher
) -> tuple[list[Cost], list[str]]:
    """Return what each factor of each constant costs, the dearest first, and what was left out.

    Trials that the folder holds are not measured again; see `Sweep.run`.
    """
    whole = [Scaled(at) for at in range(len(captures))]
    scaled = [(one, factor) for one in constants() for factor in FACTORS]
    sweep = ConstantSweep(tuple(captures), folder)
    trials = [replace(at, constant=one, factor=by) for one, by in scaled for at in whole]
    results = sweep.run([*whole, *trials], watcher)
    costs = []
    for one, factor in scaled:
        lost = [
            results[at]["psnr_db"] - results[trial]["psnr_db"]
            for at in whole
            if (trial := replace(at, constant=one, factor=factor)) in results
        ]
        if lost:
            error = float(np.std(lost, ddof=1)) / len(lost) ** 0.5 if len(lost) > 1 else 0.0
            mean = sum(lost) / len(lost)
            costs.append(Cost(one.label, str(one.value), factor, mean, error, max(lost)))
    costs.sort(key=lambda cost: -abs(cost.mean_db))
    return costs, sorted(set(sweep.left_out.values()))


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure twice and half of each constant (`chart --constants`)."""
    scenes, size = asked.scenes or tuple(SCENES), asked.size or (96, 96)
    captures = [Setup(scene, asked.described, size, asked.seed) for scene in scenes]
    costs, left_out = constant_costs(captures, folder, show)
    show.table(
        ("constant", "value", "times", "costs dB", "error", "at most"),
        [
            (one.constant, one.value, f"{one.factor:g}", f"{one.mean_db:+.2f}",
             f"{one.error_db:.2f}", f"{one.worst_db:+.2f}")
            for one in costs
        ],
    )  # fmt: skip
    for line in left_out:
        show.note("left out", line)
    rows = [one.as_dict() for one in costs]
    with result_folder(folder, "chart --constants", adds=True) as new:
        write_text(new / "constants.csv", csv_text(rows, form=".3g"))
    about = {"scenes": list(scenes), "camera": asked.camera, "size": list(size)}
    return {**about, "rows": rows, "left_out": left_out}
