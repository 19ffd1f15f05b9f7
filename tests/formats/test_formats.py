"""Every format that a light field is exported in: read back, and by an independent reader."""

import configparser
import importlib
import json

import h5py
import numpy as np
import PIL.Image
import pytest
import scipy.io
import tifffile
from programs import program

from emmc_rig.errors import ERRORS
from emmc_rig.formats.displays import walk
from emmc_rig.formats.format import Export
from emmc_rig.formats.registry import FORMATS
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.novel_view import between, view_disparities
from emmc_rig.model.srgb import linear_of, srgb_of
from emmc_rig.report.viewer import VIEWER

VIEWS, SIZE = (5, 5), (36, 48)
NEEDS = {"exr": "OpenEXR", "ome-zarr": "ngff_zarr"}
CODE = 0.5 / 255 * 2.4 / 1.055 + 1e-5
"""Half an 8-bit code of sRGB at its steepest, at white, where d linear / d code is 2.4 / 1.055."""
KEPT = {
    "png8": 0.51 / 255, "png16": 0.51 / 65535, "tiff": 0, "exr": 0, "hci": CODE,
    "hci-hdf5": CODE, "lftoolbox": 0.51 / 65535, "eslf": 2e-5, "ome-zarr": 0,
}  # fmt: skip
"""Largest error of what is read back."""
SCENES = {"eslf": "light_field_5x5_eslf.png", "lftoolbox": "light_field.mat",
          "hci-hdf5": "lf.h5", "ome-zarr": "light_field.ome.zarr"}  # fmt: skip
"""Path of the scene within an export; without an entry the export is the scene."""


@pytest.fixture(scope="module")
def export() -> Export:
    scene = open_scene("deep-occlusions", size=SIZE)
    sigma = np.full(scene.light_field.shape[:4], 0.02, np.float32)
    return Export("a scene", "", scene.light_field, None, scene.disparity_px, sigma)


@pytest.fixture
def written(tmp_path, export):
    def write(name):
        if name in NEEDS:
            pytest.importorskip(NEEDS[name], reason="extra `formats`")
        FORMATS[name].write(tmp_path, export)
        return tmp_path

    return write


def seen_elsewhere(path):
    """Return a picture of 8 bits as Pillow reads it."""
    with PIL.Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def decoded_by_ffmpeg(path, form):
    """Return the frames of a picture or a video; extra `peers`."""
    with pytest.importorskip("av", reason="extra `peers`").open(str(path)) as stream:
        return [frame.to_ndarray(format=form) for frame in stream.decode(video=0)]


@pytest.mark.slow
@pytest.mark.parametrize("name", KEPT)
def test_what_is_written_comes_back_as_a_scene(written, export, name):
    folder = written(name)
    scene = open_scene(str(folder / SCENES.get(name, "")))
    assert np.abs(scene.light_field - export.light_field).max() <= KEPT[name] + 1e-7


def test_srgb_and_back_is_the_same_and_has_the_standard_s_values():
    light = np.linspace(0, 1, 1001, dtype=np.float32)
    np.testing.assert_allclose(linear_of(srgb_of(light)), light, atol=2e-6)
    # IEC 61966-2-1: middle grey 0.2140 is code value 0.5.
    np.testing.assert_allclose(srgb_of(np.array([0.21404])), 0.5, atol=1e-4)


def test_png_files_say_that_they_are_linear(written, export):
    content = (written("png16") / "view_1_2.png").read_bytes()
    assert content[37:45] == b"gAMA" + (100_000).to_bytes(4, "big")
    with PIL.Image.open(written("png8") / "view_1_2.png") as picture:
        assert picture.info["gamma"] == 1.0
        codes = np.asarray(picture)
    assert np.abs(codes / 255 - export.light_field[1, 2]).max() < 0.51 / 255


def test_tiff_and_exr_read_alike_elsewhere(written, export):
    view = tifffile.imread(written("tiff") / "view_3_0.tif")
    np.testing.assert_array_equal(view, export.light_field[3, 0])
    folder = written("exr")
    (read,) = decoded_by_ffmpeg(folder / "view_3_0.exr", None)
    np.testing.assert_array_equal(read, export.light_field[3, 0])


def test_the_hci_folder_has_the_views_in_hci_s_order(written, export):
    folder = written("hci")
    config = configparser.ConfigParser()
    config.read(folder / "parameters.cfg")
    assert config.getint("extrinsics", "num_cams_x") == 5
    first = seen_elsewhere(folder / "input_Cam000.png")
    np.testing.assert_allclose(linear_of(first / 255), export.light_field[4, 4], atol=CODE)
    content = (folder / "gt_disp_lowres.pfm").read_bytes()
    assert content.startswith(b"Pf\n48 36\n-1")
    bottom = np.frombuffer(content[-48 * 36 * 4 :], "<f4")[:48]  # PFM begins at the bottom
    np.testing.assert_array_equal(bottom, export.disparity[-1])
    (disparity,) = decoded_by_ffmpeg(folder / "gt_disp_lowres.pfm", "grayf32le")
    np.testing.assert_array_equal(disparity, export.disparity)


def test_hdf5_and_mat_hold_what_their_tools_ask_for(written, export):
    with h5py.File(written("hci-hdf5") / "lf.h5") as file:
        codes = np.asarray(file["LF"])
        assert codes.shape == (5, 5, 36, 48, 3)
        views = linear_of(codes[::-1, ::-1] / 255)
        np.testing.assert_allclose(views, export.light_field, atol=CODE)
        assert (file.attrs["vRes"], file.attrs["xRes"]) == (5, 48)
    held = scipy.io.loadmat(written("lftoolbox") / "light_field.mat")["LF"]
    assert (held.dtype, held.shape) == (np.uint16, (5, 5, 36, 48, 4))
    np.testing.assert_allclose(held[..., :3] / 65535, export.light_field, atol=1e-5)


def test_eslf_interleaves_the_views(written, export):
    (picture,) = decoded_by_ffmpeg(written("eslf") / SCENES["eslf"], "rgb48le")
    np.testing.assert_allclose(
        linear_of(picture[3::5, 1::5] / 65535), export.light_field[3, 1], atol=2e-5
    )


@pytest.mark.slow
def test_ome_zarr_is_what_the_specification_says(written, export):
    folder = written("ome-zarr") / SCENES["ome-zarr"]
    attributes = json.loads((folder / ".zattrs").read_text())
    scales = attributes["multiscales"][0]
    assert [axis["name"] for axis in scales["axes"]] == ["c", "z", "y", "x"]
    ngff = importlib.import_module("ngff_zarr")
    ngff.from_ngff_zarr(str(folder), validate=True)
    zarr = importlib.import_module("zarr")
    data = np.asarray(zarr.open_group(str(folder), mode="r")[scales["datasets"][0]["path"]])
    np.testing.assert_array_equal(data[:, 7], export.light_field[1, 2].transpose(2, 0, 1))


@pytest.mark.slow
def test_ome_zarr_of_version_0_4_whose_views_lie_along_time_still_opens(tmp_path, export):
    ngff = pytest.importorskip("ngff_zarr", reason="extra `formats`")
    path = tmp_path / SCENES["ome-zarr"]
    views = export.light_field.reshape(25, *SIZE, 3).transpose(0, 3, 1, 2)
    image = ngff.to_ngff_image(np.ascontiguousarray(views), dims=("t", "c", "y", "x"))
    ngff.to_ngff_zarr(str(path), ngff.to_multiscales(image, [{"y": 2, "x": 2}]), version="0.4")
    attributes = json.loads((path / ".zattrs").read_text())
    attributes["emmc_rig"] = {"views": [5, 5]}
    (path / ".zattrs").write_text(json.dumps(attributes))
    np.testing.assert_array_equal(open_scene(str(path)).light_field, export.light_field)


def test_the_point_cloud_is_read_by_an_independent_reader(written, export):
    plyfile = pytest.importorskip("plyfile", reason="extra `peers`")
    vertices = plyfile.PlyData.read(written("ply") / "points.ply")["vertex"]
    assert len(vertices) == SIZE[0] * SIZE[1]
    nearest = export.disparity.argmax()
    assert vertices["z"].argmin() == nearest
    np.testing.assert_allclose(vertices["sigma"], 0.02)
    red = linear_of(vertices["red"].reshape(SIZE) / 255)
    np.testing.assert_allclose(red, export.light_field[2, 2, ..., 0], atol=CODE)


def test_cameras_see_the_points_where_the_views_have_them(written, export):
    plyfile = pytest.importorskip("plyfile", reason="extra `peers`")
    folder = written("ply")
    cloud = plyfile.PlyData.read(folder / "points.ply")["vertex"]
    about = json.loads((written("transforms") / "transforms.json").read_text())
    # x right, y down, z away here; cameras of transforms.json look along -z with y up.
    points = np.stack([cloud["x"], -cloud["y"], -cloud["z"]])
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    for number, (v, u) in enumerate(np.ndindex(*VIEWS)):
        frame = about["frames"][number]
        moved = points - np.array(frame["transform_matrix"])[:3, 3:]
        column = frame["cx"] + about["fl_x"] * moved[0] / -moved[2] - 0.5
        row = frame["cy"] - about["fl_y"] * moved[1] / -moved[2] - 0.5
        shift = export.disparity.astype(float)
        np.testing.assert_allclose(column, (x + shift * (u - 2)).ravel(), atol=1e-3)
        np.testing.assert_allclose(row, (y + shift * (v - 2)).ravel(), atol=1e-3)


def test_the_quilt_holds_the_views_between_from_left_to_right(written, export):
    (path,) = written("quilt").iterdir()
    assert path.name == "quilt_qs8x6a1.33.png"
    quilt = seen_elsewhere(path)
    assert quilt.shape == (6 * SIZE[0], 8 * SIZE[1], 3)
    tiles = quilt.reshape(6, SIZE[0], 8, SIZE[1], 3)[::-1].transpose(0, 2, 1, 3, 4)
    views = linear_of(tiles.reshape(48, *SIZE, 3) / 255)
    np.testing.assert_allclose(views[0], export.light_field[2, 4], atol=CODE)
    np.testing.assert_allclose(views[47], export.light_field[2, 0], atol=CODE)
    seen = view_disparities(export.disparity, VIEWS)
    u = 4 - 4 * 20 / 47
    np.testing.assert_allclose(views[20], between(export.light_field, seen, 2, u), atol=CODE)


@pytest.mark.parametrize(("name", "ending"), [("mp4", "mp4"), ("webm", "webm"), ("gif", "gif")])
def test_an_animation_has_every_picture_of_the_round(written, export, name, ending):
    frames = decoded_by_ffmpeg(written(name) / f"parallax.{ending}", "rgb24")
    expected = list(walk(export))
    assert len(frames) == len(expected) == 48
    for at, frame in enumerate(frames):
        own, quarter_round_on = (
            np.abs(expected[(at + step) % 48].astype(float) - frame).mean() for step in (0, 12)
        )
        assert own < 0.8 * quarter_round_on


DAMAGED = {
    "hci": "parameters.cfg", "hci-hdf5": "lf.h5", "lftoolbox": "light_field.mat",
    "eslf": "light_field_5x5_eslf.png", "tiff": "view_1_1.tif", "exr": "view_1_1.exr",
    "ome-zarr": "light_field.ome.zarr/.zattrs",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGED)
@pytest.mark.parametrize("left", [0, 40])
def test_a_damaged_file_is_one_clear_line(written, name, left):
    folder = written(name)
    damaged = folder / DAMAGED[name]
    damaged.write_bytes(damaged.read_bytes()[:left])
    with pytest.raises(ERRORS) as caught:
        open_scene(str(folder / SCENES.get(name, "")))
    assert "\n" not in str(caught.value)


def test_the_command_writes_what_it_lists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, listed, _ = program("export", "--list")
    assert code == 0
    assert [line.split()[0] for line in listed.splitlines()] == [VIEWER.name, *FORMATS]
    code, reported, err = program("export", "near-planar", "--format", "lftoolbox", "--out", "mat")
    assert code == 0, err
    assert "light_field.mat" in reported
    assert json.loads((tmp_path / "mat/metrics.json").read_text())["shape"] == [5, 5, 192, 256, 3]
    assert program("export", "mat/light_field.mat", "--format", "no-such")[0] == 2
    assert program("export", "--format", "tiff")[0] == 2
    assert program("export", "nowhere", "--format", "tiff")[0] == 1
