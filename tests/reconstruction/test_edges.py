"""Edges that views do not reach: found, left out of the fit, and given back as dark as they are."""

import numpy as np
import pytest
from planes import plane_scene

from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.adaptive import method
from emmc_rig.reconstruction.adaptive.edges import DarkEdges, dark_edges, faded
from emmc_rig.reconstruction.adaptive.joint import TextureSettings
from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings

SIGMA = 2e-3


@pytest.fixture
def camera_psi(coded_psi):
    return coded_psi("rggb", 1, 1, (64, 72), (3, 3))


def darkened(light_field, k=1):
    """Every second pixel of the last row black, others dim; a tenth of the first two columns."""
    out = light_field.copy()
    out[:, :, -k:] *= 0.4 * (np.arange(out.shape[3]) // k % 2)[:, None]
    out[:, :, :, : 2 * k] *= 0.1
    return out


def noisy(psi, light_field):
    clean = psi.forward(light_field)
    return clean + np.random.default_rng(0).normal(0, SIGMA, clean.shape).astype(np.float32)


def found_edges(psi, frames):
    return dark_edges(psi, frames, np.ones(frames.shape, bool))


@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize("shots", [1, 2])
def test_dark_edges_are_found_on_their_sides(coded_psi, binning, shots):
    psi = coded_psi("rggb", binning, shots, (64 * binning, 72 * binning), (3, 3))
    light_field, _ = plane_scene(psi, 1.5)
    assert found_edges(psi, noisy(psi, light_field)) is None
    edges = found_edges(psi, noisy(psi, darkened(light_field, binning)))
    assert edges is not None
    assert edges.widths == (0, 1, 2, 0)
    expected = np.zeros((64, 72), dtype=bool)
    expected[-1] = expected[:, :2] = True
    np.testing.assert_array_equal(edges.within, expected)


def test_an_object_across_the_border_is_no_edge(camera_psi):
    light_field, _ = plane_scene(camera_psi, 1.5)
    light_field[:, :, :20, :30] *= 0.1
    light_field[:, :, :, -20:] *= 0.1
    assert found_edges(camera_psi, noisy(camera_psi, light_field)) is None


@pytest.mark.parametrize("bright_px", [12, 20])
def test_a_dark_object_that_ends_beside_the_picture_is_no_edge_unless_it_is_all_along(
    camera_psi, bright_px
):
    light_field, _ = plane_scene(camera_psi, 1.5)
    light_field[:, :, bright_px:, :4] *= 0.4
    assert found_edges(camera_psi, noisy(camera_psi, light_field)) is None
    light_field[:, :, :bright_px, :4] *= 0.4
    edges = found_edges(camera_psi, noisy(camera_psi, light_field))
    assert edges is not None
    assert edges.widths == (0, 0, 4, 0)


def test_a_dark_line_inside_a_brighter_one_is_no_edge(camera_psi):
    light_field, _ = plane_scene(camera_psi, 1.5)
    light_field[:, :, -3] *= 0.1
    assert found_edges(camera_psi, noisy(camera_psi, light_field)) is None


@pytest.mark.parametrize("columns", [0, 2])
def test_a_line_dark_in_part_is_an_edge_where_another_side_has_one(camera_psi, columns):
    light_field, _ = plane_scene(camera_psi, 1.5)
    light_field[:, :, -1, 30:] *= 0.1
    light_field[:, :, :, :columns] *= 0.1
    edges = found_edges(camera_psi, noisy(camera_psi, light_field))
    assert (None if edges is None else edges.widths) == ((0, 1, 2, 0) if columns else None)


def test_a_shadow_that_deepens_to_the_border_is_no_edge_where_another_side_has_one(camera_psi):
    light_field, _ = plane_scene(camera_psi, 1.5)
    light_field[:, :, -8:, 30:] *= 0.7 ** np.arange(1, 9, dtype=np.float32)[:, None, None]
    light_field[:, :, :, :2] *= 0.1
    edges = found_edges(camera_psi, noisy(camera_psi, light_field))
    assert edges is not None
    assert edges.widths == (0, 0, 2, 0)


def test_frames_too_small_to_tell_have_no_edges(coded_psi):
    psi = coded_psi("rggb", 1, 1, (28, 60), (3, 3))
    light_field = np.ones(psi.light_field_shape, dtype=np.float32)
    assert found_edges(psi, noisy(psi, darkened(light_field))) is None


def test_edges_are_given_back_as_dark_as_the_frames_say(camera_psi):
    light_field, _ = plane_scene(camera_psi, 1.5)
    dark = darkened(light_field)
    within = np.zeros((64, 72), dtype=bool)
    within[-1] = within[:, :2] = True
    usable = np.ones(camera_psi.frames_shape, dtype=bool)
    usable[:, 5, 1] = False
    edges = DarkEdges((0, 1, 2, 0), within)
    out = faded(edges, camera_psi, light_field, camera_psi.forward(dark), usable)
    np.testing.assert_allclose(out[:, :, 5, 1], light_field[:, :, 5, 1])
    out[:, :, 5, 1] = dark[:, :, 5, 1]
    np.testing.assert_allclose(out, dark, atol=1e-5)


def test_edges_do_not_spoil_what_is_beside_them(camera_psi, monkeypatch):
    light_field, _ = plane_scene(camera_psi, 1.5)
    dark = darkened(light_field)
    frames = noisy(camera_psi, dark)
    settings = AdaptiveSettings(texture=TextureSettings(steps=6), patches=None)
    aware = reconstruct_adaptive(camera_psi, even_frames(frames, SIGMA), settings)
    assert aware.parameters["dark_edge_px"] == 2
    monkeypatch.setattr(method, "dark_edges", lambda *_: None)
    unaware = reconstruct_adaptive(camera_psi, even_frames(frames, SIGMA), settings)
    assert "dark_edge_px" not in unaware.parameters
    assert psnr_db(aware.light_field, dark) > psnr_db(unaware.light_field, dark) + 2
    beside = np.s_[:, :, :-4, 4:12]
    assert psnr_db(aware.light_field[beside], dark[beside]) > psnr_db(
        unaware.light_field[beside], dark[beside]
    )
