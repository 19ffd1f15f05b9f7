"""Whiteboards as arrays to Psi, against the Psi that the simulated bench has and its BoardSet's."""

import inspect
import typing

import numpy as np
import pytest
from moved_mask import CAMERA
from whiteboard_bench import ORDINARY_BENCH, BenchTruth, Setting, WhiteboardBench

import emmc_rig as emmc
from emmc_rig.calibration.boards import BoardFrame, BoardSet
from emmc_rig.calibration.frames import average
from emmc_rig.calibration.routes import calibrate
from emmc_rig.model.camera import build_imaging_matrix, psi_layout
from emmc_rig.simulators.bench import MountingErrors

SIZE = (44, 60)
MOUNTING = MountingErrors((31.0, -22.0), 0.15, 1.002, 0.0008, 0.05, 1.0, 3.0)
POSES = [
    {"reference": True},
    {"mask_um": (0.0, 0.0)},
    {"mask_um": (270.0, 162.0)},
    *({"view": view} for view in ((1, 1), (0, 0), (2, 0), (0, 2), (2, 2))),
    {"mask_um": (0.0, 0.0), "validation": True},
    {"mask_um": (-207.0, 118.0), "validation": True},
]
REPEATS = 4
NOISE = CAMERA.sensor.noise


@pytest.fixture(scope="module")
def bench():
    truth = BenchTruth(MOUNTING, ORDINARY_BENCH.optics, ORDINARY_BENCH.sensor, rays_per_view=512)
    return WhiteboardBench(CAMERA, SIZE, truth)


@pytest.fixture(scope="module")
def taken(bench):
    """(whiteboards, poses, darks): arrays (repeat, y, x) and dicts."""

    def exposed(pose):
        setting = Setting(
            pinhole=pose.get("view"), stage_um=pose.get("mask_um", (0.0, 0.0)), repeats=REPEATS
        )
        exposure_s = bench.board_exposure_s() * (9 if setting.pinhole else 1)
        masks_in = not pose.get("reference", False)
        frames = [bench._exposed(setting, exposure_s, masks_in) for _ in range(REPEATS)]
        return np.stack(frames), {**pose, "exposure_s": exposure_s, "taken_s": bench.seconds}

    boards, poses = zip(*(exposed(pose) for pose in POSES), strict=True)
    darks = {
        t: np.stack([bench._exposed(Setting(lamp="off"), t, False) for _ in range(REPEATS)])
        for t in sorted({pose["exposure_s"] for pose in poses})
    }
    return list(boards), list(poses), darks


@pytest.fixture(scope="module")
def calibrated(taken):
    boards, poses, darks = taken
    return emmc.calibrate(boards, poses, CAMERA, darks=darks)


@pytest.mark.slow
def test_arrays_make_the_psi_of_the_bench(bench, calibrated):
    psi, report = calibrated.psi, calibrated
    exact = bench.exact_psi(build_imaging_matrix(CAMERA, SIZE))
    assert psi.relative_difference(exact) < 0.02
    assert build_imaging_matrix(CAMERA, SIZE).relative_difference(exact) > 0.1
    assert report.held_out_error < 0.02
    assert "validation error" in repr(report)


@pytest.mark.slow
def test_arrays_make_the_same_psi_as_the_board_sets_that_a_session_makes(taken, calibrated):
    boards, poses, darks = taken
    white = NOISE.white_level_dn

    def mean(frames, exposure_s, taken_s=0.0, lit=True):
        return average(frames, exposure_s, white, "", taken_s, lit)

    means = [mean(b, p["exposure_s"], p["taken_s"]) for b, p in zip(boards, poses, strict=True)]
    dark = tuple(mean(frames, t, lit=False) for t, frames in darks.items())
    every = BoardSet(dark, {(0, "white"): means[0]}, ())
    frames = [
        (BoardFrame.held(m, p.get("mask_um", (0.0, 0.0)), 0, p.get("view")), p)
        for m, p in list(zip(means, poses, strict=True))[1:]
    ]
    fitted = [frame for frame, pose in frames if not pose.get("validation")]
    fitted.sort(key=lambda item: item.pinhole is not None)
    held_out = every.with_frames([frame for frame, pose in frames if pose.get("validation")])
    layout = psi_layout(CAMERA, SIZE)
    few = every.with_frames(fitted)
    outcome = calibrate(CAMERA, layout, ("parametric", "mixed"), held_out, few)
    np.testing.assert_array_equal(calibrated.psi.weights, outcome.calibration.psi.weights)


@pytest.mark.slow
def test_what_the_bench_reads_of_a_scene_are_frames_by_the_report(bench, calibrated, tmp_path):
    psi, report = calibrated.psi, calibrated
    scene = emmc.scene("near-planar", size=SIZE, views=(3, 3))
    looking = WhiteboardBench(CAMERA, SIZE, bench.truth, seed=5, scene=scene.light_field)
    dn, exposures_s = looking.capture_scene()
    frames = report.frames(dn, exposures_s)
    off = (frames.readings - psi @ scene)[frames.usable]
    assert np.sqrt(np.mean(off**2)) < 3 * frames.noise_sigma + 0.01
    with pytest.raises(emmc.ERRORS, match="rows and columns are swapped"):
        report.frames(dn.swapaxes(1, 2))
    report.save(tmp_path / "psi")
    np.testing.assert_array_equal(emmc.Psi.load(tmp_path / "psi/psi.h5").weights, psi.weights)
    page = (tmp_path / "psi/report.html").read_text()
    assert (
        "emmc_rig.reconstruct(calibration.psi, calibration.frames(dn))" in page
        or report.outcome.advice
    )


BOARD = np.full((2, *SIZE), 30_000.0)
DARK = np.random.default_rng(0).normal(256, 2, (2, *SIZE))
GIVEN = {"whiteboards": [BOARD, BOARD], "poses": [{"reference": True}, {}], "darks": DARK}
MISTAKES = {
    "no camera": ({"camera": "rgbw-mono"}, "camera: got 'rgbw-mono'; it takes the camera"),
    "a pose too few": ({"poses": [{}]}, "2 whiteboards, and 1 poses: give one for each"),
    "a misspelt key": (
        {"poses": [{"reference": True}, {"mask_mm": (0, 0)}]},
        r"poses\[1\]: unknown key 'mask_mm': did you mean 'mask_um'",
    ),
    "no darks": ({"darks": None}, "darks: got None; it takes an array"),
    "no reference": ({"poses": [{}, {}]}, "a whiteboard without the mask"),
    "no validation": ({}, "they have no validation whiteboard"),
    "another size": ({"darks": DARK[:, :-2]}, r"whiteboards\[0\]: \(44, 60\) pixels, the darks"),
    "a hole": ({"whiteboards": [BOARD, BOARD * np.nan]}, r"whiteboards\[1\]: holds values that"),
    "a flat list": ({"whiteboards": [1, 2]}, r"whiteboards\[0\]: got 1; it takes DN"),
    "no list": ({"whiteboards": None}, "whiteboards: got None; it takes a list of arrays"),
    "poses in mm": (
        {"poses": [{"reference": True}, {"mask_um": (0.27, 0.162)}]},
        r"moves by 0.27 um at most, and its cells are [\d.]+ um wide: .* were these mm\?",
    ),
    "a place that is no number": (
        {"poses": [{"reference": True}, {"mask_um": (0, np.nan)}]},
        r"poses\[1\]: mask_um.1: ",
    ),
    "darks of two sizes": ({"darks": {1.0: DARK, 2.0: DARK[:, 1:]}}, "darks: of 2 sizes"),
    "darks by a name": ({"darks": {"1 s": DARK}}, "an exposure of darks: got '1 s'"),
    "a hole in the darks": ({"darks": DARK * np.inf}, "darks at 1: holds values that are not"),
    "a shot of none": (
        {"poses": [{"reference": True}, {"shot": 2}]},
        "shot 2, the camera has shots 0 to 0",
    ),
    "a view of none": (
        {"poses": [{"reference": True}, {"view": (3, 0)}]},
        r"view \(3, 0\), the camera has \(3, 3\) views from 0",
    ),
    "saturated": (
        {"whiteboards": [BOARD, np.full((2, *SIZE), 65535)]},
        r"whiteboards\[1\]: 100.0% of the pixels are saturated",
    ),
}


def test_what_arrays_and_sessions_do_not_take_is_refused():
    with pytest.raises(TypeError, match=r"whiteboards: got .*a session is given without poses"):
        emmc.calibrate("plan-session", "free")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="sensor: got True; it takes True with a session only"):
        emmc.calibrate([BOARD], [{}], CAMERA, darks=DARK, sensor=True)
    with pytest.raises(TypeError, match="poses: got None"):
        emmc.calibrate([BOARD], darks=DARK)
    with pytest.raises(emmc.ERRORS, match="method best: use one of auto, parametric"):
        emmc.calibrate(GIVEN["whiteboards"], GIVEN["poses"], CAMERA, darks=DARK, method="best")


def test_one_signature_says_what_calibrate_takes_and_returns():
    signature = inspect.signature(emmc.calibrate)
    names = ["whiteboards", "poses", "camera", "darks", "method", "sensor", "watcher"]
    assert list(signature.parameters) == names
    hints = typing.get_type_hints(emmc.calibrate)
    assert typing.Any not in hints.values()
    assert hints["return"].__name__ == "SessionCalibration"


@pytest.mark.parametrize("mistake", MISTAKES)
def test_whiteboards_that_do_not_fit_are_refused_in_one_line(mistake):
    given, words = MISTAKES[mistake]
    given = {"camera": CAMERA, **GIVEN, **given}
    with pytest.raises(emmc.ERRORS, match=words) as refused:
        emmc.calibrate(given["whiteboards"], given["poses"], given["camera"], darks=given["darks"])
    assert "\n" not in str(refused.value)
