"""The points of a chart: captures, and methods with their settings; measured one at a time.

The methods are all of `reconstruction.methods.METHODS`; VARIATIONS adds settings for some. The
order of a measurement matters: frames, dictionary, a warm-up on a small window (which compiles and
loads), the timed runs, the peak of memory; only then the light field is compared with the truth.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import psutil
from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.process.cost import forget_peak, peak_memory_mib
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, find_method, installed_methods
from emmc_rig.simulators.scenes import STILL_SCENES
from emmc_rig.study.rows import available_cores
from emmc_rig.study.scores import scored
from emmc_rig.study.trial import Capture, Trial, trial_of

FAST_SCENES = ("near-planar", "deep-occlusions")
FAST_CAMERAS = ("rgbw-bayer-1shot", "rgbw-bayer-3shots")
CAMERAS = ("rgbw-bayer-1shot", "rgbw-bayer-2shots", "rgbw-bayer-3shots", "rgbw-mono")
FAST = {"size": (64, 80), "zoom": 3, "repeats": 3, "enough_s": 1.0}
DEFAULT = "default"
_QUICK_PATCHES = {"stride": 9, "solver": {"rtol": 1e-2, "max_steps": 200}}
VARIATIONS: dict[str, dict[str, dict[str, Any]]] = {
    "adaptive": {DEFAULT: {}, "best": {"adaptive": {"patches": 1}}},
    "tv": {
        "15 steps": {"tv": {"max_steps": 15}},
        "40 steps": {"tv": {"max_steps": 40}},
        DEFAULT: {},
        "best": {"tv": {"rtol": 1e-5, "max_steps": 1500}},
    },
    "dict-admm": {
        "fast": {"sparse": _QUICK_PATCHES},
        DEFAULT: {},
        "best": {"sparse": {"stride": 3, "solver": {"rtol": 1e-4}}},
    },
    "tv-dict": {
        "fast": {"sparse": _QUICK_PATCHES, "tv": {"max_steps": 40}},
        DEFAULT: {},
        "best": {"sparse": {"stride": 3}, "tv": {"rtol": 1e-4, "max_steps": 1500}},
    },
}
BESIDE_FRONT = ("best", "fast")
"""Levels that take long, or that the front over all scenes does without: --fast has none."""

WARM_UP_PX = 27
"""Side of the window of the warm-up: large enough for patches, small enough to take no time."""


@dataclass(frozen=True)
class Configuration:
    """A method with settings; `level` names one of a method's settings."""

    method: str
    level: str = DEFAULT
    settings: MethodSettings = field(default_factory=MethodSettings)

    @property
    def label(self) -> str:
        """In words, such as "tv, 15 steps"."""
        return self.method if self.level == DEFAULT else f"{self.method}, {self.level}"


@dataclass(frozen=True)
class Point:
    """One measurement."""

    capture: Capture
    configuration: Configuration

    @property
    def label(self) -> str:
        """In words."""
        capture = self.capture
        return f"{capture.scene_name}, {capture.camera_name}, {self.configuration.label}"


class ChartSettings(Settings):
    """How a chart measures.

    zoom: built-in scenes are rendered so many times larger than `size`, and cut. repeats: at most;
    they end early when `enough_s` are spent.
    """

    scenes: tuple[str, ...]
    cameras: tuple[str, ...]
    size: tuple[int, int] | None = None
    zoom: int = Field(default=1, ge=1)
    fast: bool = False
    methods: tuple[str, ...] = ()
    dictionary: str | None = None
    repeats: int = Field(default=5, ge=1)
    enough_s: float = Field(default=120.0, gt=0)
    seed: int = Field(default=0, ge=0)


def chart_settings(
    fast: bool,
    scenes: Sequence[str],
    cameras: Sequence[str],
    size: tuple[int, int] | None,
    repeats: int | None,
    **others: object,
) -> ChartSettings:
    """Return the settings of a chart; defaults are those of --fast or of the full chart."""
    given = {"size": size, "repeats": repeats}
    chosen = {
        "fast": fast,
        "scenes": tuple(scenes) or (FAST_SCENES if fast else tuple(STILL_SCENES)),
        "cameras": tuple(cameras) or (FAST_CAMERAS if fast else CAMERAS),
        **(FAST if fast else {}),
        **{key: value for key, value in given.items() if value is not None},
        **others,
    }
    return ChartSettings.model_validate(chosen)


def configurations(settings: ChartSettings) -> list[Configuration]:
    """Return the methods with their settings, quick ones first.

    Raises ReconstructionError naming the nearest for a method that is not known.
    """
    for name in settings.methods:
        find_method(name)
    chosen = settings.methods or installed_methods()
    return [
        Configuration(method, level, MethodSettings.model_validate(changed))
        for method in METHODS
        if method in chosen
        for level, changed in VARIATIONS.get(method, {DEFAULT: {}}).items()
        if not (settings.fast and level in BESIDE_FRONT)
    ]


def charted_points(settings: ChartSettings) -> list[Point]:
    """Return the points of speed against accuracy."""
    return [
        Point(Capture(scene, camera, settings.size, settings.seed, settings.zoom), configuration)
        for scene in settings.scenes
        for camera in settings.cameras
        for configuration in configurations(settings)
    ]


def measured(point: Point, chart: ChartSettings) -> dict:
    """Return the figures of a point.

    seconds: median of the repeats. cpu_seconds: likewise, of all cores together. peak_mib: memory
    that the timed runs take at most, beyond the process with Psi, frames and dictionary.
    """
    trial, method = trial_of(point.capture), point.configuration.method
    settings, dictionary = point.configuration.settings, chart.dictionary
    trial.dictionary(method, dictionary)
    _window(trial).solved(method, settings, dictionary)
    load = psutil.getloadavg()[0]
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
