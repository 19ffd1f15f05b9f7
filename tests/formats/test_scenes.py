"""Opening any scene by name: built in, a file or a folder; and finer than it was measured."""

import numpy as np
import pytest
from view_files import save_views

from emmc_rig.formats.scenes import box_average, fine_scene, open_scene
from emmc_rig.model.errors import ModelError
from emmc_rig.model.lightfield import save_hdf5
from emmc_rig.simulators.scenes import SCENES, render


@pytest.fixture
def measured() -> np.ndarray:
    """Edges from black to white and noise: what a cubic overshoots at."""
    light_field = np.random.default_rng(5).random((3, 3, 20, 26, 3), dtype=np.float32)
    light_field[..., :13, :] = np.round(light_field[..., :13, :])
    return light_field


def test_a_built_in_scene_opens_by_name():
    scene = open_scene("near-planar", (32, 48), seed=2, views=(3, 3))
    rendered = render("near-planar", (3, 3), (32, 48), 2)
    np.testing.assert_array_equal(scene.light_field, rendered.light_field)
    assert scene.disparity_px is not None
    np.testing.assert_array_equal(scene.disparity_px, rendered.disparity_px)
    assert scene.name == "near-planar"
    assert "seed 2, 3x3 views of 32x48 pixels" in scene.provenance


def test_a_folder_and_a_file_open_by_path(tmp_path, measured):
    save_hdf5(tmp_path / "lf.h5", measured, {})
    save_views(tmp_path / "views", measured)
    from_file, from_folder = (
        open_scene(str(tmp_path / "lf.h5")),
        open_scene(str(tmp_path / "views")),
    )
    np.testing.assert_array_equal(from_file.light_field, measured)
    np.testing.assert_allclose(from_folder.light_field, measured, atol=0.51 / 255)
    assert (from_file.name, from_folder.name) == ("lf", "views")
    assert from_file.disparity_px is None
    assert str(tmp_path / "lf.h5") in from_file.provenance


def test_a_built_in_name_wins_over_a_folder_of_that_name(tmp_path, monkeypatch, measured):
    monkeypatch.chdir(tmp_path)
    save_views(tmp_path / "dark", measured)
    assert open_scene("dark", (16, 16), views=(2, 2)).light_field.shape == (2, 2, 16, 16, 3)
    assert open_scene("./dark").light_field.shape == measured.shape


def test_of_a_measured_scene_the_middle_is_cut(tmp_path, measured):
    save_hdf5(tmp_path / "lf.h5", measured, {})
    scene = open_scene(str(tmp_path / "lf.h5"), size=(10, 12), views=(2, 3))
    np.testing.assert_array_equal(scene.light_field, measured[0:2, :, 5:15, 7:19])
    assert "its middle 2x3 of 10x12" in scene.provenance


MISTAKES = [
    (lambda: open_scene("lf.h5", size=(21, 26)), "has 3x3 views of 20x26 pixels, fewer than"),
    (lambda: open_scene("lf.h5", views=(3, 4)), "has 3x3 views of 20x26 pixels, fewer than"),
    (lambda: open_scene("near-planar", size=(0, 5)), "it takes rows and columns"),
    (lambda: open_scene("near-plana"), f"did you mean 'near-planar'.*{'.*'.join(SCENES)}"),
    (lambda: open_scene("lf.txt"), r"ends in \.h5, \.hdf5 or \.mat"),
    (lambda: fine_scene("dark", 0, 2), "factors are 1 or more"),
    (lambda: fine_scene("dark", 2, 0), "factors are 1 or more"),
]


@pytest.mark.parametrize(("call", "words"), MISTAKES)
def test_what_is_no_scene_is_refused_in_one_line(tmp_path, monkeypatch, measured, call, words):
    monkeypatch.chdir(tmp_path)
    save_hdf5(tmp_path / "lf.h5", measured, {})
    (tmp_path / "lf.txt").write_text("")
    with pytest.raises(ModelError, match=words) as error:
        call()
    assert "\n" not in str(error.value)


def test_the_truth_of_a_fine_built_in_scene_is_its_box_average():
    fine = fine_scene("near-planar", 2, 3, (24, 32), seed=1, views=(2, 3))
    assert fine.samples.shape == (4, 6, 72, 96, 3)
    assert (fine.aperture_factor, fine.pixel_factor) == (2, 3)
    expected = fine.samples.reshape(2, 2, 3, 2, 24, 3, 32, 3, 3).mean(axis=(1, 3, 5, 7))
    np.testing.assert_allclose(fine.scene.light_field, expected, atol=1e-6)


@pytest.mark.parametrize("pixel_factor", [1, 2, 3])
def test_a_measured_scene_is_refined_without_changing_its_samples(tmp_path, measured, pixel_factor):
    save_hdf5(tmp_path / "lf.h5", measured, {})
    fine = fine_scene(str(tmp_path / "lf.h5"), 4, pixel_factor)
    assert fine.aperture_factor == 1
    assert fine.samples.shape == (3, 3, 20 * pixel_factor, 26 * pixel_factor, 3)
    assert fine.samples.min() >= 0
    assert fine.samples.max() <= 1
    np.testing.assert_array_equal(fine.scene.light_field, measured)
    np.testing.assert_allclose(box_average(fine.samples, 1, pixel_factor), measured, atol=1e-6)


def test_refining_a_ramp_interpolates_it_instead_of_repeating_samples(tmp_path):
    ramp = np.broadcast_to(np.linspace(0.1, 0.9, 33)[:, None], (2, 2, 16, 33, 3))
    save_hdf5(tmp_path / "lf.h5", ramp, {})
    fine = fine_scene(str(tmp_path / "lf.h5"), 1, 2).samples
    expected = 0.1 + 0.8 / 32 * ((np.arange(66) - 0.5) / 2)
    np.testing.assert_allclose(fine[0, 1, 8, 6:-6, 2], expected[6:-6], atol=1e-4)
