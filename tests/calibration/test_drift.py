"""Blind drift: what has moved since calibration, found and mended from scene captures alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from moved_mask import CAMERA
from whiteboard_bench import BenchTruth, WhiteboardBench

from emmc_rig.calibration.drift import (
    KINDS,
    DriftSettings,
    displacement_px,
    drifted,
    find_drift,
)
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.evidence import (
    CHROMA_SPREAD,
    COARSE_PX,
    COARSE_SPREAD,
    FINE_PX,
    FINE_SPREAD,
    FLOOR_SHARE,
    MEAN_SPREAD,
    averaged,
    log_evidence,
    plane_prior,
)
from emmc_rig.calibration.parametric import psi_at
from emmc_rig.calibration.placement import designed_placement
from emmc_rig.calibration.shadow import Shadow, shadow_mask
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.model.camera import build_imaging_matrix, psi_layout
from emmc_rig.model.frames import Frames
from emmc_rig.simulators.bench import MountingErrors
from emmc_rig.simulators.flaws import PERFECT_OPTICS, PERFECT_SENSOR, SensorFlaws

SIZE = (64, 80)
MOUNTING = MountingErrors((12.0, -7.0), 0.05, 1.0005, edge_blur_um=2.0)
QUICK = DriftSettings(blocks=40, coarse_blocks=16, disparity_px=1.0, disparity_steps=5, block_px=6)


def placed():
    return replace(
        designed_placement(CAMERA),
        offset_x_um=MOUNTING.offset_um[0],
        offset_y_um=MOUNTING.offset_um[1],
        rotation_rad=float(np.deg2rad(MOUNTING.rotation_deg)),
        scale=MOUNTING.stretch,
        blur_um=MOUNTING.edge_blur_um,
    )


@cache
def captured(shots=1, seed=0, scene="deep-occlusions", sensor=PERFECT_SENSOR, kind=(), size=SIZE):
    """Return captures and their camera; kind: changes of CAMERA's sensor."""
    own = CAMERA.sensor.model_copy(update=dict(kind))
    camera = CAMERA.model_copy(update={"sensor": own}).with_shots(shots)
    fine = fine_scene(scene, 2, 2, size=size, views=camera.views, seed=3)
    truth = BenchTruth(MOUNTING, PERFECT_OPTICS, sensor, rays_per_view=256)
    bench = WhiteboardBench(camera, size, truth, seed, fine.samples)
    frames, exposures_s = bench.capture_scene()
    noise, times = camera.sensor.noise, exposures_s[:, None, None]
    light = np.stack([bench.bench.light(shot) for shot in range(shots)])
    readings = noise.normalise(frames, times, light)
    usable = ~noise.saturated(frames)
    layout, k = psi_layout(camera, size), camera.sensor.binning
    colour = None if layout.colour is None else layout.colour[:, ::k, ::k]
    deviation = np.sqrt(noise.variance(readings, times, light))
    return Frames(readings, deviation, usable), colour, camera


@cache
def found_for(before, shots=1, settings=QUICK, gains=(), size=SIZE, **more):
    """Return the drift found when the calibration had the mask `before` where it now stands."""
    taken, colour, camera = captured(shots, size=size, **more)
    readings = taken.readings.copy()
    for shot, gain in enumerate(gains):
        readings[shot] *= gain
    stages = [shot.offset_um.get("code", (0.0, 0.0)) for shot in camera.shots]
    mask = shadow_mask(camera, size)
    placement = drifted(placed(), -np.array(before))
    return find_drift(replace(taken, readings=readings), colour, mask, placement, stages, settings)


def left_px(found, drift, size=SIZE):
    values = np.array([found.values[kind] for kind in KINDS])
    values[: len(drift)] -= drift
    return displacement_px(shadow_mask(CAMERA, size), placed(), values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drift", "kind"),
    [
        ((8.0, -9.0, 0.0, 0.0, 0.0), "shift"),
        ((0.0, 0.0, 0.008, 0.0, 0.0), "rotation"),
        ((-26.0, 5.0, 0.002, 0.001, 0.0), "shift"),
        # As far as is searched: 8 pixels, 2 degrees, 3 %.
        ((185.0, -180.0, -0.033, 0.029, 0.0), "shift"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.017, 0.0), "tilt_x"),
    ],
)
def test_a_drift_is_reported_with_its_kind_and_mended_from_one_shot(drift, kind):
    found = found_for(drift)
    assert found.drifted
    assert left_px(found, drift) < 0.05
    largest = max(found.by_kind_px, key=lambda name: found.by_kind_px[name])
    assert largest.startswith(kind)
    assert "no longer fits" in found.words
    for name, truth in zip(KINDS, drift, strict=False):
        assert abs(found.values[name] - truth) < 6 * found.deviations[name] + 1e-4 * abs(truth)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["deep-occlusions", "non-lambertian"])
def test_a_psi_that_fits_raises_no_alarm(scene):
    found = found_for((0.0,) * 5, scene=scene, seed=5)
    assert not found.drifted
    assert found.displacement_px < 0.05
    assert found.words.startswith("Psi still fits the captures (searched: shifts up to 8 pixels")


@pytest.mark.slow
def test_a_colour_filter_that_leaks_is_no_move_of_the_mask():
    found = found_for((0.0,) * 5, sensor=SensorFlaws(crosstalk=0.05))
    assert not found.drifted
    assert found.values["crosstalk"] == pytest.approx(0.05, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "size"), [((("cfa", "mono"),), SIZE), ((("binning", 2),), (128, 160))]
)
def test_sensors_that_see_all_colours_or_bin_their_pixels_are_taken_as_well(kind, size):
    drift = (150.0, -30.0, 0.01, 0.0, 0.0)
    found = found_for(drift, kind=kind, size=size)
    assert found.drifted
    assert not found.refused
    assert left_px(found, drift, size) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drift", "words"),
    [
        ((240.0, 0.0, 0.0, 0.0, 0.0), "has moved by about 10.0 pixels, farther than searched"),
        ((400.0, 50.0, 0.0, 0.0, 0.0), "is not recognised in these captures"),
    ],
)
def test_a_mask_beyond_what_is_searched_is_refused_and_not_repaired(drift, words):
    found = found_for(drift)
    assert found.refused
    assert words in found.words
    assert "shifts up to 8 pixels, turns up to 2 degrees, scales up to 3%" in found.words


@pytest.mark.slow
def test_a_darker_second_shot_is_reported_as_brightness_and_not_as_a_move():
    found = found_for((0.0,) * 5, shots=2, gains=(1.0, 0.93))
    assert found.values["brightness_2"] == pytest.approx(-0.07, abs=0.01)
    assert not found.drifted


@pytest.mark.slow
def test_the_mended_psi_is_that_of_the_bench_as_it_stands():
    drift = (8.0, -9.0, 0.0, 0.0, 0.0)
    found = found_for(drift)
    design = build_imaging_matrix(CAMERA, SIZE)
    mask, stages = shadow_mask(CAMERA, SIZE), [(0.0, 0.0)]
    exact = psi_at(Shadow(mask, placed()), design, stages)
    stale = psi_at(Shadow(mask, drifted(placed(), -np.array(drift))), design, stages)
    mended = psi_at(Shadow(mask, found.placement), design, stages)
    assert mended.relative_difference(exact) < 0.1 * stale.relative_difference(exact)


def _cubic(t):
    """The B-spline by repeated convolution of boxes, from its definition by divided powers."""
    plus = [np.clip(t + 2 - k, 0, None) ** 3 for k in range(5)]
    return (plus[0] - 4 * plus[1] + 6 * plus[2] - 4 * plus[3] + plus[4]) / 6


@pytest.mark.parametrize("stored", [1, 3])
def test_the_kernel_gives_the_evidence_of_its_definition(stored):
    rng = np.random.default_rng(0)
    views, side, shots, d = (2, 3), 4, 2, 0.7
    coefficients = rng.random((1, stored, shots, side * side, *views))
    colours = rng.integers(0, 3, (1, shots, side * side), dtype=np.uint8)
    readings = rng.random((1, shots, side * side)) + 1
    noise = 1e-4 * rng.random((1, shots, side * side))
    prior = plane_prior(views, side, np.array([0.0, d]))
    got = log_evidence(prior, coefficients, colours, readings, noise, np.array([[1]]))[0, 0]

    reach = d * (max(views) - 1) / 2
    pixels = np.arange(side) - (side - 1) / 2
    covariance = np.zeros((shots * side * side,) * 2)
    chroma = np.zeros_like(covariance)
    colour = colours.ravel()
    for step, spread in ((FINE_PX, FINE_SPREAD), (COARSE_PX, COARSE_SPREAD), (None, MEAN_SPREAD)):
        if step is None:
            knots = np.zeros(1)
        else:
            count = int(np.ceil((side - 1 + 2 * reach) / step)) + 3
            knots = (np.arange(count) - (count - 1) / 2) * step
        for ky in knots:
            for kx in knots:
                column = np.zeros((stored, shots, side, side))
                for v, u in np.ndindex(views):
                    y = pixels + d * (v - (views[0] - 1) / 2)
                    x = pixels + d * (u - (views[1] - 1) / 2)
                    if step is None:
                        seen = np.ones((side, side))
                    else:
                        seen = np.outer(_cubic((y - ky) / step), _cubic((x - kx) / step))
                    weights = coefficients[0, ..., v, u].reshape(stored, shots, side, side)
                    column += weights * seen
                each = column.reshape(stored, -1)
                covariance += spread**2 * np.outer(each.sum(axis=0), each.sum(axis=0))
                if step != FINE_PX:
                    chroma += CHROMA_SPREAD**2 * each.T @ each
    scale = np.trace(covariance) / len(covariance)
    covariance += chroma if stored > 1 else chroma * (colour[:, None] == colour)
    level = readings.mean()
    covariance += np.diag(scale * (FLOOR_SHARE**2 + noise.ravel() / level**2))
    y = readings.ravel()
    misfit = y @ np.linalg.solve(covariance, y)
    expected = -0.5 * len(y) * np.log(misfit) - 0.5 * np.linalg.slogdet(covariance)[1]
    assert got == pytest.approx(expected, rel=1e-9)


def test_the_average_over_disparities_is_that_of_likelihoods():
    evidence = np.log(np.array([[1.0, 3.0], [2.0, 2.0]]))
    np.testing.assert_allclose(averaged(evidence - 1e4), np.log([2.0, 2.0]) - 1e4)


def test_a_displacement_is_counted_in_pixels_of_the_shadow():
    mask, at = shadow_mask(CAMERA, SIZE), designed_placement(CAMERA)
    assert displacement_px(mask, at, np.array([24.0, 0, 0, 0, 0])) == pytest.approx(1)
    # A turn moves a point by its distance from the middle: sqrt((a^2 + b^2) / 12) of a rectangle.
    turn = displacement_px(mask, at, np.array([0, 0, 0.01, 0, 0]))
    assert turn == pytest.approx(0.01 * np.hypot(*SIZE) / np.sqrt(12), rel=0.15)


def test_captures_without_light_or_usable_pixels_are_refused():
    taken, colour, camera = captured()
    usable = taken.usable.copy()
    usable[:, ::3, ::3] = False
    mask, stages = shadow_mask(camera, SIZE), [(0.0, 0.0)]
    with pytest.raises(CalibrationError, match="blocks of 6 x 6 pixels are lit"):
        find_drift(replace(taken, usable=usable), colour, mask, placed(), stages, QUICK)
