"""The lens's pupil in Psi, against single rays through its opening."""

from __future__ import annotations

import numpy as np
import pytest

from emmc_rig.model.camera import (
    Camera,
    build_imaging_matrix,
    draw_plates,
    seen_of_white,
    shipped_cameras,
)
from emmc_rig.model.errors import CameraError
from emmc_rig.model.settings import validated

SIZE = (4, 5)
RAYS = 160
"""Along each side of an aperture cell."""
CODE = {"distance_mm": 0.24, "cell_um": 24, "pattern": {"kind": "uniform_colour", "seed": 4}}
BETWEEN = {"distance_mm": 25, "cell_um": 900, "pattern": {"kind": "uniform_colour", "seed": 7}}
LEFT_ROUND = {"diameter_mm": 25, "centre_mm": [0.8, -0.5]}
PUPILS = {
    "round": {"diameter_mm": 25},
    "decentred": LEFT_ROUND,
    "small": {"diameter_mm": 18},
    "blades": {"shape": "polygon", "blades": 5, "diameter_mm": 27, "turn_deg": 11},
    "square": {"shape": "square", "diameter_mm": 21, "turn_deg": 20},
    "upright square": {"shape": "square", "diameter_mm": 21.3},
}


def camera_with(pupil, masks=None, sensor=None, **lens):
    return Camera.model_validate(
        {
            "title": "test",
            "lens": {"pupil": pupil, **lens},
            "sensor": {"pixel_fill": 0, **(sensor or {})},
            "masks": {"code": CODE} if masks is None else masks,
        }
    )


def is_open(pupil, x_mm, y_mm, pixel_mm=(0.0, 0.0)):
    """Return which points of the lens lie in the pupil: in each half plane, in each disk."""
    x0, y0 = pupil.get("centre_mm", (0, 0))
    x, y, shape = x_mm - x0, y_mm - y0, pupil.get("shape", "round")
    if shape == "round":
        inside = np.hypot(x, y) <= pupil["diameter_mm"] / 2
    else:
        turn = np.deg2rad(pupil.get("turn_deg", 0))
        sides = 4 if shape == "square" else pupil["blades"]
        first = 0.0 if shape == "square" else np.pi / sides
        reach = pupil["diameter_mm"] / 2 * (1 if shape == "square" else np.cos(np.pi / sides))
        inside = np.ones(x.shape, bool)
        for side in range(sides):
            angle = turn + first + 2 * np.pi * side / sides
            inside &= np.cos(angle) * x + np.sin(angle) * y <= reach
    if rim := pupil.get("rim"):
        shift = rim.get("shift", -1)
        away = np.hypot(x_mm - shift * pixel_mm[0], y_mm - shift * pixel_mm[1])
        inside &= away <= rim["diameter_mm"] / 2
    return inside


def psi_of_rays(camera, pupil, size=SIZE):
    """Return Psi (v, u, y, x, colour) of points of a sensor without filters, ray by ray."""
    rng = np.random.default_rng(0)
    lens, pitch_mm = camera.lens, camera.sensor.sample_pitch_um / 1e3
    # A jittered grid over the open part of an aperture cell.
    along, down = (
        (np.arange(RAYS).reshape(shape) + rng.random((RAYS, RAYS))) / RAYS - 0.5
        for shape in ((1, -1), (-1, 1))
    )
    plates = draw_plates(camera, size).values()
    psi, opened = np.zeros((*camera.views, *size, 3)), np.zeros((*camera.views, *size, 1))
    for v, u, y, x in np.ndindex(psi.shape[:4]):
        at = pitch_mm * (x - (size[1] - 1) / 2), pitch_mm * (y - (size[0] - 1) / 2)
        on_lens = [
            lens.aperture_cell_mm * (view - (count - 1) / 2 + lens.aperture_fill * within)
            for view, count, within in zip((u, v), camera.views[::-1], (along, down), strict=True)
        ]
        inside = is_open(pupil, on_lens[0], on_lens[1], at)
        passed = np.repeat(inside[..., None], 3, axis=2).astype(float)
        for plate in plates:
            ratio = plate.distance_mm / lens.distance_mm
            rows, columns = plate.cells.shape[1:3]
            column, row = (
                np.floor(1e3 * ((1 - ratio) * pixel + ratio * ray) / plate.cell_um + count / 2)
                for pixel, ray, count in zip(at, on_lens, (columns, rows), strict=True)
            )
            passed *= plate.cells[0][row.astype(int), column.astype(int)]
        psi[v, u, y, x], opened[v, u, y, x] = passed.mean(axis=(0, 1)), inside.mean()
    return psi / opened.sum(axis=(0, 1)) / 3


def in_order_of_rays(psi):
    """Return the weights of a Psi of one shot as (v, u, y, x, colour)."""
    return psi.weights[0].transpose(0, 1, 2, 4, 3)


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("name", PUPILS)
def test_psi_behind_a_pupil_is_that_of_the_rays_inside_it(name):
    camera = camera_with(PUPILS[name])
    found = in_order_of_rays(build_imaging_matrix(camera, SIZE))
    rays = psi_of_rays(camera, PUPILS[name])
    assert relative_error(found, rays) < 2e-3
    # To take the views for whole is wrong by far more.
    whole = in_order_of_rays(build_imaging_matrix(camera_with(None), SIZE))
    assert relative_error(whole, rays) > 0.1


@pytest.mark.parametrize("shift", [-1.0, 0.5])
def test_a_rim_cuts_other_views_at_other_places_of_the_picture(shift):
    pupil = {"diameter_mm": 25, "rim": {"diameter_mm": 26, "shift": shift}}
    # Samples of 2 mm: 8 mm from edge to edge, over which the rim moves by more than a view.
    camera = camera_with(pupil, sensor={"sample_pitch_um": 2000.0})
    found = in_order_of_rays(build_imaging_matrix(camera, SIZE))
    assert relative_error(found, psi_of_rays(camera, pupil)) < 5e-3
    left, right = found[2, 0].sum(axis=(0, 2))[[0, -1]]
    assert (left < 0.8 * right) if shift < 0 else (right < 0.8 * left)


@pytest.mark.parametrize("fill", [0.0, 0.6])
def test_point_and_narrow_apertures_lie_inside_a_pupil_or_outside(fill):
    camera = camera_with({"diameter_mm": 25}, aperture_fill=fill)
    found = in_order_of_rays(build_imaging_matrix(camera, SIZE))
    assert relative_error(found, psi_of_rays(camera, {"diameter_mm": 25})) < 2e-3
    assert camera.view_shares()[0, 0] == pytest.approx(0.0 if fill == 0 else 0.025, abs=1e-3)


def test_two_masks_are_seen_together_through_what_is_open():
    masks = {"code": CODE, "far": BETWEEN}
    camera = camera_with(LEFT_ROUND, masks)
    found = in_order_of_rays(build_imaging_matrix(camera, SIZE))
    assert relative_error(found, psi_of_rays(camera, LEFT_ROUND)) < 1e-2


@pytest.mark.parametrize("rim", [None, {"diameter_mm": 26}])
@pytest.mark.parametrize("cfa", ["mono", "rggb"])
def test_a_camera_without_masks_reads_one_from_white_behind_any_pupil(cfa, rim):
    pupil = {"diameter_mm": 25, "rim": rim}
    camera = camera_with(pupil, {}, {"cfa": cfa, "sample_pitch_um": 500.0})
    psi = build_imaging_matrix(camera, SIZE)
    white = np.ones((5, 5, *SIZE, 3), np.float32)
    np.testing.assert_allclose(psi.forward(white), 1, rtol=1e-5)
    seen = seen_of_white(camera, SIZE, {})
    np.testing.assert_allclose(seen, psi.weights.sum(axis=(1, 2)), rtol=1e-5)


def test_a_pupil_around_all_views_changes_nothing():
    """Whole views are one box each, and all shares are alike."""
    around = build_imaging_matrix(camera_with({"diameter_mm": 40}), SIZE)
    none = build_imaging_matrix(camera_with(None), SIZE)
    np.testing.assert_allclose(around.weights, none.weights, rtol=1e-6)


def test_views_outside_of_the_pupil_have_no_coefficients_and_are_named():
    camera = camera_with(PUPILS["small"])
    measured = camera.views_measured()
    np.testing.assert_array_equal(~measured, np.hypot(*np.indices((5, 5)) - 2.0) > 2.5)
    psi = build_imaging_matrix(camera, SIZE)
    assert not psi.weights[0][~measured].any()
    assert (psi.weights[0][measured].max(axis=(1, 2, 3)) > 0).all()
    outside, narrow = camera.warnings()
    assert outside == (
        "views (0, 0), (0, 4), (4, 0), (4, 4) outside of the lens's pupil: not measured"
    )
    assert narrow.startswith("views (0, 1), (0, 3), (1, 0), (1, 4), (3, 0), ")
    assert "(4, 3) 6 % open; views (0, 2), (2, 0), (2, 4), (4, 2) 28 % open" in narrow


@pytest.mark.parametrize(
    ("pupil", "line"),
    [
        ({"diametre_mm": 25}, "unknown key 'lens.pupil.diametre_mm': did you mean 'diameter_mm'?"),
        ({"diameter_mm": 25, "rim": {"shfit": 1}}, "did you mean 'shift'?"),
        ({"diameter_mm": 25, "shape": "ruond"}, "lens.pupil.shape"),
        ({"diameter_mm": 2, "centre_mm": [90, 0]}, "lens.pupil leaves no view open"),
    ],
)
def test_a_pupil_that_cannot_be_is_refused_with_one_line(pupil, line):
    with pytest.raises(CameraError) as refused:
        validated(Camera, {"title": "t", "lens": {"pupil": pupil}}, "mine.yaml", CameraError)
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_camera_without_a_pupil_is_written_as_before():
    for camera in shipped_cameras().values():
        assert camera.lens.pupil is None
        assert "pupil" not in camera.model_dump_json()
    given = camera_with({"diameter_mm": 25, "rim": {"diameter_mm": 26}})
    assert Camera.model_validate_json(given.model_dump_json()) == given
