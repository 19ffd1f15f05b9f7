"""Files of other programs are read whole and as a viewer shows them, by every door alike."""

import os
import shutil
import socket
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps

from emmc_rig.captures.import_table import read_table
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.errors import AppError
from emmc_rig.formats.own_arrays import read_own
from emmc_rig.formats.photograph import read_photograph
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.decoding.pictures import upright
from emmc_rig.model.errors import CameraError, SceneError
from emmc_rig.model.lightfield import read_picture
from emmc_rig.model.masks import Picture

GREY = np.random.default_rng(0).integers(0, 256, (20, 30), np.uint8)
COLOUR = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
STACK = np.random.default_rng(2).integers(0, 4096, (4, 20, 30), np.uint16)


def drawn(path):
    """What the pattern of a camera's mask makes of a picture, as codes."""
    return Picture(kind="picture", path=path).draw(1, 20, 30, 10.0)[0] * 255


def photographed(path):
    """What the command for masks makes of it."""
    return read_photograph(path, linear=True) * 255


DOORS = {
    "picture pattern": drawn,
    "photograph": photographed,
    "view": lambda path: read_picture(path) * 255,
    "import": lambda path: read_own(path).frames[0],
}


def same(codes, wanted):
    codes = np.atleast_3d(np.asarray(codes, float))
    return codes.shape[:2] == wanted.shape[:2] and np.allclose(
        codes, np.atleast_3d(wanted), atol=1e-3
    )


# As a viewer shows it


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_is_turned_upright_as_pillow_does(orientation):
    picture = Image.fromarray(COLOUR)
    exif = picture.getexif()
    exif[274] = orientation
    picture.info["exif"] = exif.tobytes()
    wanted = np.asarray(ImageOps.exif_transpose(picture))
    assert np.array_equal(upright(COLOUR, orientation), wanted)


@pytest.mark.slow
@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("ending", ["jpg", "png", "webp", "tif"])
def test_every_door_reads_a_turned_picture_as_a_viewer_shows_it(tmp_path, ending, door):
    picture, path = Image.fromarray(COLOUR), tmp_path / f"phone.{ending}"
    exif = picture.getexif()
    exif[274] = 6
    more: dict[str, Any] = {"tiffinfo": {274: 6}} if ending == "tif" else {"exif": exif}
    if ending == "webp":
        more["lossless"] = True
    picture.save(path, **more)
    wanted = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
    assert wanted.shape == (30, 20, 3)
    assert same(DOORS[door](path), wanted)


PACKED = {
    **{
        f"colour {packing}": (COLOUR, {"compression": packing})
        for packing in ("tiff_lzw", "jpeg", "tiff_deflate", "packbits", "zstd")
    },
    **{
        f"one bit {packing}": (GREY > 99, {"compression": packing})
        for packing in ("group3", "group4", "tiff_lzw")
    },
    "palette": (COLOUR, {"palette": 16}),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", PACKED)
def test_a_tiff_reads_as_libtiff_shows_it(tmp_path, kind):
    pixels, how = PACKED[kind]
    picture, path = Image.fromarray(pixels), tmp_path / "a.tif"
    if "palette" in how:
        picture.quantize(how["palette"]).save(path)
    else:
        picture.save(path, **how)
    wanted = np.asarray(Image.open(path).convert("RGB"))
    assert same(drawn(path), wanted)
    read = read_own(path).frames[0]
    assert same(read if read.ndim == 3 else np.repeat(read[..., None], 3, -1), wanted)


def test_a_raw_photograph_is_turned_as_its_tag_says(tmp_path):
    path = tmp_path / "a.dng"
    path.write_bytes(encode_dng(STACK[0].repeat(2, 0), "mono", 64, 4095, 0.01))
    flat = read_photograph(path)
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages.first.tags[274].overwrite(8)
    assert flat.shape == (40, 30, 1)
    assert np.array_equal(read_photograph(path), np.rot90(flat, 1))


def test_where_white_is_zero_it_is_still_white(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", 255 - GREY, photometric="miniswhite")
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.tif").convert("L")), GREY)
    assert np.array_equal(read_own(tmp_path / "a.tif").frames[0], GREY)


@pytest.mark.slow
def test_twelve_packed_bits_are_values_to_4095_and_white_is_that(tmp_path):
    codes = STACK[0]
    tifffile.imwrite(tmp_path / "a.tif", codes, bitspersample=12, compression=None)
    assert np.array_equal(read_own(tmp_path / "a.tif").frames[0], codes)
    assert np.allclose(read_photograph(tmp_path / "a.tif")[..., 0], codes / 4095)


@pytest.mark.slow
def test_colours_in_planes_are_a_picture_but_for_stacks_of_frames(tmp_path):
    planes = np.moveaxis(COLOUR, -1, 0)
    about: dict[str, Any] = {"photometric": "rgb", "planarconfig": "separate"}
    tifffile.imwrite(tmp_path / "a.tif", planes, metadata=None, **about)
    assert np.array_equal(read_own(tmp_path / "a.tif").frames[0], COLOUR)
    tifffile.imwrite(tmp_path / "b.tif", planes, **about)  # as it writes a stack of three
    assert np.array_equal(read_own(tmp_path / "b.tif").frames, planes)
    assert same(drawn(tmp_path / "b.tif"), COLOUR)


@pytest.mark.parametrize("ending", ["png", pytest.param("tif", marks=pytest.mark.slow)])
def test_colours_are_those_of_the_file_and_a_transparent_view_is_refused(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(np.dstack([COLOUR, GREY])).save(path)
    for door in ("picture pattern", "photograph", "import"):
        assert same(DOORS[door](path), COLOUR)
    with pytest.raises(SceneError, match=rf"a\.{ending}: partly transparent"):
        read_picture(path)


@pytest.mark.slow
def test_views_of_opencv_are_a_scene_whichever_format(tmp_path):
    views = np.random.default_rng(3).integers(0, 65_536, (2, 2, 20, 30, 3), np.uint16)
    for ending in ("png", "tif", "tiff"):
        (tmp_path / ending).mkdir()
        for v, u in np.ndindex(2, 2):
            cv2.imwrite(str(tmp_path / ending / f"view_{v}_{u}.{ending}"), views[v, u, ..., ::-1])
        light_field = open_scene(str(tmp_path / ending)).light_field
        assert np.allclose(light_field, views / 65_535, atol=1e-6)


# Every frame is accounted for


def ome(tmp_path, files=("a.ome.tif", "b.ome.tif"), listed=range(4), plane=""):
    """A series of four planes over two files, as Micro-Manager splits it."""
    uuids = [f"urn:uuid:0000000{k}-0000-4000-8000-000000000000" for k in range(len(files))]
    each = 4 // len(files)
    data = "".join(
        f'<TiffData FirstC="0" FirstT="{t}" FirstZ="0" IFD="{t % each}" PlaneCount="1">'
        f'<UUID FileName="{files[t // each]}">{uuids[t // each]}</UUID></TiffData>'
        for t in listed
    )
    for number, name in enumerate(files):
        xml = (
            '<?xml version="1.0" encoding="UTF-8"?>'
            '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
            f'UUID="{uuids[number]}"><Image ID="Image:0"><Pixels ID="Pixels:0" '
            'DimensionOrder="XYZCT" Type="uint16" SizeX="30" SizeY="20" SizeZ="1" SizeC="1" '
            f'SizeT="4"><Channel ID="Channel:0:0" SamplesPerPixel="1"/>{data}{plane}'
            "</Pixels></Image></OME>"
        )
        with tifffile.TiffWriter(tmp_path / name) as file:
            for k in range(each):
                description = xml.encode() if k == 0 else None
                frame = STACK[number * each + k]
                file.write(frame, description=description, metadata=None, contiguous=False)
    return [tmp_path / name for name in files]


PLANES = "".join(
    f'<Plane TheZ="0" TheC="0" TheT="{t}" ExposureTime="{t + 1}" ExposureTimeUnit="{unit}"/>'
    for t, unit in ((3, "ms"), (0, "min"), (2, "\u00b5s"), (1, "s"))
)
"""Not in the order of the planes, which their indices state."""


@pytest.mark.slow
def test_each_file_of_a_series_gives_its_own_planes_once_with_their_exposures(tmp_path):
    a, b = ome(tmp_path, plane=PLANES)
    first, second = (read_own(file, apart={a, b}) for file in (a, b))
    assert np.array_equal(first.frames, STACK[:2])
    assert np.array_equal(second.frames, STACK[2:])
    assert np.allclose(first.exposures_s, [60, 2])
    assert np.allclose(second.exposures_s, [3e-6, 4e-3])
    alone = read_own(b)
    assert np.array_equal(alone.frames, STACK)
    assert {path.name for path in alone.members} == {"a.ome.tif", "b.ome.tif"}
    b.unlink()
    with pytest.raises(AppError, match=r"b\.ome\.tif of its series is missing: put it beside"):
        read_own(a)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("listed", "complaint"),
    [
        ((0, 1, 2), "states 4 planes and lists pages of 3"),
        ((0, 1, 2, 2), "states 4 planes and lists pages of 3"),
        ((3, 2, 1, 0), None),
    ],
)
def test_planes_are_in_the_order_that_their_indices_state(tmp_path, listed, complaint):
    (path,) = ome(tmp_path, ("a.ome.tif",), listed)
    if complaint is None:
        assert np.array_equal(read_own(path).frames, STACK)
        return
    with pytest.raises(AppError, match=complaint):
        read_own(path)


@pytest.mark.slow
def test_positions_are_all_taken_and_pages_of_another_size_named(tmp_path):
    with tifffile.TiffWriter(tmp_path / "positions.ome.tif") as file:
        for frame in STACK[:2]:
            file.write(frame, metadata={"axes": "YX"}, contiguous=False)
    assert np.array_equal(read_own(tmp_path / "positions.ome.tif").frames, STACK[:2])
    for name, other in (("size", STACK[1, :9, :9]), ("depth", GREY)):
        with tifffile.TiffWriter(tmp_path / f"{name}.tif") as file:
            for frame in (STACK[0], other, STACK[2]):
                file.write(frame, contiguous=False)
        with pytest.raises(AppError, match=r"the first is 20x30 uint16, page 2 of 3 is"):
            read_own(tmp_path / f"{name}.tif")


@pytest.mark.slow
def test_planes_behind_one_page_are_frames_and_smaller_copies_are_not(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", STACK, imagej=True)
    assert np.array_equal(read_own(tmp_path / "a.tif").frames, STACK)
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        file.write(STACK[0], subifds=1)
        file.write(STACK[0, ::2, ::2], subfiletype=1)
    own = read_own(tmp_path / "b.tif")
    assert np.array_equal(own.frames, STACK[:1])
    assert own.notes[0].endswith("b.tif: pages that are smaller copies are not taken: 1")


@pytest.mark.slow
def test_a_tiff_cut_short_anywhere_gives_no_frames(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for frame in STACK:
            file.write(frame, contiguous=False)
    data = (tmp_path / "a.tif").read_bytes()
    for kept in range(4000, len(data), 500):
        (tmp_path / "b.tif").write_bytes(data[:kept])
        with pytest.raises(AppError):
            read_own(tmp_path / "b.tif")


@pytest.mark.slow
def test_values_that_a_tiff_calls_not_valid_are_refused(tmp_path):
    frame = STACK[0].copy()
    frame[3, 4:7] = 9999
    tifffile.imwrite(tmp_path / "a.tif", frame, extratags=[(42113, "s", 0, "9999", True)])
    with pytest.raises(AppError, match=r"the value 9999, which the file calls not valid: 3"):
        read_own(tmp_path / "a.tif")


def test_animations_and_torn_photographs_are_refused(tmp_path):
    first, *others = (Image.fromarray(GREY), Image.fromarray(255 - GREY))
    for ending in ("gif", "png", "webp"):
        path = tmp_path / f"a.{ending}"
        first.save(path, save_all=True, append_images=others)
        with pytest.raises(AppError, match="an animation of 2 pictures; save each as a file"):
            read_own(path)
    first.resize((300, 200)).save(tmp_path / "b.jpg")
    whole = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(AppError, match=r"b\.jpg: cannot be decoded \(image file is truncated"):
        read_own(tmp_path / "b.jpg")


def test_axes_of_length_one_are_dropped_in_every_format(tmp_path):
    scipy_io = pytest.importorskip("scipy.io")
    wide = STACK[:2, None, None]
    np.save(tmp_path / "a.npy", wide)
    np.savez(tmp_path / "a.npz", frames=wide)
    scipy_io.savemat(tmp_path / "a.mat", {"frames": wide})
    tifffile.imwrite(tmp_path / "a.ome.tif", wide, metadata={"axes": "TCZYX"})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = wide
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        file["frames"] = wide.T
    for name in ("a.npy", "a.npz", "a.mat", "a.h5", "b.mat", "a.ome.tif"):
        assert np.array_equal(read_own(tmp_path / name).frames, STACK[:2]), name


@pytest.mark.slow
def test_a_mat_file_of_version_7_3_is_a_scene(tmp_path):
    views = np.random.default_rng(4).integers(0, 256, (3, 3, 20, 30, 3), np.uint8)
    with h5py.File(tmp_path / "lf.mat", "w", userblock_size=512) as file:
        file["LF"] = views.T
    with (tmp_path / "lf.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    light_field = open_scene(str(tmp_path / "lf.mat")).light_field
    assert np.allclose(light_field, views / 255, atol=1e-6)


@pytest.mark.slow
def test_zarr_is_read_as_it_is_written_and_absent_chunks_are_named(tmp_path):
    zarr = pytest.importorskip("zarr", reason="needs the extra `zarr`")
    group = zarr.open_group(tmp_path / "ome.zarr", mode="w", zarr_format=2)
    group.create_array("0", data=STACK[:, None, None])
    group.create_array("1", data=STACK[:, None, None, ::2, ::2])
    scales = {"datasets": [{"path": "0"}, {"path": "1"}]}
    group.attrs["multiscales"] = [scales]
    assert np.array_equal(read_own(tmp_path / "ome.zarr").frames, STACK)
    assert np.array_equal(read_own(tmp_path / "ome.zarr", "1").frames, STACK[:, ::2, ::2])
    for version in (2, 3):
        zarr.save_array(tmp_path / f"{version}.zarr", STACK, zarr_format=version)
        assert np.array_equal(read_own(tmp_path / f"{version}.zarr").frames, STACK)
    plate = zarr.open_group(tmp_path / "plate.zarr", mode="w", zarr_format=3)
    field = plate.create_group("A/1/0")
    field.create_array("0", data=STACK)
    field.create_array("1", data=STACK[:, ::2, ::2])
    field.attrs["ome"] = {"multiscales": [scales]}
    assert np.array_equal(read_own(tmp_path / "plate.zarr").frames, STACK)
    views = np.random.default_rng(5).integers(0, 256, (2, 3, 20, 30, 3), np.uint8)
    zarr.save_array(tmp_path / "scene.zarr", views)
    light_field = open_scene(str(tmp_path / "scene.zarr")).light_field
    assert np.allclose(light_field, views / 255, atol=1e-6)
    torn = zarr.create_array(
        tmp_path / "torn.zarr", shape=STACK.shape, chunks=(1, 20, 30), dtype="u2", fill_value=0
    )
    torn[:3] = STACK[:3] + 1
    with pytest.raises(AppError, match=r"torn\.zarr: .*1 of its 4 chunks are not there"):
        read_own(tmp_path / "torn.zarr")


def test_hdf5_that_was_not_written_whole_or_says_what_is_not_valid_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("a", STACK.shape, "u2", chunks=(1, 20, 30))
        data[:3] = STACK[:3]
        file.create_dataset("b", STACK.shape, "u2")
        file["c"] = STACK
        file["c"].attrs["_FillValue"] = STACK[0, 0, 0]
    for name, complaint in (
        ("a", "1 of the 4 parts of 'a' were never written"),
        ("b", "1 of the 1 parts of 'b' were never written"),
        ("c", r"'c' has values that its _FillValue calls not valid: \d+"),
    ):
        with pytest.raises(AppError, match=complaint):
            read_own(tmp_path / "a.h5", name)


@pytest.mark.parametrize(
    ("odd", "complaint"),
    [
        ("view_1_x.png", "view_1_x.png: named otherwise"),
        ("view 1 1.png", "view 1 1.png: named otherwise"),
        ("v_2_2.png", "v_2_2.png: named otherwise"),
        ("view_0_1.jpg", "view_0_1.jpg: named otherwise"),
        ("view_0_1.tif", "view_0_1.png and view_0_1.tif are the same view"),
        ("view_1_0.tif", "views of several formats"),
    ],
)
def test_views_that_are_not_understood_are_named(tmp_path, odd, complaint):
    for name in ("view_0_0.png", "view_0_1.png", "notes.txt", "depth.png"):
        cv2.imwrite(str(tmp_path / "a.png"), COLOUR)
        shutil.move(tmp_path / "a.png", tmp_path / name)
    assert open_scene(str(tmp_path)).views == (1, 2)
    (tmp_path / odd).write_bytes((tmp_path / "view_0_0.png").read_bytes())
    with pytest.raises(SceneError, match=complaint):
        open_scene(str(tmp_path))


# Regular files only, and words


@pytest.mark.parametrize("name", ["a.tif", "a.png", "a.npy", "a.h5", "a.mat", "a.dng", "a.csv"])
@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "folder"])
def test_what_is_no_file_is_refused_at_once(tmp_path, monkeypatch, name, kind):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(name)
    else:
        path.mkdir()
    doors = [read_table] if name == "a.csv" else [read_own, read_photograph, drawn]
    for door in doors:
        with pytest.raises((AppError, CameraError), match=f"{name}: a {kind}"):
            door(path)


FOREIGN = {
    "a FITS file": b"SIMPLE  =                    T",
    "a HEIC picture": b"\0\0\0\x18ftypheic\0\0\0\0",
    "a DXF drawing": b"  0\r\nSECTION\r\n  2\r\nHEADER\r\n",
    "a GDS layout": b"\x00\x06\x00\x02\x02\x58",
    "a PDF": b"%PDF-1.7\n",
    "an SVG drawing": b'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"/>',
    "a web page": b"<!DOCTYPE html><html></html>",
    "a ZIP archive": b"PK\x03\x04aaaa",
    "of an unknown format": b"\x01\x02\x03\x04",
    "empty": b"",
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_format_that_is_not_read_is_named_and_never_called_damaged(tmp_path, kind):
    for name in ("a.png", "a.tif", "a.dat", "a.h5"):
        (tmp_path / name).write_bytes(FOREIGN[kind])
        for door in (read_own, read_photograph, drawn):
            with pytest.raises((AppError, CameraError)) as refused:
                door(tmp_path / name)
            said = str(refused.value)
            assert f"{name}: {kind}" in said
            assert "formats read here are PNG, TIFF" in said
            assert "damaged" not in said


# Tables as spreadsheets write them

ROWS = [("s.npy", "shot", 0.1), ("d.npy", "dark", 0.25)]
TABLES = {
    "plain": "file,kind,exposure_s\ns.npy,shot,0.1\nd.npy,dark,0.25\n",
    "trailing commas": "file,kind,exposure_s,,\ns.npy,shot,0.1,,\nd.npy,dark,0.25,,\n,,,,\n",
    "longer rows": "file,kind,exposure_s\ns.npy,shot,0.1,,\nd.npy,dark,0.25\n",
    "sep": "sep=;\nfile;kind;exposure_s\ns.npy;shot;0,1\nd.npy;dark;2,5E-01\n",
    "sep and commas": '"sep=,",\nfile,kind,exposure_s\ns.npy,shot,1.0E-01\nd.npy,dark,.25\n',
    "decimal commas": "file;kind;exposure_s\ns.npy;shot;1,0E-01\nd.npy;dark;+0,25\n",
    "tabs": "file\tkind\texposure_s\ns.npy\tshot\t1,0e-1\nd.npy\tdark\t0,25\n",
    "old ends of lines": "file,kind,exposure_s\rs.npy,shot,0.1\rd.npy,dark,0.25\r",
}


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read_as_spreadsheets_write_it(tmp_path, name, coding):
    for file, _, _ in ROWS:
        np.save(tmp_path / file, GREY)
    (tmp_path / "t.csv").write_bytes(TABLES[name].encode(coding))
    rows = [listed.row for listed in read_table(tmp_path / "t.csv")]
    assert [(row.file, row.kind, row.exposure_s) for row in rows] == ROWS


def test_a_cell_without_a_column_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("file,kind,\ns.npy,shot,0.1\n")
    with pytest.raises(AppError, match="line 2: 3 cells under 2 columns"):
        read_table(tmp_path / "t.csv")
