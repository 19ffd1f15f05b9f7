"""The points of a stability study: scenes, faults at their strengths, methods; measured untimed.

All methods of a (scene, fault, strength) get the same trial.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from emmc_rig.model.lightfield import replicate_centre
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, find_method
from emmc_rig.reconstruction.sparse import SparseSettings
from emmc_rig.study.points import Results, Study
from emmc_rig.study.rows import check_scene_names, check_size, described
from emmc_rig.study.scores import angular_snr_db
from emmc_rig.study.stability.faults import FAULTS, Point, find_fault
from emmc_rig.study.trial import Capture, Trial, method_inputs

SWEPT_METHODS = ("tv", "dict-omp", "dict-admm", "tv-dict", "adaptive", "adaptive-fast")
FAST_METHODS = ("tv", "adaptive-fast")
SCENES = ("deep-occlusions", "near-planar", "non-lambertian")
FAST_SCENES = ("deep-occlusions",)
ALL = "all"
"""Instead of a method's name: every one; those not installed are left out in one line."""
CAMERA = "rgbw-bayer-3shots"
SIZE, ZOOM = (96, 128), 2
FAST_SIZE, FAST_ZOOM = (36, 48), 4


class StabilitySettings(Settings):
    """What to sweep. faults, methods: names; empty takes all. zoom: see `zoomed_scene`."""

    scenes: tuple[str, ...]
    camera: str = CAMERA
    size: tuple[int, int] | None = None
    zoom: int = Field(default=1, ge=1)
    fast: bool = False
    faults: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    dictionary: str | None = None
    seed: int = Field(default=0, ge=0)

    @property
    def captures(self) -> list[Capture]:
        """Every scene through the camera."""
        return [Capture(s, self.camera, self.size, self.seed, self.zoom) for s in self.scenes]


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


def chosen_methods(settings: StabilitySettings) -> tuple[str, ...]:
    """Return the methods of a study, those usually compared where none is given.

    Raises ReconstructionError naming the nearest for one not known.
    """
    if ALL in settings.methods:
        return tuple(METHODS)
    for name in settings.methods:
        find_method(name)
    return settings.methods or (FAST_METHODS if settings.fast else SWEPT_METHODS)


def planned(settings: StabilitySettings) -> list[Point]:
    """Return the points, those of one trial together; raises AppError for wrong names."""
    check_size(settings.size)
    check_scene_names(settings.scenes)
    methods = chosen_methods(settings)
    return [
        Point(capture, fault.name, strength, method)
        for capture in settings.captures
        for fault in [find_fault(name) for name in settings.faults] or FAULTS.values()
        for strength in (fault.quick if settings.fast else fault.strengths)
        for method in methods
    ]


@dataclass
class StabilityStudy(Study[Point]):
    """The points; settings: StabilitySettings."""

    revision = 2

    def unmeasured(self) -> list[str]:
        """Return a line for what could not be measured, and why."""
        strengths: dict[tuple[str, str, str], list[str]] = {}
        absent = {}
        for point, why in self.left_out.items():
            if not METHODS[point.method].installed:
                absent[why] = None
                continue
            listed = strengths.setdefault((str(point.fault), point.scene_name, why), [])
            if f"{point.strength:g}" not in listed:
                listed.append(f"{point.strength:g}")
        return [*absent] + [
            f"{FAULTS[fault].title} at {', '.join(listed)}, {scene}: {why}"
            for (fault, scene, why), listed in strengths.items()
        ]

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        return {
            **described(point.same_trial),
            **method_inputs(point.method, self.settings.dictionary),
            "settings": _settings().model_dump(mode="json"),
        }

    def group(self, point: Point) -> Hashable:
        """Return the trial of a point, which all methods share."""
        return replace(point, method="")

    def measured(self, points: Sequence[Point]) -> Results:
        """Yield the methods' figures on one trial."""
        made = points[0].trial()
        for point in points:
            yield self._measured(point, made)

    def _measured(self, point: Point, made: Trial) -> dict:
        view_db = made.psnr_db(replicate_centre(made.truth))
        try:
            settings = _settings(made.psi.binning)
            result = made.solved(point.method, settings, self.settings.dictionary)
        except MemoryError:
            return {"failed": "not enough memory", "keep": False}
        except Exception as fault:
            # That a method fails is a finding; a fault of the program is measured again next time.
            known = type(fault).__module__.startswith("emmc_rig")
            kind = "" if known else f"{type(fault).__name__}: "
            return {"failed": f"{kind}{fault}", "view_db": view_db, "keep": known}
        estimate = result.light_field
        if not np.isfinite(estimate).all():
            return {"failed": "the estimate is not finite", "view_db": view_db}
        return {
            "psnr_db": made.psnr_db(estimate),
            "view_db": view_db,
            "angular_db": angular_snr_db(estimate, made.truth),
            "usable": float(made.usable.mean()),
            "noise_sigma": made.noise_sigma,
            "psi_error": made.psi.relative_difference(made.true_psi),
            "status": result.status,
            "advice": result.advice,
            "screening": "; ".join(result.screening),
        }


def _settings(binning: int = 1) -> MethodSettings:
    """Return the default settings, patches placed on whole pixels."""
    stride = SparseSettings().stride
    return MethodSettings(sparse=SparseSettings(stride=max(stride // binning * binning, binning)))
