"""Host time of a stage command, over a wire in memory that takes no time of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emmc_rig.rig.hardware import open_simulated
from emmc_rig.rig.stage_config import PROTOCOLS
from emmc_rig.study.benchmarks.timing import Figures
from simulators.firmware import SimulatedController


@dataclass(frozen=True)
class StageTiming(Figures):
    """Median time of one command, the simulated firmware's part included.

    exchanges: how often the command wrote to the wire.
    """

    protocol: str
    command: str
    exchanges: float
    milliseconds: float


def stage_timings(repeats: int) -> list[StageTiming]:
    """Return the timings of every protocol's commands."""
    return [one for protocol in PROTOCOLS for one in _timings(protocol, repeats)]


def _timings(protocol: str, repeats: int) -> list[StageTiming]:
    stage, firmware = open_simulated(protocol)
    stage.home()
    axis = stage.axes[0]
    low_um, high_um = stage.limits_um(axis)
    places_um = [(low_um + high_um) / 2 + step_um for step_um in (0.0, 100.0)]
    calls: dict[str, Callable[[int], object]] = {
        "position": lambda turn: stage.position_um(axis),
        "is homed": lambda turn: stage.is_homed(axis),
        "stop": lambda turn: stage.stop([axis]),
        "move 100 um and wait": lambda turn: stage.move_to_um({axis: places_um[turn % 2]}),
    }
    return [_timing(protocol, name, call, firmware, repeats) for name, call in calls.items()]


def _timing(
    protocol: str,
    name: str,
    call: Callable[[int], object],
    firmware: SimulatedController,
    repeats: int,
) -> StageTiming:
    call(0)
    call(1)
    written = firmware.fed
    seconds = []
    for turn in range(repeats):
        start_s = time.perf_counter()
        call(turn)
        seconds.append(time.perf_counter() - start_s)
    exchanges = (firmware.fed - written) / repeats
    return StageTiming(protocol, name, exchanges, float(np.median(seconds)) * 1e3)
