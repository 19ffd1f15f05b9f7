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
from emmc_rig.study.design.comparison import (
    SCENES,
    SIZE_PX,
    Simulated,
    buildable,
    shipped_like,
    simulated,
)
from emmc_rig.study.design.design_page import design_page, draw_pareto
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
from emmc_rig.study.points import study_folder
from emmc_rig.study.rows import check_scene_names, provenance

JOURNAL, PAGE, CAMERA = "simulations.jsonl", "report.html", "camera.yaml"
COMMAND = "design"
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
    started, scenes = time.monotonic(), tuple(scenes) or SCENES
    check_scene_names(scenes)
    with study_folder(out, JOURNAL, COMMAND) as folder:
        searched = search(bench, watcher)
        winner = searched.winner.camera(bench)
        rivals = {
            name: _at_equal_light(camera, bench)
            for name, camera in shipped_like(bench).items()
            if buildable(camera, bench) and len(camera.shots) == bench.shots
        }
        cameras = {DESIGNED: winner, **rivals}
        compared = simulated(bench, cameras, scenes, size or SIZE_PX, seed, folder, watcher)
        verdict = _verdict(compared)
        with result_folder(folder, COMMAND, adds=True) as new:
            left_out = _write_mask(winner, bench, new)
            (new / "bench.yaml").write_text(bench_text(bench), encoding="utf-8")
            picture = draw_pareto(searched, new / "light.svg")
            origin = provenance(bench, time.monotonic() - started, Scenes=", ".join(scenes))
            about = [
                f"{len(searched.tried)} masks tried for {bench.shots} shot(s) by theory; {verdict}"
            ]
            page = design_page(about, searched, compared, verdict, picture, folder / CAMERA, origin)
            (new / PAGE).write_text(page, encoding="utf-8")
            write_metrics(new, _metrics(bench, searched, compared))
    return Designed(searched, tuple(compared), verdict, folder / PAGE, tuple(left_out))


def _write_mask(winner: Camera, bench: DesignBench, folder: Path) -> list[str]:
    """Write the camera and its mask; return a line for what could not be written."""
    cells = mask_cells(winner, bench)
    write_picture(cells, folder / PICTURE)
    camera = with_picture(winner).model_dump(mode="json", exclude_defaults=True)
    (folder / CAMERA).write_text(yaml.safe_dump(camera, sort_keys=False), encoding="utf-8")
    if not can_write_gdsii():
        return [f'{GDSII} needs gdstk: pip install "emmc-rig[design]", run it again']
    write_gdsii(cells, winner.masks[MASK].cell_um, folder / GDSII)
    return []


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
