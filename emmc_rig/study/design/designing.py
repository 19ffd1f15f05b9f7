"""A design from bench to files: search, comparison with the shipped cameras, what is written."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import yaml

from emmc_rig.model.camera import Camera, shipped_cameras
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, reconstruct
from emmc_rig.report.page import (
    Card,
    Head,
    Section,
    fragment,
    framed,
    number,
    provenance_section,
    typed,
)
from emmc_rig.store.folders import result_folder
from emmc_rig.store.results import write_metrics
from emmc_rig.study.design.bench import DesignBench, bench_text
from emmc_rig.study.design.expected import SIZE, expected
from emmc_rig.study.design.mask_file import (
    GDSII,
    PICTURE,
    can_write_gdsii,
    mask_cells,
    with_picture,
    write_gdsii,
    write_picture,
)
from emmc_rig.study.design.printed import printed_psi
from emmc_rig.study.design.search import AS_DESIGNED, MASK, Search, search
from emmc_rig.study.points import Results, Study, study_folder
from emmc_rig.study.rows import check_scene_names, provenance
from emmc_rig.study.trial import Capture

JOURNAL, PAGE, CAMERA = "simulations.jsonl", "report.html", "camera.yaml"
COMMAND = "design"
DESIGNED = "this design"
GOAL_DB = 1.5
"""Over the best shipped camera, from which a mask of one's own is worth its price."""
SCENES = ("deep-occlusions", "near-planar", "non-lambertian")
SIZE_PX = (96, 96)
CAVEATS = (
    "Theory assumes textures on two planes half a sample of disparity apart, and noise, without "
    "occlusion. Differences of a tenth of a dB are below its accuracy.",
    "Frames are simulated by the Psi of the mask as printed, on the grid of the reconstruction; "
    "on a bench, calibration measures that Psi.",
)
SHOWN = 20
"""Masks in the table."""
Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Heads of the columns, and rows."""


@dataclass(frozen=True)
class Simulated:
    """A camera: what theory expects, and the default method's PSNR by scene, dB."""

    name: str
    expected_db: float
    psnr_db: Mapping[str, float]

    @property
    def mean_db(self) -> float:
        """Over the scenes."""
        return float(np.mean(list(self.psnr_db.values())))


def shipped_like(bench: DesignBench) -> dict[str, Camera]:
    """Return the shipped cameras of a bench's views, colour filters and sample pitch."""
    sensor = bench.sensor
    return {
        name: camera
        for name, camera in shipped_cameras().items()
        if camera.views == bench.views
        and camera.sensor.cfa == sensor.cfa
        and camera.sensor.sample_pitch_um == sensor.sample_pitch_um
    }


def buildable(camera: Camera, bench: DesignBench) -> bool:
    """Return whether a camera is no sampled model, and its maker can print its masks."""
    return camera.lens.aperture_fill > 0 and all(
        mask.cell_um >= bench.maker.smallest_cell_um for mask in camera.masks.values()
    )


@dataclass
class Simulations(Study[tuple[str, str]]):
    """Points of camera and scene; settings: DesignBench."""

    cameras: Mapping[str, Camera]
    size: tuple[int, int]
    seed: int
    journal = JOURNAL
    noun = "simulations"
    stage = "simulate the default method"
    revision = 1

    def inputs(self, point: tuple[str, str]) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        name, scene = point
        return {
            "camera": self.cameras[name].model_dump(mode="json"),
            "scene": scene,
            "size": self.size,
            "seed": self.seed,
            "method": DEFAULT_METHOD,
        }

    def measured(self, points: Sequence[tuple[str, str]]) -> Results:
        """Yield the PSNR of each point: frames by the printed mask's Psi, which is calibrated."""
        for name, scene in points:
            camera = self.cameras[name]
            truth = Capture(scene, camera, self.size, self.seed).scene_seen().light_field
            psi = printed_psi(camera, (truth.shape[2], truth.shape[3]), AS_DESIGNED)
            shots = camera.expose(truth, self.seed, psi)
            result = reconstruct(DEFAULT_METHOD, psi, shots)
            yield {"psnr_db": psnr_db(result.light_field, truth)}

    def label(self, point: tuple[str, str]) -> str:
        """Return a point in words."""
        return f"{point[0]}, {Path(point[1]).stem}"


def simulated(
    bench: DesignBench,
    cameras: Mapping[str, Camera],
    scenes: Sequence[str],
    size: tuple[int, int],
    seed: int,
    folder: Path,
    watcher: Watcher,
) -> list[Simulated]:
    """Return theory and simulation of cameras; what the folder holds is not simulated again.

    Raises what scenes and methods do for wrong input.
    """
    points = [(name, scene) for name in cameras for scene in scenes]
    results = Simulations(bench, folder, cameras, size, seed).run(points, watcher)
    watcher.begin("expected error of each camera, by theory", len(cameras))
    found = []
    for name, camera in cameras.items():
        psi = printed_psi(camera, SIZE, AS_DESIGNED)
        expected_db = expected(camera, psi, bench.disparities_px).psnr_db
        by_scene = {Path(scene).stem: results[name, scene]["psnr_db"] for scene in scenes}
        found.append(Simulated(name, expected_db, by_scene))
        watcher.step(name)
    return found


def simulated_table(found: Sequence[Simulated]) -> Table:
    """Return the heads and rows of theory and simulation, a row a camera."""
    scenes = list(found[0].psnr_db)
    rows = [
        [row.name, *(f"{db:.2f}" for db in (row.expected_db, row.mean_db, *row.psnr_db.values()))]
        for row in found
    ]
    return ("Camera", "Theory", "Simulated, mean", *scenes), rows


def design_page(
    about: Sequence[str],
    found: Search,
    simulated: Table,
    verdict: str,
    camera: Path,
    provenance: Mapping[str, str],
) -> str:
    """Return the page of a design.

    simulated: theory and simulation, a row a camera. camera: its file, as it will lie.
    """
    best = found.expected
    loss_db = found.ideal_db - best.psnr_db
    cards = (
        Card(
            "Expected PSNR",
            f"{best.psnr_db:.2f} dB",
            f"{found.held[0].worst_db:.2f} with the maker's worst error",
        ),
        Card("Light", f"{best.light:.0%}", "of the open camera's"),
        Card("Fresnel number", f"{best.fresnel:.2g}", f"diffraction loses {loss_db:.2f} dB"),
    )
    names = list(found.held[0].psnr_db)
    body = fragment(
        "design.html",
        cards=cards,
        tried=(
            ("Mask", "Expected PSNR, dB", "Light", "Fresnel number"),
            [
                [
                    mask.label,
                    f"{theory.psnr_db:.2f}",
                    f"{theory.light:.0%}",
                    f"{theory.fresnel:.2g}",
                ]
                for mask, theory in found.tried[:SHOWN]
            ],
        ),
        held=(
            ["Mask", *names],
            [
                [mask.candidate.label, *(number(mask.psnr_db[name], ".2f") for name in names)]
                for mask in found.held
            ],
        ),
        simulated=simulated,
    )
    sections = [Section("design", found.winner.label, body, "Design")]
    sections.append(provenance_section(provenance))
    head = Head(
        found.winner.label,
        verdict,
        [
            "try it on a scene of your own: "
            f"`emmc-rig simulate --camera {typed(camera)} --scene FOLDER`",
            "to have it made, send the mask's GDSII file, which is beside that camera",
        ],
    )
    return framed("Which mask to order", about, CAVEATS, sections, head=head)


@dataclass(frozen=True)
class Designed:
    """The search, the comparison and the page. left_out: a line for each file not written."""

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
            origin = provenance(bench, time.monotonic() - started, Scenes=", ".join(scenes))
            about = [
                f"{len(searched.tried)} masks tried for {bench.shots} shot(s) by theory; {verdict}"
            ]
            shown = simulated_table(compared)
            page = design_page(about, searched, shown, verdict, folder / CAMERA, origin)
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
        return "no shipped camera of this sensor has as many shots to compare with."
    best = max(compared[1:], key=lambda camera: camera.mean_db)
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
        "expected": asdict(found.expected),
        "expected_without_diffraction_db": found.ideal_db,
        "manufacturing_db": {mask.candidate.label: dict(mask.psnr_db) for mask in found.held},
        "tried": [{**asdict(mask), **asdict(theory)} for mask, theory in found.tried],
        "simulated": [asdict(camera) for camera in compared],
        "settings": bench.model_dump(mode="json"),
    }
