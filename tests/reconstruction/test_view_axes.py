"""Views that are bands or times, few or many, closed in part: Psi to files, pages and exports."""

import hashlib
from dataclasses import replace
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from programs import program

import emmc_rig as emmc
from emmc_rig.formats.exports import open_export
from emmc_rig.formats.registry import FORMATS
from emmc_rig.model.camera import Camera, camera_of, psi_layout, sensor_response
from emmc_rig.model.errors import SensingError, ViewOrderWarning
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import check_light_field, save_hdf5
from emmc_rig.model.sensing import Psi
from emmc_rig.model.view_axes import ANGLES
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.reconstructing import reconstruct_undrawn
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.preview import Preview
from emmc_rig.reconstruction.verdict.bands import mask_shift_px
from emmc_rig.reconstruction.verdict.rules import verdict_from
from emmc_rig.report.page import light_field_head
from emmc_rig.report.report import ReportContent, render
from emmc_rig.report.result_figure import draw_results
from emmc_rig.report.viewer import render_viewer, viewer_data
from emmc_rig.store.pool import opened_pool
from emmc_rig.store.psi import FRAMES, PSI, StoredPsi, save_shards
from emmc_rig.store.result_files import MAPS

SIZE = (24, 32)
BANDS, TIMES = ("angle", "band"), ("time", "angle")
NOISE = 0.003


def psi_of(views, axes, shots=1, closed=False, size=SIZE):
    """Return the Psi of a random binary code; closed: half of the views let no light through."""
    rng = np.random.default_rng(3)
    weights = rng.integers(0, 2, (shots, *views, size[0], 1, size[1])).astype(np.float32)
    if closed:
        weights[:, :, ::2] = 0
    weights /= weights.sum(axis=(1, 2)).mean()
    return Psi(weights, np.zeros((shots, *size), np.uint8), view_axes=axes)


def light_of(views, axes, size=SIZE):
    """Return a light field: disparity 0.5 of angles; pictures that dim one after the other."""
    rng = np.random.default_rng(4)
    fine = cv2.GaussianBlur(rng.random((2 * size[0] + 60, 2 * size[1] + 60)), (0, 0), 4)
    fine = (fine - fine.min()) / (fine.max() - fine.min())
    light = np.empty((*views, *size, 3), np.float32)
    for k, (v, u) in enumerate(np.ndindex(*views)):
        down, right = (v, u) if axes == ANGLES else (0, 0)
        seen = fine[30 - down :, 30 - right :][: 2 * size[0] : 2, : 2 * size[1] : 2]
        light[v, u] = (seen * (1 if axes == ANGLES else 1 - 0.5 * k / views[0] / views[1]))[
            ..., None
        ]
    return light


def frames_of(psi, light):
    rng = np.random.default_rng(5)
    return (psi @ light + rng.normal(0, NOISE, psi.frames_shape)).astype(np.float32)


def solved(views, axes, method="tv"):
    """Return the result from the readings of `light_of` by `psi_of`."""
    psi = psi_of(views, axes)
    return emmc.reconstruct(psi, frames_of(psi, light_of(views, axes)), method, noise_sigma=NOISE)


def cassi_file(folder, cells, bands=24, step=2):
    """Write the YAML of a mask whose shadow moves by `step` pixels from band to band."""
    lens_mm, mask_mm, pitch_um = 50, 0.5, 24
    cell_um = (1 - mask_mm / lens_mm) * pitch_um  # one sample wide on the sensor
    pattern = {"kind": "parameters", "cells": cells.tolist()}
    camera = {
        "title": "CASSI",
        "views": [1, bands],
        "view_axes": ["angle", "band"],
        "lens": {
            "distance_mm": lens_mm,
            "aperture_cell_mm": step * cell_um * lens_mm / mask_mm / 1e3,
            "aperture_fill": 0,
        },
        "sensor": {"sample_pitch_um": pitch_um},
        "masks": {"code": {"distance_mm": mask_mm, "cell_um": cell_um, "pattern": pattern}},
    }
    path = folder / "cassi.yaml"
    path.write_text(yaml.safe_dump(camera))
    return path


@pytest.fixture(scope="module")
def bands():
    """A light field of 6 bands, reconstructed."""
    return solved((1, 6), BANDS)


@pytest.mark.parametrize("axes", [BANDS, TIMES, ("time", "band")])
def test_the_names_of_the_view_axes_are_kept_by_files_and_parts_of_psi(tmp_path, axes):
    psi = psi_of((2, 3), axes, shots=2)
    psi.save(tmp_path / "psi.h5")
    pytest.importorskip("zarr")
    save_shards(psi, tmp_path / "psi.zarr")
    for path in (tmp_path / "psi.h5", tmp_path / "psi.zarr"):
        saved = StoredPsi(path)
        assert saved.load().view_axes == saved.view_axes == axes
        assert saved.window(slice(0, 8), slice(0, 8)).view_axes == axes
        assert saved.checksum == psi.checksum()
    assert psi.of_shots([1]).view_axes == psi.window(slice(0, 8), slice(0, 8)).view_axes == axes
    assert ", ".join(axes) in repr(psi)
    again = Psi.from_scipy(psi.to_scipy(), (2, 3), SIZE, view_axes=axes)
    assert again.view_axes == axes


def test_a_psi_of_an_earlier_version_has_its_views_at_angles(tmp_path):
    psi = psi_of((2, 3), ANGLES)
    psi.save(tmp_path / "psi.h5")
    with h5py.File(tmp_path / "psi.h5", "r+") as file:
        del file.attrs["view_axes"]
    assert Psi.load(tmp_path / "psi.h5").view_axes == ANGLES
    content = b"emmc-rig imaging matrix 1|1|" + psi.weights.tobytes() + psi.colour_map.tobytes()
    assert psi.checksum() == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    ("stored", "words"),
    [
        ("angle,colour", r"psi\.h5: view_axes 'angle,colour': two of angle"),
        ("angle,time", "checksum"),
    ],
)
def test_other_view_axes_in_a_file_are_refused(tmp_path, stored, words):
    path = tmp_path / "psi.h5"
    psi_of((1, 3), BANDS).save(path)
    with h5py.File(path, "r+") as file:
        file.attrs["view_axes"] = stored
    for opened in (Psi.load, lambda path: StoredPsi(path).verify()):
        with pytest.raises(SensingError, match=words):
            opened(path)


def test_a_cassi_described_by_a_file_has_the_matrix_of_its_shifted_masks(tmp_path):
    (rows, columns), count, step = SIZE, 24, 2
    cells = np.random.default_rng(6).integers(0, 2, (rows + 16, columns + step * (count - 1) + 16))
    camera = emmc.camera(cassi_file(tmp_path, cells))
    psi = camera.psi(SIZE)
    shifted = [cells[8:, 8 + step * band :][:rows, :columns] for band in range(count)]
    expected = emmc.Psi.from_weights(np.stack(shifted)[None, None] / count, view_axes=BANDS)
    np.testing.assert_allclose(psi.weights, expected.weights, atol=1e-7)
    np.testing.assert_array_equal(psi.colour, expected.colour)
    assert psi.view_axes == psi_layout(camera, SIZE).view_axes == psi.view_axes == BANDS
    assert psi.psi(psi.weights).checksum() == psi.checksum()
    assert camera_of(psi) == camera
    assert "1x24 bands" in repr(camera)
    assert emmc.camera(camera.model_dump()) == camera


def test_bands_that_are_darker_at_the_ends_are_no_vignetting(tmp_path):
    cells = np.random.default_rng(7).integers(0, 2, (110, 170))
    camera = emmc.camera(cassi_file(tmp_path, cells, bands=12))
    picture = light_of((1, 1), ANGLES, (64, 96))[0, 0]
    lit = 1 - 0.8 * np.abs(np.arange(12) - 6) / 6
    light = (picture * lit[:, None, None, None]).astype(np.float32)[None]
    psi = camera.psi((64, 96))
    verdict = emmc.reconstruct(psi, camera.expose(light, psi=psi), "adaptive-fast").verdict
    for wrong in ("outermost rays", "aperture", "colour"):
        assert wrong not in verdict.words


def test_a_sensor_without_filters_sees_bands_as_light_without_colours(tmp_path):
    path = cassi_file(tmp_path, np.ones((90, 90), int), bands=3)
    assert emmc.camera(path).psi((8, 8)).colour is not None
    filtered = yaml.safe_load(path.read_text())
    for more in ({"shots": [{"filter": "green"}]}, {"view_axes": ["angle", "time"]}):
        described = {**filtered, **more}
        seen = sensor_response(emmc.camera(described), (8, 8))
        assert seen[..., 1].all()


def test_a_camera_at_angles_is_described_and_hashed_as_by_earlier_versions():
    camera = emmc.camera("rgbw-mono-3shots")
    assert camera.view_axes == ANGLES
    assert "view_axes" not in camera.model_dump()
    assert "view_axes" not in camera.psi((8, 8)).camera_json
    assert Camera.model_validate_json(camera.model_dump_json()) == camera


def described(**view_axes):
    return lambda: emmc.camera({"title": "mine", **view_axes})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: Psi(np.ones((1, 1, 2, 4, 3, 4)), None, view_axes=("angle", "colour")),
            "view_axes.*'angle', 'band'",
        ),
        (described(view_axes=["angle", "colour"]), "view_axes.1: .*'angle', 'band' or 'time'"),
        (described(view_axes=["band"]), "view_axes"),
        (described(view_axis=["angle", "band"]), "'view_axes'"),
    ],
)
def test_other_names_of_view_axes_are_refused_in_one_line(make, words):
    with pytest.raises(emmc.ERRORS, match=words) as fault:
        make()
    assert "\n" not in str(fault.value)


def test_a_camera_of_bands_is_listed_as_such(tmp_path):
    path = cassi_file(tmp_path, np.ones((90, 90), int), bands=3)
    code, output, _ = program("cameras", str(path), "--out", str(tmp_path / "out"))
    assert code == 0
    assert "1x3 bands" in output


def test_a_report_of_bands_speaks_of_no_view():
    light = light_of((1, 6), BANDS)
    metrics = {
        "view_axes": list(BANDS), "psnr_db": 20.0, "replicate_psnr_db": 25.0, "size": [24, 32],
        "verdict": {"level": "trust", "reasons": []},
    }  # fmt: skip
    content = ReportContent("t", light, metrics, light[0, :1, ..., 0], truth=light)
    page = render(content)
    words = page.split("<script")[0]
    for wrong in ("another side", "parallax", "centre view", "over views"):
        assert wrong not in words
    assert "the true middle band in all places" in words
    worse = "5.0 dB worse than the baseline (middle band in all places)"
    assert worse in str(light_field_head(metrics))


def test_a_result_of_bands_calls_them_so_in_every_file(bands, tmp_path):
    bands.save(tmp_path / "out")
    with (
        h5py.File(tmp_path / "out/light_field.h5") as file,
        h5py.File(tmp_path / "out" / MAPS) as maps,
    ):
        assert file["light_field"].attrs["view_axes"] == maps.attrs["view_axes"] == "angle,band"
    page = (tmp_path / "out/report.html").read_text().split("<script")[0]
    assert "Drag from band to band" in page
    assert "1x6 bands" in repr(bands)
    assert bands.metrics()["view_axes"] == list(BANDS)
    opened = open_export(str(tmp_path / "out"))
    assert opened.view_axes == BANDS
    shown: dict[str, Any] = viewer_data(opened)
    assert shown["axes"] == ["", "band"]
    assert shown["disparity"]["low"] == 0
    assert shown["disparity"]["high"] == 1e-3
    page = render_viewer(opened)
    assert "from band to band" in page
    assert 'alt="Band 3"' in page
    caption = draw_results([opened]).caption
    assert caption.startswith("Band 3 of 1x6")
    assert "epipolar" not in caption.lower()


def test_a_scene_of_bands_is_not_put_into_the_order_of_its_parallax(tmp_path):
    picture = light_of((1, 1), ANGLES, (48, 64))[0, 0]
    light = np.stack([np.roll(picture, (-k, -2 * k), (0, 1)) for k in range(3)])[None]
    light = np.concatenate([np.roll(light, 2 * k, axis=2) for k in range(3)])
    path = tmp_path / "light_field.h5"
    save_hdf5(path, light, {"view_axes": "band,time"})
    np.testing.assert_array_equal(emmc.scene(path).light_field, light)
    save_hdf5(path, light, {})
    with pytest.warns(ViewOrderWarning):
        emmc.scene(path)


@pytest.mark.parametrize("name", FORMATS)
def test_bands_are_exported_unless_a_format_shows_parallax(bands, tmp_path, name):
    if name in ("exr", "ome-zarr"):
        pytest.importorskip("OpenEXR" if name == "exr" else "ngff_zarr")
    bands.save(tmp_path / "out")
    code, _, error = program(
        "export", str(tmp_path / "out"), "--format", name, "--out", str(tmp_path / "exported")
    )
    if FORMATS[name].parallax:
        assert code == 1
        assert f"format {name} shows parallax, and out has bands for views" in error
        assert not (tmp_path / "exported").exists()
    else:
        assert code == 0
        assert any((tmp_path / "exported").iterdir())


@pytest.mark.parametrize("axes", [ANGLES, BANDS])
def test_pictures_that_are_alike_lack_parallax_only_where_they_are_angles(axes):
    coded = psi_of((1, 6), axes)
    psi = replace(coded, weights=np.full_like(coded.weights, 1 / 6))  # no code tells views apart
    light = np.repeat(light_of((1, 1), ANGLES), 6, axis=1)
    verdict = emmc.reconstruct(psi, frames_of(psi, light), "tv", noise_sigma=NOISE).verdict
    said = [reason.what for reason in verdict.reasons if "parallax" in reason.what]
    assert bool(said) == (axes == ANGLES)
    assert (verdict.evidence.parallax is None) == (axes != ANGLES)


def test_what_a_method_calls_disparity_is_a_shift_between_times():
    result = solved((6, 1), TIMES, "adaptive-fast")
    assert result.disparity is None
    assert {"shift", "shift_sigma"} <= set(result.maps)
    assert not any("disparit" in name for name in result.maps)
    assert "disparit" not in result.verdict.words


def test_the_preview_of_a_camera_without_colours_is_grey():
    psi = psi_of((1, 6), BANDS, size=(32, 48))
    frames = frames_of(psi, light_of((1, 6), BANDS, (32, 48)))
    preview = Preview(psi, 4, even_frames(frames, NOISE))
    preview.follow(frames, 5)
    light = preview.light_field
    assert light.std() > 0.01
    assert (light == light[..., :1]).all()


@pytest.mark.parametrize("views", [(1, 2), (2, 1), (1, 24)])
def test_a_row_of_views_is_a_light_field(views):
    light = light_of(views, ANGLES)
    np.testing.assert_array_equal(check_light_field(light, "a row"), light)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "views", "axes", "shots", "closed"),
    [
        ("tv", (3, 3), ANGLES, 3, True),
        ("tv", (9, 9), ANGLES, 1, False),
        ("tv", (1, 28), BANDS, 1, True),
        ("tv-dict", (3, 3), ANGLES, 2, False),
        ("tv-dict", (8, 1), TIMES, 1, False),
        ("dict-admm", (1, 24), BANDS, 1, False),
        ("adaptive-fast", (3, 3), ANGLES, 3, True),
        ("adaptive-fast", (9, 9), ANGLES, 1, False),
        ("adaptive-fast", (1, 28), BANDS, 1, True),
        ("adaptive-fast", (8, 1), TIMES, 1, False),
    ],
)
def test_every_grid_of_views_is_reconstructed_and_kept(
    tmp_path, method, views, axes, shots, closed
):
    psi, light = psi_of(views, axes, shots, closed), light_of(views, axes)
    frames = frames_of(psi, light)
    result = emmc.reconstruct(psi, frames, method, noise_sigma=NOISE)
    result.save(tmp_path / "out")
    opened = open_export(str(tmp_path / "out"))
    assert opened.light_field.shape == light.shape
    assert opened.view_axes == axes
    result.figure()
    assert '"axes": null' in result.viewer() or axes != ANGLES
    # Of opened views, better than the mean brightness says; closed ones are neighbours' guesses.
    seen = psi.weights.any(axis=(0, 3, 4, 5))
    off = (result.light_field - light)[seen][..., 0]
    assert np.sqrt(np.mean(np.square(off))) < 0.9 * light[seen][..., 0].std()


@pytest.mark.slow
def test_a_demo_of_bands_is_grey_and_speaks_of_bands(tmp_path):
    cells = np.random.default_rng(8).integers(0, 2, (70, 90))
    path = cassi_file(tmp_path, cells, bands=3)
    code, output, _ = program(
        "demo", "--camera", str(path), "--scene", "near-planar", "--size", "24x32",
        "--method", "tv", "--out", str(tmp_path / "out"),
    )  # fmt: skip
    assert code == 0
    assert "over the baseline (middle band in all places)" in output
    opened = open_export(str(tmp_path / "out"))
    assert opened.view_axes == BANDS
    assert opened.light_field.std() > 0.01
    assert (opened.light_field == opened.light_field[..., :1]).all()


@pytest.mark.slow
def test_blocks_of_a_capture_of_bands_are_kept_as_bands(tmp_path):
    psi = psi_of((1, 6), BANDS, size=(64, 96))
    psi.save(tmp_path / PSI)
    frames = frames_of(psi, light_of((1, 6), BANDS, (64, 96)))
    with h5py.File(tmp_path / FRAMES, "w") as file:
        file["readings"] = frames
        file["deviation"] = np.full(frames.shape, NOISE)
        file["usable"] = np.ones(frames.shape, bool)
    settings = MethodSettings.model_validate({"blocks": {"side": 32, "whole": 32 * 32}})
    (tmp_path / "out").mkdir()
    with opened_pool(1) as pool:
        metrics, _ = reconstruct_undrawn(
            opened_capture(tmp_path),
            tmp_path / "out",
            "adaptive-fast",
            settings=settings,
            pool=pool,
        )
    assert metrics["view_axes"] == list(BANDS)
    assert metrics["blocks"] == [1, 2]
    assert "disparit" not in str(metrics["verdict"]["reasons"])
    with h5py.File(tmp_path / "out" / MAPS) as maps:
        assert maps.attrs["view_axes"] == "angle,band"
        assert "shift" in maps
        assert "disparity" not in maps
    assert open_export(str(tmp_path / "out")).view_axes == BANDS


@pytest.mark.parametrize("along", [0, 1])
@pytest.mark.parametrize("shift_px", [0, 2, 3])
def test_psi_says_how_far_bands_lie_apart_behind_a_prism(shift_px, along):
    bands, size, rng = 5, (60, 80), np.random.default_rng(0)
    code = rng.integers(0, 2, (size[0] + 20, size[1] + 20)).astype(np.float32)
    code = cv2.GaussianBlur(code, (0, 0), 0.7)
    rows = [code[: size[0], 20 - shift_px * k : 20 - shift_px * k + size[1]] for k in range(bands)]
    columns = [
        code[20 - shift_px * k : 20 - shift_px * k + size[0], : size[1]] for k in range(bands)
    ]
    weights = np.stack(rows if along else columns).astype(np.float32)
    views = (1, bands) if along else (bands, 1)
    axes = ("angle", "band") if along else ("band", "angle")
    weights = weights.reshape(1, *views, size[0], 1, size[1])
    psi = Psi(weights, np.zeros((1, *size), np.uint8), view_axes=axes)
    assert mask_shift_px(psi) == pytest.approx(shift_px, abs=0.02)
    # Codes of their own are no shift.
    assert mask_shift_px(psi_of((1, 5), BANDS, size=size)) is None


@pytest.mark.parametrize(
    ("shifts_px", "level"),
    [((1.98, 2.0), "trust"), ((0.25, 2.0), "doubt"), ((5.2, 2.0), "doubt"), ((0.01, 2.0), "trust")],
)
def test_bands_that_lie_elsewhere_than_the_masks_are_doubted(shifts_px, level):
    psi = emmc.camera("rgbw-bayer-1shot").psi((48, 64))
    verdict = emmc.reconstruct(psi, psi @ emmc.scene("near-planar", size=(48, 64)), "tv").verdict
    found = replace(verdict.evidence, stated=0.02, view_axes=BANDS, shifts_px=shifts_px)
    judged = verdict_from(found)
    assert judged.level == level, judged.words
    assert (level == "trust") == ("the bands lie" not in judged.words)
