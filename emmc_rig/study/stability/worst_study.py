"""`emmc-rig stability --worst`: every method under the worst noise-sized perturbation, and details.

Points are kept one by one, and gone on with after a stop.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.camera import camera_of, pixel_light
from emmc_rig.model.files import write_text
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.pages.page import Head, Section, fragment, framed, provenance_section
from emmc_rig.progress import Watcher
from emmc_rig.study.scores import swept_disparity
from emmc_rig.study.stability.details import SHAPES, Detail, Shown, shown
from emmc_rig.study.stability.fault_sweep import (
    StabilitySettings,
    named_methods,
    stability_settings,
)
from emmc_rig.study.stability.worst import Solve, confined, worst_perturbation
from emmc_rig.study.sweep import (
    NotApplicableError,
    Results,
    Sweep,
    check_scene_names,
    check_size,
    csv_text,
    described,
    dictionary_identity,
    open_folder,
    provenance,
)
from emmc_rig.study.trial import Capture, Trial, trial_of
from reconstruction.errors import ReconstructionError
from reconstruction.methods import reconstruct

Array = NDArray[np.floating]
CAMERA = "rgbw-bayer-1shot"
SIZE, FAST_SIZE, SMALLEST_PX = (64, 80), (32, 40), 24
REGION_PX, RIM_PX = 16, 4
"""Side of the region that a local perturbation is confined to; what it changes beside it counts."""
SIZES_PX, CONTRASTS = (1, 2, 3), (0.05, 0.1, 0.3)
FAST_SIZES_PX, FAST_CONTRASTS = (1, 2), (0.3,)
FURTHEST_PX = 3.0
"""Disparities to both sides among which a measured scene's place is looked for."""
JOURNAL, PAGE, COMMAND = "worst.jsonl", "report.html", "stability --worst"
NOISE = "worst noise"


def details(fast: bool) -> list[Detail]:
    """Return the details to put into a scene."""
    sizes, contrasts = (FAST_SIZES_PX, FAST_CONTRASTS) if fast else (SIZES_PX, CONTRASTS)
    return [Detail(*one) for one in product(SHAPES, sizes, contrasts)]


def worst_settings(
    fast: bool,
    scenes: Sequence[str],
    camera: str | None,
    methods: Sequence[str],
    size: tuple[int, int] | None,
    dictionary: str | None,
    seed: int,
) -> StabilitySettings:
    """Return the settings, checked; raises AppError and ReconstructionError for wrong ones."""
    size = size or (FAST_SIZE if fast else SIZE)
    check_size(size, SMALLEST_PX)
    settings = stability_settings(
        fast, scenes, size, zoom=1, camera=camera or CAMERA, methods=named_methods(methods, fast),
        dictionary=dictionary, seed=seed,
    )  # fmt: skip
    check_scene_names(settings.scenes)
    find_camera(settings.camera)
    return settings


@dataclass(frozen=True)
class Point:
    """A capture and a method; detail: None for the worst perturbation."""

    capture: Capture
    method: str
    detail: Detail | None = None

    @property
    def scene_name(self) -> str:
        """The scene as tables call it."""
        return self.capture.scene_name

    @property
    def label(self) -> str:
        """In words."""
        what = NOISE if self.detail is None else self.detail.label
        return f"{self.scene_name}, {self.method}, {what}"


@dataclass
class WorstSweep(Sweep[Point]):
    """The points; settings: StabilitySettings."""

    journal = JOURNAL
    stage = "worst perturbations and details"
    revision = 1

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        return {**described(point), "dictionary": dictionary_identity(self.settings.dictionary)}

    def group(self, point: Point) -> Point:
        """Return what points that share a trial and a reconstruction have in common."""
        return replace(point, detail=None)

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the figures of each point of one scene and method."""
        trial, method = trial_of(points[0].capture), points[0].method
        dictionary = trial.dictionary(method, self.settings.dictionary)

        def solve(readings: Array) -> Array:
            frames = readings.astype(np.float32)
            sigma = max(trial.noise_sigma, 1e-9)
            given = (trial.psi, frames, sigma, dictionary)
            try:
                return reconstruct(method, *given, usable=trial.usable).light_field
            except ReconstructionError as why:
                raise NotApplicableError(f"{method}: {why}") from why

        base = None
        for point in points:
            if point.detail is None:
                yield noise_figures(trial, solve, self.settings.seed)
                continue
            base = solve(trial.readings) if base is None else base
            truth = point.detail.put_into(trial.truth, place_disparity(trial))
            added = trial.psi.forward(truth) - trial.psi.forward(trial.truth)
            one = shown(solve(trial.readings + added), base, truth, trial.truth)
            yield {"kept": one.kept, "invented": one.invented}


def place_disparity(trial: Trial) -> float:
    """Return the disparity in the middle of the centre view, pixels per view step."""
    disparity_px = trial.disparity_px
    if disparity_px is None:
        disparity_px = swept_disparity(trial.truth, -FURTHEST_PX, FURTHEST_PX)
    rows, columns = (n // 2 for n in disparity_px.shape)
    return float(np.median(disparity_px[rows - 4 : rows + 4, columns - 4 : columns + 4]))


def noise_figures(trial: Trial, solve: Solve, seed: int) -> dict[str, float]:
    """Return PSNR without noise, with noise and with the worst of its size, dB; and in a region.

    region_*: of REGION_PX a side with RIM_PX around it, perturbed there alone. beyond: share of the
    energy of that change that lies further away.
    """
    clean = trial.true_psi.forward(trial.truth)
    camera = camera_of(trial.psi)
    exposures_s = camera.exposures_s()[:, None, None]
    light = pixel_light(camera, trial.psi.size)
    variance = camera.sensor.noise.variance(clean, exposures_s, light)
    deviation = np.where(np.isfinite(variance), np.sqrt(variance), 0.0)
    found = worst_perturbation(
        solve, clean, deviation, trial.truth, np.random.default_rng([seed, 1])
    )
    free = solve(clean)
    estimates = {
        "free_db": free,
        "noise_db": solve(clean + found.random),
        "worst_db": solve(clean + found.perturbation),
    }
    figures = {name: psnr_db(one, trial.truth) for name, one in estimates.items()}
    local, square = confined(found.perturbation, REGION_PX)
    noise, _ = confined(found.random, REGION_PX)
    around = tuple(slice(max(s.start - RIM_PX, 0), s.stop + RIM_PX) for s in square)
    here = np.s_[:, :, around[0], around[1]]
    hurt = solve(clean + local)
    change = np.square(hurt - free)
    figures |= {
        "region_free_db": psnr_db(free[here], trial.truth[here]),
        "region_noise_db": psnr_db(solve(clean + noise)[here], trial.truth[here]),
        "region_worst_db": psnr_db(hurt[here], trial.truth[here]),
        "beyond": 1 - float(change[here].sum()) / max(float(change.sum()), 1e-12),
        "gain": found.gain,
    }
    return figures


@dataclass(frozen=True)
class WorstOutcome:
    """noise: figures by scene and method; details: what is shown of each. page: where to look.

    left_out: lines about methods that could not be measured.
    """

    noise: Mapping[Point, Mapping[str, float]]
    details: Mapping[Point, Shown]
    page: Path
    left_out: Sequence[str]


def run_worst(settings: StabilitySettings, out: Path, watcher: Watcher) -> WorstOutcome:
    """Measure into a folder, and write page, table and metrics; raises AppError for a wrong one."""
    started = time.monotonic()
    folder = open_folder(out, JOURNAL, COMMAND)
    points = [
        Point(capture, method, detail)
        for capture in settings.captures
        for method in settings.methods
        for detail in (None, *details(settings.fast))
    ]
    sweep = WorstSweep(settings, folder)
    results = sweep.run(points, watcher)
    left_out = list(dict.fromkeys(sweep.left_out.values()))
    if not results:
        raise AppError(f"nothing could be measured: {'; '.join(left_out)}")
    noise = {point: one for point, one in results.items() if point.detail is None}
    fates = {point: Shown(**one) for point, one in results.items() if point.detail is not None}
    rows = [
        {"scene": point.scene_name, "method": point.method, "what": point.label, **one}
        for point, one in results.items()
    ]
    with result_folder(folder, COMMAND, adds=True) as new:
        write_text(new / "worst.csv", csv_text(rows))
        sections = [
            worst_section(scene, noise, fates)
            for scene in dict.fromkeys(point.scene_name for point in results)
        ]
        sections.append(provenance_section(provenance(settings, time.monotonic() - started)))
        about = [
            "Every method under the worst perturbation of the noise's size, and small details."
        ]
        head = _head(noise, fates)
        page = framed("The worst that can happen", about, CAVEATS, sections, head=head)
        write_text(new / PAGE, page)
        metrics = {"points": rows, "settings": settings.model_dump(mode="json")}
        write_metrics(new, {**metrics, "left_out": left_out})
    return WorstOutcome(noise, fates, folder / PAGE, left_out)


def _head(noise: Mapping[Point, Mapping[str, float]], details: Mapping[Point, Shown]) -> Head:
    """Return the method that loses least to the worst perturbation, and what each invents."""
    losses: dict[str, float] = {}
    for point, one in noise.items():
        lost_db = one["noise_db"] - one["worst_db"]
        losses[point.method] = max(losses.get(point.method, lost_db), lost_db)
    best = min(losses, key=losses.__getitem__)
    fates = [one.fate for point, one in details.items() if point.method == best]
    invented = [
        f"trust no small detail of {point.method}: in {point.scene_name} it invents a "
        f"{point.detail.label}"
        for point, one in details.items()
        if one.fate == "invented" and point.detail is not None
    ]
    return Head(
        f"{best} loses least",
        f"at most {losses[best]:.2f} dB to the worst perturbation of the noise's size; it keeps "
        f"{fates.count('kept')} of {len(fates)} details",
        invented or ["look at what is lost among the small details below"],
        "watch" if invented else "",
    )


CAVEATS = (
    "The perturbation is the worst that was found by a few dozen reconstructions: a lower bound.",
    "A detail counts as kept where half of it or more is shown; as invented where the "
    "reconstruction of the scene without it holds as much of it.",
)


def noise_table(
    scene: str, noise: Mapping[Point, Mapping[str, float]]
) -> tuple[list[str], list[list[str]]]:
    """Return heads and a row a method of one scene."""
    heads = [
        "Method", "Noise-free, dB", "Noise", "Worst", "Lost to its direction",
        f"{REGION_PX}x{REGION_PX} region: noise", "worst", "lost", "beyond it", "gain",
    ]  # fmt: skip
    rows = []
    for point, one in noise.items():
        if point.scene_name == scene:
            rows.append(
                [
                    point.method,
                    *(f"{one[name]:.2f}" for name in ("free_db", "noise_db", "worst_db")),
                    f"{one['noise_db'] - one['worst_db']:.2f}",
                    *(f"{one[name]:.2f}" for name in ("region_noise_db", "region_worst_db")),
                    f"{one['region_noise_db'] - one['region_worst_db']:.2f}",
                    f"{one['beyond']:.0%}",
                    f"{one['gain']:.2f}",
                ]
            )
    return heads, rows


def details_table(scene: str, details: Mapping[Point, Shown]) -> tuple[list[str], list[list[str]]]:
    """Return heads and a row a detail of one scene: its share that each method shows, and fate."""
    some = {point: one for point, one in details.items() if point.scene_name == scene}
    methods = list(dict.fromkeys(point.method for point in some))
    rows: dict[str, list[str]] = {}
    for point, one in some.items():
        assert point.detail is not None
        cells = rows.setdefault(point.detail.label, [point.detail.label])
        cells.append(f"{one.kept:.0%}, {one.fate}")
    return ["Detail", *methods], list(rows.values())


def worst_section(
    scene: str, noise: Mapping[Point, Mapping[str, float]], details: Mapping[Point, Shown]
) -> Section:
    """Return the tables of a scene."""
    body = fragment(
        "worst.html", noise=noise_table(scene, noise), details=details_table(scene, details)
    )
    return Section(f"worst-{scene}", scene, body)
