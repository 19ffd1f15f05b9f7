"""`emmc-rig stability`: faults at their strengths, methods; measured untimed, drawn as curves.

All methods of a (scene, fault, strength) get the same trial.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.lightfield import replicate_centre
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.dictionary import open_dictionary
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, find_method
from emmc_rig.reconstruction.sparse import SparseSettings
from emmc_rig.report.drawing import colours_of
from emmc_rig.report.page import Head, Section, embedded, fragment, part
from emmc_rig.study.points import Report, Results, Study, Table
from emmc_rig.study.rows import check_scene_names, check_size, machine
from emmc_rig.study.scores import angular_snr_db
from emmc_rig.study.stability.curves import (
    LOST_DB,
    Curve,
    break_row,
    breaking_rows,
    curves,
    draw_curves,
    place_words,
)
from emmc_rig.study.stability.faults import FAULTS, Point, find_fault
from emmc_rig.study.trial import Capture, Trial, method_inputs

POINTS_CSV, BREAKS_CSV, DRAWN = "points.csv", "breaking.csv", "charts"
SWEPT_METHODS = ("tv", "dict-admm", "tv-dict", "adaptive", "adaptive-fast")
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
    captures = [
        Capture(scene, settings.camera, settings.size, settings.seed, settings.zoom)
        for scene in settings.scenes
    ]
    return [
        Point(capture, fault.name, strength, method)
        for capture in captures
        for fault in [find_fault(name) for name in settings.faults] or FAULTS.values()
        for strength in (fault.quick if settings.fast else fault.strengths)
        for method in methods
    ]


@dataclass
class StabilityStudy(Study[Point]):
    """The faults under which methods fail; settings: StabilitySettings."""

    revision = 2
    command, title, page = "stability", "Where methods fail", "stability.html"
    style_sheets = ("stability.css",)
    caveats = (
        "A method breaks where it falls 3 dB below its best on that curve, and where it falls "
        "below the baseline: the true centre view in all places. Between measured strengths curves "
        "are interpolated linearly.",
        "Frames are simulated with the faulty Psi and the sensor's noise, on the grid of the "
        "reconstruction; the methods are given the Psi of the design.",
        "Turning or scaling a mask moves its rim most: the larger the picture, the smaller the "
        "error that breaks a method.",
        "Contrast: PSNR is measured after stretching the picture back to full contrast.",
    )
    columns: ClassVar[Mapping[str, Sequence[str]]] = {
        POINTS_CSV: (
            "scene", "fault", "unit", "strength", "method", "psnr_db", "view_db", "angular_db",
            "usable", "noise_sigma", "psi_error", "status", "advice", "screening", "failed",
        ),
        # ..._to: the lowest strength that breaks a method; empty: beyond the sweep. Then in words.
        BREAKS_CSV: (
            "scene", "fault", "unit", "repairable", "method", "best_db", "below_best_to",
            "below_best", "below_view_to", "below_view",
        ),
    }  # fmt: skip

    def planned(self) -> list[Point]:
        """Return the points, those of one trial together; raises for wrong names."""
        points, spec = planned(self.settings), self.settings.dictionary
        camera = find_camera(self.settings.camera)
        if spec and any(METHODS[point.method].needs_dictionary for point in points):
            open_dictionary(spec, camera.views, camera.sensor.binning)
        return points

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        trial = point.same_trial
        return {
            "capture": trial.capture.identity(),
            "fault": trial.fault,
            "strength": trial.strength,
            "method": point.method,
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

    @property
    def curves(self) -> list[Curve]:
        """Curves of the measured points, those of all scenes first."""
        return curves(self.results)

    def unmeasured(self) -> list[str]:
        """Return a line for each fault and scene that could not be measured, and why."""
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

    def shown(self) -> Iterable[Table]:
        """Return where methods break, for a terminal: of all scenes where there are several."""
        every = self.curves
        scene = every[0].scene
        rows, methods = breaking_rows(every, scene)
        title = f"{scene}: falls 3 dB below its best / below the baseline at"
        shown = [(f"{fault.title}, {fault.unit}", *cells) for fault, cells in rows]
        yield Table(title, ("fault", *methods), shown)

    def report(self, new: Path) -> Report:
        """Return the content of the files; raises AppError where nothing could be measured."""
        every = self.curves
        if not every:
            why = next(iter(self.unmeasured()), "fewer than two strengths were measured")
            raise AppError(f"nothing could be measured: {why}")
        breaks, settings = [break_row(curve) for curve in every], self.settings
        size = "whole views" if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
        scenes = ", ".join(Path(scene).stem for scene in settings.scenes)
        return Report(
            head=_head(every),
            about=[
                f"{len(self.results)} points on {scenes}, {size}, through "
                f"{Path(settings.camera).stem}; seed {settings.seed}."
            ],
            sections=_sections(every, new / DRAWN),
            rows={
                POINTS_CSV: [_row(*pair) for pair in self.results.items()],
                BREAKS_CSV: breaks,
            },
            metrics={
                "points": len(self.results),
                "seconds": self.seconds,
                "machine": machine(),
                "curves": [
                    {**row, "strengths": c.strengths, "psnr_db": c.levels, "view_db": c.views}
                    for row, c in zip(breaks, every, strict=True)
                ],
                "left_out": self.excluded(),
                "settings": settings.model_dump(mode="json"),
            },
            sources={"Machine": machine()},
        )


def _settings(binning: int = 1) -> MethodSettings:
    """Return the default settings, patches placed on whole pixels."""
    stride = SparseSettings().stride
    return MethodSettings(sparse=SparseSettings(stride=max(stride // binning * binning, binning)))


def _row(point: Point, result: dict) -> dict[str, object]:
    """Return a point as a row of points.csv."""
    return {
        **result,
        "scene": point.scene_name,
        "fault": point.fault,
        "unit": FAULTS[str(point.fault)].unit,
        "strength": float(point.strength),
        "method": point.method,
    }


def _head(curves: Sequence[Curve]) -> Head:
    """Return the method that breaks under the fewest faults; curves: pooled first."""
    first = [curve for curve in curves if curve.scene == curves[0].scene]
    faults = len({curve.fault.name for curve in first})
    broken = Counter({curve.method: 0 for curve in first})
    broken.update(curve.method for curve in first if curve.below_best() is not None)
    (best, least), *others = reversed(broken.most_common())
    return Head(
        f"{best} withstands faults best" if others else best,
        f"it falls {LOST_DB:g} dB below its best under {least} of {faults} faults"
        + (", the fewest" if others else ""),
        [
            "keep the errors of your bench below the breaking points",
            *(
                f"for comparison, {name}: under {count} of {faults} faults"
                for name, count in others
            ),
        ],
    )


def _sections(found: Sequence[Curve], drawn: Path) -> list[Section]:
    """Return the tables (method x fault -> breaking point) of all scenes, then their curves.

    Curves of one kind of fault are small multiples of one drawing, in the folder `drawn`.
    """
    drawn.mkdir(exist_ok=True)
    colours = colours_of(curve.method for curve in found)
    tables, charts = [], []
    for scene in dict.fromkeys(curve.scene for curve in found):
        of_scene, slug = [curve for curve in found if curve.scene == scene], _slug(scene)
        rows, methods = breaking_rows(of_scene, scene)
        body = fragment("stability_breaking.html", rows=rows, methods=methods)
        tables.append(Section(f"breaking-{slug}", f"Breaking points, {scene}", body))
        for kind in dict.fromkeys(fault.kind for fault in FAULTS.values()):
            some = [curve for curve in of_scene if curve.fault.kind == kind]
            if some:
                svg = draw_curves(some, colours, drawn / f"{slug}-{_slug(kind.lower())}.svg")
                title = f"{kind}, {scene}"
                body = part("bullets", answers(some)) + part("drawings", {title: embedded(svg)})
                charts.append(Section(_slug(f"{kind}-{scene}".lower()), title, body))
    return [*tables, *charts]


def _slug(title: str) -> str:
    return title.replace(" ", "-")


def answers(curves: Sequence[Curve]) -> list[str]:
    """Return for each fault of some curves a sentence: which method breaks first, which last."""
    sentences = []
    for fault in dict.fromkeys(curve.fault for curve in curves):
        some = [(curve.below_best(), curve) for curve in curves if curve.fault is fault]
        never = [curve.method for place, curve in some if place is None]
        breaking = sorted(
            ((place, curve) for place, curve in some if place is not None), key=lambda pair: pair[0]
        )
        if not breaking:
            sentences.append(f"{fault.title}: no method loses {LOST_DB:g} dB in this sweep.")
            continue
        first, last = breaking[0], breaking[-1]
        words = f"{fault.title}: {_broken(*first)}"
        if never:
            words += f"; {', '.join(never)} nowhere in this sweep"
        elif last is not first:
            words += f"; {_broken(*last)}, the last"
        sentences.append(words + ".")
    return sentences


def _broken(place: float, curve: Curve) -> str:
    at = f"{place_words(place, curve.strengths)} {curve.fault.unit}"
    return f"{curve.method} has lost {LOST_DB:g} dB at {at}"
