"""Scenes and results as arrays: refocused, between views, in mm, and for other programs."""

import base64
import html
import re
import sys
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

import emmc_rig as emmc
from emmc_rig.formats.exports import open_export
from emmc_rig.formats.light_field_array import LightFieldArray
from emmc_rig.model.errors import CameraError
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.optics import Optics, optics_of
from emmc_rig.report import viewer
from emmc_rig.report.display import png_of, tiled
from emmc_rig.report.viewer import curve_of, viewer_data

LENS = {"distance_mm": 52.0, "aperture_cell_mm": 3.0, "focus_mm": 700.0}
CAMERA = {"title": "mine", "lens": LENS, "sensor": {"sample_pitch_um": 12.0}}


@pytest.fixture(scope="module")
def scene():
    return emmc.scene("deep-occlusions", size=(48, 64))


@pytest.fixture(scope="module")
def result():
    """A result of `adaptive`, which has a disparity and deviations."""
    scene = emmc.scene("near-planar", size=(40, 52))
    camera = emmc.camera("rgbw-bayer-1shot")
    described = camera.model_dump()
    camera = emmc.camera({**described, "lens": {**described["lens"], "focus_mm": 700.0}})
    psi = camera.psi(scene.size)
    return emmc.reconstruct(psi, camera.expose(scene, psi=psi))


def test_the_viewer_has_the_all_in_focus_picture_and_the_optics_of_python(
    result, tmp_path, monkeypatch
):
    def lossless(views, most_bytes, tile=16):
        return png_of(np.ascontiguousarray(tiled(views, tile)[..., ::-1]))

    monkeypatch.setattr(viewer, "sprite", lossless)
    result.save(tmp_path / "saved")
    for export in (result._export(), open_export(str(tmp_path / "saved"))):
        data: Any = viewer_data(export)
        sharp = data["overlays"][-1]
        codes = np.frombuffer(base64.b64decode(sharp["picture"].partition(",")[2]), np.uint8)
        shown = cv2.imdecode(codes, cv2.IMREAD_COLOR_RGB)
        np.testing.assert_array_equal(shown, curve_of(export).encode(result.all_in_focus()))
        np.testing.assert_allclose(
            Optics(**data["optics"]).depth_mm(result._centre_disparity), result.depth_mm().mm
        )
        assert data["no_depth"] == ""
    with pytest.raises(CameraError) as refused:
        optics_of(None, None)
    missing = viewer_data(replace(export, camera=None))["no_depth"]
    assert missing.lower() == f"{refused.value}.".lower()


def sheared(disparity_px, size=(40, 60), noise=0.0):
    """A smooth light field of one disparity, 5x5 views."""
    v, u, y, x = np.ogrid[-2:3, -2:3, : size[0], : size[1]]
    y, x = y - disparity_px * v, x - disparity_px * u
    grey = 0.5 + 0.3 * np.sin(0.3 * x + 0.2 * y) * np.cos(0.25 * y)
    light = np.repeat(grey[..., None], 3, axis=-1)
    noisy = light + np.random.default_rng(0).normal(0, noise, light.shape)
    return np.clip(noisy, 0, 1).astype(np.float32), light


def test_numpy_takes_scenes_and_results_as_light_fields(scene, result):
    for given in (scene, result):
        assert np.asarray(given).dtype == np.float32
        np.testing.assert_array_equal(np.asarray(given), given.light_field)
        assert given.shape == given.light_field.shape
        np.testing.assert_array_equal(given[1:3, 2, ..., 0], given.light_field[1:3, 2, ..., 0])
    assert emmc.scene(result).size == (40, 52)


def test_what_is_refocused_on_is_sharp_and_as_the_centre_view():
    light_field, light = sheared(1.5)
    scene = emmc.scene(light_field)
    inner = np.s_[6:-6, 6:-6]
    np.testing.assert_allclose(scene.refocus(1.5)[inner], light[2, 2][inner], atol=2e-3)
    assert np.abs(scene.refocus(0.0)[inner] - light[2, 2][inner]).max() > 0.1


@pytest.mark.parametrize("depth_mm", [300.0, 700.0, 2500.0])
@pytest.mark.parametrize("lens_mm", [-6.0, 3.0])
def test_depth_is_where_rays_through_a_thin_lens_meet(depth_mm, lens_mm):
    camera = emmc.camera(CAMERA)
    focal_mm = 1 / (1 / 52 + 1 / 700)

    def on_sensor(u_mm, object_mm=4.0):
        slope = (u_mm - object_mm) / depth_mm - u_mm / focal_mm
        return u_mm + 52 * slope

    steps = lens_mm / 3.0
    disparity_px = (on_sensor(lens_mm) - on_sensor(0.0)) / 0.012 / steps
    optics = optics_of(camera, None)
    assert optics.depth_mm(np.array(disparity_px)) == pytest.approx(depth_mm, rel=1e-9)
    assert optics.disparity_of(depth_mm) == pytest.approx(disparity_px, abs=1e-9)


def test_the_deviation_of_depth_is_that_of_depths_by_noisy_disparities():
    optics, rng = Optics(focus_mm=700.0, per_px=5e-5), np.random.default_rng(0)
    depths = optics.depth_mm(rng.normal(1.2, 0.05, 200_000))
    sigma = optics.sigma_mm(optics.depth_mm(np.array(1.2)), np.array(0.05))
    assert depths.std() == pytest.approx(float(sigma), rel=0.02)
    assert np.isinf(optics.depth_mm(np.array(-1 / 700 / 5e-5 - 0.1)))


def test_a_result_has_its_depth_in_mm_and_is_refocused_on_one(result):
    depth = result.depth_mm()
    assert depth.mm.shape == np.shape(depth.sigma_mm) == (40, 52)
    assert np.corrcoef(depth.mm.ravel(), result.disparity.ravel())[0, 1] < -0.9
    optics = optics_of(emmc.camera("rgbw-bayer-1shot"), 700.0)
    foretold_mm = optics.sigma_mm(depth.mm, result.maps["disparity_sigma"])  # widened once
    np.testing.assert_allclose(depth.sigma_mm, foretold_mm, rtol=1e-6)
    nearer = result.depth_mm(focus_mm=400.0)
    assert np.median(nearer.mm) < np.median(depth.mm)
    assert nearer.sigma_mm.mean() < depth.sigma_mm.mean()
    px = optics.disparity_of(650.0)
    np.testing.assert_array_equal(result.refocus(depth_mm=650.0), result.refocus(px))
    assert result.refocus(depth_mm=650.0, focus_mm=650.0).shape == (40, 52, 3)


@pytest.mark.parametrize(
    ("camera", "focus_mm", "missing", "known"),
    [
        (None, None, "lens.distance_mm.*sample_pitch_um.*; and .*lens.focus_mm", "$^"),
        (None, 700.0, "lens.distance_mm", "focus_mm"),
        ("rgbw-mono", None, "lens.focus_mm", "distance_mm"),
    ],
)
def test_the_numbers_that_depth_lacks_are_named_in_one_line(
    scene, camera, focus_mm, missing, known
):
    with pytest.raises(emmc.ERRORS, match=missing) as refused:
        scene.depth_mm(focus_mm, camera and emmc.camera(camera))
    assert not re.search(known, str(refused.value))
    assert "\n" not in str(refused.value)


def test_a_camera_without_focus_is_described_and_hashed_as_before():
    assert "focus_mm" not in emmc.camera("rgbw-mono").model_dump_json()
    assert '"focus_mm":700' in emmc.camera(CAMERA).model_dump_json()


def test_all_in_focus_has_less_noise_and_no_ghosts(scene):
    noisy, light = sheared(1.25, noise=0.03)
    taken = emmc.scene(noisy)
    gained_db = psnr_db(taken.all_in_focus(), light[2, 2]) - psnr_db(noisy[2, 2], light[2, 2])
    assert gained_db > 6  # 14 dB by 25 equal views, less what interpolation costs
    assert psnr_db(scene.all_in_focus(), scene[2, 2]) > 38  # occlusions, no noise


def test_a_view_between_lies_between_and_a_view_is_itself(scene):
    light_field, _ = sheared(1.0)
    taken = emmc.scene(light_field)
    np.testing.assert_array_equal(taken.view(3, 1), light_field[3, 1])
    inner = np.s_[6:-6, 6:-6]
    y, x = np.mgrid[:40, :60].astype(float)
    y, x = y + 0.5, x - 1.25
    true = 0.5 + 0.3 * np.sin(0.3 * x + 0.2 * y) * np.cos(0.25 * y)
    np.testing.assert_allclose(taken.view(1.5, 3.25)[inner][..., 0], true[inner], atol=0.02)


def test_epipolar_images_are_rows_and_columns_of_the_middle_views(scene):
    np.testing.assert_array_equal(scene.epipolar(row=7), scene.light_field[2, :, 7])
    np.testing.assert_array_equal(scene.epipolar(column=9), scene.light_field[:, 2, :, 9])


MISTAKES = {
    "nothing to focus on": (lambda s: s.refocus(), "either disparity"),
    "twice focused": (lambda s: s.refocus(1, depth_mm=2), "either disparity"),
    "a map to focus on": (lambda s: s.refocus(np.ones((4, 4))), "either disparity"),
    "behind the lens": (lambda s: s.refocus(depth_mm=-2, camera=emmc.camera(CAMERA)), "above 0"),
    "a focus of nothing": (lambda s: s.depth_mm(0, emmc.camera(CAMERA)), "above 0"),
    "beyond the views": (lambda s: s.view(1, 4.5), "u: got 4.5; .* 0 to 4"),
    "a view by name": (lambda s: s.view("centre", 2), "v: got 'centre'"),
    "no line": (lambda s: s.epipolar(), "a row from 0 to 47"),
    "two lines": (lambda s: s.epipolar(1, 2), "one of them"),
    "a line outside": (lambda s: s.epipolar(column=64), "a column to 63"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused_in_one_line(scene, mistake):
    call, words = MISTAKES[mistake]
    with pytest.raises(emmc.ERRORS, match=words) as refused:
        call(scene)
    assert "\n" not in str(refused.value)


def test_bands_show_no_parallax_and_say_so(scene):
    bands = LightFieldArray()
    bands.__dict__.update(light_field=scene.light_field, view_axes=("angle", "band"), maps={})
    for call in (lambda: bands.refocus(1.0), bands.all_in_focus, lambda: bands.view(0.5, 1)):
        with pytest.raises(emmc.ERRORS, match="bands for views"):
            call()
    np.testing.assert_array_equal(bands.view(1, 2), scene[1, 2])


def test_xarray_has_the_axes_with_units_and_all_maps(result):
    pytest.importorskip("xarray")
    found = result.to_xarray()
    assert found.light_field.dims == ("v", "u", "y", "x", "c")
    np.testing.assert_array_equal(
        found.light_field.sel(v=1, u=3, c="green"), np.asarray(result)[1, 3, ..., 1]
    )
    np.testing.assert_array_equal(found.sigma, result.sigma)
    np.testing.assert_array_equal(found.depth, result.depth_mm().mm)
    np.testing.assert_allclose(found.u_mm, [-10, -5, 0, 5, 10])
    assert float(found.x_um[1] - found.x_um[0]) == pytest.approx(24)
    units = {name: found[name].attrs["units"] for name in ("v", "x", "v_mm", "depth", "disparity")}
    assert units == {
        "v": "view", "x": "pixel", "v_mm": "mm", "depth": "mm", "disparity": "pixel per view"
    }  # fmt: skip
    assert set(emmc.scene(np.asarray(result)).to_xarray().data_vars) == {"light_field"}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of napari itself
def test_napari_shows_the_views_with_sliders_and_its_maps_on_the_same_pixels(result):
    napari = pytest.importorskip("napari")
    viewer = napari.components.ViewerModel()
    viewer.layers.extend(result.to_napari())
    assert next(layer.name for layer in viewer.layers) == "light field"
    assert {layer.name for layer in viewer.layers} >= {"disparity", "sigma"}
    assert viewer.dims.ndim == 4
    assert viewer.dims.nsteps == (5, 5, 40, 52)
    assert [layer.visible for layer in viewer.layers].count(True) == 1


@pytest.mark.parametrize(("call", "package"), [("to_xarray", "xarray"), ("to_napari", "napari")])
def test_an_extra_that_is_missing_is_named_with_what_installs_it(scene, monkeypatch, call, package):
    for name in (package, f"{package}.layers"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(emmc.ERRORS, match=rf'needs {package}: pip install "emmc-rig\[{package}\]"'):
        getattr(scene, call)()


def pictures_of(shown):
    """Return the pictures of `_repr_html_` by their titles, RGB codes."""
    found = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,([^"]*)"', shown)
    codes = {title: np.frombuffer(base64.b64decode(data), np.uint8) for title, data in found}
    return {
        html.unescape(title): np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1]
        for title, data in codes.items()
    }


def test_a_notebook_shows_a_camera_s_masks_and_their_shadow():
    cells = np.zeros((80, 100))
    cells[:, 50:] = 1
    mask = {"distance_mm": 0.5, "cell_um": 24, "pattern": cells}
    camera = emmc.camera({"title": "half", "masks": {"code": mask}})
    seen = pictures_of(camera._repr_html_())
    plate, outer, inner, every = seen.values()
    assert [title.split(",")[0] for title in seen] == [
        "mask 'code' at 0.5 mm", "shadow in view (0", "shadow in view (2", "shadow in all 5x5 views"
    ]  # fmt: skip
    assert plate.min() == 0
    assert plate.max() == 255
    open_columns = [int((picture[24, :, 0] > 128).sum()) for picture in (outer, inner)]
    assert open_columns[1] - open_columns[0] == pytest.approx(4.2, abs=1)  # 2 x 50 um of 24
    assert every.shape == (48, 64, 3)
    assert repr(camera) in html.unescape(camera._repr_html_())
    small = {**mask, "pattern": np.ones((4, 4))}
    refused = emmc.camera({"title": "small", "masks": {"code": small}})._repr_html_()
    assert "small" in refused
    assert not pictures_of(refused)


def test_a_notebook_shows_frames_with_unusable_pixels_in_red_and_psi_and_scenes(scene):
    camera = emmc.camera("rgbw-bayer-2shots")
    psi = camera.psi(scene.size)
    frames = camera.expose(scene, psi=psi)
    frames.usable[1, 3, 5] = False
    first, second = pictures_of(frames._repr_html_()).values()
    red = (second[..., 0] > 2 * second[..., 1].astype(int)) & (second[..., 1] == 0)
    assert np.argwhere(red & (second[..., 0] > 99)).tolist() == [[3, 5]]
    assert (np.ptp(first.astype(int), axis=-1) == 0).all()
    corner = next(iter(pictures_of(psi._repr_html_()).values()))
    assert ((corner > 0).sum(axis=-1) <= 1).all()  # a Bayer pixel sees one colour
    view, lines, disparity = pictures_of(scene._repr_html_()).values()
    assert view.shape[:2] == disparity.shape[:2] == (48, 64)
    assert lines.shape[1] == 64


def test_a_mask_is_a_bare_array_and_an_exposure_is_given_with_the_scene(scene):
    cells = np.random.default_rng(0).random((64, 90)) < 0.5
    place = {"distance_mm": 0.5, "cell_um": 36}
    bare = emmc.camera({"title": "m", "masks": {"code": {**place, "pattern": cells}}})
    pattern = {"kind": "parameters", "cells": cells}
    assert bare == emmc.camera({"title": "m", "masks": {"code": {**place, "pattern": pattern}}})
    psi = bare.psi(scene.size)
    usual, long = (bare.expose(scene, psi=psi, exposure_s=s) for s in (0.05, 5.0))
    assert usual.frames_dn.max() < long.frames_dn.max()
    np.testing.assert_array_equal(usual.frames_dn, bare.expose(scene, psi=psi).frames_dn)
    two = emmc.camera("rgbw-bayer-2shots")
    dim, bright = two.expose(scene, exposure_s=(0.01, 0.04)).deviation
    assert np.median(dim / bright) == pytest.approx(2, rel=0.1)  # photons: the root of four


def test_what_is_saved_is_opened_as_the_same_array(result, tmp_path):
    result.save(tmp_path / "kept")
    again = emmc.open_result(tmp_path / "kept")
    np.testing.assert_array_equal(np.asarray(again), np.asarray(result))
    np.testing.assert_array_equal(again.depth_mm().sigma_mm, result.depth_mm().sigma_mm)
