"""How many shots scenes need, and what choosing them saves: sessions assessed after every shot.

A session with every planned shot of a scene is captured on the simulated rig, which traces rays.
The whiteboards of the first give Psi to all: the bench is the same. Shots are then chosen from it
as `emmc-rig capture --until` chooses them, and beside that taken in the plan's order; both are
compared with the truth after each shot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import TypeAdapter

from calibration.shadow import shadow_mask
from emmc_rig.acquisition.assessment import METHOD, Assessment, assessed
from emmc_rig.acquisition.command import CaptureRequest, FrontEnd, run_capture
from emmc_rig.acquisition.plan import Plan, PlannedShot, planned_camera
from emmc_rig.bench.rig_config import SIMULATED, ImagedRig, rig_description
from emmc_rig.errors import AppError
from emmc_rig.files.scenes import APERTURE_FACTOR, PIXEL_FACTOR, Scene, fine_scene
from emmc_rig.model.camera import Camera
from emmc_rig.model.lightfield import psnr_db, replicate_centre
from emmc_rig.processing.board_plan import capture_plan, parametric_plan, plan_light
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.progress import Watcher
from emmc_rig.session.lock import held
from emmc_rig.session.measured_psi import Scale, session_scale
from emmc_rig.session.readings import scaled_readings
from emmc_rig.session.session import Session
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures
from emmc_rig.study.sweep import Results, Sweep
from reconstruction.methods import reconstruct
from reconstruction.result import Reconstruction
from simulators.scenes import SCENES

ROWS, SESSIONS = "next_shots.jsonl", "sessions"
PLANNED, MOST = 6, 5
"""Shots to choose from, and to take at most."""
RAYS = 512


@dataclass(frozen=True)
class ShotRow:
    """After some shots: the PSNR that the deviation states, and that against the truth.

    foretold_db: what the shot that is chosen next is expected to gain; None where none is chosen.
    """

    shots: tuple[int, ...]
    stated_db: float
    psnr_db: float
    foretold_db: float | None = None

    @property
    def count(self) -> int:
        """How many shots."""
        return len(self.shots)


@dataclass(frozen=True)
class SceneRows:
    """A scene's rows by the shots chosen, and by shots in the plan's order, one shot more each."""

    scene: str
    chosen: tuple[ShotRow, ...]
    in_order: tuple[ShotRow, ...]
    copied_db: float
    """Of the true centre view, copied."""


@dataclass(frozen=True)
class Saving(Figures):
    """For a scene and a target: where `--until` stops, and how many shots in order reach it.

    stopped: the last row taken; reached: whether it states the target. fixed: shots in order until
    the truth is met to the target, None where `MOST` do not.
    """

    scene: str
    target_db: float
    stopped: ShotRow
    reached: bool
    fixed: int | None


def candidate_plan(camera_name: str, camera: Camera, size: tuple[int, int]) -> Plan:
    """Return a plan of PLANNED shots and the whiteboards that measure Psi of all of them.

    Every shot is exposed as the camera's first. Raises CameraError where the camera does not say
    how masks move on, CalibrationError where its mask cannot be fitted.
    """
    several = camera.with_shots(PLANNED)
    settings = CalibrateSettings(camera_name, several, size)
    mask = shadow_mask(several, size)
    light = plan_light(several, mask)
    plan = capture_plan(settings, parametric_plan(several, mask, light, settings.target))
    exposure_s = (float(camera.exposures_s()[0]),)
    shots = tuple(PlannedShot(exposure_s=exposure_s) for _ in several.shots)
    return plan.model_copy(update={"shots": shots})


def captured(plan: Plan, rig: ImagedRig, folder: Path) -> Session:
    """Return a session with every planned shot, begun or gone on with in a folder.

    Raises KeyboardInterrupt where Ctrl-C stopped it; it goes on the next time.
    """
    text = yaml.safe_dump(plan.model_dump(mode="json", exclude_defaults=True), sort_keys=False)
    described = rig_description(SIMULATED, rig)
    request = CaptureRequest(
        folder / "plan.yaml", plan, text, planned_camera(plan), folder, described
    )
    with held(folder):
        taken = run_capture(request, FrontEnd(ask=_nobody))
    assert taken is not None
    session, outcome = taken
    if not outcome.complete:
        raise KeyboardInterrupt
    return session


def _nobody(what: str) -> None:
    raise AppError(f"the study needs a person to {what}: use a rig that needs none")


def after(session: Session, scale: Scale, shots: Sequence[int]) -> tuple[Reconstruction, float]:
    """Return the light field that some of a session's shots give, and their readings' deviation."""
    taken = scaled_readings(session, scale, shots)
    sigma = taken.noise_sigma
    return reconstruct(METHOD, taken.psi, taken.readings, sigma, usable=taken.usable), sigma


def rows_of(
    session: Session,
    scale: Scale,
    truth: np.ndarray,
    scene: str,
    most: int,
    on_row: Callable[[str], None],
) -> SceneRows:
    """Return what a session's shots give, chosen and in order, up to `most` of them."""
    known: dict[tuple[int, ...], tuple[ShotRow, Assessment]] = {}

    def row(shots: tuple[int, ...]) -> tuple[ShotRow, Assessment]:
        if shots not in known:
            result, sigma = after(session, scale, shots)
            target_db = math.inf if len(shots) < most else 0.0
            found = assessed(scale.psi, result, shots, sigma, target_db)
            gain = None if found.next is None else found.expected_db[found.next] - found.stated_db
            achieved_db = psnr_db(result.light_field, truth)
            known[shots] = ShotRow(shots, found.stated_db, achieved_db, gain), found
            on_row(f"{scene}, {len(shots)} shots")
        return known[shots]

    def chosen() -> Iterator[ShotRow]:
        shots: tuple[int, ...] = (0,)
        while True:
            taken, found = row(shots)
            yield taken
            if found.next is None:
                return
            shots = (*shots, found.next)

    rows = tuple(chosen())
    in_order = tuple(row(tuple(range(count)))[0] for count in range(1, most + 1))
    return SceneRows(scene, rows, in_order, psnr_db(replicate_centre(truth), truth))


@dataclass
class ShotSweep(Sweep[str]):
    """Scenes, each with its planned shots; settings: the Plan.

    The first session captured gives Psi to all, as the bench is the same.
    """

    camera: Camera
    size: tuple[int, int]
    seed: int
    rays: int
    most: int
    scale: Scale | None = None
    journal = ROWS
    noun = "scenes"
    stage = "capture and judge"
    revision = 1

    def rig(self, scene: str) -> ImagedRig:
        """Return the simulated rig before a scene."""
        return ImagedRig(scene=scene, size=self.size, seed=self.seed, rays=self.rays)

    def seen(self, scene: str) -> Scene:
        """Return a scene as the truth has it."""
        return fine_scene(
            scene, APERTURE_FACTOR, PIXEL_FACTOR, size=self.size, views=self.camera.views,
            seed=self.seed,
        ).scene  # fmt: skip

    def inputs(self, point: str) -> dict[str, object]:
        """Return everything that a scene's rows depend on, as plain data."""
        return {
            "plan": self.settings.model_dump(mode="json"),
            "camera": self.camera.model_dump(mode="json"),
            "rig": self.rig(point).model_dump(mode="json"),
            "most": self.most,
            "method": METHOD,
            "sum": float(np.sum(self.seen(point).light_field, dtype=np.float64)),
        }

    def measured(self, points: Sequence[str], watcher: Watcher) -> Results:
        """Yield the rows of each scene, its shots captured by the simulated rig."""
        (self.folder / SESSIONS).mkdir(exist_ok=True)
        for point in points:
            scene = self.seen(point)
            watcher.begin(f"capture {scene.name}", None)
            place = self.folder / SESSIONS / f"{scene.name}-{self.digest(point)[:8]}"
            if self.scale is None:
                session = captured(self.settings, self.rig(point), place)
                self.scale = session_scale(session)
            else:
                shots_alone = self.settings.model_copy(update={"whiteboards": None})
                place = place.with_name(f"{place.name}-shots")
                session = captured(shots_alone, self.rig(point), place)
            watcher.begin(f"judge {scene.name}", None)
            truth = scene.light_field
            yield asdict(rows_of(session, self.scale, truth, scene.name, self.most, watcher.step))


def next_shots(
    scenes: Sequence[str],
    camera_name: str,
    camera: Camera,
    size: tuple[int, int],
    seed: int,
    folder: Path,
    watcher: Watcher,
    rays: int = RAYS,
    most: int = MOST,
) -> list[SceneRows]:
    """Return each scene's rows; those that the folder holds are not measured again.

    folder: see `emmc_rig.study.sweep.open_folder`. Raises what the layers below do.
    """
    plan = candidate_plan(camera_name, camera, size)
    results = ShotSweep(plan, folder, camera, size, seed, rays, most).run(scenes, watcher)
    return TypeAdapter(list[SceneRows]).validate_python(list(results.values()))


def savings(rows: SceneRows, targets_db: Sequence[float]) -> list[Saving]:
    """Return what choosing saves on a scene, for every target."""
    found = []
    for target_db in targets_db:
        stopped = next((row for row in rows.chosen if row.stated_db >= target_db), rows.chosen[-1])
        fixed = next((row.count for row in rows.in_order if row.psnr_db >= target_db), None)
        reached = stopped.stated_db >= target_db
        found.append(Saving(rows.scene, target_db, stopped, reached, fixed))
    return found


def total_savings(rows: Sequence[Saving]) -> Iterator[str]:
    """Yield, for every target, the shots that choosing saves against one number for all scenes."""
    for target_db in dict.fromkeys(row.target_db for row in rows):
        served = [
            (row, row.fixed)
            for row in rows
            if row.target_db == target_db and row.reached and row.fixed is not None
        ]
        if not served:
            yield f"{target_db:g} dB: no scene reaches it with the shots there are"
            continue
        taken = sum(row.stopped.count for row, _ in served)
        fixed = max(count for _, count in served)
        met = sum(row.stopped.psnr_db >= target_db for row, _ in served)
        yield (
            f"{target_db:g} dB: {taken} shots for {len(served)} scene(s), {met} of which meet it "
            f"in truth; {fixed * len(served)} with the fixed number that serves them all, {fixed}"
        )


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure how many shots scenes need for a PSNR, chosen or in order (`chart --next-shot`)."""
    size, targets_db = asked.size or (128, 160), sorted(asked.targets_db or [30.0])
    scenes = asked.scenes or list(SCENES)
    found = next_shots(scenes, asked.camera, asked.described, size, asked.seed, folder, show)
    rows = [one for scene in found for one in savings(scene, targets_db)]
    show.table(
        ("scene", "wanted, dB", "shots", "stated, dB", "in truth, dB", "fixed number"),
        [
            (
                one.scene,
                f"{one.target_db:g}",
                f"{one.stopped.count}{'' if one.reached else ', short'}",
                f"{one.stopped.stated_db:.2f}",
                f"{one.stopped.psnr_db:.2f}",
                "-" if one.fixed is None else str(one.fixed),
            )
            for one in rows
        ],
    )
    for line in total_savings(rows):
        show.line(line)
    return {
        "camera": asked.camera,
        "size": list(size),
        "seed": asked.seed,
        "rows": [row.as_dict() for row in rows],
        "scenes": [asdict(scene) for scene in found],
    }
