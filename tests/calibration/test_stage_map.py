"""The stage as the sensor sees it: a stage of known faults is found with them."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.boards import Board
from calibration.errors import CalibrationError
from calibration.placement import designed_placement
from calibration.shadow import Shadow, shadow_mask
from calibration.stage_map import Place, locate, stage_map
from emmc_rig.model.camera import Camera, build_imaging_matrix

SIZE = (32, 40)
CAMERA = Camera.model_validate(
    {
        "title": "test",
        "views": [3, 3],
        "sensor": {"cfa": "rggb"},
        "masks": {"code": {"distance_mm": 0.12, "cell_um": 36, "pattern": {"kind": "random_rgbw"}}},
    }
)
SCALE, TURN, SKEW = (1.003, 0.998), np.deg2rad(0.4), np.deg2rad(0.15)
REPEATABILITY = 0.12


def visited(count=40, seed=0):
    """Return positions sent to, and where the mask stood."""
    rng = np.random.default_rng(seed)
    sent = rng.uniform(-400, 400, (count, 2))
    y_axis = TURN + SKEW
    matrix = np.array(
        [
            [SCALE[0] * np.cos(TURN), -SCALE[1] * np.sin(y_axis)],
            [SCALE[0] * np.sin(TURN), SCALE[1] * np.cos(y_axis)],
        ]
    )
    real = sent @ matrix.T + (4.0, -2.0)
    return sent, real + rng.normal(0, REPEATABILITY, real.shape)


def mapped(count=40, seed=0):
    sent, real = visited(count, seed)
    places = [Place(float(x), float(y), 0.01) for x, y in real]
    return stage_map([(x, y) for x, y in sent], places)


def test_scale_rotation_orthogonality_and_repeatability_come_out():
    found = mapped()
    assert found.scale == pytest.approx(SCALE, abs=4 * found.deviations["scale_x"])
    turn = np.degrees(TURN)
    assert found.rotation_deg == pytest.approx(turn, abs=4 * found.deviations["rotation_deg"])
    skew = np.degrees(SKEW)
    limit = 4 * found.deviations["orthogonality_deg"]
    assert found.orthogonality_deg == pytest.approx(skew, abs=limit)
    assert found.repeatability_um == pytest.approx((REPEATABILITY,) * 2, rel=0.5)


def test_the_stated_deviations_are_those_of_repeated_maps():
    found = [mapped(seed=seed) for seed in range(40)]
    for values, key in (
        ([one.scale[0] for one in found], "scale_x"),
        ([one.rotation_deg for one in found], "rotation_deg"),
    ):
        stated = np.mean([one.deviations[key] for one in found])
        assert np.std(values, ddof=1) / stated == pytest.approx(1, abs=0.35)


def test_what_the_map_leaves_of_each_place_is_the_repeatability():
    assert np.abs(mapped().residual_um).max() < 5 * REPEATABILITY


@pytest.mark.parametrize(("x", "y"), [(0.37, -0.81), (6.0, 9.0), (-14.0, 3.0)])
def test_a_whiteboard_shows_where_its_mask_stood_to_a_hundredth_of_a_pixel(x, y):
    mask = shadow_mask(CAMERA, SIZE)
    design = build_imaging_matrix(CAMERA, SIZE)
    at = replace(designed_placement(CAMERA), blur_um=2.0)
    pixels = np.argwhere(np.ones(SIZE, dtype=bool))
    every = np.ones((3, 3), dtype=bool)
    stage = (100.0 + x, -50.0 + y)
    assert design.colour is not None
    clean = Shadow(mask, at).readings(pixels, design.colour[0].ravel(), every, stage)
    # A brighter lamp is not a moved mask.
    noisy = 1.03 * clean + np.random.default_rng(0).normal(0, 0.004, len(clean))
    board = Board(
        "test",
        noisy.reshape(SIZE).astype(np.float32),
        np.full(SIZE, 0.004**2, np.float32),
        design.colour[0],
        every,
        (100.0, -50.0),
        0,
    )
    place = locate(board, mask, at)
    assert place.deviation_um < 0.1
    error = np.hypot(place.x_um - stage[0], place.y_um - stage[1])
    assert error < 4 * place.deviation_um
    assert error < 0.01 * 24


def test_too_few_moves_and_one_line_are_refused():
    sent, real = visited(20)
    places = [Place(float(x), float(y), 0.01) for x, y in real]
    pairs = [(x, y) for x, y in sent]
    with pytest.raises(CalibrationError, match="needs 3 more"):
        stage_map(pairs[:5], places[:5])
    with pytest.raises(CalibrationError, match="lie on one line"):
        stage_map([(x, 2 * x) for x, _ in pairs], places)
