"""Measure the points of a sweep, each kept as it is done, and go on where a run stopped.

Accuracy only, in this process: nothing is timed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from pathlib import Path

import numpy as np

from emmc_rig.files.cameras import find_camera
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.model.lightfield import psnr_db, replicate_centre
from emmc_rig.pages.pictures import telling_lines
from emmc_rig.pages.thumbnails import save_thumbnail
from emmc_rig.progress import Watcher
from emmc_rig.study.chart.run import dictionary_identity, machine
from emmc_rig.study.chart.scores import angular_snr_db
from emmc_rig.study.points import Journal, digest_of, kept_when_stopped
from emmc_rig.study.stability.faults import FAULTS, camera_for, trial
from emmc_rig.study.stability.plan import Point, StabilitySettings
from emmc_rig.study.stability.trial import NotApplicableError, Setup, Trial
from emmc_rig.version import __version__
from reconstruction.dictionary import Dictionary
from reconstruction.methods import METHODS, MethodSettings, reconstruct
from reconstruction.sparse import SparseSettings

POINTS, PICTURES = "points.jsonl", "pictures"
REVISION = 1
"""Of what a point's figures are; raised with them, so that older points are measured again."""
STAGE = "measure the points"


class StabilityStopped(KeyboardInterrupt):
    """Ctrl-C; the points done are kept."""


@dataclass
class StabilityRun:
    """What to measure, and where. results: by point; one with `failed` says why there is none.

    pictures: by point; truths: by point, the picture of what should have been found.
    """

    settings: StabilitySettings
    folder: Path
    results: dict[Point, dict] = field(default_factory=dict)
    pictures: dict[Point, Path] = field(default_factory=dict)
    truths: dict[Point, Path] = field(default_factory=dict)
    _missing: dict[tuple[str, str, str], list[float]] = field(default_factory=dict)

    @property
    def left_out(self) -> list[str]:
        """A line for what could not be, and why."""
        return [
            f"{FAULTS[fault].title} at {', '.join(map('{:g}'.format, some))}, {Path(scene).stem}: "
            f"{why}"
            for (scene, fault, why), some in self._missing.items()
        ]

    def measure_all(self, points: Sequence[Point], watcher: Watcher) -> None:
        """Measure every point that the folder does not hold, and fill the dictionaries.

        Raises StabilityStopped at Ctrl-C, AppError when the folder cannot be written, and what the
        layers below do for wrong input; what is done is kept in each case.
        """
        journal = Journal(self.folder / POINTS)

        def kept() -> str:
            return f"{len(self.results)} of {len(points)} points are"

        with kept_when_stopped(self.folder, self.folder, StabilityStopped, kept):
            (self.folder / PICTURES).mkdir(exist_ok=True)
            watcher.begin(STAGE, len(points))
            for (scene, fault, strength), some in groupby(
                points, lambda point: (point.scene, point.fault, point.strength)
            ):
                self._measure_trial(scene, fault, strength, list(some), journal, watcher)

    def _measure_trial(
        self,
        scene: str,
        fault: str,
        strength: float,
        points: Sequence[Point],
        journal: Journal,
        watcher: Watcher,
    ) -> None:
        try:
            captured = self._captured(scene, fault, strength)
        except NotApplicableError as why:
            self._leave_out(scene, fault, strength, points, str(why), watcher)
            return
        truth_picture = self.folder / PICTURES / f"{digest_of(captured)}-truth.webp"
        made: Trial | None = None
        for point in points:
            inputs = {**captured, **self._solved_by(point)}
            digest = digest_of(inputs)
            picture = self.folder / PICTURES / f"{digest}.webp"
            result = journal.get(digest)
            if result is None or not ("failed" in result or picture.is_file()):
                try:
                    made = made or self._trial(scene, fault, strength)
                except NotApplicableError as why:
                    self._leave_out(scene, fault, strength, points, str(why), watcher)
                    return
                result = self._measured(point, made, picture)
                if not truth_picture.is_file():
                    save_thumbnail(truth_picture, made.truth, telling_lines(made.truth))
                if result.get("keep", True):
                    journal.add(digest, inputs, result)
            self.results[point] = result
            self.pictures[point], self.truths[point] = picture, truth_picture
            watcher.step(told(point, result))

    def _leave_out(
        self,
        scene: str,
        fault: str,
        strength: float,
        points: Sequence[Point],
        why: str,
        watcher: Watcher,
    ) -> None:
        self._missing.setdefault((scene, fault, why), []).append(strength)
        for point in points:
            watcher.step(f"left out: {point.label}")

    def _trial(self, scene: str, fault: str, strength: float) -> Trial:
        settings = self.settings
        camera = find_camera(settings.camera)
        return trial(
            FAULTS[fault], strength, scene, camera, settings.size, settings.seed, settings.zoom
        )

    def _captured(self, scene: str, fault: str, strength: float) -> dict[str, object]:
        """Return everything that a trial depends on, as plain data."""
        settings, one = self.settings, FAULTS[fault]
        clean = one.is_clean(strength)
        return {
            "version": __version__,
            "revision": REVISION,
            "machine": machine(),
            "scene": Path(scene).stem,
            "content": _content(scene, settings.camera, settings.size, settings.seed),
            "camera": camera_for(one, find_camera(settings.camera)).model_dump(mode="json"),
            "size": settings.size,
            "zoom": settings.zoom,
            "seed": settings.seed,
            "fault": None if clean else fault,
            "strength": None if clean else strength,
        }

    def _solved_by(self, point: Point) -> dict[str, object]:
        needed = METHODS[point.method].needs_dictionary
        return {
            "method": point.method,
            "settings": _settings(point).model_dump(mode="json"),
            "dictionary": dictionary_identity(self.settings.dictionary) if needed else None,
        }

    def _measured(self, point: Point, made: Trial, picture: Path) -> dict:
        dictionary = None
        if METHODS[point.method].needs_dictionary:
            views = made.psi.light_field_shape[:2]
            dictionary = _dictionary(self.settings.dictionary, views, made.psi.binning)
        try:
            found = reconstruct(
                point.method,
                made.psi,
                made.readings,
                made.noise_sigma,
                dictionary,
                _settings(point, made.psi.binning),
                made.usable,
            )
        except MemoryError:
            return {"failed": "not enough memory", "keep": False}
        except Exception as fault:
            # That a method fails is a finding; a fault of the program is measured again next time.
            known = type(fault).__module__.startswith(("reconstruction", "emmc_rig"))
            kind = "" if known else f"{type(fault).__name__}: "
            return {"failed": f"{kind}{fault}", "view_db": _view_db(made), "keep": known}
        estimate = found.light_field
        if not np.isfinite(estimate).all():
            return {"failed": "the estimate is not finite", "view_db": _view_db(made)}
        save_thumbnail(picture, estimate, telling_lines(made.truth))
        return {
            "psnr_db": _finite(psnr_db(estimate, made.truth) + 20 * math.log10(made.peak)),
            "view_db": _view_db(made),
            "angular_db": _finite(angular_snr_db(estimate, made.truth)),
            "usable": float(made.usable.mean()),
            "noise_sigma": made.noise_sigma,
            "psi_error": made.psi.relative_difference(made.true_psi),
            "status": found.status,
            "advice": found.advice,
            "screening": "; ".join(found.screening),
        }


def told(point: Point, result: Mapping[str, object]) -> str:
    """Return a measured point in words."""
    if "failed" in result:
        return f"{point.label}: {result['failed']}"
    return f"{result['psnr_db']:.2f} dB, {point.label}"


def _view_db(made: Trial) -> float | None:
    return _finite(psnr_db(replicate_centre(made.truth), made.truth) + 20 * math.log10(made.peak))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _settings(point: Point, binning: int = 1) -> MethodSettings:
    """Return the settings of a point: the default ones, patches placed on whole pixels."""
    stride = SparseSettings().stride
    sparse = SparseSettings(stride=max(stride // binning * binning, binning))
    return MethodSettings(screening=point.screened, sparse=sparse)


@lru_cache(maxsize=4)
def _dictionary(spec: str | None, views: tuple[int, int], binning: int) -> Dictionary:
    return open_dictionary(spec, views, binning)


@lru_cache
def _content(
    scene: str, camera: str, size: tuple[int, int] | None, seed: int
) -> list[float] | None:
    """Return what tells a measured scene from another of its name; a built-in one has its seed."""
    setup = Setup(scene, find_camera(camera), size, seed)
    if setup.is_built_in:
        return None
    seen = setup.scene_seen().light_field
    return [float(np.sum(seen, dtype=np.float64)), float(np.sum(np.square(seen, dtype=np.float64)))]
