"""Psi is known as well as asked, and as well as it is stated, on simulated benches.

Every session is planned, captured by the sequencer from the simulated rig and calibrated as a real
one is; the truth is what the bench's own rays integrate to. One line runs it, from the repository:

    python benchmarks/calibration_checks.py psi hands few effects session cost drift streamed

It writes docs/results/calibration_checks.csv and .svg, and needs the extra `lab`. On the bench of
`--smallest` the limits do not hold: it shows that every check runs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import lab
import numpy as np
import pandas
from numpy.typing import NDArray
from simulated_calibration import (
    CalibrateSettings,
    calibrate_simulated,
    rig_to_calibrate,
    simulated_plan,
    stated_error,
    true_error,
    true_parameters,
    true_psi,
)

import emmc_rig as emmc
from emmc_rig.bench.hardware import Fitted
from emmc_rig.calibration.boards import channels_of
from emmc_rig.calibration.drift import DriftSettings, drifted, find_drift
from emmc_rig.calibration.frames import bands
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.parametric import psi_at, shot_stages
from emmc_rig.calibration.planning import Kind, PlannedFrames
from emmc_rig.calibration.routes import Outcome
from emmc_rig.calibration.shadow import Shadow, shadow_mask
from emmc_rig.calibration.whiteboard import LAMP_COLOURS, Calibration
from emmc_rig.captures.board_plan import BOARD_LEVEL, capture_plan, soft_design
from emmc_rig.captures.expand import expand
from emmc_rig.captures.plan import Checks, Plan, PlannedShot
from emmc_rig.demo import simulated_session
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.model.camera import psi_layout
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.methods import DEFAULT_METHOD
from emmc_rig.reconstruction.tv import TVSettings, reconstruct_tv
from emmc_rig.session.frame_file import NO_FIGURES, frame_entry, frame_file
from emmc_rig.session.measured_psi import scale_of
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.readings import session_frames, shot_readings
from emmc_rig.session.session import Frozen, Session
from emmc_rig.simulators.effects import APART, EFFECTS, ORDINARY, TOGETHER, Flaws, flawed
from emmc_rig.store.psi import StoredPsi
from emmc_rig.store.results import parse_size

Array = NDArray[np.floating]
CAMERA = "rgbw-bayer-1shot"
REAL_SCENES = ("dragons", "buttercup", "antinous")
BUILT_IN = ("deep-occlusions", "near-planar", "non-lambertian")
DRIFTS = {
    "shift of 0.5 px": (8.5, -8.5, 0.0, 0.0, 0.0),
    "rotation of 0.1 degrees": (0.0, 0.0, float(np.deg2rad(0.1)), 0.0, 0.0),
    "distance error of 2 %": (0.0, 0.0, 0.0, 0.0, 0.02),
    "all of them": (8.5, -8.5, float(np.deg2rad(0.1)), 0.0, 0.02),
}
"""In the order of `calibration.drift.KINDS`."""
COVERED, COVERED_TWICE, MARGIN = 0.683, 0.954, 0.03
"""Shares of a normal distribution within one and two deviations, and how far off is as asked."""
HANDS_UM, HANDS_COST = 100.0, 1.5
"""How far a hand puts a pinhole off its hole, and how much more Psi may then be off by."""
STATED_TRUE = 1.25
"""Times the stated error: what Psi may be off by."""
TRUE_ERROR, LARGEST_COST_DB, LARGEST_GIB, LEAST_RECOVERED = 0.01, 0.05, 4.0, 0.85
COMPARED_ROWS, FRAME_S, SEED, LEAST_LOST_DB = 32, 0.5, 0, 0.2
PROGRAM = """\
import atexit, time
from emmc_rig.cli import main
from emmc_rig.process.cost import peak_memory_mib
atexit.register(lambda: print(peak_memory_mib(), time.process_time()))
main()
"""
"""The command, which prints its peak memory, MiB, and CPU seconds last."""


TO_MEND = (ORDINARY, *(name for name in APART if name != "glare"))
"""Faults of pinholes and of a bench that drifts: `calibrate` names them, or refuses."""


@dataclass(frozen=True)
class Size:
    """How large a check is: rows and columns, rays per view and pixel, scenes, single effects.

    method: of the reconstruction from a session. search: of the drift.
    """

    pixels: tuple[int, int]
    rays: int
    scenes: int = 3
    drifts: tuple[str, ...] = tuple(DRIFTS)
    effects: tuple[str, ...] = (*(name for name in EFFECTS if name not in TO_MEND), TOGETHER)
    method: str = DEFAULT_METHOD
    search: DriftSettings | None = None
    views: tuple[int, int] = (5, 5)


FULL = {
    "psi": Size((192, 256), 512),
    "hands": Size((48, 64), 4096),
    "few": Size((96, 128), 4096),
    "effects": Size((48, 64), 1024),
    "session": Size((48, 64), 1024),
    "cost": Size((96, 128), 512),
    "drift": Size((96, 128), 512, scenes=2),
    "streamed": Size((4000, 6000), 0),
}
SEARCH = DriftSettings(blocks=24, coarse_blocks=16, disparity_px=0.5, disparity_steps=3, block_px=4)
SMALLEST = Size((24, 32), 128, 1, ("shift of 0.5 px",), ("lamp",), "tv", SEARCH, (3, 3))


@dataclass(frozen=True)
class Row:
    """One figure; limit: the most that is asked, or the least; None: nothing is asked of it."""

    what: str
    measured: float
    at_most: float | None = None
    at_least: float | None = None

    @property
    def met(self) -> bool:
        """Whether the figure is as asked."""
        high = np.inf if self.at_most is None else self.at_most
        low = -np.inf if self.at_least is None else self.at_least
        return low <= self.measured <= high


def covered(what: str, within: tuple[float, float]) -> list[Row]:
    """Return the rows of the shares of coefficients within one and two stated deviations."""
    asked = zip(("one deviation", "two"), within, (COVERED, COVERED_TWICE), strict=True)
    return [Row(f"{what}: within {n}", share, p + MARGIN, p - MARGIN) for n, share, p in asked]


def settings_for(size: Size, seed: int, **more: object) -> CalibrateSettings:
    """Return settings of a calibration of the one-shot camera."""
    camera = find_camera(CAMERA).model_copy(update={"views": size.views})
    given = {"rays": size.rays, "seed": seed, **more}
    return replace(CalibrateSettings(CAMERA, camera, size.pixels), **given)


def check_psi(size: Size, seed: int) -> Iterator[Row]:
    """All routes on a bench with a misplaced, dusty mask: error of Psi and of the geometry."""
    settings = settings_for(size, seed)
    found = calibrate_simulated(settings).found
    errors = found.metrics["psi_relative_error"]
    stated = found.metrics["psi_stated_error"]
    yield Row("Psi, parametric (dust not modelled)", errors["parametric"])
    yield Row("Psi, mixed", errors["mixed"], STATED_TRUE * stated["mixed"])
    yield Row("Psi, free", errors["free"], 0.02)
    yield Row("Psi, combined", errors["combined"], 0.005)
    yield Row("frames", found.metrics["frames"]["combined"])
    parametric = found.outcome.parametric
    assert parametric is not None
    at, truth = parametric.fit.placement, true_parameters(settings.flaws)
    distance = (1 + at.distance_share) / (1 + truth["distance_share"]) - 1
    off_um = at.offset_x_um - truth["offset_x_um"], at.offset_y_um - truth["offset_y_um"]
    yield Row("distance d, relative", abs(distance), 0.005)
    yield Row("shift, px", np.hypot(*off_um) / settings.camera.sensor.sample_pitch_um, 0.02)
    turn_rad = at.rotation_rad - truth["rotation_rad"]
    yield Row("rotation, degrees", abs(float(np.degrees(turn_rad))), 0.005)


def check_hands(size: Size, seed: int) -> Iterator[Row]:
    """The pinhole put on every hole by a hand, off by up to HANDS_UM, against by a stage."""
    by_stage = calibrate_simulated(settings_for(size, seed)).found.metrics
    fitted = Fitted(("mask_x", "mask_y"), hands_um=HANDS_UM)
    by_hand = calibrate_simulated(settings_for(size, seed, fitted=fitted)).found.metrics
    for route, error in by_hand["psi_relative_error"].items():
        yield Row(
            f"Psi by hand, {route}", error, HANDS_COST * by_stage["psi_relative_error"][route]
        )
        stated = by_hand["psi_stated_error"][route]
        yield Row(f"Psi by hand, {route}: true over stated", error / stated, STATED_TRUE)


def check_few(size: Size, seed: int) -> Iterator[Row]:
    """The fitted mask from about ten whiteboards: open ones, halves and corners of the aperture."""
    settings = settings_for(size, seed, few=True, target=0.005 if size.rays > 1000 else 0.02)
    boards = simulated_plan(settings).whiteboards
    assert boards is not None
    yield Row(
        "few: whiteboards", sum(board.repeats for board in boards.open if not board.validation), 12
    )
    yield from _error_rows("few", calibrate_simulated(settings).found.metrics, 0.005)


def check_effects(size: Size, seed: int) -> Iterator[Row]:
    """One more thing wrong with the bench at a time, and all at once."""
    for name in size.effects:
        settings = settings_for(size, seed, flaws=flawed(Flaws(), [ORDINARY, name]))
        yield from _error_rows(name, calibrate_simulated(settings).found.metrics, TRUE_ERROR)


def _error_rows(what: str, metrics: dict, limit: float) -> Iterator[Row]:
    chosen = metrics["chosen"]
    yield Row(f"{what}: true error of Psi", metrics["psi_relative_error"][chosen], limit)
    yield Row(f"{what}: stated error of Psi", metrics["psi_stated_error"][chosen])
    yield from covered(what, metrics["psi_coverage"][chosen])


def check_session(size: Size, seed: int) -> Iterator[Row]:
    """All effects together, before a scene: what Psi costs the default method against the truth."""
    settings = settings_for(size, seed, flaws=flawed(Flaws(), [TOGETHER]))
    camera = settings.camera
    fine = fine_scene(BUILT_IN[1], 2, 2, size=size.pixels, views=camera.views, seed=seed)
    rig, bench = rig_to_calibrate(settings, fine.samples)
    with simulated_session(simulated_plan(settings), camera, rig, Watcher()) as session:
        found, (_, seen) = emmc.calibrate(session), session_frames(session)
    true, known, good = true_psi(camera, rig, bench), found.calibration, found.outcome.good
    error, stated = true_error(known.psi, true, good), stated_error(known, good)
    yield Row("session: true error of Psi", error, min(STATED_TRUE * stated, TRUE_ERROR))
    exact = replace(known.psi, weights=true, colour=None)
    of_exact, of_known = (
        psnr_db(
            emmc.reconstruct(
                psi, seen.readings, size.method, noise_sigma=seen.noise_sigma, usable=seen.usable
            ).light_field,
            fine.scene.light_field,
        )
        for psi in (exact, known.psi)
    )
    yield Row("session: cost in PSNR, dB", of_exact - of_known, LARGEST_COST_DB)


def scenes(count: int) -> Sequence[str]:
    """Return names of scenes: REAL_SCENES of EMMC_LIGHTFIELDS if present, else BUILT_IN."""
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    real = [str(Path(folder) / name) for name in REAL_SCENES] if folder else []
    return (real if real and all(Path(folder).is_dir() for folder in real) else list(BUILT_IN))[
        :count
    ]


@dataclass(frozen=True, eq=False)
class Captured:
    """A scene captured on a bench, normalised by a calibration, and what it is compared with."""

    readings: Array
    variance: Array
    usable: NDArray[np.bool_]
    truth: Array

    def psnr(self, psi: Psi) -> float:
        """Return the PSNR of a reconstruction by total variation."""
        sigma = float(np.sqrt(self.variance[self.usable].mean()))
        result = reconstruct_tv(psi, even_frames(self.readings, sigma, self.usable), TVSettings())
        return psnr_db(result.light_field, self.truth)


def captured_scene(spec: str, settings: CalibrateSettings, known: Calibration) -> Captured:
    """Return the shots of a scene on the bench of the settings."""
    camera = settings.camera
    fine = fine_scene(spec, 1, 2, size=settings.size, views=camera.views)
    rig, _ = rig_to_calibrate(settings, fine.samples)
    shots = tuple(PlannedShot() for _ in camera.shots)
    checks = Checks(largest_saturated_share=1.0)
    plan = Plan(camera=settings.camera_name, shots=shots, whiteboards=None, checks=checks)
    with simulated_session(plan, camera, rig, Watcher()) as session:
        frames = shot_readings(session, scale_of(known, session))
    variance = np.square(frames.deviation)
    return Captured(frames.readings, variance, frames.usable, fine.scene.light_field)


@cache
def _fitted(size: Size, seed: int) -> tuple[Outcome, Psi]:
    """Return the calibration by the fitted mask, and the truth in the form of its Psi."""
    done = calibrate_simulated(settings_for(size, seed, route="mixed"))
    return done.found.outcome, _stored(done.true, done.found.psi)


def _stored(true: Array, psi: Psi) -> Psi:
    """Return true coefficients of three colours as the one colour that a Psi stores."""
    assert psi.colour is not None
    own = psi.colour[:, None, None, :, None, :].astype(np.int64)
    return replace(psi, weights=np.ascontiguousarray(np.take_along_axis(true, own, axis=4)))


def check_cost(size: Size, seed: int) -> Iterator[Row]:
    """What the measured Psi costs total variation, against the bench's own Psi."""
    settings = settings_for(size, seed)
    outcome, exact = _fitted(size, seed)
    known = outcome.calibration
    for spec in scenes(size.scenes):
        captured = captured_scene(spec, replace(settings, seed=seed + 1), known)
        cost_db = captured.psnr(exact) - captured.psnr(known.psi)
        yield Row(f"cost of the fitted mask, {Path(spec).name}, dB", cost_db, 0.3)


def moved(flaws: Flaws, drift: Array) -> Flaws:
    """Return a bench after a drift."""
    at = flaws.mounting
    (x, y), turn_deg = at.offset_um, float(np.degrees(drift[2]))
    mounting = replace(
        at,
        offset_um=(x + drift[0], y + drift[1]),
        rotation_deg=at.rotation_deg + turn_deg,
        distance_share=at.distance_share + drift[4],
    )
    return replace(flaws, mounting=mounting)


def check_drift(size: Size, seed: int) -> Iterator[Row]:
    """PSNR lost after a drift of the mask, and how much of it the blind correction recovers."""
    settings = settings_for(size, seed)
    outcome, _ = _fitted(size, seed)
    assert outcome.mixed is not None
    known, shadow, stages = outcome.calibration, outcome.mixed.shadow, shot_stages(settings.camera)
    colour, layout = known.psi.colour, known.psi
    for name in size.drifts:
        drift = np.array(DRIFTS[name])
        after = replace(settings, flaws=moved(settings.flaws, drift), seed=seed + 2)
        lost = gained = 0.0
        for spec in scenes(size.scenes):
            captured = captured_scene(spec, after, known)
            deviation = np.sqrt(captured.variance)
            taken = Frames(captured.readings, deviation, captured.usable)
            found = find_drift(taken, colour, shadow.mask, shadow.placement, stages, size.search)
            mismatched = captured.psnr(known.psi)
            oracle, blind = (
                captured.psnr(psi_at(Shadow(shadow.mask, at), layout, stages))
                for at in (drifted(shadow.placement, drift), found.placement)
            )
            yield Row(f"{name}, {Path(spec).name}: lost, dB", oracle - mismatched)
            lost, gained = lost + oracle - mismatched, gained + blind - mismatched
        if lost > LEAST_LOST_DB:
            yield Row(f"{name}: share recovered", gained / lost, at_least=LEAST_RECOVERED)


def check_streamed(size: Size, seed: int) -> Iterator[Row]:
    """`calibrate SESSION --method free` of one shot, measured in a process of its own."""
    settings = settings_for(size, seed)
    channels = channels_of(psi_layout(settings.camera, settings.size))
    with tempfile.TemporaryDirectory() as name:
        folder, out = Path(name) / "session", Path(name) / "out"
        shadow = draw_session(folder, settings, channels)
        command = ["calibrate", str(folder), "--method", "free", "--out", str(out)]
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, *command], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(f"emmc-rig {' '.join(command)} failed: {done.stderr.strip()[-500:]}")
        peak_gib, cpu_s = (float(word) for word in done.stdout.split()[-2:])
        error = _streamed_error(out / "psi.h5", shadow, channels)
    yield Row("streamed: peak memory, GiB", peak_gib / 2**10, LARGEST_GIB)
    yield Row("streamed: CPU time, s", cpu_s)
    yield Row("streamed: error of Psi", error, 0.02)


def _streamed_error(path: Path, shadow: Shadow, channels: NDArray[np.uint8]) -> float:
    """Return the relative error of a stored Psi over the middle rows."""
    first = channels.shape[0] // 4 * 2
    rows = slice(first, min(first + COMPARED_ROWS, channels.shape[0]))
    found = StoredPsi(path).window(rows, slice(None)).weights[0, :, :, :, 0]
    missed = total = 0.0
    for view in np.ndindex(shadow.mask.views):
        true = drawn(shadow, channels, rows, views_open(shadow.mask.views, view))
        missed += float(np.square(found[view] - true, dtype=np.float64).sum())
        total += float(np.square(true, dtype=np.float64).sum())
    return float(np.sqrt(missed / total))


def drawn(
    shadow: Shadow,
    channels: NDArray[np.uint8],
    rows: slice,
    opened: NDArray[np.bool_],
    stage_um: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float32]:
    """Return what some rows read of a white board, (y, x), by the model of the mask's shadow."""
    seen = channels[rows]
    pixels = np.moveaxis(np.mgrid[: seen.shape[0], : seen.shape[1]], 0, -1).reshape(-1, 2)
    read = shadow.readings(pixels + np.array([rows.start, 0]), seen.ravel(), opened, stage_um)
    return read.reshape(seen.shape).astype(np.float32)


def draw_session(folder: Path, settings: CalibrateSettings, channels: NDArray[np.uint8]) -> Shadow:
    """Write a session of every view as a mask off its design draws it; return that mask's shadow.

    Rays through 24 megapixels would take days: this check of memory and time inverts the model that
    made its data. With shot and read noise.
    """
    camera, noise = settings.camera, settings.camera.sensor.noise
    mask = shadow_mask(camera, settings.size)
    shadow = Shadow(mask, replace(soft_design(camera, mask), offset_x_um=14.0))
    views = [Kind((v, u)) for v, u in np.ndindex(camera.views)]
    plan = capture_plan(settings, PlannedFrames(dict.fromkeys(views, 1), 0.0))
    frames = expand(plan, camera, 0.0, 0.0)
    about = {"title": "drawn", "created": "", "command": "", "versions": {"emmc-rig": ""}}
    session = Session.create(folder, Frozen("", camera.model_dump(mode="json"), {}, frames), about)
    range_dn = noise.white_level_dn - noise.black_level_dn
    board_s = BOARD_LEVEL * range_dn / noise.gain_dn_per_electron / noise.electrons_per_s
    rng = np.random.default_rng(settings.seed)
    seconds, kept = 0.0, {}
    for planned in frames:
        if planned.kind == "shot":
            continue
        exposure_s = planned.exposure_s or board_s * planned.light
        seconds += exposure_s + FRAME_S
        # Open whiteboards are seen again and again, and the dearest to draw.
        key = planned.bench.lamp, planned.bench.masks_in, *planned.bench.offsets_um.items()
        reading = kept.get(key) if planned.view is None else None
        if reading is None:
            reading = _reading(planned, shadow, channels)
            if planned.view is None:
                kept[key] = reading
        electrons = reading * np.float32(noise.electrons_per_s * exposure_s)
        spread = np.sqrt(electrons + noise.read_noise_electrons**2)
        electrons += spread * rng.standard_normal(electrons.shape, dtype=np.float32)
        dn = noise.black_level_dn + noise.gain_dn_per_electron * electrons
        mosaic = np.clip(np.rint(dn), 0, noise.white_level_dn).astype(np.uint16)
        data = encode_dng(
            mosaic, camera.sensor.cfa_name, noise.black_level_dn, noise.white_level_dn, exposure_s
        )
        frame = decode_raw(data)
        entry = frame_entry(frame, exposure_s, 1.0, figures=NO_FIGURES)
        entry = entry.model_copy(update={"host_time_s": seconds})
        session.store(planned, frame_file(frame), lambda entry=entry: entry)
    return shadow


def _reading(planned: PlannedFrame, shadow: Shadow, channels: NDArray[np.uint8]) -> Array:
    """Return what pixels read of a whiteboard, (y, x)."""
    bench = planned.bench
    if bench.lamp == "off":
        return np.zeros(channels.shape, np.float32)
    if not bench.masks_in:
        lit = np.ones(channels.shape, bool)
        if bench.lamp in LAMP_COLOURS:
            lit = channels == LAMP_COLOURS.index(bench.lamp)
        return lit.astype(np.float32)
    stage_um = bench.offsets_um.get("mask_x", 0.0), bench.offsets_um.get("mask_y", 0.0)
    opened = views_open(shadow.mask.views, planned.view, planned.window)
    parts = [drawn(shadow, channels, rows, opened, stage_um) for rows in bands(channels)]
    return np.concatenate(parts)


CHECKS = {
    "psi": check_psi,
    "hands": check_hands,
    "few": check_few,
    "effects": check_effects,
    "session": check_session,
    "cost": check_cost,
    "drift": check_drift,
    "streamed": check_streamed,
}


def main() -> None:
    """Run the checks named, and write table and picture."""
    known = ", ".join(CHECKS)
    parser = argparse.ArgumentParser(description="Check the calibration on simulated benches.")
    parser.add_argument("checks", nargs="*", metavar="CHECK", help=f"some of {known}; default: all")
    parser.add_argument("--size", help="ROWSxCOLUMNS of all checks in place of their own")
    parser.add_argument("--rays", type=int, help="per view and pixel, in place of their own")
    parser.add_argument("--smallest", action="store_true", help="only whether every check runs")
    parser.add_argument("--out", type=Path, default=lab.RESULTS)
    given = parser.parse_args()
    if wrong := [name for name in given.checks if name not in CHECKS]:
        parser.error(f"no check {wrong[0]}: use some of {known}")
    rows = []
    for name in given.checks or CHECKS:
        size = SMALLEST if given.smallest else FULL[name]
        size = replace(
            size, pixels=parse_size(given.size) or size.pixels, rays=given.rays or size.rays
        )
        for row in CHECKS[name](size, SEED):
            met = row.met if (row.at_most, row.at_least) != (None, None) else None
            pixels = "x".join(map(str, size.pixels))
            rows.append({"check": name, **vars(row), "met": met, "size": pixels})
            print(f"{row.what}: {row.measured:.4g}{'' if met in (None, True) else ', MISSED'}")
    given.out.mkdir(parents=True, exist_ok=True)
    table = pandas.DataFrame(rows).assign(commit=lab.commit_of_code())
    table.to_csv(given.out / "calibration_checks.csv", index=False)
    asked = table[table.at_most.notna() & (table.at_most > 0)].set_index("what")
    axes = (asked.measured / asked.at_most).plot.barh(xlabel="measured / at most asked", ylabel="")
    lab.note_run(given.out, "calibration_checks")
    lab.finished(table, axes, "calibration_checks", given)


if __name__ == "__main__":
    main()
