"""Frames are screened: what is wrong is found, what is right is left alone."""

import dataclasses

import numpy as np
import pytest

from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.methods import MethodSettings, reconstruct
from emmc_rig.reconstruction.screening import (
    bad_pixels,
    neighbour_range,
    screened,
    shot_gains,
)
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.trial import Capture

SIZE = (48, 64)
CAMERA = find_camera("rgbw-bayer-3shots")


def made(name, strength, camera=CAMERA, scene="near-planar"):
    return Point(Capture(scene, camera, SIZE, zoom=3), name, strength).trial()


def screen(trial):
    return screened(trial.psi, trial.frames)


def level_db(trial, method, screening):
    """Return the PSNR by a method, with screening or without; only screening adds notes."""
    frames = even_frames(trial.readings, trial.noise_sigma)
    settings = MethodSettings(screening=screening)
    result = reconstruct(method, trial.psi, frames, None, settings)
    assert bool(result.screening) <= screening
    return psnr_db(result.light_field, trial.truth)


def test_the_range_of_neighbours_is_that_of_numpy():
    rng = np.random.default_rng(0)
    values = rng.random((9, 11)).astype(np.float32)
    colours = rng.integers(0, 2, (9, 11), dtype=np.uint8)
    good = rng.random((9, 11)) < 0.7
    low, high = np.empty((2, 9, 11), np.float32)
    neighbour_range(values, colours, good, 2, 0.1, 4, low, high)
    for y, x in np.ndindex(9, 11):
        near = np.s_[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3]
        kept = good[near] & (colours[near] == colours[y, x])
        kept[min(y, 2), min(x, 2)] = False
        around = np.sort(values[near][kept])
        if len(around) < 4:
            assert (low[y, x], high[y, x]) == (-np.inf, np.inf)
        else:
            step = int(0.1 * (len(around) - 1) + 0.5)
            assert (low[y, x], high[y, x]) == (around[step], around[-1 - step])


@pytest.mark.parametrize("stored", [1, 3])
@pytest.mark.parametrize("binning", [1, 2])
def test_a_picture_in_all_views_is_seen_as_psi_sees_it(random_psi, stored, binning):
    psi = random_psi(shots=2, stored=stored, binning=binning)
    rng = np.random.default_rng(1)
    picture = rng.random((*psi.size, 3), dtype=np.float32)
    everywhere = np.ascontiguousarray(np.broadcast_to(picture, psi.light_field_shape))
    assert psi.forward_picture(picture) == pytest.approx(psi.forward(everywhere), rel=1e-5)
    frames = rng.random(psi.frames_shape, dtype=np.float32)
    summed = psi.adjoint(frames).sum(axis=(0, 1))
    assert psi.adjoint_picture(frames) == pytest.approx(summed, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("camera", ["rgbw-bayer-3shots", "rgbw-bayer-1shot", "rgbw-mono"])
def test_good_frames_pass_as_they_are(camera):
    trial = made("bad-pixels", 0, find_camera(camera))
    seen = screen(trial)
    assert seen.frames.readings is trial.readings
    assert not seen.dark
    assert not seen.double
    assert (seen.gains == 1).all()
    assert seen.bad.mean() < 0.005


@pytest.mark.parametrize("count", [1, 2])
def test_dark_and_double_shots_are_left_out(count):
    last = tuple(range(3 - count, 3))
    for name, kind in (("missing-shot", "dark"), ("repeated-shot", "double")):
        seen = screen(made(name, count))
        assert getattr(seen, kind) == last
        assert not seen.frames.usable[list(last)].any()
        assert seen.frames.usable[0].mean() > 0.99
        assert seen.notes[0].startswith("excluded shot")


def test_a_mask_that_is_to_stand_still_repeats_its_shots():
    still = CAMERA.model_copy(update={"shots": (CAMERA.shots[0],) * 2})
    seen = screen(made("flicker", 0, still))
    assert seen.double == ()


@pytest.mark.parametrize(("fault", "strength"), [("edge-blur", 2), ("mask-distance-error", 200)])
def test_masks_that_show_weakly_do_not_make_shots_repeat(fault, strength):
    assert screen(made(fault, strength)).double == ()


@pytest.mark.parametrize("percent", [3, 30])
def test_flicker_is_measured_and_evened(percent):
    trial = made("flicker", percent)
    seen = screen(trial)
    real = trial.readings.mean(axis=(1, 2)) / made("flicker", 0).readings.mean(axis=(1, 2))
    assert seen.gains == pytest.approx(real / np.median(real), rel=0.01)
    assert seen.frames.readings == pytest.approx(
        trial.readings / seen.gains[:, None, None], rel=1e-5
    )


def test_shots_behind_filters_are_compared_with_shots_of_the_same_colour():
    """A scene without much green and blue is darker behind these filters, and does not flicker."""
    capture = Capture("near-planar", find_camera("scenario-i-rgb").with_shots(6), SIZE, zoom=3)
    psi = capture.psi()
    tinted = capture.scene_seen().light_field * np.array([1, 0.3, 0.2], np.float32)
    readings, usable = psi.forward(tinted), np.ones(psi.frames_shape, bool)
    assert (shot_gains(psi, readings, usable) == 1).all()
    readings[4] *= 0.9  # the second green shot, of two
    expected = [1, 1 / 0.95, 1, 1, 0.9 / 0.95, 1]
    assert shot_gains(psi, readings, usable) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("camera", ["rgbw-bayer-3shots", "rgbw-bayer-1shot", "scenario-ii-cfa"])
@pytest.mark.parametrize("percent", [3, 10])
def test_bad_pixels_are_found_and_good_ones_kept(camera, percent):
    described = find_camera(camera)
    trial, reported = (made(name, percent, described) for name in ("bad-pixels", "masked-pixels"))
    bad = ~reported.usable[0]
    # A dead pixel in the shade, or one that hardly glows, does no harm.
    harmful = np.abs(trial.readings - trial.psi.forward(trial.truth)).mean(axis=0) > 0.1
    found = bad_pixels(trial.psi, trial.readings, trial.usable)
    assert harmful[bad].mean() > 0.5
    assert found[bad & harmful].mean() > 0.7
    assert found[~bad].mean() < 0.05


def test_pixels_that_are_known_to_be_bad_do_not_spoil_their_neighbours():
    reported = made("masked-pixels", 10)
    found = bad_pixels(reported.psi, reported.readings, reported.usable)
    assert not found[~reported.usable[0]].any()
    assert found[reported.usable[0]].mean() < 0.01


@pytest.mark.parametrize(
    ("name", "strength", "least_db"),
    [
        ("bad-pixels", 3, 1.0),
        ("flicker", 20, 5.0),
        ("missing-shot", 1, 5.0),
        ("repeated-shot", 1, 4),
    ],
)
def test_screening_mends_what_would_break_a_method(name, strength, least_db):
    trial = made(name, strength)
    assert level_db(trial, "tv", True) > level_db(trial, "tv", False) + least_db


@pytest.mark.slow
@pytest.mark.parametrize("method", ["tv", "adaptive-fast"])
def test_screening_costs_good_frames_next_to_nothing(method):
    trial = made("flicker", 0)
    with_db, without_db = (level_db(trial, method, screening) for screening in (True, False))
    assert abs(with_db - without_db) < 0.1


def test_nothing_is_found_where_nothing_is_to_be_seen():
    trial = made("flicker", 0)
    dark = dataclasses.replace(trial, readings=np.zeros_like(trial.readings))
    assert screen(dark).notes == ()


def test_shots_so_dim_that_most_pixels_read_nothing_tell_no_gain():
    seen = screen(made("exposure", 5, scene="deep-occlusions"))
    assert np.isfinite(seen.frames.readings).all()
    assert (seen.gains == 1).all()


def test_a_glint_behind_masks_that_differ_is_no_hot_pixel():
    trial = made(None, 0.0)
    plain = bad_pixels(trial.psi, trial.readings, trial.usable)
    glint, hot = (20, 30), (30, 20)
    assert not plain[glint]
    assert not plain[hot]
    frames = trial.readings.copy()
    frames[(slice(None), *glint)] *= 8
    frames[(slice(None), *hot)] += 0.5
    found = bad_pixels(trial.psi, frames, trial.usable)
    assert not found[glint]
    assert found[hot]
    alone = trial.usable.copy()
    alone[1:] = False
    assert bad_pixels(trial.psi, frames, alone)[glint], "one shot cannot tell"


def test_dark_outermost_lines_are_an_edge_of_the_light_field_and_no_dead_lines():
    trial = made("bad-pixels", 0, find_camera("rgbw-bayer-1shot"))
    frames = trial.readings.copy()
    frames[:, -1] = frames[:, :, :2] = 0.01 * frames.mean()
    assert not screened(trial.psi, even_frames(frames, 0.0, trial.usable)).lines.any()
    frames[:, :, -1] = 2 * frames.mean()
    stuck = np.zeros(SIZE, bool)
    stuck[:, -1] = True
    np.testing.assert_array_equal(
        screened(trial.psi, even_frames(frames, 0.0, trial.usable)).lines, stuck
    )


@pytest.mark.parametrize("camera", ["rgbw-bayer-1shot", "rgbw-mono", "conventional"])
@pytest.mark.parametrize("response", [0.02, 0.0])
def test_dead_lines_are_left_out_though_their_neighbours_are_dead_as_well(camera, response):
    trial = made("bad-pixels", 0, find_camera(camera))
    assert not screen(trial).lines.any()
    stuck = 0.3 * float(trial.readings.mean())
    frames, dead = trial.readings.copy(), np.zeros(SIZE, bool)
    dead[:, 20:22] = dead[31] = True
    frames[:, dead] = stuck + response * frames[:, dead]
    found = screened(trial.psi, even_frames(frames, 0.0, trial.usable))
    np.testing.assert_array_equal(found.lines, dead)
    assert not found.frames.usable[:, dead].any()
    assert any("rows 31 and columns 20, 21" in note for note in found.notes)
    # Lines listed as unusable are not reported, and neither are the lines beside them.
    listed = screened(trial.psi, even_frames(frames, 0.0, trial.usable & ~dead))
    assert not listed.lines.any()
    np.testing.assert_array_equal(listed.frames.usable, found.frames.usable)
