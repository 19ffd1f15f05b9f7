"""The mismatch protocol: each method with the right Psi, a wrong one, and the wrong one mended.

Four scenarios, after InverseNet (arXiv 2603.04538): ideal, nothing has moved; mismatched, the mask
has moved and Psi is the design's; oracle-corrected, the same readings with the Psi that made them;
blind-corrected, with the Psi that the readings themselves suggest (`calibration.drift`, as
`emmc-rig calibrate --drift` mends it: left alone where no drift is told). Recovered is
(blind - mismatched) / (ideal - mismatched); what the oracle does not recover is lost by the moved
mask being a worse code for this scene, not by not knowing it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calibration.drift import DriftSettings, find_drift
from calibration.errors import CalibrationError
from calibration.parametric import psi_at, shot_stages
from calibration.placement import designed_placement
from calibration.shadow import Shadow, shadow_mask
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.model.camera import Camera, pixel_light
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.progress import Watcher
from emmc_rig.study.points import Journal, digest_of
from emmc_rig.study.stability.faults import find_fault, trial
from emmc_rig.study.stability.trial import NotApplicableError, Trial
from emmc_rig.version import __version__
from reconstruction.errors import ReconstructionError
from reconstruction.methods import METHODS, reconstruct

POINTS = "mismatch.jsonl"
REVISION = 1
SCENARIOS = ("ideal", "mismatched", "oracle", "blind")
ERRORS = (
    ("mask-shift", 0.5),
    ("mask-shift", 1.0),
    ("mask-rotation", 0.5),
    ("mask-scale", 0.5),
    ("mask-distance-error", 25.0),
)
QUICK_ERRORS = (("mask-shift", 0.5), ("mask-rotation", 0.5), ("mask-distance-error", 25.0))
QUICK_DRIFT = DriftSettings(blocks=60, coarse_blocks=24, block_px=6, disparity_steps=7)
METHODS_JUDGED = ("tv", "dict-omp", "dict-admm", "tv-dict", "adaptive", "adaptive-fast")
QUICK_METHODS = ("tv", "dict-omp", "adaptive-fast")
LEAST_DB = 0.2
"""Loss below which a recovered share would be that of noise."""


@dataclass(frozen=True)
class MismatchSettings:
    """What to measure. size: rows and columns of the crop."""

    fast: bool = False
    scenes: tuple[str, ...] = ("deep-occlusions",)
    camera: str = "rgbw-bayer-1shot"
    size: tuple[int, int] = (64, 80)
    zoom: int = 3
    methods: tuple[str, ...] = METHODS_JUDGED
    seed: int = 0

    @property
    def errors(self) -> tuple[tuple[str, float], ...]:
        """Faults and their strengths."""
        return QUICK_ERRORS if self.fast else ERRORS

    @property
    def drift(self) -> DriftSettings:
        """Of the blind search."""
        return QUICK_DRIFT if self.fast else DriftSettings()


@dataclass(frozen=True)
class Mismatch:
    """One method under one error, PSNRs in dB; NaN where it refused.

    told: whether the readings told the drift. psi_error, psi_left: relative error of Psi before and
    after blind mending (Frobenius norm).
    """

    scene: str
    error: str
    method: str
    ideal: float
    mismatched: float
    oracle: float
    blind: float
    told: bool
    psi_error: float
    psi_left: float

    @property
    def recovered(self) -> float | None:
        """Share of the loss that blind mending recovers; None where next to nothing is lost."""
        return _share(self.blind - self.mismatched, self.ideal - self.mismatched)

    @property
    def of_oracle(self) -> float | None:
        """Likewise of what knowing Psi recovers."""
        return _share(self.blind - self.mismatched, self.oracle - self.mismatched)


def _share(gained: float, lost: float) -> float | None:
    return gained / lost if math.isfinite(gained) and lost > LEAST_DB else None


def mended(moved: Trial, settings: DriftSettings) -> tuple[ImagingMatrix, bool]:
    """Return Psi as the readings suggest, and whether they told a drift.

    Raises NotApplicableError for a camera of which no drift is sought.
    """
    psi = moved.psi
    camera = Camera.model_validate_json(psi.camera_json)
    if psi.colour is None:
        raise NotApplicableError("a drift is sought on sensors with a colour filter")
    noise, light = camera.sensor.noise, pixel_light(camera, psi.size)
    variance = noise.variance(moved.readings, camera.exposures_s()[:, None, None], light)
    try:
        mask, stages = shadow_mask(camera, psi.size), shot_stages(camera)
        found = find_drift(
            moved.readings,
            variance,
            moved.usable,
            psi.colour,
            mask,
            designed_placement(camera),
            stages,
            settings,
        )
    except CalibrationError as fault:
        raise NotApplicableError(str(fault)) from fault
    if not found.drifted:
        return psi, False
    return psi_at(Shadow(mask, found.placement), psi.layout, stages), True


def _psnr(taken: Trial, psi: ImagingMatrix, method: str) -> float:
    dictionary = None
    if METHODS[method].needs_dictionary:
        dictionary = open_dictionary(None, psi.light_field_shape[:2], psi.binning)
    try:
        found = reconstruct(
            method, psi, taken.readings, taken.noise_sigma, dictionary, usable=taken.usable
        )
    except ReconstructionError:
        return math.nan
    return psnr_db(found.light_field, taken.truth)


def measure_mismatch(settings: MismatchSettings, folder: Path, watcher: Watcher) -> list[Mismatch]:
    """Return every row, those that the folder does not hold measured and kept there.

    Raises what scenes and cameras do for wrong input, NotApplicableError for cameras without a
    mask that can sit otherwise.
    """
    path = folder / POINTS
    path.touch()
    journal, camera = Journal(path), find_camera(settings.camera)
    count = len(settings.scenes) * (1 + len(settings.errors)) * len(settings.methods)
    watcher.begin("mismatch of Psi", count)
    rows = []
    for scene in settings.scenes:

        def done(method: str, scene: str = scene) -> None:
            watcher.step(f"{method}, {Path(scene).stem}")

        ideal = _kept(settings, camera, scene, ("mask-shift", 0.0), journal, done)
        for error in settings.errors:
            found = _kept(settings, camera, scene, error, journal, done)
            rows += _rows(settings, scene, error, ideal, found)
    return rows


def _kept(
    settings: MismatchSettings,
    camera: Camera,
    scene: str,
    error: tuple[str, float],
    journal: Journal,
    done: Callable[[str], None],
) -> dict:
    """Return the PSNRs of one error, scenario -> method, and what became of Psi."""
    name, strength = error
    inputs: dict[str, object] = {
        "revision": REVISION,
        "version": __version__,
        "camera": camera.model_dump(mode="json"),
        "error": error,
        "scene": scene,
        "size": settings.size,
        "zoom": settings.zoom,
        "methods": settings.methods,
        "drift": settings.drift.model_dump(),
        "seed": settings.seed,
    }
    digest = digest_of(inputs)
    known = journal.get(digest)
    if known is not None:
        return known
    fault = find_fault(name)
    moved = trial(fault, strength, scene, camera, settings.size, settings.seed, settings.zoom)
    blind, told = mended(moved, settings.drift)
    scenarios = {"mismatched": moved.psi, "oracle": moved.true_psi, "blind": blind}
    if strength == 0:
        scenarios = {"mismatched": moved.psi, "blind": blind}
    found: dict = {kind: {} for kind in scenarios}
    for method in settings.methods:
        for kind, psi in scenarios.items():
            same = kind == "blind" and not told
            db = found["mismatched"][method] if same else _psnr(moved, psi, method)
            found[kind][method] = db if db is not None and math.isfinite(db) else None
        done(method)
    found["told"] = told
    found["psi_error"] = moved.psi.relative_difference(moved.true_psi)
    found["psi_left"] = blind.relative_difference(moved.true_psi)
    journal.add(digest, inputs, found)
    return found


def _rows(
    settings: MismatchSettings, scene: str, error: tuple[str, float], ideal: dict, found: dict
) -> list[Mismatch]:
    fault = find_fault(error[0])

    def db(value: float | None) -> float:
        return math.nan if value is None else value

    return [
        Mismatch(
            Path(scene).stem,
            f"{fault.title} {error[1]:g} {fault.unit}",
            method,
            db(ideal["mismatched"][method]),
            db(found["mismatched"][method]),
            db(found["oracle"][method]),
            db(found["blind"][method]),
            bool(found["told"]),
            float(found["psi_error"]),
            float(found["psi_left"]),
        )
        for method in settings.methods
    ]
