"""The points of a stability sweep: scenes, faults at their strengths, methods.

All methods of a (scene, fault, strength) get the same trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.model.settings import Settings
from emmc_rig.study.stability.fault import Fault
from emmc_rig.study.stability.faults import FAULTS, find_fault, trial
from emmc_rig.study.stability.trial import Trial
from emmc_rig.study.sweep import check_scene_names
from reconstruction.methods import find_method, installed_methods

METHODS = ("tv", "dict-omp", "dict-admm", "tv-dict", "adaptive", "adaptive-fast")
FAST_METHODS = ("tv", "dict-omp", "adaptive-fast")
SCENES = ("deep-occlusions", "near-planar", "non-lambertian")
FAST_SCENES = ("deep-occlusions",)
ALL = "all"
"""Instead of a method's name: every one that is installed."""
CAMERA = "rgbw-bayer-3shots"
SIZE, ZOOM = (96, 128), 2
FAST_SIZE, FAST_ZOOM = (64, 80), 3
SMALLEST_PX = 16


class StabilitySettings(Settings):
    """What to sweep. faults, methods: names; empty takes all. zoom: see `zoomed_scene`.

    screening: whether the frames are screened for bad pixels and shots before they are
    reconstructed; "both" measures without too, for the faults that screening is for.
    """

    scenes: tuple[str, ...]
    camera: str = CAMERA
    size: tuple[int, int] | None = None
    zoom: int = Field(default=1, ge=1)
    fast: bool = False
    faults: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    screening: Literal["on", "off", "both"] = "both"
    dictionary: str | None = None
    seed: int = Field(default=0, ge=0)

    def trial(self, fault: str, strength: float, scene: str) -> Trial:
        """Return what methods get of a scene with a fault; raises what `faults.trial` does."""
        camera = find_camera(self.camera)
        return trial(FAULTS[fault], strength, scene, camera, self.size, self.seed, self.zoom)


def stability_settings(
    fast: bool, scenes: Sequence[str], size: tuple[int, int] | None, **others: object
) -> StabilitySettings:
    """Return the settings of a sweep; defaults are those of --fast or of the full sweep."""
    chosen = {
        "fast": fast,
        "scenes": tuple(scenes) or (FAST_SCENES if fast else SCENES),
        "size": size or (FAST_SIZE if fast else SIZE),
        "zoom": FAST_ZOOM if fast else ZOOM,
        **others,
    }
    return StabilitySettings.model_validate(chosen)


@dataclass(frozen=True)
class Point:
    """One measurement; screened: whether the frames were screened first."""

    scene: str
    fault: str
    strength: float
    method: str
    screened: bool = True

    @property
    def scene_name(self) -> str:
        """The scene as charts call it."""
        return Path(self.scene).stem

    @property
    def label(self) -> str:
        """In words."""
        fault = FAULTS[self.fault]
        without = "" if self.screened else ", not screened"
        return (
            f"{self.scene_name}, {fault.title} {self.strength:g} {fault.unit}, "
            f"{self.method}{without}"
        )


def chosen_faults(settings: StabilitySettings) -> list[Fault]:
    """Return the faults to sweep; raises AppError naming the nearest for one not known."""
    return [find_fault(name) for name in settings.faults] or list(FAULTS.values())


def named_methods(names: Sequence[str], fast: bool) -> tuple[str, ...]:
    """Return methods by name, those usually compared where none is given, every one for ALL.

    Raises ReconstructionError naming the nearest for one not known.
    """
    if ALL in names:
        return installed_methods()
    for name in names:
        find_method(name)
    return tuple(names) or (FAST_METHODS if fast else METHODS)


def chosen_methods(settings: StabilitySettings) -> tuple[str, ...]:
    """Return the methods of a sweep; raises what `named_methods` does."""
    return named_methods(settings.methods, settings.fast)


def strengths(fault: Fault, settings: StabilitySettings) -> tuple[float, ...]:
    """Return the strengths at which a fault is measured."""
    return fault.quick if settings.fast else fault.strengths


def planned(settings: StabilitySettings) -> list[Point]:
    """Return the points, those of one trial together; raises AppError for wrong names."""
    if settings.size is not None and min(settings.size) < SMALLEST_PX:
        raise AppError(
            f"--size {settings.size[0]}x{settings.size[1]}: needs {SMALLEST_PX}x{SMALLEST_PX} "
            "or more"
        )
    check_scene_names(settings.scenes)
    methods = chosen_methods(settings)
    both = settings.screening == "both"
    return [
        Point(scene, fault.name, strength, method, screened)
        for scene in settings.scenes
        for fault in chosen_faults(settings)
        for strength in strengths(fault, settings)
        for method in methods
        for screened in (
            (True, False) if both and fault.screened else (settings.screening != "off",)
        )
    ]
