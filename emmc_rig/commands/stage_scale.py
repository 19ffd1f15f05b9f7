"""`emmc-rig devices scale`: measure the length of an axis's step by a ruler."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import yaml

from emmc_rig.commands.output import give_result, shown_progress, tell
from emmc_rig.errors import AppError

if TYPE_CHECKING:
    from drivers.stage import Stage
    from emmc_rig.bench.stage_config import StageConfig

SMALLEST_COUNT = 100
APPROACH_SHARE = 0.05
"""Every place is come to from below by so much of the whole distance: backlash stays out."""
FEWEST_PLACES = 3

ReadPlace = Callable[[int], float]
"""Given the number of a place (from 0), returns where the axis reads to be there, in um."""


def register(app: typer.Typer) -> None:
    """Add the command to the program's `devices`."""
    app.command("scale")(scale)


def scale(
    axis: Annotated[str, typer.Argument(help="name of the axis")],
    counts: Annotated[int, typer.Argument(help="distance to move, in the device's own counts")],
    stage: Annotated[
        str, typer.Option("--stage", help="zaber:PORT, grbl:PORT, apt:PORT, or a YAML file")
    ],
    places: Annotated[int, typer.Option("--places", min=3, help="places to read")] = 5,
    out: Annotated[
        Path | None, typer.Option("--out", help="write the stage's YAML file, with the scale")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask before the axis moves")] = False,
) -> None:
    """Measure the length of an axis's step: home, move a known count, read where it stands.

    Every place is asked for: read it off a ruler or a dial indicator, in um.
    Counts are microsteps (Zaber), encoder counts (APT), thousandths of Grbl's own millimetre.
    """
    from drivers.errors import DriverError
    from emmc_rig.acquisition.signals import signals_interrupt
    from emmc_rig.bench.hardware import open_stage
    from emmc_rig.bench.stage_config import parse_stage
    from emmc_rig.files.folders import refuse_inside_session

    if counts < SMALLEST_COUNT:
        raise AppError(f"{counts} counts are too few to measure: move at least {SMALLEST_COUNT}")
    if out is not None:
        refuse_inside_session(out.parent)
        if out.exists():
            raise AppError(f"{out} exists: name another file")
    config = parse_stage(stage)
    settings = {"approach_um": APPROACH_SHARE * counts}
    try:
        with signals_interrupt(), open_stage(stage, settings, to_measure=True) as opened:
            if axis not in opened.axes:
                raise AppError(f"no axis {axis!r} on {stage}: use one of {', '.join(opened.axes)}")
            question = (
                f"{axis} will be homed, then moved by {counts} counts of unknown length. "
                "Is its way free?"
            )
            if not (yes or typer.confirm(question, err=True)):
                raise AppError("nothing was moved: clear the way, then answer y")
            with shown_progress("home"):
                opened.home([axis])
            steps, readings = measure(opened, axis, counts, places, _asked)
            found = fit_step_length(steps, readings)
            settings = scale_settings(config, opened, axis, found.um_per_step)
    except DriverError as fault:
        raise AppError("; ".join([str(fault), *getattr(fault, "__notes__", [])])) from fault
    share = found.deviation_um / found.um_per_step
    tell(
        f"{axis}: {found.um_per_step:.6g} um a count, deviation {100 * share:.2g} %, worst reading "
        f"{found.worst_um:.3g} um off the line" + (", counting downwards" * found.reversed)
    )
    tell("take the data sheet's own figure if it is within that; for the stage's file:")
    tell(yaml.safe_dump(settings, sort_keys=False).removesuffix("\n"))
    give_result(
        axis=axis, um_per_step=found.um_per_step, deviation_um=found.deviation_um, settings=settings
    )
    if out is not None:
        whole = _merged(config.model_dump(mode="json", exclude_defaults=True), settings)
        with out.open("x", encoding="utf-8") as file:
            yaml.safe_dump({"protocol": config.protocol} | whole, file, sort_keys=False)


def measure(
    stage: Stage, axis: str, counts: int, places: int, read: ReadPlace
) -> tuple[list[float], list[float]]:
    """Return where the axis counted to be and where it was read, at places over the distance.

    The axis is homed; the places lie about the middle of its travel, and every one is approached
    from below. The stage's unit is the count.
    """
    low, high = stage.limits_um(axis)
    if counts > high - low:
        raise AppError(f"{axis} has {high - low:.0f} counts of travel: move less than {counts}")
    steps, readings = [], []
    first = round((low + high - counts) / 2)
    for number in range(places):
        target = first + round(counts * number / (places - 1))
        steps.append(stage.move_to_um({axis: target})[axis])
        readings.append(read(number))
    return steps, readings


def scale_settings(config: StageConfig, stage: Any, axis: str, um_per_step: float) -> dict:
    """Return the settings of a stage's file that state what was measured."""
    figure = float(f"{um_per_step:.6g}")
    if config.protocol == "zaber":
        resolution = stage.resolution(axis)
        stated = {"microstep_um": {axis: figure}}
        return stated | ({} if resolution is None else {"resolution": {axis: resolution}})
    if config.protocol == "apt":
        return {"axes": {axis: {"counts_per_um": float(f"{1 / um_per_step:.6g}")}}}
    return {"steps_per_mm": {axis: float(f"{stage.steps_per_mm(axis) / um_per_step:.6g}")}}


def _asked(number: int) -> float:
    return typer.prompt(f"place {number + 1}: where does it stand, in um", type=float, err=True)


@dataclass(frozen=True)
class StepLength:
    """um of one step, its standard deviation, and the largest distance of a reading from the line.

    um_per_step is positive; `reversed` says that readings fell while the axis counted up.
    """

    um_per_step: float
    deviation_um: float
    worst_um: float
    reversed: bool


def fit_step_length(steps: Sequence[float], readings_um: Sequence[float]) -> StepLength:
    """Return the slope of a straight line through the places, least squares.

    Raises AppError for fewer than three places, places that do not differ, or readings
    that a line does not explain.
    """
    import numpy as np

    if len(steps) < FEWEST_PLACES or len(steps) != len(readings_um):
        raise AppError(
            f"{len(steps)} places and {len(readings_um)} readings: read at least {FEWEST_PLACES}"
        )
    x, y = np.array(steps, dtype=np.float64), np.array(readings_um, dtype=np.float64)
    spread = ((x - x.mean()) ** 2).sum()
    if not (spread > 0 and np.isfinite(y).all()):
        raise AppError("the places do not differ, or a reading is no number")
    slope = float(((x - x.mean()) * (y - y.mean())).sum() / spread)
    residual = y - y.mean() - slope * (x - x.mean())
    deviation = float(np.sqrt((residual**2).sum() / (len(x) - 2) / spread))
    if not abs(slope) > 3 * deviation:
        raise AppError(
            f"the readings do not follow the axis ({slope:g} um a step, deviation {deviation:g}): "
            "check that it moved what was measured"
        )
    return StepLength(abs(slope), deviation, float(np.abs(residual).max()), slope < 0)


def _merged(base: dict, more: dict) -> dict:
    """Return settings with those of `more` in their place, mapping by mapping."""
    merged = dict(base)
    for key, value in more.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            value = _merged(old, value)
        merged[key] = value
    return merged
