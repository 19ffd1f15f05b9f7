"""`emmc-rig design`: search, comparison with the shipped cameras, and the files of a mask."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from emmc_rig.model.camera import Camera, shipped_cameras
from emmc_rig.model.files import write_text
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, reconstruct
from emmc_rig.report.page import Card, Head, Section, fragment, number, typed
from emmc_rig.study.design.bench import DesignBench
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
from emmc_rig.study.points import Report, Results, Study, Table, study_folder
from emmc_rig.study.rows import check_scene_names
from emmc_rig.study.trial import Capture

CAMERA = "camera.yaml"
DESIGNED = "this design"
GOAL_DB = 1.5
"""Over the best shipped camera, from which a mask of one's own is worth its price."""
SCENES = ("deep-occlusions", "near-planar", "non-lambertian")
SIZE_PX = (96, 96)
SHOWN = 20
"""Masks in the table."""


class Simulation(NamedTuple):
    """A camera's name, and a scene before it."""

    camera: str
    scene: str


@dataclass(frozen=True)
class Simulated:
    """A camera: PSNR expected by theory, and the default method's by scene, dB."""

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
class DesignStudy(Study[Simulation]):
    """A mask beside the shipped cameras, simulated; settings: DesignBench.

    found: the search that the mask won. theory_db: PSNR expected of each camera.
    """

    found: Search
    cameras: Mapping[str, Camera]
    theory_db: Mapping[str, float]
    scenes: Sequence[str]
    size: tuple[int, int]
    seed: int
    journal = "simulations.jsonl"
    noun = "simulations"
    stage = "simulate the default method"
    revision = 1
    command, title, page = "design", "Which mask to order", "report.html"
    caveats = (
        "Theory assumes textures on two planes half a sample of disparity apart, and noise, "
        "without occlusion. Differences of a tenth of a dB are below its accuracy.",
        "Frames are simulated by the Psi of the mask as printed, on the grid of the "
        "reconstruction; on a bench, calibration measures that Psi.",
    )

    def planned(self) -> list[Simulation]:
        """Return every camera before every scene."""
        return [Simulation(name, scene) for name in self.cameras for scene in self.scenes]

    def inputs(self, point: Simulation) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        return {
            "camera": self.cameras[point.camera].model_dump(mode="json"),
            "scene": point.scene,
            "size": self.size,
            "seed": self.seed,
            "method": DEFAULT_METHOD,
        }

    def measured(self, points: Sequence[Simulation]) -> Results:
        """Yield the PSNR of each point: frames by the printed mask's Psi, which is calibrated."""
        for point in points:
            camera = self.cameras[point.camera]
            truth = Capture(point.scene, camera, self.size, self.seed).scene_seen().light_field
            psi = printed_psi(camera, (truth.shape[2], truth.shape[3]), AS_DESIGNED)
            shots = camera.expose(truth, self.seed, psi)
            result = reconstruct(DEFAULT_METHOD, psi, shots)
            yield {"psnr_db": psnr_db(result.light_field, truth)}

    def label(self, point: Simulation) -> str:
        """Return a point in words."""
        return f"{point.camera}, {Path(point.scene).stem}"

    @property
    def compared(self) -> list[Simulated]:
        """Theory and simulation of every camera; the design is first."""
        return [
            Simulated(
                name,
                self.theory_db[name],
                {
                    Path(scene).stem: self.results[Simulation(name, scene)]["psnr_db"]
                    for scene in self.scenes
                },
            )
            for name in self.cameras
        ]

    @property
    def table(self) -> Table:
        """Theory and simulation in dB, a row a camera."""
        compared = self.compared
        rows = []
        for row in compared:
            figures = (row.expected_db, row.mean_db, *row.psnr_db.values())
            rows.append([row.name, *(f"{db:.2f}" for db in figures)])
        heads = ("Camera", "Theory", "Simulated, mean", *compared[0].psnr_db)
        return Table("", heads, rows)

    @property
    def verdict(self) -> str:
        """What the design gains on the best shipped camera, in words."""
        design, *shipped = self.compared
        if not shipped:
            return "no shipped camera of this sensor has as many shots to compare with."
        best = max(shipped, key=lambda camera: camera.mean_db)
        gain_db = design.mean_db - best.mean_db
        worth = "order it" if gain_db >= GOAL_DB else "a mask you have may do as well"
        return (
            f"simulated, {gain_db:+.2f} dB against {best.name}, the best shipped camera of this "
            f"sensor, light and number of shots: {worth}."
        )

    def unmeasured(self) -> list[str]:
        """Return a line for the mask's file, where it cannot be written."""
        needed = f'{GDSII} needs gdstk: pip install "emmc-rig[design]", run it again'
        return [] if can_write_gdsii() else [needed]

    def shown(self) -> Iterable[Table | str]:
        """Return the mask and what to expect of it, for a terminal."""
        best = self.found.expected
        loss_db = self.found.ideal_db - best.psnr_db
        yield self.found.winner.label
        yield (
            f"expected {best.psnr_db:.2f} dB, {best.light:.0%} of the light, Fresnel number "
            f"{best.fresnel:.2g}: diffraction loses {loss_db:.2f} dB"
        )
        yield self.table
        yield self.verdict

    def report(self, new: Path) -> Report:
        """Return the content of the files; the camera, its mask and the bench are written."""
        bench, found = self.settings, self.found
        winner = self.cameras[DESIGNED]
        cells = mask_cells(winner, bench)
        write_picture(cells, new / PICTURE)
        if can_write_gdsii():
            write_gdsii(cells, winner.masks[MASK].cell_um, new / GDSII)
        camera = with_picture(winner).model_dump(mode="json", exclude_defaults=True)
        write_text(new / CAMERA, yaml.safe_dump(camera, sort_keys=False))
        described = bench.model_dump(mode="json")
        text = yaml.safe_dump(described, sort_keys=False, default_flow_style=None)
        write_text(new / "bench.yaml", text)
        head = Head(
            found.winner.label,
            self.verdict,
            [
                "try it on a scene of your own: "
                f"`emmc-rig simulate --camera {typed(self.folder / CAMERA)} --scene PATH`",
                "to have it made, send the mask's GDSII file, which is beside that camera",
            ],
        )
        shots = f"{bench.shots} shot{'s' * (bench.shots > 1)}"
        masks = f"{len(found.tried)} masks tried by theory for {shots}"
        metrics = {
            "winner": asdict(found.winner),
            "expected": asdict(found.expected),
            "expected_without_diffraction_db": found.ideal_db,
            "manufacturing_db": {mask.candidate.label: dict(mask.psnr_db) for mask in found.held},
            "tried": [{**asdict(mask), **asdict(theory)} for mask, theory in found.tried],
            "simulated": [asdict(camera) for camera in self.compared],
            "settings": described,
        }
        return Report(
            head=head,
            about=[f"{masks}; {self.verdict}"],
            sections=[_section(found, self.table)],
            rows={},
            metrics=metrics,
            sources={"Scenes": ", ".join(self.scenes)},
        )


def _section(found: Search, simulated: Table) -> Section:
    """Return the search on the page. simulated: theory and simulation, a row a camera."""
    best = found.expected
    loss_db = found.ideal_db - best.psnr_db
    worst = f"{found.held[0].worst_db:.2f} with the maker's worst error"
    cards = (
        Card("Expected PSNR", f"{best.psnr_db:.2f} dB", worst),
        Card("Light", f"{best.light:.0%}", "of the open camera's"),
        Card("Fresnel number", f"{best.fresnel:.2g}", f"diffraction loses {loss_db:.2f} dB"),
    )
    tried = [
        [mask.label, f"{theory.psnr_db:.2f}", f"{theory.light:.0%}", f"{theory.fresnel:.2g}"]
        for mask, theory in found.tried[:SHOWN]
    ]
    errors = list(found.held[0].psnr_db)
    held = [
        [mask.candidate.label, *(number(mask.psnr_db[name], ".2f") for name in errors)]
        for mask in found.held
    ]
    body = fragment(
        "design.html",
        cards=cards,
        tried=(("Mask", "Expected PSNR, dB", "Light", "Fresnel number"), tried),
        held=(["Mask", *errors], held),
        simulated=(simulated.heads, simulated.rows),
    )
    return Section("design", found.winner.label, body, "Design")


def run_design(
    bench: DesignBench,
    scenes: Sequence[str],
    size: tuple[int, int] | None,
    seed: int,
    out: Path,
    watcher: Watcher,
) -> DesignStudy:
    """Choose a mask, compare it, and write page, camera and mask into a folder.

    Raises AppError for a folder that holds something else, and errors of scenes for wrong input.
    """
    started, scenes = time.perf_counter(), tuple(scenes) or SCENES
    check_scene_names(scenes)
    with study_folder(out, DesignStudy.journal, DesignStudy.command):
        found = search(bench, watcher)
    rivals = {
        name: _at_equal_light(camera, bench)
        for name, camera in shipped_like(bench).items()
        if buildable(camera, bench) and len(camera.shots) == bench.shots
    }
    cameras = {DESIGNED: found.winner.camera(bench), **rivals}
    watcher.begin("expected error of each camera, by theory", len(cameras))
    theory_db = {}
    for name, camera in cameras.items():
        psi = printed_psi(camera, SIZE, AS_DESIGNED)
        theory_db[name] = expected(camera, psi, bench.disparities_px).psnr_db
        watcher.step(name)
    study = DesignStudy(bench, out, found, cameras, theory_db, scenes, size or SIZE_PX, seed)
    study.started = started
    study.carry_out(watcher)
    return study


def _at_equal_light(camera: Camera, bench: DesignBench) -> Camera:
    """Return a camera with the bench's exposure and noise."""
    sensor = camera.sensor.model_copy(update={"noise": bench.sensor.noise})
    update = {"sensor": sensor, "total_exposure_s": bench.total_exposure_s}
    return camera.model_copy(update=update)
