"""Camera descriptions: their Psi, and the one helpful line that refuses a wrong description."""

from copy import deepcopy

import cv2
import numpy as np
import pytest
import yaml

from emmc_rig.model.camera import (
    Camera,
    build_imaging_matrix,
    load_camera,
    pixel_light,
    psi_layout,
    sensor_response,
)
from emmc_rig.model.errors import CameraError

VALID = {
    "title": "two masks",
    "views": [3, 3],
    "lens": {"distance_mm": 50.0, "aperture_cell_mm": 5.0},
    "sensor": {"cfa": "rggb", "noise": {"read_noise_electrons": 2.5}},
    "masks": {
        "near": {
            "distance_mm": 0.24,
            "cell_um": 24,
            "pattern": {"kind": "random_binary", "open_probability": 0.5},
        },
        "far": {
            "distance_mm": 50.0,
            "cell_um": 5000,
            "pattern": {"kind": "sequence", "scan": [3, 3]},
        },
    },
    "shots": [
        {"offset_um": {"near": [0, 0]}},
        {"offset_um": {"near": [24, 48]}, "exposure_s": 0.02},
    ],
    "more_shots_step_um": {"near": [72, -24]},
    "total_exposure_s": 0.06,
}


def changed(*path_and_value):
    """Return VALID with the value at a path replaced."""
    *path, value = path_and_value
    data = deepcopy(VALID)
    node = data
    for part in path[:-1]:
        node = node[part]
    node[path[-1]] = value
    return data


def refusal(tmp_path, data):
    """Return the one line with which a description is refused, without the name of the file."""
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    with pytest.raises(CameraError) as fault:
        load_camera(path)
    message = str(fault.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def test_a_valid_description_is_read(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(VALID))
    camera = load_camera(path)
    assert camera == Camera.model_validate(VALID)
    assert camera.masks["near"].distance_mm == 0.24
    assert Camera.model_validate_json(camera.model_dump_json()) == camera


@pytest.mark.parametrize(
    ("path", "key", "near"),
    [
        ((), "titel", "title"),
        (("sensor", "noise"), "read_noise_electron", "read_noise_electrons"),
        (("masks", "near", "pattern"), "open_probabilty", "open_probability"),
        (("masks", "far", "pattern"), "scann", "scan"),
        (("shots", 0), "offsets_um", "offset_um"),
    ],
)
def test_a_misspelt_key_is_an_error_that_names_the_nearest_valid_one(tmp_path, path, key, near):
    message = refusal(tmp_path, changed(*path, key, 1))
    assert message.endswith(f"did you mean '{near}'?")
    assert key in message


def test_a_key_of_another_pattern_is_not_offered(tmp_path):
    message = refusal(tmp_path, changed("masks", "near", "pattern", "cycles_per_mm", [[1, 1]]))
    assert "valid keys: kind, open_probability, redraw, seed" in message


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        (("lens", "distance_mm"), float("nan"), "lens.distance_mm: input should be a finite"),
        (("shots", 0, "offset_um", "near"), [float("nan"), 0], "finite"),
        (("lens", "distance_mm"), "far", "lens.distance_mm: input should be a number"),
        (("views",), [0, 3], "'views' needs at least one row and one column"),
        (("views",), [2.5, 3], "views.0: input should be a whole number"),
        (("shots", 0, "filter"), "violet", "shots.0.filter: input should be 'none', 'red'"),
        (("sensor", "cfa"), "rgbx", "sensor: unknown CFA 'rgbx': use one of mono, rggb"),
        (("sensor", "noise", "black_level_dn"), 65535, "black_level_dn must be below"),
        (("masks", "near", "pattern"), {"kind": "lace"}, "'open'"),
        (("masks", "near", "pattern"), {"kind": "mura", "prime": 9}, "9 is not prime"),
        (("masks", "near", "pattern"), {"kind": "tile", "cells": [[2]]}, "must lie in [0, 1]"),
    ],
)
def test_a_value_that_cannot_be_is_refused(tmp_path, path, value, complaint):
    assert complaint in refusal(tmp_path, changed(*path, value))


def test_a_missing_setting_is_named(tmp_path):
    data = deepcopy(VALID)
    del data["masks"]["near"]["cell_um"]
    assert refusal(tmp_path, data) == "masks.near.cell_um: field required"


def test_a_mask_further_away_than_the_lens_is_refused(tmp_path):
    message = refusal(tmp_path, changed("masks", "far", "distance_mm", 51))
    assert "mask 'far' at 51 mm is further away than the lens (50 mm)" in message


@pytest.mark.parametrize(
    ("path", "value", "where"),
    [
        (("shots", 0, "masks"), ["nearest"], "shot 0 names mask 'nearest'"),
        (("shots", 1, "offset_um"), {"middle": [0, 0]}, "shot 1 names mask 'middle'"),
        (("more_shots_step_um",), {"nera": [0, 0]}, "more_shots_step_um names mask 'nera'"),
    ],
)
def test_a_mask_that_is_not_described_cannot_be_used(tmp_path, path, value, where):
    message = refusal(tmp_path, changed(*path, value))
    assert where in message
    assert message.endswith("which is not among: near, far")


def offsets(camera, name="near"):
    return [shot.offset_um.get(name) for shot in camera.shots]


def test_more_shots_are_further_rounds_moved_by_the_step():
    camera = Camera.model_validate(VALID).with_shots(5)
    assert offsets(camera) == [(0, 0), (24, 48), (72, -24), (96, 24), (144, -48)]
    assert [shot.exposure_s for shot in camera.shots] == [None, 0.02, None, 0.02, None]


def test_a_step_also_moves_a_mask_that_the_first_round_leaves_in_place():
    camera = Camera.model_validate(changed("shots", [{}])).with_shots(3)
    assert [dict(shot.offset_um) for shot in camera.shots] == [
        {},
        {"near": (72, -24)},
        {"near": (144, -48)},
    ]


def test_more_shots_than_the_camera_has_a_rule_for_are_refused():
    camera = Camera.model_validate(changed("more_shots_step_um", None))
    assert len(camera.with_shots(2).shots) == 2
    with pytest.raises(CameraError, match=r"'two masks' has 2 shots, not 3: ask for fewer"):
        camera.with_shots(3)
    with pytest.raises(CameraError, match="at least one"):
        camera.with_shots(0)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_the_shots_share_the_total_exposure_whatever_their_number(count):
    camera = Camera.model_validate(changed("shots", [{}])).with_shots(count)
    np.testing.assert_allclose(camera.exposures_s(), 0.06 / count)


def test_a_shot_may_name_its_own_exposure():
    camera = Camera.model_validate(changed("shots", [{"exposure_s": 0.5}, {"exposure_s": 0.25}]))
    np.testing.assert_array_equal(camera.exposures_s(), [0.5, 0.25])


def test_a_shot_has_the_masks_it_names_or_all():
    camera = Camera.model_validate(changed("shots", [{}, {"masks": ["far"]}, {"masks": []}]))
    assert [camera.shot_masks(shot) for shot in range(3)] == [("near", "far"), ("far",), ()]


def one_mask(mask, size=(6, 6), shots=({},), sensor=None):
    described = Camera.model_validate(
        {"title": "t", "views": [3, 3], "masks": {"m": mask}, "shots": shots}
        | ({"sensor": sensor} if sensor else {})
    )
    return build_imaging_matrix(described, size)


@pytest.mark.parametrize("side", [2, 3])
def test_a_given_mask_smaller_than_the_beam_is_refused(side):
    pattern = {"kind": "parameters", "cells": [[1.0] * side] * side}
    mask = {"distance_mm": 50.0, "cell_um": 5000, "pattern": pattern}
    if side == 3:
        one_mask(mask)
        with pytest.raises(CameraError, match=r"mask 'm', shot 1: .* smaller than the beam"):
            one_mask(mask, shots=[{}, {"offset_um": {"m": [0, 100]}}])
    else:
        with pytest.raises(CameraError, match=r"mask 'm', shot 0: .* has 2 cells .* needs 3"):
            one_mask(mask)


def test_a_picture_smaller_than_the_beam_is_refused_unless_it_repeats(tmp_path):
    path = tmp_path / "mask.png"
    assert cv2.imwrite(str(path), np.full((5, 5), 255, np.uint8))
    pattern = {"kind": "picture", "path": str(path)}
    mask = {"distance_mm": 0.0, "cell_um": 24.0, "pattern": pattern}
    with pytest.raises(CameraError, match="it has 5 cells of 24 um, the beam needs 6"):
        one_mask(mask)
    one_mask(mask, size=(5, 5))
    one_mask(mask | {"pattern": pattern | {"repeat": True}})


def test_a_mask_in_contact_has_its_cells_on_the_samples():
    mask = {"distance_mm": 0.0, "cell_um": 24.0, "pattern": {"kind": "random_binary"}}
    for size in [(6, 6), (7, 9), (8, 5)]:
        seen = one_mask(mask, size).weights * 27
        np.testing.assert_allclose(seen, seen.round(), atol=1e-6)


def test_an_offset_moves_the_mask_towards_larger_x_and_y():
    mask = {"distance_mm": 0.0, "cell_um": 24.0, "pattern": {"kind": "uniform_colour"}}
    still, moved = one_mask(mask, shots=[{}, {"offset_um": {"m": [48, -24]}}]).weights
    np.testing.assert_allclose(moved[:, :, :-1, :, 2:], still[:, :, 1:, :, :-2], atol=1e-7)


def test_a_programmable_aperture_shows_frame_after_frame_and_starts_again():
    pattern = {"kind": "sequence", "scan": [3, 3]}
    mask = {"distance_mm": 50.0, "cell_um": 5000, "pattern": pattern}
    open_views = one_mask(mask, shots=[{}] * 11).weights.sum(axis=(3, 4, 5)) > 0
    for shot in range(11):
        expected = np.zeros(9, dtype=bool)
        expected[shot % 9] = True
        np.testing.assert_array_equal(open_views[shot].ravel(), expected)


@pytest.mark.parametrize(
    "shots",
    [[{}, {"masks": ["m"]}], [{"masks": []}, {}]],
)
def test_a_shot_that_no_light_reaches_is_refused(shots):
    pattern = {"kind": "pinhole", "at_cells": [500, 0]}
    mask = {"distance_mm": 0.0, "cell_um": 24.0, "pattern": pattern}
    with pytest.raises(CameraError, match=r"no light reaches the sensor in shot \d: open its"):
        one_mask(mask, shots=shots)


def test_pixels_that_do_not_divide_the_light_field_are_refused_with_a_size_that_fits():
    camera = Camera.model_validate(changed("sensor", "binning", 3))
    with pytest.raises(CameraError, match=r"3 x 3 .* 10 x 12: crop it to 9 x 12"):
        build_imaging_matrix(camera, (10, 12))


def test_the_tile_of_binned_pixels_spans_pixels_not_samples():
    camera = Camera.model_validate(changed("sensor", {"cfa": "rggb", "binning": 2}))
    response = sensor_response(camera, (8, 8))[0]
    np.testing.assert_array_equal(response[::2, ::2], response[1::2, 1::2])
    assert response[0, 0].tolist() == [1, 0, 0]
    assert response[2, 2].tolist() == [0, 0, 1]
    assert response[0, 2].tolist() == response[2, 0].tolist() == [0, 1, 0]


@pytest.mark.parametrize("binning", [1, 2])
def test_a_pixel_collects_light_in_proportion_to_its_colours_and_samples(binning):
    sensor = {"cfa": ["RW"], "binning": binning}
    shots = [{}, {"filter": "red"}, {"filter": "blue"}]
    camera = Camera.model_validate({"title": "t", "sensor": sensor, "shots": shots})
    light = pixel_light(camera, (4, 4))
    assert light.shape == (3, 4 // binning, 4 // binning)
    for shot, pair in enumerate([(1, 3), (1, 1), (0, 1)]):
        expected = np.resize(np.array(pair) * binning**2, light.shape[1:])
        np.testing.assert_array_equal(light[shot], expected)


def test_a_mask_whose_shadow_diffraction_blurs_is_warned_about():
    assert Camera.model_validate(VALID).warnings() == []
    (warning,) = Camera.model_validate(changed("masks", "near", "distance_mm", 5)).warnings()
    assert "mask 'near': Fresnel number 0.052 < 1" in warning


@pytest.mark.parametrize("cfa", ["rggb", "mono", "x-trans", "rgbw"])
@pytest.mark.parametrize("binning", [1, 2])
def test_the_layout_of_psi_is_that_of_the_psi_built(cfa, binning):
    camera = Camera.model_validate({"title": "x", "sensor": {"cfa": cfa, "binning": binning}})
    layout, built = psi_layout(camera, (24, 36)), build_imaging_matrix(camera, (24, 36))
    assert layout.weights_shape == built.weights.shape
    assert layout.frames_shape == built.frames_shape
    assert (layout.colour is None) == (built.colour is None)
    if built.colour is not None:
        np.testing.assert_array_equal(layout.colour, built.colour)
