"""`emmc-rig stability --worst`: every method under the worst noise-sized perturbation, and details.

Points are kept one by one, and gone on with after a stop.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.camera import Camera, pixel_light
from emmc_rig.model.files import write_text
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.settings import Settings
from emmc_rig.pages.page import Head, Section, fragment, framed, provenance_section
from emmc_rig.progress import Watcher
from emmc_rig.study.scores import swept_disparity
from emmc_rig.study.stability.details import SHAPES, Detail, Shown, shown
from emmc_rig.study.stability.fault_sweep import FAST_SCENES, SCENES, named_methods
from emmc_rig.study.stability.worst import Solve, confined, worst_perturbation
from emmc_rig.study.sweep import (
    Results,
    Sweep,
    check_scene_names,
    csv_text,
    dictionary_identity,
    open_folder,
    provenance,
)
from emmc_rig.study.trial import Setup, Trial, trial_of
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


class WorstSettings(Settings):
    """What to measure: see `emmc-rig stability --worst`."""

    scenes: tuple[str, ...]
    camera: str = CAMERA
    methods: tuple[str, ...]
    size: tuple[int, int]
    fast: bool = False
    dictionary: str | None = None
    seed: int = 0

    def trial(self, scene: str) -> Trial:
        """Return what a method gets of a scene, nothing at fault."""
        return trial_of(Setup(scene, find_camera(self.camera), self.size, self.seed))

    @property
    def details(self) -> tuple[Detail, ...]:
        """The details to put in."""
        sizes, contrasts = (FAST_SIZES_PX, FAST_CONTRASTS) if self.fast else (SIZES_PX, CONTRASTS)
        return tuple(Detail(*one) for one in product(SHAPES, sizes, contrasts))


def worst_settings(
    fast: bool,
    scenes: Sequence[str],
    camera: str | None,
    methods: Sequence[str],
    size: tuple[int, int] | None,
    dictionary: str | None,
    seed: int,
) -> WorstSettings:
    """Return the settings, checked; raises AppError and ReconstructionError for wrong ones."""
    size = size or (FAST_SIZE if fast else SIZE)
    if min(size) < SMALLEST_PX:
        raise AppError(f"--size {size[0]}x{size[1]}: needs {SMALLEST_PX}x{SMALLEST_PX} or more")
    scenes = tuple(scenes) or (FAST_SCENES if fast else SCENES)
    check_scene_names(scenes)
    methods = named_methods(methods, fast)
    camera = camera or CAMERA
    find_camera(camera)
    return WorstSettings(
        scenes=scenes, camera=camera, methods=methods, size=size, fast=fast,
        dictionary=dictionary, seed=seed,
    )  # fmt: skip


@dataclass(frozen=True)
class Point:
    """A scene and a method; detail: None for the worst perturbation."""

    scene: str
    method: str
    detail: Detail | None = None

    @property
    def scene_name(self) -> str:
        """The scene as tables call it."""
        return Path(self.scene).stem

    @property
    def label(self) -> str:
        """In words."""
        what = NOISE if self.detail is None else self.detail.label
        return f"{self.scene_name}, {self.method}, {what}"


@dataclass
class WorstSweep(Sweep[Point]):
    """The points; settings: WorstSettings."""

    journal = JOURNAL
    stage = "worst perturbations and details"
    revision = 1

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        settings: WorstSettings = self.settings
        detail = point.detail
        return {
            "scene": point.scene,
            "method": point.method,
            "detail": detail and (detail.kind, detail.size_px, detail.contrast),
            "camera": find_camera(settings.camera).model_dump(mode="json"),
            "size": settings.size,
            "seed": settings.seed,
            "dictionary": dictionary_identity(settings.dictionary),
        }

    def group(self, point: Point) -> tuple[str, str]:
        """Return what points that share a trial and a reconstruction have in common."""
        return point.scene, point.method

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the figures of each point of one scene and method."""
        trial, method = self.settings.trial(points[0].scene), points[0].method
        dictionary = trial.dictionary(method, self.settings.dictionary)

        def solve(readings: Array) -> Array:
            frames = readings.astype(np.float32)
            sigma = max(trial.noise_sigma, 1e-9)
            result = reconstruct(method, trial.psi, frames, sigma, dictionary, usable=trial.usable)
            return result.light_field

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
    camera = Camera.model_validate_json(trial.psi.camera_json)
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
    """noise: figures by scene and method; details: what is shown of each. page: where to look."""

    noise: Mapping[Point, Mapping[str, float]]
    details: Mapping[Point, Shown]
    page: Path


def run_worst(settings: WorstSettings, out: Path, watcher: Watcher) -> WorstOutcome:
    """Measure into a folder, and write page, table and metrics; raises AppError for a wrong one."""
    started = time.monotonic()
    folder = open_folder(out, JOURNAL, COMMAND)
    points = [
        Point(scene, method, detail)
        for scene in settings.scenes
        for method in settings.methods
        for detail in (None, *settings.details)
    ]
    results = WorstSweep(settings, folder).run(points, watcher)
    noise = {point: one for point, one in results.items() if point.detail is None}
    details = {point: Shown(**one) for point, one in results.items() if point.detail is not None}
    rows = [
        {"scene": point.scene_name, "method": point.method, "what": point.label, **one}
        for point, one in results.items()
    ]
    with result_folder(folder, COMMAND, adds=True) as new:
        write_text(new / "worst.csv", csv_text(rows))
        sections = [
            worst_section(scene, noise, details)
            for scene in dict.fromkeys(point.scene_name for point in points)
        ]
        sections.append(provenance_section(provenance(settings, time.monotonic() - started)))
        about = [
            "Every method under the worst perturbation of the noise's size, and small details."
        ]
        head = _head(noise, details)
        page = framed("The worst that can happen", about, CAVEATS, sections, head=head)
        write_text(new / PAGE, page)
        write_metrics(new, {"points": rows, "settings": settings.model_dump(mode="json")})
    return WorstOutcome(noise, details, folder / PAGE)


def _head(noise: Mapping[Point, Mapping[str, float]], details: Mapping[Point, Shown]) -> Head:
    """Return the method that loses least to the worst perturbation, and what each invents."""
    losses: dict[str, float] = {}
    for point, one in noise.items():
        lost_db = one["noise_db"] - one["worst_db"]
        losses[point.method] = max(losses.get(point.method, lost_db), lost_db)
    best = min(losses, key=losses.__getitem__)
    fates = [one.fate for point, one in details.items() if point.method == best]
    invented = [
        f"{point.method} invents it in {point.scene_name}: {point.label}"
        for point, one in details.items()
        if one.fate == "invented"
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
