"""The points of a chart: captures, methods with their settings, and sizes of the problem.

Nothing is computed here. The methods are those of `reconstruction.methods.METHODS`, whatever they
are; VARIATIONS adds settings for those it knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.model.errors import nearest_of
from emmc_rig.model.settings import Settings
from emmc_rig.study.chart.peers import PEERS
from emmc_rig.study.trial import Capture
from reconstruction.methods import METHODS, MethodSettings, installed_methods
from simulators.scenes import SCENES

FAST_SCENES = ("near-planar", "deep-occlusions", "wide-disparity")
FAST_CAMERAS = ("rgbw-bayer-1shot", "rgbw-bayer-3shots")
CAMERAS = ("rgbw-bayer-1shot", "rgbw-bayer-2shots", "rgbw-bayer-3shots", "rgbw-mono")
FAST = {"size": (64, 80), "zoom": 3, "repeats": 3, "enough_s": 1.0, "limit_s": 300.0}
DEFAULT = "default"
_QUICK_PATCHES = {"stride": 9, "solver": {"rtol": 1e-2, "max_steps": 200}}
VARIATIONS: dict[str, dict[str, dict[str, Any]]] = {
    "tv": {
        "15 steps": {"tv": {"max_steps": 15}},
        "40 steps": {"tv": {"max_steps": 40}},
        DEFAULT: {},
        "best": {"tv": {"rtol": 1e-5, "max_steps": 1500}},
    },
    "dict-omp": {
        "5 atoms, stride 9": {"sparse": {"stride": 9, "solver": {"atoms": 5}}},
        DEFAULT: {},
        "40 atoms": {"sparse": {"solver": {"atoms": 40}}},
        "stride 3": {"sparse": {"stride": 3}},
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
SLOW_METHODS = ("dict-lars", "dict-ista", "dict-fista", "dict-sl0")
BESIDE_FRONT = ("best", "fast", "5 atoms, stride 9", "40 atoms", "stride 3")
"""Levels that take long, or that the front over all scenes does without: --fast has none."""


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

    @property
    def is_peer(self) -> bool:
        """Whether it is another library's."""
        return self.method in PEERS

    @property
    def needs_dictionary(self) -> bool:
        """Whether it takes a dictionary."""
        known = PEERS if self.is_peer else METHODS
        return known[self.method].needs_dictionary


@dataclass(frozen=True)
class Point:
    """One measurement. cores: None takes those that the process may use."""

    capture: Capture
    configuration: Configuration
    cores: int | None = None

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
    scaling: bool = True
    rivals: bool = True
    dictionary: str | None = None
    repeats: int = Field(default=5, ge=1)
    enough_s: float = Field(default=120.0, gt=0)
    limit_s: float = Field(default=3600.0, gt=0, description="after which a point is given up")
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
        "scenes": tuple(scenes) or (FAST_SCENES if fast else tuple(SCENES)),
        "cameras": tuple(cameras) or (FAST_CAMERAS if fast else CAMERAS),
        **(FAST if fast else {}),
        **{key: value for key, value in given.items() if value is not None},
        **others,
    }
    return ChartSettings.model_validate(chosen)


def check_methods(names: Sequence[str]) -> None:
    """Raise AppError naming the nearest for a method that is not known."""
    known = [*METHODS, *PEERS]
    for name in names:
        if name not in known:
            raise AppError(f"--method {name}: {nearest_of(name, known)}")


def configurations(settings: ChartSettings) -> list[Configuration]:
    """Return the methods with their settings, quick ones first, other libraries' last."""
    check_methods(settings.methods)
    found = []
    for method in METHODS if settings.methods else installed_methods():
        if settings.fast and method in SLOW_METHODS and method not in settings.methods:
            continue
        for level, changed in VARIATIONS.get(method, {DEFAULT: {}}).items():
            if settings.fast and level in BESIDE_FRONT:
                continue
            found.append(Configuration(method, level, MethodSettings.model_validate(changed)))
    if settings.rivals:
        found += [Configuration(peer) for peer in PEERS]
    chosen = settings.methods
    return [one for one in found if not chosen or one.method in chosen]


def charted_points(settings: ChartSettings) -> list[Point]:
    """Return the points of speed against accuracy."""
    return [
        Point(Capture(scene, camera, settings.size, settings.seed, settings.zoom), configuration)
        for scene in settings.scenes
        for camera in settings.cameras
        for configuration in configurations(settings)
    ]


@dataclass(frozen=True)
class Scaling:
    """One size of the problem varied, all else equal. at: its values. points: one for each."""

    axis: str
    configuration: Configuration
    at: tuple[float, ...]
    points: tuple[Point, ...]


_FIXED = {
    "tv": ("30 steps", {"tv": {"max_steps": 30, "rtol": 1e-12}}),
    "dict-omp": ("10 atoms", {"sparse": {"solver": {"atoms": 10, "tolerance_factor": 0}}}),
    "dict-admm": ("fast", {"sparse": _QUICK_PATCHES}),
}
"""Settings whose work does not depend on how soon they converge, where there are such."""
_NOT_SWEPT = (*SLOW_METHODS, "tv-dict")
_NOT_SWEPT_FAST = ("dict-admm", "adaptive-fast")


def scalings(settings: ChartSettings, cores: int) -> list[Scaling]:
    """Return what is varied: pixels, views, shots, disparity range and cores, for some methods.

    They see a built-in scene, as only such can be rendered at any size. cores: there are.
    """
    if not settings.scaling:
        return []
    rows, columns = (32, 40) if settings.fast else (64, 80)
    factors = (1, 2, 4) if settings.fast else (1, 2, 4, 8)
    middle = Capture("deep-occlusions", CAMERAS[0], (2 * rows, 2 * columns), settings.seed, shots=1)
    axes = {
        "pixels": [
            (f * f * rows * columns, replace(middle, size=(f * rows, f * columns)), None)
            for f in factors
        ],
        "views": [(n * n, replace(middle, views=(n, n)), None) for n in (3, 5, 7)],
        "shots": [(s, replace(middle, shots=s), None) for s in (1, 2, 3)],
        "disparity range": [(z, replace(middle, zoom=z), None) for z in (1, 2, 4)],
        "cores": [(k, middle, k) for k in _core_counts(cores)],
    }
    found = []
    for method in installed_methods():
        if method in _NOT_SWEPT or (settings.fast and method in _NOT_SWEPT_FAST):
            continue
        if settings.methods and method not in settings.methods:
            continue
        level, changed = _FIXED.get(method, (DEFAULT, {}))
        one = Configuration(method, level, MethodSettings.model_validate(changed))
        for axis, varied in axes.items():
            if len(varied) > 1:
                points = tuple(Point(capture, one, used) for _, capture, used in varied)
                found.append(Scaling(axis, one, tuple(float(x) for x, _, _ in varied), points))
    return found


def _core_counts(cores: int) -> list[int]:
    """Return 1, 2, 4, ... and all cores."""
    counts = [2**i for i in range(cores.bit_length()) if 2**i < cores]
    return [*counts, cores]
