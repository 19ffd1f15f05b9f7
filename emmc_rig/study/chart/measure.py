"""The points of a chart, measured one at a time: PSNR, seconds and memory of a reconstruction.

Order matters: frames, dictionary, a warm-up on a small window (which compiles and loads), the timed
runs, the peak of memory; only then the light field is compared with the truth.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, replace

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.model.errors import ModelError
from emmc_rig.process.cost import forget_peak, peak_memory_mib
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.study.chart.chart_points import ChartSettings, Point
from emmc_rig.study.points import Results, Study
from emmc_rig.study.rows import available_cores
from emmc_rig.study.scores import scored
from emmc_rig.study.trial import Trial, method_inputs, trial_of

WARM_UP_PX = 27
"""Side of the window of the warm-up: large enough for patches, small enough to take no time."""
EXPECTED_ERRORS = (AppError, ModelError, ReconstructionError, CalibrationError, DriverError)


def measured(point: Point, chart: ChartSettings) -> dict:
    """Return the figures of a point.

    seconds: median of the repeats. cpu_seconds: likewise, of all cores together. peak_mib: memory
    that the timed runs take at most, beyond the process with Psi, frames and dictionary.
    """
    trial, method = trial_of(point.capture), point.configuration.method
    settings, dictionary = point.configuration.settings, chart.dictionary
    trial.dictionary(method, dictionary)
    _window(trial).solved(method, settings, dictionary)
    load = os.getloadavg()[0]
    forget_peak()
    held_mib = peak_memory_mib()
    wall, cpu, result = [], [], None
    while len(wall) < chart.repeats and (not wall or sum(wall) < chart.enough_s):
        result = None
        cpu_started, started = time.process_time(), time.perf_counter()
        result = trial.solved(method, settings, dictionary)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - cpu_started)
    assert result is not None
    peak_mib = peak_memory_mib() - held_mib
    scores = scored(
        result.light_field, trial.truth, trial.disparity_px, result.maps.get("disparity")
    )
    return {
        **asdict(scores),
        "seconds": statistics.median(wall),
        "fastest_s": min(wall),
        "slowest_s": max(wall),
        "cpu_seconds": statistics.median(cpu),
        "repeats": len(wall),
        "peak_mib": peak_mib,
        "cores": available_cores(),
        "load": load,
        "steps": result.steps,
        "status": result.status,
        "advice": result.advice,
        "shots": trial.psi.shots,
        "views": "x".join(map(str, trial.psi.light_field_shape[:2])),
        "rows": trial.psi.size[0],
        "columns": trial.psi.size[1],
    }


def _window(trial: Trial) -> Trial:
    """Return a corner of a trial; it has no truth."""
    k = trial.psi.binning
    side = WARM_UP_PX // k * k
    rows, columns = (slice(0, min(side, length)) for length in trial.psi.size)
    seen = (slice(None), slice(0, rows.stop // k), slice(0, columns.stop // k))
    return replace(
        trial,
        psi=trial.psi.window(rows, columns),
        readings=trial.readings[seen].copy(),
        usable=trial.usable[seen].copy(),
    )


@dataclass
class ChartStudy(Study[Point]):
    """The points of a chart; settings: ChartSettings."""

    revision = 4

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        settings = self.settings
        return {
            **method_inputs(point.configuration.method, settings.dictionary),
            "capture": point.capture.identity(),
            "settings": point.configuration.settings.model_dump(mode="json"),
            "cores": available_cores(),
            "repeats": settings.repeats,
            "enough_s": settings.enough_s,
        }

    def group(self, point: Point) -> Hashable:
        """All points are measured one after the other."""
        return None

    def measured(self, points: Sequence[Point]) -> Results:
        """Yield the points' figures, those of one capture after the other."""
        for point in points:
            try:
                yield measured(point, self.settings)
            except EXPECTED_ERRORS as fault:
                yield {"failed": str(fault), "keep": False}
            except MemoryError:
                yield {"failed": "not enough memory", "keep": False}

    def words(self, point: Point, result: dict) -> str:
        """Return a measured point in words."""
        took = f" (in {result['seconds']:.2f} s)" if "seconds" in result else ""
        return super().words(point, result) + took
