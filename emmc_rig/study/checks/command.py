"""`emmc-rig calibrate --check`: what calibration reaches, against what was asked of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from emmc_rig.calibrate.settings import CalibrateSettings
from emmc_rig.errors import AppError
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.study.checks.bench import check_few, check_psi, check_sensor, check_stage
from emmc_rig.study.checks.effects import check_effect, effects
from emmc_rig.study.checks.large import check_large
from emmc_rig.study.checks.rows import Row
from emmc_rig.study.checks.scenes import (
    check_alarms,
    check_cost,
    check_drift,
    check_frames,
)
from emmc_rig.study.checks.statistics import check_bound, check_plan

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
}
EFFECTS = "effects"


def run_checks(settings: CalibrateSettings, names: str, folder: Path) -> dict:
    """Run the checks named, commas between, and write metrics.json; return the metrics.

    `effects` stands for every effect, which can be named alone too.
    """
    benches = list(effects(settings.truth))
    known = [*CHECKS, EFFECTS, *benches]
    wanted = [*CHECKS, EFFECTS] if names == "all" else names.split(",")
    for name in wanted:
        if name not in known:
            raise AppError(f"--check {name}: use all, or some of {', '.join(known)}")
    wanted = [one for name in wanted for one in (benches if name == EFFECTS else [name])]
    rows: list[Row] = []
    details: dict[str, object] = {}
    seconds: dict[str, float] = {}
    for name in wanted:
        started = time.perf_counter()
        found, detail = CHECKS[name](settings) if name in CHECKS else check_effect(settings, name)
        rows += found
        details[name] = detail
        seconds[name] = time.perf_counter() - started
    metrics = {
        "camera": settings.camera_name,
        "size": list(settings.size),
        "rays_per_view": settings.truth.rays_per_view,
        "rows": [asdict(row) for row in rows],
        "details": details,
        "seconds": seconds,
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(folder, metrics)
    return metrics
