"""What twice and half of each tuned constant of the adaptive method costs, in dB.

They are those of the modules of `reconstruction.adaptive` (see `study.scaling`), and the numbers
among its settings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, lru_cache
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
from emmc_rig.study.scaling import (
    FACTORS,
    Constant,
    is_number,
    modules_of,
    numbers_of,
    scaled,
    scaled_value,
    short_name,
)
from emmc_rig.study.sweep import NotApplicableError, Results, Sweep, csv_text
from emmc_rig.study.trial import Capture, trial_of
from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.settings import AdaptiveSettings
from simulators.scenes import SCENES

ELSEWHERE = ("method", "models", "planning", "uncertainty")
"""Modules whose constants change advice, maps and deviation, but not the light field."""


@dataclass(frozen=True)
class Scaled:
    """A capture reconstructed with a constant times a factor; None: with all as they are."""

    capture: Capture
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
    return [one for one in modules_of(reconstruction.adaptive) if short_name(one) not in ELSEWHERE]


@cache
def constants() -> tuple[Constant, ...]:
    """Return the constants and numerical settings of the adaptive method."""
    settings = AdaptiveSettings()
    found = numbers_of(_modules())
    for module, part in (("settings", settings), ("settings.texture", settings.texture)):
        found += [Constant(module, name, value) for name, value in part if is_number(value)]
    return tuple(found)


@contextmanager
def _with(constant: Constant | None, factor: float) -> Iterator[AdaptiveSettings]:
    """Yield the settings with a constant times a factor, which modules use until the block ends.

    Raises NotApplicableError where it may not have that value, or is a whole number that stays.
    """
    if constant is None:
        yield AdaptiveSettings()
        return
    if not _is_setting(constant):
        with scaled(_modules(), constant, factor):
            yield AdaptiveSettings()
        return
    value = scaled_value(constant, factor)
    own = {constant.name: value}
    within = own if constant.module == "settings" else {"texture": own}
    try:
        changed = AdaptiveSettings.model_validate(within)
    except ValidationError as why:
        raise NotApplicableError(f"{constant.label} may not be {value}") from why
    yield changed


def _is_setting(constant: Constant) -> bool:
    return constant.module.startswith("settings")


_trial = lru_cache(maxsize=32)(trial_of)


@dataclass
class ConstantSweep(Sweep[Scaled]):
    """The PSNR of captures with a constant scaled; settings are not asked."""

    journal = "constants.jsonl"
    noun = "captures"
    stage = "reconstruct"
    revision = 1

    def inputs(self, point: Scaled) -> dict[str, object]:
        """Return everything that a trial depends on, as plain data."""
        every = {one.label: one.value for one in constants()}
        capture = point.capture.identity()
        return {"capture": capture, "constants": every, "constant": point.label}

    def measured(self, points: Sequence[Scaled], watcher: Watcher) -> Results:
        """Yield the PSNR of each point."""
        for point in points:
            given = _trial(point.capture)
            with _with(point.constant, point.factor) as settings:
                result = reconstruct_adaptive(
                    given.psi, given.readings, given.noise_sigma, settings, given.usable
                )
            yield {"psnr_db": given.psnr_db(result.light_field)}


def constant_costs(
    captures: Sequence[Capture], folder: Path, watcher: Watcher
) -> tuple[list[Cost], list[str]]:
    """Return what each factor of each constant costs, the dearest first, and what was left out.

    Trials that the folder holds are not measured again; see `Sweep.run`.
    """
    whole = [Scaled(one) for one in captures]
    scaled = [(one, factor) for one in constants() for factor in FACTORS]
    sweep = ConstantSweep(None, folder)
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
    captures = [Capture(scene, asked.camera, size, asked.seed) for scene in scenes]
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
