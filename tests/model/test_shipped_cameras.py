"""Shipped cameras: properties of their Psi, and mistakes in their files."""

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

SHIPPED = shipped_cameras()
NAMES = tuple(SHIPPED)
SCENARIOS = ("scenario-i-rgb", "scenario-ii-cfa", "scenario-iii-mono")
AT_LENS = (
    "coded-aperture-cosines",
    "coded-aperture-random",
    "coded-aperture-sequential-random",
    "learned-aperture",
    "programmable-aperture",
)
EPS = float(np.finfo(np.float32).eps)

every_camera = pytest.mark.parametrize("name", NAMES)
every_scenario = pytest.mark.parametrize("name", SCENARIOS)


def transmittance(camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """Return the share of light that passes (shot, v, u, y, stored colour, x)."""
    psi = build_imaging_matrix(camera, size)
    colours_seen = psi.weights.shape[4]
    return psi.weights * (camera.views[0] * camera.views[1] * colours_seen)


@every_camera
def test_a_shipped_camera_names_the_reference_it_stands_for(name: str) -> None:
    camera = SHIPPED[name]
    assert camera.title
    assert "paper" in camera.reference
    assert camera.views == (5, 5)


@every_camera
def test_an_odd_size_builds_and_no_pixel_reads_more_than_the_open_camera(name: str) -> None:
    psi = build_imaging_matrix(SHIPPED[name], (21, 25))
    whiteboard = psi.forward(np.ones(psi.light_field_shape, dtype=np.float32))
    assert psi.weights.min() >= 0
    assert whiteboard.max() <= 1 + 25 * EPS
    assert 0 < psi.light_efficiency() <= 1 + 25 * EPS
    assert psi.light_efficiency() == pytest.approx(whiteboard.mean(), rel=1e-5)


@pytest.mark.parametrize("name", AT_LENS)
def test_a_mask_at_the_lens_gives_each_view_one_value_its_own_cell(name: str) -> None:
    camera = SHIPPED[name]
    passed = transmittance(camera, (6, 8))
    plates = draw_plates(camera, (6, 8))
    for shot in range(len(camera.shots)):
        (mask,) = camera.shot_masks(shot)
        cells = plates[mask].cells
        expected = cells[shot % len(cells)].transpose(2, 0, 1)
        for colour in range(3):
            seen = passed[shot, :, :, :, colour]
            np.testing.assert_allclose(
                seen, np.broadcast_to(expected[colour, ..., None, None], seen.shape), atol=1e-6
            )


@every_scenario
@pytest.mark.parametrize("size", [(20, 24), (21, 25), (4, 331)])
def test_every_sample_of_a_scenario_sees_exactly_one_mask_cell(
    name: str, size: tuple[int, int]
) -> None:
    camera = SHIPPED[name]
    passed = transmittance(camera.with_shots(2 * len(camera.shots)), size)
    assert np.abs(passed - np.rint(passed)).max() < 1e-6
    if passed.shape[4] == 3:
        open_colours = np.rint(passed).sum(axis=4)
        assert np.isin(open_colours, (1, 3)).all()  # a red, green, blue or clear cell


@every_scenario
def test_a_scenarios_mask_moves_by_one_sample_from_view_to_view(name: str) -> None:
    bare = SHIPPED["scenario-iii-mono"]
    camera = SHIPPED[name].model_copy(update={"sensor": bare.sensor, "shots": bare.shots})
    passed = transmittance(camera, (20, 24))
    np.testing.assert_allclose(passed[:, :, :-1, :, :, 1:], passed[:, :, 1:, :, :, :-1], atol=1e-6)
    np.testing.assert_allclose(passed[:, :-1, :, 1:], passed[:, 1:, :, :-1], atol=1e-6)


def test_colour_by_colour_moves_its_mask_only_between_rounds_of_three() -> None:
    camera = SHIPPED["scenario-i-rgb"].with_shots(6)
    assert [shot.filter for shot in camera.shots] == 2 * ["red", "green", "blue"]
    offsets = [shot.offset_um.get("mask", (0.0, 0.0)) for shot in camera.shots]
    assert offsets[:3] == [(0.0, 0.0)] * 3
    assert len(set(offsets[3:])) == 1
    cell_um = camera.masks["mask"].cell_um
    assert np.array(offsets[3]) / cell_um == pytest.approx([11, 7], rel=1e-12)


@pytest.mark.parametrize("name", [name for name in NAMES if SHIPPED[name].more_shots_step_um])
def test_further_rounds_of_shots_see_the_mask_elsewhere(name: str) -> None:
    camera = SHIPPED[name]
    longer = camera.with_shots(3 * len(camera.shots))
    states = [(shot.filter, tuple(shot.offset_um.items())) for shot in longer.shots]
    assert len(set(states)) == len(states)
    psi = build_imaging_matrix(longer, (8, 8))
    blocks = np.moveaxis(psi.gram, (0, 1), (2, 3))
    full_rank = np.linalg.matrix_rank(blocks, tol=1e-6) == psi.shots
    assert full_rank.mean() > 0.5


@pytest.mark.parametrize("shots", [1, 2, 3])
def test_the_bench_camera_takes_the_shots_of_its_name_within_one_exposure(shots: int) -> None:
    camera = SHIPPED[f"rgbw-bayer-{shots}shot{'s' if shots > 1 else ''}"]
    assert len(camera.shots) == shots
    assert camera.exposures_s().sum() == pytest.approx(0.05)
    assert camera.masks == SHIPPED["rgbw-bayer-1shot"].masks


@every_camera
def test_shipped_masks_are_coarse_enough_for_ray_optics(name: str) -> None:
    assert SHIPPED[name].warnings() == []


@pytest.mark.parametrize("name", NAMES)
def test_white_is_seen_as_by_all_views_of_psi_together(name):
    camera, size = SHIPPED[name], (14, 20)
    psi = build_imaging_matrix(camera, size)
    seen = seen_of_white(camera, size, draw_plates(camera, size))
    np.testing.assert_allclose(seen, psi.weights.sum(axis=(1, 2)), rtol=1e-5, atol=1e-7)
