"""What twice and half of each constant of verdicts and screening costs: broken and good flagged.

Rules judge evidence that is kept, so their limits are scaled without measuring anything. What
the evidence itself depends on is measured anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import reconstruction.verdict
from emmc_rig.files.folders import result_folder
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.study.benchmarks.timing import Figures
from emmc_rig.study.scaling import (
    FACTORS,
    Constant,
    Value,
    modules_of,
    numbers_of,
    scaled,
    scaled_value,
    short_name,
)
from emmc_rig.study.stability.detector import (
    CaseResult,
    DetectorSettings,
    DetectorSweep,
    case_results,
    cases,
    judged_row,
    tallied,
)
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.sweep import (
    NotApplicableError,
    Results,
    Sweep,
    csv_text,
    described,
    sweep_folder,
)
from emmc_rig.study.trial import Trial
from reconstruction import screening
from reconstruction.verdict import rules
from reconstruction.verdict.rules import Limits

CSV = "verdict-constants.csv"
MODULES = (
    screening,
    *(one for one in modules_of(reconstruction.verdict) if short_name(one) != "blocks"),
)
"""Without what judges blocks: these captures are one."""


@dataclass(frozen=True)
class Remeasured:
    """A case whose evidence is measured with a constant scaled."""

    case: Point
    constant: Constant
    factor: float

    @property
    def label(self) -> str:
        """Return the trial in words."""
        return f"{self.factor:g} x {self.constant.label}, {self.case.label}"


@dataclass(frozen=True)
class Cost(Figures):
    """A constant times a factor: how many more (or fewer) of the broken and of the good results are
    flagged, and how many verdicts of all change their level."""

    constant: str
    value: str
    factor: float
    broken_flagged: int
    good_flagged: int
    changed: int


_trial = lru_cache(maxsize=8)(Point.trial)


@cache
def constants() -> tuple[Constant, ...]:
    """Return the constants of screening and verdicts."""
    return tuple(numbers_of(MODULES))


def _judges(constant: Constant) -> bool:
    return f"reconstruction.verdict.{constant.module}" == rules.__name__


@dataclass
class VerdictConstantSweep(Sweep[Remeasured]):
    """Evidence with a constant scaled; settings: DetectorSettings."""

    journal = "verdict-constants.jsonl"
    noun = "cases"
    stage = "judge with scaled constants"
    revision = 1

    def inputs(self, point: Remeasured) -> dict[str, object]:
        """Return everything that a case's evidence depends on, as plain data."""
        every = {one.label: str(one.value) for one in constants()}
        return {"case": described(point.case), "constants": every, "scaled": point.label}

    def group(self, point: Remeasured) -> Point:
        """Return the trial: what is measured on one follows another."""
        return replace(point.case, method="")

    def measured(self, points: Sequence[Remeasured], watcher: Watcher) -> Results:
        """Yield the evidence of each case."""
        given: Trial = _trial(self.group(points[0]))
        for point in points:
            with scaled(MODULES, point.constant, point.factor):
                yield judged_row(point.case.method, given)


def _cost(
    constant: Constant, factor: float, plain: Sequence[CaseResult], found: Sequence[CaseResult]
) -> Cost:
    before, after = tallied(plain), tallied(found)
    levels = {one.case: one.verdict.level for one in plain}
    return Cost(
        constant.label,
        _value_words(constant.value),
        factor,
        after.broken_flagged - before.broken_flagged,
        after.good_flagged - before.good_flagged,
        sum(one.verdict.level != levels.get(one.case) for one in found),
    )


def _value_words(value: Value) -> str:
    return f"{value.doubt:g} / {value.refuse:g}" if isinstance(value, Limits) else str(value)


def _rejudged(rows: Mapping[Point, dict], given: Mapping[Point, dict]) -> list[CaseResult]:
    """Return what `rows` lead to; their PSNR is that of `given`, so that kinds stay."""
    kept = {
        case: {**rows.get(case, {}), **{key: one[key] for key in ("psnr_db", "even_db")}}
        for case, one in given.items()
        if "psnr_db" in one
    }
    return case_results(kept)


def _possible() -> tuple[list[tuple[Constant, float]], list[str]]:
    """Return constants with the factors that they can be scaled by; and which cannot, and why."""
    possible, left_out = [], []
    for constant in constants():
        for factor in FACTORS:
            try:
                scaled_value(constant, factor)
            except NotApplicableError as why:
                left_out.append(str(why))
            else:
                possible.append((constant, factor))
    return possible, left_out


def run_verdict_constants(
    settings: DetectorSettings, out: Path, watcher: Watcher
) -> tuple[list[Cost], list[str]]:
    """Measure all constants; write verdict-constants.csv beside the rows; return what was left out.

    Raises as `run_detector` does.
    """
    with sweep_folder(out, DetectorSweep.journal, "stability --verdicts") as folder:
        points = cases(settings)
        given = DetectorSweep(settings, folder).run(points, watcher)
        plain = case_results(given)
        possible, left_out = _possible()
        again = [one for one in possible if not _judges(one[0])]
        sweep = VerdictConstantSweep(settings, folder)
        rows = sweep.run([Remeasured(case, *by) for by in again for case in points], watcher)
        costs = []
        for constant, factor in possible:
            if _judges(constant):
                with scaled(MODULES, constant, factor):
                    found = case_results(given)
            else:
                own = {case: rows.get(Remeasured(case, constant, factor), {}) for case in points}
                found = _rejudged(own, given)
            costs.append(_cost(constant, factor, plain, found))
        costs.sort(key=lambda one: (-abs(one.broken_flagged) - abs(one.good_flagged), -one.changed))
        with result_folder(folder, "stability --verdicts", adds=True) as new:
            write_text(new / CSV, csv_text([one.as_dict() for one in costs]))
    return costs, left_out
