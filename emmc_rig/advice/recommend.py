"""Which method and settings to take for a time budget or a wanted PSNR, learnt from a chart.

A chart keeps its advice as JSON beside its page; a default measured by this very command comes
with the program. What a method takes is carried over by the yardstick of `reference`, and along a
line in the number of values of the light field; its PSNR is the mean over the chart's scenes,
which yours may not resemble.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from emmc_rig.advice.reference import reference
from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.files.results import parse_psnr
from emmc_rig.model.reading import one_line
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.methods import METHODS, MethodSettings

ADVICE, SHIPPED = "recommended.json", "recommended.json"
FORMAT = "emmc-rig chart 1"
DEFAULT_LEVEL = "default"
_NUMBER = r"(\d+(?:\.\d+)?)\s*"
_SECONDS = {"": 1, "s": 1, "min": 60, "m": 60, "h": 3600}


@dataclass(frozen=True)
class Row:
    """A configuration through one camera, over all scenes of the chart.

    settings: what differs from the defaults. The rest is computing time over the yardstick's:
    making the dictionary, what does not grow with the light field, and what a million values take.
    """

    camera: str
    shots: int
    filtered: bool
    method: str
    level: str
    settings: dict
    psnr_db: float
    gain_db: float
    preparing: float
    fixed: float
    per_million: float

    def seconds(self, values: int, reference_s: float) -> float:
        """Return the seconds expected for a light field of so many values."""
        return reference_s * (self.preparing + self.fixed + self.per_million * values / 1e6)


@dataclass(frozen=True)
class Problem:
    """What is to be reconstructed. values: of the light field. filtered: pixels see one colour."""

    values: int
    shots: int
    filtered: bool


@dataclass(frozen=True)
class Advice:
    """The method to take, and why, in words."""

    method: str
    settings: MethodSettings
    seconds: float
    psnr_db: float
    why: str


def saved(rows: Sequence[Row], measured: Mapping[str, object]) -> str:
    """Return the advice as JSON. measured: how, where and under which load."""
    content = {
        "format": FORMAT,
        "measured": dict(measured),
        "rows": [_rounded(asdict(row)) for row in rows],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _rounded(row: dict) -> dict:
    return {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in row.items()}


def read_rows(folder: Path | None) -> list[Row]:
    """Return the rows of a chart's folder, of the one that comes with the program for None.

    Rows of methods that this version does not have are left out. Raises AppError for a folder
    without a chart, and a file that is not one.
    """
    if folder is None:
        source = "the shipped chart"
        text = resources.files("emmc_rig.advice").joinpath(SHIPPED).read_text("utf-8")
    else:
        path = folder / ADVICE
        source = str(path)
        try:
            text = path.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as fault:
            raise AppError(
                f"--chart {folder}: holds no readable {ADVICE}; name a folder that `emmc-rig "
                "chart` wrote"
            ) from fault
    try:
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}, needs {FORMAT!r}")
        rows = [Row(**row) for row in content["rows"]]
        for row in rows:
            MethodSettings.model_validate(row.settings)
    except (ValueError, KeyError, TypeError, RecursionError) as fault:
        raise AppError(
            f"{source}: not a chart's advice ({one_line(fault)}); chart again"
        ) from fault
    return [row for row in rows if row.method in METHODS]


def parse_budget(text: str) -> float:
    """Return the seconds of "30s", "2min", "1h" or "30"; raise AppError for anything else."""
    found = re.fullmatch(_NUMBER + "(s|min|m|h|)", text.strip().lower())
    if found is None or float(found[1]) == 0:
        raise WrongUsageError(
            f"--budget {text}: write a time above 0, for instance 30s, 2min or 1h"
        )
    return float(found[1]) * _SECONDS[found[2]]


def parse_wanted(text: str) -> float:
    """Return the dB of "28dB" or "28"; raise AppError for anything else."""
    return parse_psnr(text, "--want")


def advice_for(
    psi: ImagingMatrix, budget: str | None, want: str | None, chart: Path | None
) -> Advice:
    """Return the method to take for frames of this Psi, by a chart and this machine's yardstick.

    budget, want: as typed, such as "30s" and "28dB". chart: the folder of one; None takes the
    shipped one. Raises AppError for what cannot be read.
    """
    budget_s = None if budget is None else parse_budget(budget)
    wanted_db = None if want is None else parse_wanted(want)
    rows = read_rows(chart)
    values = int(np.prod(psi.light_field_shape))
    problem = Problem(values, psi.shots, psi.colour is not None)
    return advised(rows, problem, reference().seconds, budget_s, wanted_db)


def advised(
    rows: Sequence[Row],
    problem: Problem,
    reference_s: float,
    budget_s: float | None = None,
    wanted_db: float | None = None,
) -> Advice:
    """Return the most accurate that the budget allows, or the quickest that is good enough.

    Both: the quickest that is good enough, should it keep to the budget, else the most accurate
    that does. Where nothing fits, the nearest, and `why` says so. Raises AppError without rows.
    """
    rows = _of_nearest_camera(rows, problem)
    cost = {id(row): row.seconds(problem.values, reference_s) for row in rows}
    quickest_first = sorted(rows, key=lambda row: (cost[id(row)], -row.psnr_db))
    within = [row for row in rows if budget_s is None or cost[id(row)] <= budget_s]
    good = [row for row in quickest_first if wanted_db is not None and row.psnr_db >= wanted_db]
    if wanted_db is not None and good and (budget_s is None or cost[id(good[0])] <= budget_s):
        chosen = good[0]
        reason = f"the quickest that reaches {wanted_db:g} dB there"
    elif not within:
        chosen = quickest_first[0]
        reason = f"the quickest there is: nothing keeps to {budget_s:g} s"
    else:
        chosen = max(within, key=lambda row: (row.psnr_db, -cost[id(row)]))
        limit = "of all" if budget_s is None else f"within {budget_s:g} s"
        reason = f"the most accurate {limit}"
        if wanted_db is not None:
            reason += f"; nothing {'' if budget_s is None else 'in time '}reaches {wanted_db:g} dB"
    seconds = cost[id(chosen)]
    why = (
        f"{_named(chosen)}: {reason}; {chosen.psnr_db:.1f} dB on average in the chart "
        f"({chosen.gain_db:+.1f} dB against the copied centre view, {chosen.camera}), about "
        f"{seconds:.2g} s for yours"
    )
    better = [
        row for row in quickest_first
        if row.psnr_db > chosen.psnr_db and cost[id(row)] > seconds
    ]  # fmt: skip
    if better and budget_s is not None:
        why += f"; {_named(better[0])} gave {better[0].psnr_db:.1f} dB, {cost[id(better[0])]:.2g} s"
    settings = MethodSettings.model_validate(chosen.settings)
    return Advice(chosen.method, settings, seconds, chosen.psnr_db, why)


def _named(row: Row) -> str:
    return row.method if row.level == DEFAULT_LEVEL else f"{row.method}, {row.level}"


def _of_nearest_camera(rows: Sequence[Row], problem: Problem) -> list[Row]:
    """Return the rows of the charted camera that is most like the problem's."""
    if not rows:
        raise AppError("the chart holds no method that this version has: run `emmc-rig chart`")

    def distance(row: Row) -> tuple[bool, float]:
        return row.filtered != problem.filtered, abs(np.log(row.shots / problem.shots))

    nearest = min(rows, key=distance)
    return [row for row in rows if row.camera == nearest.camera]
