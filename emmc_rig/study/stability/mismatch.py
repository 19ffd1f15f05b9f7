"""The mismatch protocol: each method with the right Psi, a wrong one, and the wrong one corrected.

Four scenarios, after InverseNet (arXiv 2603.04538): ideal, nothing has moved; mismatched, the mask
has moved and Psi is the design's; oracle-corrected, the same readings with the Psi that made them;
blind-corrected, with the Psi that the readings themselves suggest (`calibration.drift`, as
`emmc-rig calibrate --drift` corrects it: unchanged where no drift is detected). Recovered is
(blind - mismatched) / (ideal - mismatched); what the oracle does not recover is lost by the moved
mask being a worse code for this scene, not by not knowing it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from calibration.drift import Captures, DriftSettings, find_drift
from calibration.errors import CalibrationError
from calibration.parametric import psi_at, shot_stages
from calibration.placement import designed_placement
from calibration.shadow import Shadow, shadow_mask
from emmc_rig.model.camera import camera_of, pixel_light
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.pages.drawing import COLOURS, INK, legend_below, save_drawing, sheet, titled
from emmc_rig.pages.page import Section, embedded, fragment
from emmc_rig.progress import Watcher
from emmc_rig.study.stability.fault_sweep import StabilitySettings, chosen_methods
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.sweep import NotApplicableError, Results, Sweep, described
from emmc_rig.study.trial import Trial
from reconstruction.errors import ReconstructionError

SCENARIOS = ("ideal", "mismatched", "oracle", "blind")
ERRORS = (
    ("mask-shift", 0.5),
    ("mask-shift", 1.0),
    ("mask-rotation", 0.5),
    ("mask-scale", 0.5),
    ("mask-distance-error", 25.0),
)
UNMOVED = ("mask-shift", 0.0)
QUICK_ERRORS = (("mask-shift", 0.5), ("mask-rotation", 0.5), ("mask-distance-error", 25.0))
QUICK_DRIFT = DriftSettings(blocks=60, coarse_blocks=24, block_px=6, disparity_steps=7)
LEAST_DB = 0.2
"""Loss below which a recovered share would be that of noise."""


@dataclass(frozen=True)
class Mismatch:
    """One method under one error, PSNRs in dB; NaN where it refused.

    detected: whether the drift was. psi_error, psi_left: relative error of Psi before and
    after blind correction (Frobenius norm).
    """

    scene: str
    error: str
    method: str
    ideal: float
    mismatched: float
    oracle: float
    blind: float
    detected: bool
    psi_error: float
    psi_left: float

    @property
    def recovered(self) -> float | None:
        """Share of the loss that blind correction recovers; None below a loss of LEAST_DB."""
        return _share(self.blind - self.mismatched, self.ideal - self.mismatched)

    @property
    def of_oracle(self) -> float | None:
        """Likewise of what the true Psi recovers."""
        return _share(self.blind - self.mismatched, self.oracle - self.mismatched)


def _share(gained: float, lost: float) -> float | None:
    return gained / lost if math.isfinite(gained) and lost > LEAST_DB else None


def corrected(moved: Trial, settings: DriftSettings) -> tuple[ImagingMatrix, bool]:
    """Return Psi as fitted to the readings, and whether a drift was detected.

    Raises NotApplicableError for a camera whose drift cannot be estimated.
    """
    psi = moved.psi
    camera = camera_of(psi)
    noise, light = camera.sensor.noise, pixel_light(camera, psi.size)
    variance = noise.variance(moved.readings, camera.exposures_s()[:, None, None], light)
    try:
        mask, stages = shadow_mask(camera, psi.size), shot_stages(camera)
        colour = None if psi.colour is None else psi.colour[:, :: psi.binning, :: psi.binning]
        taken = Captures(moved.readings, variance, moved.usable, colour)
        found = find_drift(taken, mask, designed_placement(camera), stages, settings)
    except CalibrationError as fault:
        raise NotApplicableError(str(fault)) from fault
    if found.refused or not found.drifted:
        return psi, False
    return psi_at(Shadow(mask, found.placement), psi.layout, stages), True


def _psnr(taken: Trial, psi: ImagingMatrix, method: str) -> float:
    try:
        found = replace(taken, psi=psi).solved(method)
    except ReconstructionError:
        return math.nan
    return taken.psnr_db(found.light_field)


@dataclass
class MismatchSweep(Sweep[Point]):
    """The points of the protocol; settings: StabilitySettings."""

    journal = "mismatch.jsonl"
    stage = "mismatch of Psi"
    revision = 3

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        return {**described(point), "drift": drift_settings(self.settings.fast).model_dump()}

    def group(self, point: Point) -> Point:
        """Return what all methods on one capture have in common."""
        return replace(point, method="")

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the methods' PSNRs by scenario, and what became of Psi."""
        moved = points[0].trial()
        blind, detected = corrected(moved, drift_settings(self.settings.fast))
        for point in points:
            mismatched = _psnr(moved, moved.psi, point.method)
            if point.strength == 0:
                yield {"mismatched": mismatched}
                continue
            yield {
                "mismatched": mismatched,
                "oracle": _psnr(moved, moved.true_psi, point.method),
                "blind": _psnr(moved, blind, point.method) if detected else mismatched,
                "detected": detected,
                "psi_error": moved.psi.relative_difference(moved.true_psi),
                "psi_left": blind.relative_difference(moved.true_psi),
            }


def drift_settings(fast: bool) -> DriftSettings:
    """Return the settings of the blind search."""
    return QUICK_DRIFT if fast else DriftSettings()


def measure_mismatch(settings: StabilitySettings, folder: Path, watcher: Watcher) -> list[Mismatch]:
    """Return every row, those that the folder does not hold measured and kept there.

    Raises what scenes, cameras and methods do for wrong input, NotApplicableError for cameras
    without a mask that can sit otherwise.
    """
    methods = chosen_methods(settings)
    errors = QUICK_ERRORS if settings.fast else ERRORS
    sweep = MismatchSweep(settings, folder)
    sweep.run(
        (
            Point(capture, *error, method)
            for capture in settings.captures
            for error in (UNMOVED, *errors)
            for method in methods
        ),
        watcher,
    )
    if not sweep.results:
        raise NotApplicableError(next(iter(sweep.left_out.values())))
    return [
        _mismatch(point, result, sweep.results[replace(point, fault=UNMOVED[0], strength=0.0)])
        for point, result in sweep.results.items()
        if point.strength
    ]


def _mismatch(point: Point, result: dict, ideal: dict) -> Mismatch:
    dbs = {"ideal": ideal["mismatched"], **{kind: result[kind] for kind in SCENARIOS[1:]}}
    return Mismatch(
        point.scene_name,
        point.condition,
        point.method,
        **{kind: math.nan if db is None else db for kind, db in dbs.items()},
        detected=result["detected"],
        psi_error=result["psi_error"],
        psi_left=result["psi_left"],
    )


MARKS = {
    "ideal": ("o", INK, "none", 10),
    "mismatched": ("X", "#b42318", "#b42318", 7),
    "oracle": ("D", COLOURS[0], "none", 7),
    "blind": ("o", COLOURS[0], COLOURS[0], 4),
}


def draw_mismatch(rows: Sequence[Mismatch], path: Path) -> Path:
    """Write a panel for each error of one scene, a column a method, as SVG and PNG."""
    errors = list(dict.fromkeys(row.error for row in rows))
    figure, axes = sheet(len(errors), 3.9, 2.9, columns=min(3, len(errors)))
    for panel, error in zip(axes, errors, strict=True):
        some = [row for row in rows if row.error == error]
        for place, row in enumerate(some):
            ends = row.mismatched, row.blind
            panel.plot([place, place], ends, color=COLOURS[0], linewidth=1, alpha=0.5)
            for kind in SCENARIOS:
                mark, edge, face, size = MARKS[kind]
                panel.plot(
                    place, getattr(row, kind), mark, color=edge, markerfacecolor=face,
                    markersize=size, label=kind if place == 0 else None,
                )  # fmt: skip
        panel.set_xticks(range(len(some)), [row.method for row in some], rotation=20)
        panel.tick_params(labelsize=7.5)
        panel.set_xlim(-0.5, len(some) - 0.5)
        titled(panel, error)
    lines, names = axes[0].get_legend_handles_labels()
    legend_below(figure, lines, names, 4)
    return save_drawing(figure, path)


def recovered_share(rows: Sequence[Mismatch], of_oracle: bool = False) -> float | None:
    """Return what blind correction recovers of all that was lost; None where too little was."""
    whole = [row for row in rows if (row.of_oracle if of_oracle else row.recovered) is not None]
    best = (row.oracle if of_oracle else row.ideal for row in whole)
    lost = sum(one - row.mismatched for one, row in zip(best, whole, strict=True))
    return sum(row.blind - row.mismatched for row in whole) / lost if whole else None


def mismatch_sections(rows: Sequence[Mismatch], folder: Path) -> list[Section]:
    """Return a section for each scene, its chart written into a folder."""
    sections = []
    for scene in dict.fromkeys(row.scene for row in rows):
        some = [row for row in rows if row.scene == scene]
        picture = draw_mismatch(some, folder / f"mismatch-{scene}.svg")
        body = fragment(
            "mismatch.html",
            scene=scene,
            picture=embedded(picture),
            rows=some,
            scenarios=SCENARIOS,
            share=recovered_share(some),
            share_of_oracle=recovered_share(some, True),
        )
        sections.append(Section(f"mismatch-{scene}", f"Mismatch of Psi, {scene}", body))
    return sections
