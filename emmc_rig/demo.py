"""The whole loop on the simulated rig: whiteboards -> Psi -> shots -> light field -> report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from emmc_rig.bench.hardware import Rig, simulated_rig
from emmc_rig.bench.rig_config import SIMULATED
from emmc_rig.calibration.whiteboard import Calibration, ideal_boards, lamps_needed, measure_psi
from emmc_rig.captures.plan import Boards, Checks, Darks, Plan, PlannedShot
from emmc_rig.captures.run import CaptureRequest, new_session, planned_frames
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.formats.scenes import APERTURE_FACTOR, PIXEL_FACTOR, fine_scene
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.process.result import Result
from emmc_rig.progress import Event, Watcher
from emmc_rig.reconstruction.dictionary import open_dictionary
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, MethodSettings, find_method
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.reconstruction.verdict.rules import Verdict
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.session.board_sets import decoded, whiteboards
from emmc_rig.session.measured_psi import scale_of
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.readings import shot_frames, shot_readings
from emmc_rig.session.session import Session
from emmc_rig.simulators.bench import Bench
from emmc_rig.simulators.scenes import SCENES
from emmc_rig.store.results import write_metrics

Array = NDArray[np.floating]
SIZE = (108, 144)
"""Of a built-in scene: a third of the samples of its own 192x256, for a first run of seconds."""


@dataclass(frozen=True)
class DemoSettings:
    """What to run: scene and camera with their names, size (rows, columns) or None, seed.

    method: see `reconstruction.methods`; dictionary: see `emmc_rig.reconstruction.dictionary`.
    exact_psi: reconstruct with the exact Psi too, which shows what calibration costs.
    out: the folder as typed; named in what to do next.
    """

    scene: str
    camera_name: str
    camera: Camera
    size: tuple[int, int] | None = None
    seed: int = 0
    method: str = DEFAULT_METHOD
    dictionary: str | None = None
    solver: MethodSettings = field(default_factory=MethodSettings)
    exact_psi: bool = False
    out: str = ""


@dataclass
class _Stages:
    """The seconds that each stage took, in order."""

    watcher: Watcher
    clock: Callable[[], float] = time.perf_counter
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str, steps: int | None = None) -> Iterator[None]:
        self.watcher.begin(name, steps)
        started = self.clock()
        yield
        self.seconds[name] = self.clock() - started


class FrameSteps(Watcher):
    """Shows a capture as steps of a stage: a step for each frame that passed its checks."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher = watcher

    def event(self, event: Event) -> None:
        """Count a frame."""
        if event.name == "frame.taken":
            self._watcher.step(event.facts["id"])


@contextmanager
def simulated_session(plan: Plan, camera: Camera, rig: Rig, watcher: Watcher) -> Iterator[Session]:
    """Yield the session that the sequencer captures on a rig; its folder is gone afterwards.

    camera: as planned. Raises AppError or a `DriverError`.
    """
    text = yaml.safe_dump(plan.model_dump(mode="json", exclude_defaults=True), sort_keys=False)
    with TemporaryDirectory(prefix="emmc-rig-") as name:
        folder = Path(name) / "session"
        request = CaptureRequest(folder, plan, text, camera, folder, {"kind": SIMULATED})
        session = new_session(request, planned_frames(request, rig))
        Sequencer(session, plan, rig, FrameSteps(watcher)).run()
        yield session


def place_rig(rig: Rig, frame: PlannedFrame) -> None:
    """Bring a simulated bench to how it stands for a frame."""
    bench = frame.bench
    rig.attendant.place(bench.target, bench.board_turn_deg)
    rig.attendant.fit_masks(bench.fitting, bench.masks_in)
    rig.set_lamp(bench.lamp)
    rig.stage.move_to_um({axis: rig.zero_um[axis] + um for axis, um in bench.offsets_um.items()})


def run_demo(settings: DemoSettings, folder: Path, watcher: Watcher | None = None) -> dict:
    """Run the demo into an existing folder and return its metrics.

    Writes light_field.h5, psi.h5, frames.h5, maps.h5, metrics.json and report.html. Raises the
    errors of the layers below, each one line.
    """
    watcher = watcher or Watcher()
    find_method(settings.method)
    stages = _Stages(watcher)
    camera = settings.camera
    with stages("scene"):
        fine = fine_scene(
            settings.scene,
            APERTURE_FACTOR,
            PIXEL_FACTOR,
            size=settings.size or (SIZE if settings.scene in SCENES else None),
            views=camera.views,
            seed=settings.seed,
        )
        truth = fine.scene.light_field
        if not camera.seen_tile()[..., 1:].any():  # light without colours is all that there is
            truth = np.repeat(truth.mean(axis=-1, keepdims=True), 3, axis=-1)
        size = (truth.shape[2], truth.shape[3])
    with stages("design"):
        design = build_imaging_matrix(camera, size)
        dictionary = None
        if find_method(settings.method).needs_dictionary:
            dictionary = open_dictionary(settings.dictionary, camera.views, camera.sensor.binning)
        rig, bench = simulated_rig(camera, fine.samples, size, settings.seed)
    plan = demo_plan(settings)
    frames = planned_frames(CaptureRequest(Path(), plan, "", camera, Path(), {}), rig)
    shown = ExitStack()
    with stages("capture", len(frames)):
        session = shown.enter_context(simulated_session(plan, camera, rig, watcher))
    with shown, stages("psi"):
        measured = _measured(session, rig, bench, design)
    calibration, taken = measured.calibration, measured.taken

    def light_field(psi: Psi) -> tuple[Reconstruction, Verdict]:
        return reconstruct_judged(
            settings.method, psi, taken, dictionary, settings.solver,
            lambda p: watcher.step(_progress_words(p)),
        )  # fmt: skip

    with stages("reconstruct"):
        kind = None if dictionary is None else dictionary.kind
        solved = light_field(calibration.psi)
        result = Result(*solved, calibration.psi, taken, kind, settings.solver)
    exact_psnr = None
    if settings.exact_psi:
        with stages("exact Psi, for comparison"):
            compared, _ = light_field(measured.exact_psi)
            exact_psnr = psnr_db(compared.light_field, truth)
    with stages("evaluate"):
        psnr = psnr_db(result.light_field, truth)
        metrics = {
            **result.metrics(),
            "scene": settings.scene,
            "scene_provenance": fine.scene.provenance,
            "finer": [fine.aperture_factor, fine.pixel_factor],
            "camera": settings.camera_name,
            **result.compare(truth),
            "psi_relative_error": calibration.psi.relative_difference(measured.exact_psi),
            "design_relative_error": design.relative_difference(measured.exact_psi),
            "psi_mean_deviation": float(calibration.deviation.mean()),
            "exact_psi_psnr_db": exact_psnr,
            "calibration_cost_db": None if exact_psnr is None else exact_psnr - psnr,
            "saturated_share": float(1 - taken.usable.mean()),
            "whiteboard_frames": len(frames) - design.shots,
            "seed": settings.seed,
            "warnings": camera.warnings(),
        }
    with stages("write"):
        metrics["seconds"] = dict(stages.seconds)
        result.write(
            folder, metrics, frames_dn=measured.frames_dn, exposures_s=measured.exposures_s
        )
        calibration.psi.save(folder / "psi.h5")
        result.draw(
            folder, metrics, truth, settings.out,
            title=f"{settings.scene} through {settings.camera_name}",
            whiteboards=measured.pictures, stage_s=metrics["seconds"],
        )  # fmt: skip
    metrics["seconds"] = dict(stages.seconds)
    write_metrics(folder, metrics)
    return metrics


class _Measured(NamedTuple):
    """What a demo's session measured.

    exact_psi: by whiteboards without noise. taken: the readings of the shots. frames_dn: (shot,
    pixel_y, pixel_x), exposures_s: (shot,). pictures: names of three whiteboards, and the boards
    less the dark frame, 1 for white.
    """

    calibration: Calibration
    exact_psi: Psi
    taken: Frames
    frames_dn: NDArray[np.integer]
    exposures_s: Array
    pictures: list[tuple[str, Array]]


def _measured(session: Session, rig: Rig, bench: Bench, design: Psi) -> _Measured:
    """Return Psi and the readings of the shots of a complete session."""
    boards = whiteboards(session)
    calibration = measure_psi(boards, design)
    chosen = [boards.frames[i] for i in (0, len(boards.frames) // 2, -1)]
    shown = [board.frame.mean_dn - calibration.dark_dn for board in chosen]
    peak = max(float(np.percentile(picture, 99.9)) for picture in shown)
    pictures = [(board.name, dn / peak) for board, dn in zip(chosen, shown, strict=True)]
    white = _noise_free_white(session, rig, bench)
    ideal = ideal_boards(_noise_free(session, rig, bench), lamps_needed(design), design, white)
    taken = shot_readings(session, scale_of(calibration, session))
    of_shots = [frames[0] for frames in shot_frames(session).values()]
    frames_dn = np.stack([raw.mosaic for raw in decoded(session, of_shots)])
    exposures_s = np.array([exposure.exposures_s[0] for exposure in taken.exposures])
    exact_psi = measure_psi(ideal, design).psi
    return _Measured(calibration, exact_psi, taken, frames_dn, exposures_s, pictures)


def demo_plan(settings: DemoSettings) -> Plan:
    """Return the plan of a demo: the pinhole before every view of every shot, then the shots."""
    return Plan(
        title="demo",
        camera=settings.camera_name,
        shots=tuple(PlannedShot() for _ in settings.camera.shots),
        whiteboards=Boards(repeats=1),
        darks=Darks(),
        # The scene is exposed as its camera says, whatever that saturates.
        checks=Checks(largest_saturated_share=1.0, smallest_signal=0.0),
    )


def _noise_free(session: Session, rig: Rig, bench: Bench) -> dict[tuple[int, int, int, str], Array]:
    """Return what pixels read through the pinhole without noise, by shot, view and lamp."""
    seen = {}
    for frame in session.frames:
        if frame.view is not None and frame.repeat == 0:
            place_rig(rig, frame)
            seen[frame.bench.shot, *frame.view, frame.bench.lamp] = bench.readings()
    return seen


def _noise_free_white(session: Session, rig: Rig, bench: Bench) -> Array:
    """Return what pixels read of the white board through the open aperture, without masks."""
    reference = next(frame for frame in session.frames if frame.kind == "reference")
    place_rig(rig, replace(reference, bench=replace(reference.bench, lamp="white")))
    return bench.readings()


def _progress_words(progress: Progress) -> str:
    if progress.relative_change is None:
        return f"{progress.step} of {progress.total} patches"
    return f"change {progress.relative_change:.1e}"
