"""A design from bench to files: search, comparison with the shipped cameras, what is written."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.camera import Camera
from emmc_rig.progress import Watcher
from emmc_rig.study.design.bench import DesignBench, bench_text
from emmc_rig.study.design.candidates import MASK
from emmc_rig.study.design.check import (
    SCENES,
    SIZE_PX,
    Simulated,
    buildable,
    checked_cameras,
    rank_correlations,
    shipped_like,
    simulated,
)
from emmc_rig.study.design.design_page import check_page, design_page, draw_check, draw_pareto
from emmc_rig.study.design.mask_file import (
    GDSII,
    PICTURE,
    can_write_gdsii,
    mask_cells,
    with_picture,
    write_gdsii,
    write_picture,
)
from emmc_rig.study.design.search import Search, search
from emmc_rig.study.sweep import check_scene_names, open_folder, provenance

JOURNAL, PAGE, CAMERA = "simulations.jsonl", "report.html", "camera.yaml"
COMMAND, CHECK_COMMAND = "design", "design --check"
DESIGNED = "this design"
GOAL_DB = 1.5
"""Over the best shipped camera, from which a mask of one's own is worth its price."""


@dataclass(frozen=True)
class Designed:
    """What was found and written. left_out: lines about what could not be."""

    found: Search
    simulated: tuple[Simulated, ...]
    verdict: str
    page: Path
    left_out: tuple[str, ...]


def run_design(
    bench: DesignBench,
    scenes: Sequence[str],
    size: tuple[int, int] | None,
    seed: int,
    out: Path,
    watcher: Watcher,
) -> Designed:
    """Choose a mask, compare it, and write page, camera and mask into a folder.

    Raises AppError for a folder that holds something else, and what scenes do for wrong input.
    """
    started, scenes, folder = _begun(scenes, out, COMMAND)
    found = search(bench, watcher)
    winner = found.winner.camera(bench)
    rivals = {
        name: _at_equal_light(camera, bench)
        for name, camera in shipped_like(bench).items()
        if buildable(camera, bench) and len(camera.shots) == bench.shots
    }
    cameras = {DESIGNED: winner, **rivals}
    compared = simulated(bench, cameras, scenes, size or SIZE_PX, seed, folder, watcher)
    verdict = _verdict(compared)
    cells = mask_cells(winner, bench)
    left_out = []
    with result_folder(folder, COMMAND, adds=True) as new:
        write_picture(cells, new / PICTURE)
        if can_write_gdsii():
            write_gdsii(cells, winner.masks[MASK].cell_um, new / GDSII)
        else:
            left_out.append(f'{GDSII} needs gdstk: pip install "emmc-rig[design]", run it again')
        camera = with_picture(winner).model_dump(mode="json", exclude_defaults=True)
        (new / CAMERA).write_text(yaml.safe_dump(camera, sort_keys=False), encoding="utf-8")
        (new / "bench.yaml").write_text(bench_text(bench), encoding="utf-8")
        picture = draw_pareto(found, new / "light.svg")
        origin = provenance(bench, time.monotonic() - started, Scenes=", ".join(scenes))
        about = [f"{len(found.tried)} masks tried for {bench.shots} shot(s) by theory; {verdict}"]
        page = design_page(about, found, compared, verdict, picture, folder / CAMERA, origin)
        (new / PAGE).write_text(page, encoding="utf-8")
        write_metrics(new, _metrics(bench, found, compared))
    return Designed(found, tuple(compared), verdict, folder / PAGE, tuple(left_out))


def _begun(scenes: Sequence[str], out: Path, command: str) -> tuple[float, Sequence[str], Path]:
    """Return when it began, the scenes, checked, and the folder."""
    scenes = tuple(scenes) or SCENES
    check_scene_names(scenes)
    return time.monotonic(), scenes, open_folder(out, JOURNAL, command)


def _at_equal_light(camera: Camera, bench: DesignBench) -> Camera:
    """Return a camera with the bench's exposure and noise."""
    sensor = camera.sensor.model_copy(update={"noise": bench.sensor.noise})
    update = {"sensor": sensor, "total_exposure_s": bench.total_exposure_s}
    return camera.model_copy(update=update)


def _verdict(compared: Sequence[Simulated]) -> str:
    """Return what the design gains on the best shipped camera, in words; the design is first."""
    if len(compared) == 1:
        return "no shipped camera of this sensor takes as many shots."
    best = max(compared[1:], key=lambda one: one.mean_db)
    gain_db = compared[0].mean_db - best.mean_db
    worth = "order it" if gain_db >= GOAL_DB else "a mask you have may do as well"
    return (
        f"simulated, {gain_db:+.2f} dB against {best.name}, the best shipped camera of this "
        f"sensor, light and number of shots: {worth}."
    )


def _metrics(
    bench: DesignBench, found: Search, compared: Sequence[Simulated]
) -> Mapping[str, object]:
    return {
        "winner": asdict(found.winner),
        "expected": {**asdict(found.expected), **asdict(found.bounds)},
        "expected_without_diffraction_db": found.ideal_db,
        "manufacturing_db": {one.candidate.label: dict(one.psnr_db) for one in found.held},
        "tried": [{**asdict(one), **asdict(what)} for one, what in found.tried],
        "simulated": [asdict(one) for one in compared],
        "settings": bench.model_dump(mode="json"),
    }


@dataclass(frozen=True)
class Checked:
    """Theory beside simulation. ranks: Spearman's correlation by scene, and of the mean."""

    simulated: tuple[Simulated, ...]
    ranks: Mapping[str, float]
    page: Path


def run_check(
    bench: DesignBench,
    scenes: Sequence[str],
    size: tuple[int, int] | None,
    seed: int,
    out: Path,
    watcher: Watcher,
) -> Checked:
    """Compare theory with simulation on many cameras; raises what `run_design` does."""
    started, scenes, folder = _begun(scenes, out, CHECK_COMMAND)
    cameras = {
        name: _at_equal_light(camera, bench)
        for name, camera in checked_cameras(bench, seed).items()
    }
    found = simulated(bench, cameras, scenes, size or SIZE_PX, seed, folder, watcher)
    ranks = rank_correlations(found)
    words = ", ".join(f"{name} {rank:+.2f}" for name, rank in ranks.items())
    with result_folder(folder, CHECK_COMMAND, adds=True) as new:
        picture = draw_check(found, new / "check.svg")
        origin = provenance(bench, time.monotonic() - started, Scenes=", ".join(scenes))
        about = [f"{len(found)} cameras, {len(scenes)} scenes."]
        page = check_page(about, found, words, picture, origin)
        (new / PAGE).write_text(page, encoding="utf-8")
        rows, settings = [asdict(one) for one in found], bench.model_dump(mode="json")
        write_metrics(new, {"rank_correlations": ranks, "simulated": rows, "settings": settings})
    return Checked(tuple(found), ranks, folder / PAGE)
