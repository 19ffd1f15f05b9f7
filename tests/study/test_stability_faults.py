"""Faults: effect on readings and Psi, vanishing with the strength."""

import numpy as np
import pytest
from view_files import save_views

from emmc_rig.calibration.placement import designed_placement
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.simulators import changes
from emmc_rig.simulators.scenes import render
from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.stability.faults import FAULTS, Point, find_fault
from emmc_rig.study.stability.mask_faults import misplaced_psi
from emmc_rig.study.stability.scene_faults import flicker_gains
from emmc_rig.study.trial import Capture

SCENE, SIZE = "near-planar", (32, 40)
CAMERA = find_camera("rgbw-bayer-3shots")
MISPLACED = ("mask-shift", "mask-rotation", "mask-distance-error", "mask-scale", "edge-blur")
FAINT = {
    **dict.fromkeys(MISPLACED, 1e-4), "vignetting": 1e-4, "flicker": 1e-4, "scene-motion": 1e-4,
    "camera-motion": 1e-4, "specularity": 1e-3, "read-noise": 1e-3,
    "black-level": 1e-4, "gamma": 1e-4,
}  # fmt: skip


def made(name, strength, **more):
    chosen = {"scene": SCENE, "camera": CAMERA, "size": SIZE, **more}
    return Point(Capture(**chosen), name, strength).trial()


def spanned(trial):
    assert trial.disparity_px is not None
    return np.ptp(trial.disparity_px)


@pytest.fixture(scope="module")
def clean():
    return made("flicker", 0)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A scene of pictures, larger than what is reconstructed."""
    folder = tmp_path_factory.mktemp("shed")
    save_views(folder, render(SCENE, size=(48, 60)).light_field)
    return str(folder)


@pytest.mark.parametrize("fault", FAULTS.values(), ids=lambda fault: fault.name)
def test_a_sweep_goes_one_way(fault):
    for strengths in (fault.strengths, fault.quick):
        steps = np.diff(strengths)
        assert len(steps) >= 2
        assert (steps > 0).all() or (steps < 0).all()
    assert fault.explained.endswith(".")


@pytest.mark.parametrize("name", [f.name for f in FAULTS.values() if 0 in f.strengths])
def test_no_strength_is_no_fault(name, clean):
    none = made(name, 0)
    assert np.array_equal(none.readings, clean.readings)
    assert none.psi.checksum() == none.true_psi.checksum() == clean.psi.checksum()
    assert none.usable.all()
    assert np.array_equal(none.truth, clean.truth)


@pytest.mark.parametrize("name", FAINT)
def test_a_vanishing_fault_vanishes(name, clean):
    faint = made(name, FAINT[name])
    off = faint.readings - clean.readings
    assert np.abs(off).mean() < 1.5 * clean.noise_sigma
    assert abs(off.mean()) < 1e-3
    assert faint.psi.relative_difference(faint.true_psi) < 1e-3


@pytest.mark.parametrize("name", [*MISPLACED, "vignetting", "repeated-shot"])
def test_a_stronger_fault_moves_psi_further(name):
    errors = [
        trial.psi.relative_difference(trial.true_psi)
        for trial in (made(name, strength) for strength in FAULTS[name].quick)
    ]
    assert errors[0] == 0
    assert (np.diff(errors) > 0).all()


def test_the_method_is_given_the_design_and_the_readings_are_the_real_camera_s():
    trial = made("mask-shift", 2)
    design = build_imaging_matrix(CAMERA, SIZE)
    assert trial.psi.checksum() == design.checksum()
    real = np.abs(trial.readings - trial.true_psi.forward(trial.truth)).mean()
    assumed = np.abs(trial.readings - trial.psi.forward(trial.truth)).mean()
    assert real < 0.1 * assumed


def test_the_placement_of_a_camera_as_designed_is_its_psi():
    placed = misplaced_psi(Capture(SCENE, CAMERA, SIZE), designed_placement(CAMERA))
    assert placed.relative_difference(build_imaging_matrix(CAMERA, SIZE)) < 1e-3


def test_noise_follows_the_photons():
    trial = made("exposure", 300)
    clean = trial.psi.forward(trial.truth)
    noise = CAMERA.sensor.noise
    per_shot = 300 / len(CAMERA.shots)
    variance = clean.mean() / per_shot + (noise.read_noise_electrons**2 + 0.13) / per_shot**2
    assert np.std(trial.readings - clean) == pytest.approx(np.sqrt(variance), rel=0.1)
    assert trial.noise_sigma == pytest.approx(np.sqrt(variance), rel=0.1)


def test_read_noise_is_not_clipped_at_black():
    trial = made("read-noise", 3000)
    missed = trial.readings - trial.psi.forward(trial.truth)
    per_shot = 15_500 / len(CAMERA.shots)
    assert missed.std() == pytest.approx(3000 / per_shot, rel=0.05)
    assert abs(missed.mean()) < 3 * missed.std() / np.sqrt(missed.size)


@pytest.mark.parametrize("percent", [10, 60])
def test_so_many_readings_saturate(percent):
    trial = made("saturation", percent)
    assert 1 - trial.usable.mean() == pytest.approx(percent / 100, abs=0.02)
    brightest = trial.psi.forward(trial.truth)
    assert brightest[~trial.usable].mean() > brightest[trial.usable].mean()


def test_bad_pixels_are_bad_in_every_shot_and_known_only_when_masked(clean):
    silent, reported = made("bad-pixels", 20), made("masked-pixels", 20)
    assert silent.usable.all()
    bad = ~reported.usable[0]
    assert (reported.usable == reported.usable[0]).all()
    assert bad.mean() == pytest.approx(0.2, abs=0.03)
    off = np.abs(silent.readings - clean.readings).mean(axis=0)
    assert np.median(off[bad]) > 20 * np.median(off[~bad])


def test_the_black_level_is_off_by_a_share_of_the_mean_and_columns_are_dead(clean):
    offset = (made("black-level", 6).readings - clean.readings) / clean.readings.mean(axis=None)
    assert np.median(offset) == pytest.approx(0.06, rel=0.1)
    dead = made("dead-lines", 2).readings[:, :, 13:15]
    assert dead.max() < 0.1 * clean.readings[:, :, 13:15].mean()
    rest = made("dead-lines", 2).readings[:, :, 15:] - clean.readings[:, :, 15:]
    assert np.abs(rest).mean() < 2 * clean.noise_sigma


def test_readings_follow_a_power_of_the_light(clean):
    light = np.maximum(clean.psi.forward(clean.truth), 1e-6)
    bright = light > 0.2 * light.max()
    read = np.log(np.maximum(made("gamma", 20).readings, 1e-6))
    slope, _ = np.polyfit(np.log(light[bright]), read[bright], 1)
    assert slope == pytest.approx(0.8, rel=0.03)


def test_jpeg_of_a_lower_quality_is_further_off(clean):
    off = [
        np.sqrt(np.mean(np.square(made("jpeg", quality).readings - clean.readings)))
        for quality in (100, 85, 50)
    ]
    step = clean.readings.max() / 255
    assert off[0] < step
    assert off[2] > 1.5 * off[1] > 1.5 * 3 * step


def test_the_lamp_flickers_between_shots_alone(clean):
    trial = made("flicker", 30)
    gains = flicker_gains(3, 30, 0)
    assert gains.mean() == pytest.approx(1)
    assert np.std(np.log(gains)) == pytest.approx(0.3)
    ratio = trial.readings.mean(axis=(1, 2)) / clean.readings.mean(axis=(1, 2))
    assert ratio == pytest.approx(gains, rel=0.01)


def test_missing_shots_are_dark_and_repeated_ones_alike(clean):
    dark = made("missing-shot", 1)
    assert abs(dark.readings[2].mean()) < 1e-3
    assert np.abs(dark.readings[:2] - clean.readings[:2]).mean() < 0.01
    double = made("repeated-shot", 1)
    assert np.abs(double.readings[2] - double.readings[1]).mean() < 0.02
    assert np.abs(clean.readings[2] - clean.readings[1]).mean() > 0.1
    with pytest.raises(NotApplicableError, match="3 of 3 shots"):
        made("missing-shot", 3)


@pytest.mark.parametrize("name", ["scene-motion", "camera-motion"])
def test_the_first_shot_sees_the_truth_and_later_ones_do_not(name, clean):
    trial = made(name, 3)
    off = np.abs(trial.readings - clean.readings).mean(axis=(1, 2))
    assert off[0] < 0.005
    assert off[2] > off[1] > 2 * off[0]
    assert np.array_equal(trial.truth, clean.truth)


def test_a_measured_scene_moves_as_a_built_in_one_does(measured):
    still, turned = (made("camera-motion", px, scene=measured) for px in (0, 2))
    off = np.abs(turned.readings - still.readings).mean(axis=(1, 2))
    assert off[2] > off[1] > 3 * off[0]
    with pytest.raises(NotApplicableError, match="smaller size"):
        made("camera-motion", 8, scene=measured)


def test_a_moved_world_is_the_picture_moved():
    plain = render(SCENE, (1, 1), (48, 64)).light_field
    moved = render(
        SCENE, (1, 1), (48, 64), 0, lambda world: changes.moved(world, 4 / 64, 0, True)
    ).light_field
    assert np.abs(moved[..., 4:, :] - plain[..., :-4, :]).mean() < 2e-3


def test_the_background_stands_while_things_move():
    plain = render(SCENE, (1, 1), (48, 64)).light_field
    moved = render(SCENE, (1, 1), (48, 64), 0, lambda w: changes.moved(w, 0.02, 0)).light_field
    same = np.abs(moved - plain).max(axis=-1) < 1e-3
    assert 0.2 < same.mean() < 0.9


@pytest.mark.parametrize("px", [2, 8])
def test_disparities_span_what_is_asked(px):
    trial = made("disparity-range", px)
    assert spanned(trial) == pytest.approx(px, rel=0.05)


@pytest.mark.parametrize("percent", [20, 60])
def test_leaves_hide_the_share_asked_for(percent, clean):
    trial = made("occlusion", percent)
    hidden = (trial.disparity_px > clean.disparity_px.max() + 1e-3).mean()
    assert hidden == pytest.approx(percent / 100, abs=0.08)


def test_mirrors_show_other_things_in_every_view(clean):
    def spread(trial):
        return np.abs(trial.truth - trial.truth[2, 2]).mean()

    trial = made("specularity", 60)
    assert 0.5 < trial.truth.mean() / clean.truth.mean() < 1.5
    assert spread(trial) > 1.2 * spread(clean)


def test_contrast_fades_towards_the_mean_and_the_peak_with_it(clean):
    trial = made("contrast", 10)
    assert trial.truth.std(axis=(0, 1, 2, 3)) == pytest.approx(
        0.1 * clean.truth.std(axis=(0, 1, 2, 3)), rel=1e-3
    )
    assert trial.truth.mean() == pytest.approx(clean.truth.mean(), rel=1e-3)
    assert trial.peak == 0.1


@pytest.mark.parametrize("name", ["disparity-range", "occlusion", "specularity", "scene-motion"])
def test_a_measured_scene_is_not_made_up(name, measured):
    with pytest.raises(NotApplicableError, match="needs a built-in scene"):
        made(name, 2, scene=measured)


def test_what_a_camera_cannot_have_is_reported():
    with pytest.raises(NotApplicableError, match="one mask"):
        made("mask-shift", 1, camera=find_camera("coded-aperture-random"))


def test_equal_seeds_make_equal_trials():
    trial, same, other = (made("bad-pixels", 10, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(trial.readings, same.readings)
    assert not np.array_equal(trial.readings, other.readings)


def test_a_misspelt_fault_names_the_nearest():
    with pytest.raises(AppError, match="did you mean 'mask-shift'"):
        find_fault("maskshift")
