"""`emmc-rig calibrate --check`: accuracy and cost of the calibration, against targets."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic_core import to_jsonable_python

from emmc_rig.errors import AppError
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.progress import Watcher
from emmc_rig.study.checks.bench import check_few, check_psi, check_sensor, check_stage
from emmc_rig.study.checks.effects import check_effect, effects
from emmc_rig.study.checks.large import check_large
from emmc_rig.study.checks.rows import Row
from emmc_rig.study.checks.scenes import (
    check_alarms,
    check_cost,
    check_drift,
    check_frames,
    scenes,
)
from emmc_rig.study.checks.session import check_session
from emmc_rig.study.checks.statistics import check_bound, check_plan
from emmc_rig.study.checks.streamed import check_streamed
from emmc_rig.study.sweep import Results, Sweep, machine, sweep_folder

CHECKS: dict[str, Callable[[CalibrateSettings], tuple[list[Row], dict]]] = {
    "psi": check_psi,
    "few": check_few,
    "bound": check_bound,
    "plan": check_plan,
    "sensor": check_sensor,
    "stage": check_stage,
    "cost": check_cost,
    "frames": check_frames,
    "drift": check_drift,
    "alarms": check_alarms,
    "large": check_large,
    "session": check_session,
    "streamed": check_streamed,
}
EFFECTS = "effects"
COMMAND = "calibrate --check"


@dataclass
class CheckSweep(Sweep[str]):
    """Checks and effects by name; settings: CalibrateSettings."""

    journal = "checks.jsonl"
    noun = "checks"
    stage = "check"
    revision = 1

    def inputs(self, point: str) -> dict[str, object]:
        """Return everything that a check depends on, as plain data."""
        described = to_jsonable_python(self.settings)
        return {"check": point, "machine": machine(), "scenes": scenes(), "settings": described}

    def measured(self, points: Sequence[str], watcher: Watcher) -> Results:
        """Yield the rows of each check, its details and its seconds."""
        for name in points:
            started = time.perf_counter()
            if name in CHECKS:
                rows, detail = CHECKS[name](self.settings)
            else:
                rows, detail = check_effect(self.settings, name)
            seconds = time.perf_counter() - started
            yield {"rows": [asdict(row) for row in rows], "detail": detail, "seconds": seconds}


def chosen_checks(settings: CalibrateSettings, names: str) -> list[str]:
    """Return the checks named, commas between; "effects" stands for every effect.

    Raises AppError for a name that is unknown.
    """
    benches = list(effects(settings.truth))
    known = [*CHECKS, EFFECTS, *benches]
    wanted = [*CHECKS, EFFECTS] if names == "all" else names.split(",")
    for name in wanted:
        if name not in known:
            raise AppError(f"--check {name}: use all, or some of {', '.join(known)}")
    return [one for name in wanted for one in (benches if name == EFFECTS else [name])]


def run_checks(settings: CalibrateSettings, names: str, out: Path, watcher: Watcher) -> dict:
    """Run the checks named that the folder does not hold, and write metrics.json; return it.

    names: see `chosen_checks`. Raises what that and `Sweep.run` do.
    """
    wanted = chosen_checks(settings, names)
    with sweep_folder(out, CheckSweep.journal, COMMAND) as folder:
        results = CheckSweep(settings, folder).run(wanted, watcher)
        metrics = {
            "camera": settings.camera_name,
            "size": list(settings.size),
            "rays_per_view": settings.truth.rays_per_view,
            "rows": [row for one in results.values() for row in one["rows"]],
            "details": {name: one["detail"] for name, one in results.items()},
            "seconds": {name: one["seconds"] for name, one in results.items()},
        }
        with result_folder(folder, COMMAND, adds=True) as new:
            write_metrics(new, metrics)
    return metrics
