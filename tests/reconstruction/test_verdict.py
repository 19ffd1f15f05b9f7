"""Verdicts: their figures against theory, and that faults are named with reason and remedy."""

import dataclasses
import itertools
import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

import emmc_rig as emmc
from emmc_rig.cli import app
from emmc_rig.commands.simulate import simulate_into
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings, fast
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.result import Reconstruction, Status
from emmc_rig.reconstruction.screening import screened
from emmc_rig.reconstruction.tv import TVSettings, reconstruct_tv
from emmc_rig.reconstruction.verdict.blocks import JudgedBlock, judged_together
from emmc_rig.reconstruction.verdict.displaced import _tiled, displaced
from emmc_rig.reconstruction.verdict.evidence import Evidence, FittedFrames, gathered
from emmc_rig.reconstruction.verdict.kept import (
    compare_held_out,
    kept_readings,
    missed_readings,
    over_baselines,
)
from emmc_rig.reconstruction.verdict.readings import blockiness, pixel_figures, quantised
from emmc_rig.reconstruction.verdict.rules import CONSISTENT, LEVELS, verdict_from
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.reconstruction.verdict.shadow import (
    Relief,
    cross_strength,
    measured_relief,
    shadow,
    tile_edges,
)
from emmc_rig.reconstruction.verdict.shots import _differences, _differing, brightness, motion
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.trial import Capture, trial_of

SIZE = (48, 64)
SCREENED = ("flicker", "repeated-shot", "missing-shot", "bad-pixels")
"""What screening mends before verdicts see it; without it they must tell."""
QUICK = MethodSettings(tv=TVSettings(max_steps=20))


@pytest.fixture(scope="module")
def three():
    return build_imaging_matrix(find_camera("rgbw-bayer-3shots"), SIZE)


def everywhere(psi):
    return np.ones(psi.frames_shape, dtype=bool)


def grey(psi, value=0.5):
    return psi.forward(np.full(psi.light_field_shape, value, np.float32))


def judged(psi, frames, method="tv", noise=0.003, usable=None):
    """Return the result and the verdict of readings of one deviation, in few steps."""
    return reconstruct_judged(method, psi, even_frames(frames, noise, usable), settings=QUICK)


def noise_of(psi, seed=0):
    return 0.003 * np.random.default_rng(seed).standard_normal(psi.frames_shape, np.float32)


def relief_in(psi, frames, sigma=1e-4, usable=None):
    return measured_relief(psi, frames, sigma, everywhere(psi) if usable is None else usable)


def evidence_of(psi):
    """Return the evidence of an even scene without a fault."""
    even = np.full(psi.light_field_shape, 0.5, np.float32)
    result = Reconstruction("tv", even, Status.CONVERGED, "", 1, (), 0.0, {})
    frames = even_frames(grey(psi), 1e-3, everywhere(psi))
    kept = kept_readings(psi, frames.usable)
    return gathered(psi, FittedFrames(frames, kept, np.zeros(psi.frames_shape)), result)


@pytest.fixture(scope="module")
def clean(three):
    """Evidence without a fault, as of a scene with depth."""
    return dataclasses.replace(evidence_of(three), parallax=0.05, stated=0.03)


def test_masks_of_an_even_scene_show_at_their_full_strength(three):
    found = shadow(relief_in(three, grey(three)))
    np.testing.assert_allclose(found.strength, 1, atol=0.01)
    assert found.relief > 0.3


def test_a_few_bright_spots_do_not_make_the_masks_seem_weak(three):
    scene = np.full(three.light_field_shape, 0.05, np.float32)
    scene[:, :, 4::7, 5::9] = 0.9
    seen = shadow(relief_in(three, three.forward(scene)))
    np.testing.assert_allclose(seen.strength, 1, atol=0.03)


def test_masks_half_as_strong_show_at_half_strength(three):
    even = relief_in(three, grey(three))
    halved = even.level * (1 + 0.5 * even.masks)
    # The smooth picture follows what is left, by a little.
    np.testing.assert_allclose(shadow(relief_in(three, halved)).strength, 0.53, atol=0.06)


def test_tiles_are_regressed_as_by_least_squares_of_each():
    rng = np.random.default_rng(0)
    shape = (2, 50, 80)
    masks, read, seen, shift_y, shift_x = rng.normal(size=(5, *shape)).astype(np.float32)
    weight = (rng.random(shape) * (rng.random(shape) < 0.8)).astype(np.float32)
    weight[:, :25, :27] = 0
    good, level = weight > 0, np.ones(shape, np.float32)
    found = Relief(level, masks, read, seen, good, weight, np.ones((50, 80, 3)))
    tiled = _tiled(found, shift_y, shift_x)
    rows, columns = (tile_edges(length) for length in shape[1:])
    values, deviations = [], []
    for (top, bottom), (left, right) in itertools.product(
        itertools.pairwise(rows), itertools.pairwise(columns)
    ):
        tile = (slice(None), slice(top, bottom), slice(left, right))
        w = weight[tile].ravel().astype(np.float64)
        if not w.any():
            continue
        terms = np.stack([term[tile].ravel() for term in (masks, shift_y, shift_x)], axis=1)
        root = np.sqrt(w)[:, None]
        values.append(np.linalg.lstsq(root * terms, root[:, 0] * seen[tile].ravel())[0])
        scores = terms * (w * (seen[tile].ravel() - terms @ values[-1]))[:, None]
        inverse = np.linalg.inv(terms.T @ (w[:, None] * terms))
        deviations.append(np.sqrt(np.diag(inverse @ scores.T @ scores @ inverse)))
    assert len(values) == (len(rows) - 1) * (len(columns) - 1) - 1
    assert tiled is not None
    np.testing.assert_allclose(tiled.values, values, rtol=1e-5)
    np.testing.assert_allclose(tiled.deviations, deviations, rtol=1e-5)


def test_an_even_scene_behind_a_displaced_mask_shows_the_displacement():
    camera = find_camera("rgbw-bayer-1shot")
    moved = camera.model_copy(
        update={"shots": (camera.shots[0].model_copy(update={"offset_um": {"mask": (2.4, -4.8)}}),)}
    )
    psi, true = build_imaging_matrix(camera, SIZE), build_imaging_matrix(moved, SIZE)
    found = displaced(psi, relief_in(psi, grey(true)))
    still = displaced(psi, relief_in(psi, grey(psi)))
    assert still.size_px is not None
    # Samples of 24 um.
    assert found.size_px == pytest.approx(np.hypot(0.2, 0.1), abs=0.03)
    assert still.size_px < 0.02


def test_what_derivatives_elsewhere_would_show_as_well_is_no_displacement():
    """One monochrome shot: the picture's colours are wrong, which looks like a displaced mask."""
    camera, size = find_camera("scenario-iii-mono"), (96, 128)
    moved = camera.model_copy(
        update={"shots": (camera.shots[0].model_copy(update={"offset_um": {"mask": (0, 24.0)}}),)}
    )
    psi, true = build_imaging_matrix(camera, size), build_imaging_matrix(moved, size)
    scene = np.asarray(open_scene("deep-occlusions", size=size))
    sizes = []
    for frames in (psi.forward(scene), true.forward(scene)):
        found = displaced(psi, relief_in(psi, frames))
        assert found.size_px is not None
        sizes.append(found.size_px)
    assert sizes[0] < 0.22
    assert sizes[1] > 0.8


def test_a_psi_without_its_camera_gives_no_displacement(three):
    bare = Psi(three.weights, three.colour, three.binning)
    assert displaced(bare, relief_in(bare, grey(bare))).size_px is None


def spoilt(frames, fault, size):
    """Return frames with a fault of the readings; numpy and a JPEG coder alone."""
    if fault == "offset":
        return frames + size * frames.mean()
    if fault == "gamma":
        return frames.max() * (frames / frames.max()) ** (1 + size)
    assert fault == "jpeg"
    peak = frames.max()
    codes = np.clip(frames / peak * 255, 0, 255).round().astype(np.uint8)
    packed = [cv2.imencode(".jpg", code, [cv2.IMWRITE_JPEG_QUALITY, size])[1] for code in codes]
    read = [cv2.imdecode(item, cv2.IMREAD_GRAYSCALE) for item in packed]
    return np.asarray(read, np.float32) / 255 * peak


@pytest.fixture(scope="module")
def one_shot():
    """Psi of one shot and its readings of a scene, with noise and without a fault."""
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), SIZE)
    frames = psi.forward(np.asarray(open_scene("near-planar", size=SIZE)))
    return psi, np.maximum(frames + noise_of(psi), 1e-3)


@pytest.mark.parametrize(
    ("fault", "size", "found"),
    [
        # Over the mean reading, in which the offset is.
        ("offset", 0.06, 0.06 / 1.06),
        ("offset", -0.06, -0.06 / 0.94),
        ("gamma", -0.1, -0.1),
        ("gamma", 0.2, 0.2),
    ],
)
def test_the_cause_that_explains_most_is_the_one_at_work_and_has_its_size(
    one_shot, fault, size, found
):
    psi, frames = one_shot
    changes = displaced(psi, relief_in(psi, spoilt(frames, fault, size))).changes
    # Contrast names no cause: in a small frame it explains as much as an offset.
    likely = max(set(changes) - {"contrast"}, key=lambda name: changes[name].gain)
    assert likely == fault
    assert changes[fault].value == pytest.approx(found, rel=0.2)
    clean = displaced(psi, relief_in(psi, frames)).changes
    assert abs(clean[fault].value) < 3 * clean[fault].deviation + 0.005


@pytest.mark.parametrize("blur_px", [0.6, 0.9])
def test_a_blur_is_measured_by_a_psi_without_its_camera(blur_px):
    camera = find_camera("rgbw-mono")
    psi = dataclasses.replace(build_imaging_matrix(camera, SIZE), camera_json="")
    blurred = gaussian_filter(psi.weights, (0, 0, 0, blur_px, 0, blur_px))
    true = dataclasses.replace(psi, weights=blurred)
    scene = np.asarray(open_scene("near-planar", size=SIZE))
    changes = displaced(psi, relief_in(psi, true.forward(scene))).changes
    assert max(changes, key=lambda name: changes[name].gain) == "blur"
    assert changes["blur"].value ** 0.5 == pytest.approx(blur_px, rel=0.12)


def test_jpeg_is_seen_by_its_blocks_and_coarse_steps_by_their_repetition(one_shot):
    _, frames = one_shot

    def blocky(read):
        return blockiness(read, np.ones(read.shape, bool)) or 0.0

    usable = np.ones(frames.shape, bool)
    assert 0 < blocky(frames) < 0.1
    assert blocky(spoilt(frames, "jpeg", 85)) > 0.44
    # The blocks of a cut frame begin elsewhere.
    assert blocky(spoilt(frames, "jpeg", 70)[:, 3:, 5:]) > 0.44
    assert blockiness(frames[:, :16, :24], usable[:, :16, :24]) is None
    assert quantised(frames, usable) is None
    assert quantised(np.round(frames / 0.05) * 0.05, usable) == pytest.approx(0.05)


def test_shots_tell_their_brightness_and_whose_masks_they_show(three):
    gains = np.array([1.1, 0.9, 1.0])
    found = brightness(relief_in(three, grey(three) * gains[:, None, None]))
    np.testing.assert_allclose(found, gains, atol=0.01)
    swapped = cross_strength(relief_in(three, grey(three)[[0, 2, 1]]))
    assert swapped.argmax(axis=1).tolist() == [0, 2, 1]


def test_holes_are_measured_and_placed(three):
    usable = everywhere(three)
    usable[:, 20:31, 40:51] = False
    frames = grey(three)
    found = pixel_figures(frames, relief_in(three, frames, usable=usable), usable)
    assert found["unusable"] == pytest.approx(121 / np.prod(SIZE))
    # The middle of 11 pixels lies 6 from the nearest that is seen; the outermost ring but 1.
    assert found["hole_px"] == pytest.approx(6, abs=0.5)
    assert found["hole_at"] == (25, 45)
    assert found["blind"] == pytest.approx(81 / np.prod(SIZE), rel=0.05)
    # The excluded pixels read no more than the others: none is saturated.
    assert found["saturated"] < 0.01
    frames[~usable] = 1
    assert pixel_figures(frames, relief_in(three, frames, usable=usable), usable)[
        "saturated"
    ] == pytest.approx(121 / np.prod(SIZE))


def test_readings_kept_tell_what_is_explained_and_what_is_noise(three):
    rng = np.random.default_rng(0)
    truth = np.clip(0.5 + 0.2 * rng.normal(size=three.light_field_shape), 0, 1).astype(np.float32)
    sigma = 0.01
    clean = three.forward(truth)
    frames = (clean + sigma * rng.normal(size=clean.shape)).astype(np.float32)
    kept = rng.random(clean.shape) < 0.3
    smooth = relief_in(three, frames, sigma)
    found = compare_held_out(frames, frames - clean, sigma, kept, smooth)
    assert found["kept"] == kept.sum()
    assert found["noise_share"] == pytest.approx(1, abs=0.1)
    assert found["explained"] == pytest.approx(1, abs=0.1)
    off = compare_held_out(frames, frames - 0.9 * clean, sigma, kept, smooth)
    expected = sigma**2 / np.mean(np.square(frames - 0.9 * clean)[kept])
    assert off["noise_share"] == pytest.approx(expected, rel=0.05)
    few = np.zeros_like(kept)
    few[0, 0, :5] = True
    assert compare_held_out(frames, frames - clean, sigma, few, smooth)["explained"] is None


def test_readings_are_missed_where_the_light_field_is_wrong_and_nowhere_else():
    psi = emmc.camera("rgbw-bayer-1shot").psi(SIZE)
    rng = np.random.default_rng(3)
    light_field = rng.uniform(0.3, 0.6, psi.light_field_shape).astype(np.float32)
    readings = psi.forward(light_field)
    noise = 0.01
    noisy = (readings + rng.normal(0, noise, readings.shape)).astype(np.float32)
    usable = np.ones(readings.shape, bool)
    right = missed_readings(psi, light_field, noisy, noise, usable)
    assert right.shape == SIZE
    # 81 readings: the root mean square of normal values is within 5 sqrt(1 / 162) of 1.
    assert np.abs(right - 1)[4:-4, 4:-4].max() < 5 * np.sqrt(1 / 162)
    wrong = light_field.copy()
    wrong[:, :, 20:30, 30:40] += 0.2
    missed = missed_readings(psi, wrong, noisy, noise, usable)
    assert missed[22:28, 32:38].min() > 3
    np.testing.assert_array_equal(missed[:, :20], right[:, :20])
    unknown = missed_readings(psi, wrong, noisy, noise, np.zeros_like(usable))
    np.testing.assert_array_equal(unknown, 1)  # without a usable reading


def test_few_readings_are_kept_and_the_same_each_time(three):
    usable = everywhere(three)
    usable[0, :20] = False
    kept = kept_readings(three, usable)
    # 150 of 7,936: a larger share of a small capture.
    assert 0.012 < kept.sum() / usable.sum() < 0.025
    assert not kept[~usable].any()
    np.testing.assert_array_equal(kept, kept_readings(three, usable))


def judged_trial(
    fault, strength, camera="rgbw-bayer-3shots", scene="deep-occlusions", seed=0, screening=True
):
    given = Point(Capture(scene, camera, SIZE, seed, 3), fault, strength).trial()
    settings = QUICK.model_copy(update={"screening": screening})
    _, verdict = reconstruct_judged("tv", given.psi, given.frames, None, settings)
    return verdict


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "strength", "reason"),
    [
        ("mask-shift", 0.5, "shadow is about"),
        ("mask-shift", 4, "as with other masks"),
        ("edge-blur", 0.75, "blurred"),
        ("edge-blur", 2, "blurred by about 2 pixels"),
        ("mask-distance-error", 200, "further from"),
        ("mask-rotation", 8, "turned by about +8 degrees from x to y"),
        ("mask-scale", 10, "cells are about 10.0% larger"),
        ("vignetting", 80, "outermost rays"),
        ("flicker", 20, "brightness"),
        ("repeated-shot", 1, "shot 3 shows the masks of shot 2"),
        ("missing-shot", 1, "shot 3 is dark"),
        ("camera-motion", 2, " saw "),
        ("saturation", 60, "saturated"),
        ("masked-pixels", 90, "largest hole"),
        ("exposure", 50, "noise"),
    ],
)
def test_a_fault_is_reported_with_its_reason_and_a_remedy(fault, strength, reason):
    verdict = judged_trial(fault, strength, screening=fault not in SCREENED)
    assert verdict.level != "trust"
    reported = [item for item in verdict.reasons if reason in item.what]
    assert reported, verdict.words
    assert reported[0].remedy


@pytest.mark.parametrize("share", [0.7, 0.9])
def test_a_shot_under_another_light_takes_the_level_of_the_others(three, share):
    scene = np.asarray(open_scene("near-planar", size=SIZE)).astype(np.float32)
    frames = three.forward(scene)
    frames[1] *= share
    result, verdict = judged(three, frames + noise_of(three))
    # Nothing is left open, and the result's notes say what was done.
    assert not any("brightness" in reason.what for reason in verdict.reasons)
    assert any("brightness" in note for note in result.screening)
    assert result.light_field.mean() == pytest.approx(scene.mean(), rel=0.02)
    two = dataclasses.replace(verdict.evidence, gains=(0.9, 1.1, 1.0), left_out=(2,))
    assert "which is right is not known" in verdict_from(two).words


def test_a_light_field_that_foretells_less_than_anybody_would_is_doubted(three):
    scene = np.asarray(open_scene("near-planar", size=SIZE)).astype(np.float32)
    rng = np.random.default_rng(0)
    frames = three.forward(scene)
    frames += 0.003 * rng.standard_normal(frames.shape, np.float32)
    kept, usable = kept_readings(three, everywhere(three)), everywhere(three)
    rough = 0.1 * rng.standard_normal(frames.shape)
    for residual, worse in ((rough, True), (0.003 * rng.standard_normal(frames.shape), False)):
        over = over_baselines(three, frames, residual, 0.003, usable, kept)
        assert (over["over_flat"] > 1) == worse
    # Beside flat fields the mean of neighbours is as good as readings can be: their noise.
    even = (0.5 + 0.003 * rng.standard_normal(frames.shape)).astype(np.float32)
    assert over_baselines(three, even, rough, 0.003, usable, kept)["over_neighbours"] > 10
    too_few = over_baselines(
        three, even, rough, 0.003, usable, kept & (rng.random(kept.shape) < 0.1)
    )
    assert set(too_few.values()) == {None}


@pytest.mark.parametrize("camera", ["rgbw-bayer-1shot", "rgbw-bayer-3shots"])
@pytest.mark.parametrize("scene", ["near-planar", "wide-disparity"])
def test_a_capture_without_a_fault_is_consistent_and_trusted_where_accuracy_is_stated(
    scene, camera
):
    verdict = judged_trial("mask-shift", 0, camera, scene, seed=3)
    assert verdict.level == "cannot tell"
    (reason,) = verdict.reasons
    assert reason.what == f"{CONSISTENT}, but the accuracy is not known: tv states none"
    stated = verdict_from(dataclasses.replace(verdict.evidence, stated=0.02))
    assert (stated.level, stated.reasons) == ("trust", ())


def test_evidence_survives_json(clean):
    assert Evidence.from_dict(json.loads(json.dumps(clean.as_dict()))) == clean


def test_the_gravest_reason_comes_first_and_makes_the_verdict(clean):
    assert verdict_from(clean).level == "trust"
    verdict = verdict_from(dataclasses.replace(clean, short=0.03, displaced_px=2.0))
    assert verdict.level == "do not use"
    assert [LEVELS.index(reason.level) for reason in verdict.reasons] == [3, 2]


def missed(times):
    return {"parameters": {"misfit": times, "misfit_row": 12.0, "misfit_column": 30.0}}


def shown(error):
    strength = None if error is None else 1.0
    return {"strengths": (strength,) * 3, "strength_errors": (error,) * 3}


def undecided(noise, decided):
    return {"method": "adaptive", "noise": noise, "parameters": {"decided": decided}}


@pytest.mark.parametrize(
    ("figures", "level", "words"),
    [
        ({"over_flat": 1.2}, "doubt", "one picture for all views predicts the validation readings"),
        ({"over_neighbours": 1.2}, "doubt", "the mean of neighbouring readings predicts"),
        ({"parallax": 1e-4}, "cannot tell", "treated as flat: the frames show no parallax"),
        (missed(9.0), "trust", ""),
        (missed(13.0), "doubt", "13.0 sigma, largest near row 12, column 30"),
        # Where masks hardly show, a wrong Psi does not, either; what is wrong beside is graver.
        (shown(0.01), "trust", ""),
        (shown(0.06), "cannot tell", "a wrong Psi may go unnoticed"),
        (shown(None), "cannot tell", "cannot show whether Psi is right"),
        ({**shown(None), "noise": 0.5}, "doubt", "noise is 50%"),
        (undecided(0.1, 0.5), "doubt", "several disparities fit"),
        (undecided(0.1, 0.9), "trust", ""),
        (undecided(0.01, 0.1), "cannot tell", "depth cannot be determined in 90%"),
        (undecided(0.03, 0.5), "trust", ""),
        ({"unusable": 0.5}, "doubt", "50% of the readings are of pixels that cannot be used"),
        ({"unusable": 0.05}, "trust", ""),
        # What two shots of three lack that screening left out is no fault of pixels.
        ({"unusable": 0.68, "left_out": (1, 2)}, "trust", ""),
        ({"short": 0.05}, "doubt", "5.0% of the readings are saturated where no other"),
        ({"short": 0.005}, "trust", ""),
    ],
)
def test_a_figure_beyond_its_limit_is_a_reason(clean, figures, level, words):
    verdict = verdict_from(dataclasses.replace(clean, **figures))
    assert verdict.level == level, verdict.words
    assert words in verdict.words


def test_a_coded_aperture_leaves_nothing_in_one_frame_that_would_show_a_wrong_psi():
    psi = build_imaging_matrix(find_camera("coded-aperture-random"), SIZE)
    evidence = evidence_of(psi)
    assert evidence.displaced_px is None
    assert evidence.strengths == (None,)
    verdict = verdict_from(evidence)
    assert verdict.level == "cannot tell"
    assert "cannot show whether Psi is right" in verdict.words


MOVED = {"moved_at": (1, 5, 5), "moved_px": (9, 9)}


@pytest.mark.parametrize(
    ("figures", "by_tv", "by_adaptive"),
    [
        ({"bad": 0.03}, "trust", "doubt"),
        ({"bad": 0.01}, "trust", "trust"),
        ({**MOVED, "motion": 0.9}, "trust", "trust"),
        ({**MOVED, "motion": 1.1}, "doubt", "doubt"),
        ({**MOVED, "motion": 9.0}, "doubt", "doubt"),
        ({**MOVED, "moved_at": (None, 5, 5), "motion": 9.0}, "do not use", "do not use"),
        ({"bad": 0.1}, "doubt", "do not use"),
    ],
)
def test_a_fault_that_misleads_a_method_may_leave_another_unharmed(
    clean, figures, by_tv, by_adaptive
):
    for method, level in (("tv", by_tv), ("adaptive-fast", by_adaptive)):
        verdict = verdict_from(dataclasses.replace(clean, method=method, **figures))
        assert verdict.level == level, verdict.words


@pytest.mark.parametrize(
    ("figures", "over_plain", "level"),
    [
        ({"displaced_px": 0.12}, 0.8, "doubt"),
        ({"displaced_px": 0.12}, 0.3, "trust"),
        ({"displaced_px": 0.06}, 0.8, "trust"),
    ],
)
def test_a_slight_error_of_psi_counts_where_surfaces_hardly_explain_the_readings(
    clean, figures, over_plain, level
):
    single = {"strengths": (1.0,), "strength_errors": (0.002,), "brightness": (1.0,), **figures}
    by_tv = dataclasses.replace(clean, **single)
    by_surfaces = dataclasses.replace(
        by_tv, method="adaptive", parameters={"over_plain": over_plain}
    )
    assert verdict_from(by_surfaces).level == level
    assert verdict_from(by_tv).level == "trust"  # has no such figure


CAUSES = (
    ("offset", 0.06, "black level seems 6.0% of the mean reading too low", "stray light"),
    ("offset", -0.06, "black level seems 6.0% of the mean reading too high", "stray light"),
    ("gamma", -0.1, "to the power of 0.90", "without gamma"),
    ("blur", 0.81, "blurred by 0.9 pixels more", "calibrate"),
    ("blur", -0.81, "sharper by 0.9 pixels", "calibrate"),
    ("distance", 0.1, "10% further from", "drift"),
    ("vignetting", 0.2, "lose 20% more", "aperture"),
    ("contrast", 0.03, "masks' contrast is 95% of that in Psi", "drift"),
)


@pytest.mark.parametrize(("cause", "value", "words", "remedy"), CAUSES)
def test_causes_are_named_with_size_and_remedy_where_they_do_harm(
    clean, cause, value, words, remedy
):
    changes = {"contrast": (0.03, 0.001, 0.5), "blur": (0.1, 0.01, 0.4), cause: (value, 0.001, 1.0)}
    found = dataclasses.replace(
        clean,
        strengths=(0.95,) * 3,
        noise=0.01,
        changes=changes,
        stated=0.05,
    )
    verdict = verdict_from(found)
    assert verdict.level == "doubt"
    assert words in verdict.reasons[0].what
    assert remedy in verdict.reasons[0].remedy
    # Where the light field errs by far more, it is no matter; gamma is, as it is wrong brightness.
    harmless = verdict_from(dataclasses.replace(found, stated=0.2))
    assert harmless.level == ("trust" if cause not in ("gamma", "vignetting") else "doubt")
    # So is a blur or a distance that changes much of the masks' modulation.
    much = dict(changes, contrast=(0.05, 0.001, 0.5)) if cause != "contrast" else changes
    strong = verdict_from(dataclasses.replace(found, changes=much, stated=0.2))
    assert strong.level == ("trust" if cause in ("offset", "contrast") else "doubt")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "size", "words"),
    [
        ("offset", 0.2, "black level seems 1"),
        ("gamma", -0.1, "to the power of 0.9"),
        ("jpeg", 85, "JPEG"),
    ],
)
def test_faults_of_the_readings_are_the_first_reason(one_shot, fault, size, words):
    psi, frames = one_shot
    spoiled = spoilt(frames, fault, size).astype(np.float32)
    for readings, level in ((frames, "trust"), (spoiled, "doubt")):
        _, verdict = reconstruct_judged("adaptive-fast", psi, even_frames(readings, 0.003))
        assert verdict.level == level, verdict.words
    assert words in verdict.reasons[0].what


@pytest.fixture(scope="module")
def glare():
    """Frames of a bright square, saturated at half of its brightness."""
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), SIZE)
    truth = np.full(psi.light_field_shape, 0.1, np.float32)
    truth[:, :, 18:30, 24:40] = 0.9
    clean = psi.forward(truth)
    white = 0.5 * float(clean.max())
    usable = clean < white
    assert 0.01 < 1 - usable.mean() < 0.1
    return psi, truth, np.minimum(clean, white), usable


@pytest.mark.parametrize("method", ["tv", "adaptive-fast"])
def test_saturated_readings_say_at_least_how_bright_it_was(glare, method):
    psi, truth, readings, usable = glare

    def missed(result):
        bright = np.s_[:, :, 20:28, 26:38]
        return float(np.mean(truth[bright] - result.light_field[bright]))

    known, verdict = judged(psi, readings, method, 1e-3, usable)
    unknown, without = judged(psi, np.where(usable, readings, 0), method, 1e-3, usable)
    assert missed(known) < 0.8 * missed(unknown)
    assert verdict.evidence.short > 0.01 > without.evidence.short
    assert "saturated" in known.screening[-1]
    assert not any("saturated" in note for note in unknown.screening)
    seen = psi.forward(known.light_field)
    assert (seen[~usable] > 0.8 * readings[~usable]).all()


def test_readings_that_somebody_leaves_out_are_no_bounds(glare):
    psi, _, readings, usable = glare
    other = emmc.reconstruct(
        psi, np.where(usable, readings, 0), "tv", noise_sigma=1e-3, settings=QUICK, usable=usable
    )
    left_out = emmc.reconstruct(
        psi, readings, "tv", noise_sigma=1e-3, settings=QUICK, usable=usable
    )
    np.testing.assert_array_equal(left_out.light_field, other.light_field)
    own = Frames(readings, np.full(readings.shape, 1e-3), usable)
    bounded = emmc.reconstruct(psi, own, "tv", settings=QUICK)
    assert bounded.verdict.evidence.short > 0.01


def test_bad_pixels_that_screening_finds_are_reported():
    verdict = judged_trial("bad-pixels", 20)
    share = verdict.evidence.bad
    assert 0.1 < share < 0.2
    assert f"{share:.1%} of the pixels are bad, and not known as such" in verdict.words


def motion_in(psi, frames, sigma=1e-4, usable=None, light_field=None):
    """Return the motion that is found with a light field, by default one fitted to all shots."""
    usable = everywhere(psi) if usable is None else usable
    if light_field is None:
        light_field = reconstruct_tv(psi, even_frames(frames, sigma, usable)).light_field
    residual = frames - psi.forward(light_field)
    found = motion(measured_relief(psi, frames, sigma, usable), residual, sigma)
    assert found is not None
    return found


@pytest.mark.slow
def test_bad_pixels_behind_dark_cells_do_not_pass_for_motion():
    camera = find_camera("rgbw-bayer-3shots")
    for fault, strength, moves in (("bad-pixels", 3, False), ("camera-motion", 1, True)):
        given = Point(Capture("deep-occlusions", camera, (64, 80), 0, 3), fault, strength).trial()
        seen = screened(given.psi, given.frames).frames
        found = motion_in(given.psi, seen.readings, given.noise_sigma, seen.usable)
        assert (found.ratio > 1) == moves


def test_a_spot_that_one_shot_cannot_see_does_not_pass_for_motion(three):
    y, x = np.indices(SIZE)
    waves = 0.3 + 0.1 * np.sin(x / 5) * np.cos(y / 6)
    picture = waves + 0.6 * np.exp(-((y - 20) ** 2 + (x - 30) ** 2) / 18)
    scene = np.broadcast_to(picture[..., None], three.light_field_shape).astype(np.float32)
    usable = everywhere(three)
    usable[1, 16:21, 28:35] = False
    assert motion_in(three, three.forward(scene), usable=usable).ratio < 1


@pytest.mark.parametrize("shot", [0, 2])
@pytest.mark.parametrize(("side", "brighter"), [(6, 0.15), (20, 0.15), (20, 0.025)])
def test_what_changes_in_one_shot_is_named_with_shot_and_place(three, shot, side, brighter):
    rng = np.random.default_rng(0)
    scene = np.full(three.light_field_shape, 0.5, np.float32)
    noise = 0.003 * rng.standard_normal(three.frames_shape)
    # Texture that the light field lacks is in all shots alike.
    texture = 1 + 0.02 * rng.standard_normal(SIZE)
    still = three.forward(scene) * texture + noise
    found = motion_in(three, still, 0.003, light_field=scene)
    assert found.ratio < 1
    assert not found.moved.any()
    frames = still.copy()
    frames[shot, 15 : 15 + side, 30 : 30 + side] *= 1 + brighter
    found = motion_in(three, frames, 0.003, light_field=scene)
    assert found.ratio > 1
    assert found.shot == shot
    np.testing.assert_allclose(found.place, (15 + side / 2, 30 + side / 2), atol=3)
    assert all(side <= length <= side + 10 for length in found.size)
    changed = np.zeros(three.frames_shape, bool)
    changed[shot, 15 : 15 + side, 30 : 30 + side] = True
    assert found.moved[changed].mean() > 0.9
    assert found.moved[shot].mean() < 0.7
    assert not np.delete(found.moved, shot, axis=0).any()
    flicker = still * np.array([0.97, 1, 1.03])[:, None, None]
    assert motion_in(three, flicker, 0.003, light_field=scene).ratio < 1


def test_noise_differs_between_shots_by_as_much_as_is_expected_of_it(three):
    rng = np.random.default_rng(1)
    residual = rng.standard_normal(three.frames_shape).astype(np.float32)
    shots = np.arange(3)
    apart, expected, least = _differences(relief_in(three, grey(three)), residual, shots, 1)
    # From the mean of three each differs by two thirds of its square; spots take some of the rest.
    assert 2 / 3 < apart.mean() / expected.mean() < 1.25 * 2 / 3
    assert least == pytest.approx(expected.mean())


def with_moved_object(psi, shot, by_px=6):
    """Return readings of a striped square before a scene, moved in one shot, and the truth."""
    truth = np.array(open_scene("deep-occlusions", size=SIZE), np.float32)
    moved = truth.copy()
    y, x = np.indices((24, 24))
    stripes = (0.5 + 0.3 * np.sin((x + y) / 2))[..., None]
    truth[:, :, 10:34, 20:44] = stripes
    moved[:, :, 10:34, 20 + by_px : 44 + by_px] = stripes
    frames = psi.forward(truth)
    frames[shot] = psi.forward(moved)[shot]
    return frames + noise_of(psi), truth


def test_a_shot_is_left_out_where_something_moved_in_it_and_the_place_is_doubted(three):
    frames, truth = with_moved_object(three, 1)
    result, verdict = judged(three, frames)
    assert verdict.level == "doubt"
    assert "shot 2 saw another scene than the others in " in verdict.words
    assert "excluded there" in verdict.words
    assert "or reconstruct without shot 2" in verdict.words
    assert verdict.evidence.moved_at is not None
    _, row, column = verdict.evidence.moved_at
    np.testing.assert_allclose((row, column), (22, 35), atol=5)
    blind = reconstruct_tv(three, even_frames(frames, 0.003), QUICK.tv)
    still, _ = with_moved_object(three, 1, 0)
    best = reconstruct_tv(three, even_frames(still, 0.003), QUICK.tv)
    after, before, without = (psnr_db(item.light_field, truth) for item in (result, blind, best))
    assert after > before + 2
    assert after > without - 2
    assert any("saw another scene" in note for note in result.screening)
    missed = missed_readings(three, result.light_field, frames, 0.003, everywhere(three))
    assert missed[12:32, 22:48].mean() > 5 > missed[:, :10].mean()


def test_the_place_of_a_block_where_something_moved_is_that_of_the_whole(clean):
    moved = dataclasses.replace(clean, motion=3.0, moved_at=(1, 5, 6), moved_px=(9, 8))
    verdict = judged_together(
        [
            JudgedBlock(verdict_from(item), row, 60, 100)
            for item, row in ((moved, 50), (clean, 0), (clean, 0))
        ]
    )
    assert verdict.level == "doubt"
    assert "shot 2 saw another scene than the others in 9x8 pixels about row 55, column 66" in (
        verdict.words
    )


def test_of_two_shots_either_may_have_seen_what_moved():
    psi = build_imaging_matrix(find_camera("rgbw-bayer-2shots"), SIZE)
    frames, _ = with_moved_object(psi, 1)
    result, verdict = judged(psi, frames)
    assert verdict.level in ("doubt", "do not use")
    assert "shots saw different scenes in " in verdict.words
    assert "without shot" not in verdict.words
    assert _differing(np.array([9.0, 1.0]), np.arange(2)) is None
    assert _differing(np.array([1.0, 9.0, 1.0]), np.arange(3)) == 1
    assert _differing(np.array([8.0, 9.0, 1.0]), np.arange(3)) is None
    assert not result.screening


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A capture, and the same with a Psi whose masks lie elsewhere."""
    right, camera = tmp_path_factory.mktemp("right"), find_camera("rgbw-bayer-2shots")
    simulate_into(right, "non-lambertian", "rgbw-bayer-2shots", camera, SIZE, 0)
    wrong = right.with_name("wrong")
    shutil.copytree(right, wrong)
    psi = Psi.load(wrong / "psi.h5")
    dataclasses.replace(psi, weights=np.roll(psi.weights, 6, axis=(3, 5))).save(wrong / "psi.h5")
    return right, wrong


def test_the_command_ends_with_its_verdict_and_strict_fails_on_what_is_not_to_be_used(
    folders, tmp_path
):
    settings = tmp_path / "settings.yaml"
    settings.write_text("tv: {max_steps: 40}\n")
    options = ["--method", "tv", "--settings", str(settings), "--strict"]
    for folder, code, level in zip(folders, (0, 1), ("cannot tell", "do not use"), strict=True):
        out = tmp_path / level
        done = CliRunner().invoke(app, ["reconstruct", str(folder), *options, "--out", str(out)])
        last = done.stdout.strip().splitlines()[-1]
        verdict = json.loads((out / "metrics.json").read_text())["verdict"]
        assert (done.exit_code, verdict["level"]) == (code, level)
        assert last.startswith(verdict["reasons"][-1]["level"])
        assert "\x1b" not in last
        assert (out / "light_field.h5").is_file()
    assert "calibrate the drift" in verdict["reasons"][0]["remedy"]
    assert not any(" saw " in reason["what"] for reason in verdict["reasons"])


def test_the_command_leaves_out_shots_and_says_which_there_are(folders, tmp_path):
    settings = tmp_path / "settings.yaml"
    settings.write_text("tv: {max_steps: 5}\n")
    given = ["reconstruct", str(folders[0]), "--method", "tv", "--settings", str(settings)]
    for shots, code in ((["2"], 0), (["3"], 1), (["1", "2"], 1)):
        out = tmp_path / "-".join(shots)
        options = [part for shot in shots for part in ("--without-shots", shot)]
        done = CliRunner().invoke(app, [*given, *options, "--out", str(out)])
        assert done.exit_code == code, done.output
        assert out.exists() == (code == 0)
        if code:
            assert "the capture has shots 1 to 2" in str(done.exception or done.output)
    metrics = json.loads((tmp_path / "2" / "metrics.json").read_text())
    assert metrics["usable_share"] == pytest.approx(0.5, abs=0.01)
    assert metrics["verdict"]["features"]["motion"] is None


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["deep-occlusions", "wide-disparity"])
def test_colours_that_one_grey_shot_hardly_shows_are_uncertain(scene):
    given = trial_of(Capture(scene, find_camera("scenario-iii-mono"), SIZE, zoom=3))
    result, verdict = reconstruct_judged("adaptive-fast", given.psi, given.frames)
    assert verdict.level == "cannot tell"
    assert "colour filter" in verdict.words
    stated_db = result.stated["stated_db"]
    assert stated_db == pytest.approx(given.psnr_db(result.light_field), abs=3)


@pytest.mark.slow
def test_with_several_shots_the_default_is_as_good_as_surfaces_and_as_patches():
    given = trial_of(Capture("wide-disparity", find_camera("rgbw-bayer-3shots"), (32, 40), zoom=3))
    surfaces = fast(AdaptiveSettings())
    both = surfaces.model_copy(update={"patches": 2})

    def level_db(name, adaptive):
        result = given.solved(name, MethodSettings(adaptive=adaptive))
        return given.psnr_db(result.light_field)

    others = level_db("adaptive", surfaces), level_db("tv-dict", surfaces)
    assert level_db("adaptive", both) > max(others) - 0.2


@pytest.mark.parametrize("camera", ["rgbw-bayer-1shot", "rgbw-bayer-2shots"])
def test_a_mirror_is_the_least_accurate_place_and_named(camera):
    psi = build_imaging_matrix(find_camera(camera), (64, 80))
    truth = open_scene("dark", (64, 80), (5, 5), seed=1).light_field.copy()
    mirrored = open_scene("toy-table", (64, 80), (5, 5), seed=1).light_field[::-1, ::-1]
    box = np.s_[:, :, 24:54, 36:70]
    truth[box] = mirrored[box]
    noise = 0.003 * np.random.default_rng(0).standard_normal(psi.frames_shape)
    readings = (psi.forward(truth) + noise).astype(np.float32)
    result, _ = reconstruct_judged("adaptive-fast", psi, even_frames(readings, 0.003, None))
    missed = np.square(result.light_field - truth, dtype=np.float64).mean(axis=(0, 1, 4))
    row, column = result.stated["stated_worst_at"]
    assert 24 <= row < 54
    assert 36 <= column < 70
    there = -10 * np.log10(missed[row - 12 : row + 12, column - 12 : column + 12].mean())
    assert result.stated["stated_worst_db"] == pytest.approx(there, abs=4)
    assert there < -10 * np.log10(missed.mean()) - 2
