"""Every decoder of bytes from outside is called in one guarded place, and takes bounded memory."""

import io
import json
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from fuzzing import FUZZ
from hypothesis import example, given, settings
from hypothesis import strategies as st
from view_files import png

from emmc_rig.bench.device_config import parse_camera, parse_stage
from emmc_rig.bench.rig_config import ImagedRig, rig_description
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import RawFrameError
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.decoding.child import read_in_child
from emmc_rig.model.errors import SensingError
from emmc_rig.model.sensing import Psi
from emmc_rig.store.psi import StoredPsi

ROOT = Path(__file__).parents[2]
READING = ROOT / "emmc_rig/model/reading.py"


def test_hdf5_is_opened_for_reading_in_one_place():
    """Ruff keeps other decoders to their modules, but cannot tell reading from writing."""
    opened = re.compile(r"h5py\.File\((?![^()]*(\([^()]*\)[^()]*)*\"w\")")
    for package in ("emmc_rig", "drivers", "calibration", "reconstruction", "simulators"):
        for path in sorted(set((ROOT / package).rglob("*.py")) - {READING}):
            assert not opened.search(path.read_text(encoding="utf-8")), path


# Memory and time, each measured in a process of its own


WATCHED = """
import json, resource, sys, time
from pathlib import Path
imports, call, path = sys.argv[1], sys.argv[2], Path(sys.argv[3])
import cv2, PIL.Image
exec(imports)
def peak():
    lines = open("/proc/self/status").read().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
def of_children():
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
earlier, before, started, said = of_children(), peak(), time.process_time(), ""
try:
    eval(call)
except Exception as fault:
    said = f"{type(fault).__name__}: {fault}"
child = of_children() if of_children() > earlier else 0
print(json.dumps([said, max(peak() - before, child) / 1e3, time.process_time() - started]))
"""


def watched(imports, call, path):
    """What a call says, the megabytes it takes at most, itself or its child, and CPU seconds."""
    command = [sys.executable, "-W", "ignore", "-c", WATCHED, imports, call, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    said, megabytes, seconds = json.loads(done.stdout)
    assert "\n" not in said
    return said, megabytes, seconds


VIEWS = "from emmc_rig.model.lightfield import load_views", "load_views(path)"
HDF5 = "from emmc_rig.model.lightfield import load_hdf5", "load_hdf5(path)"
MASK = (
    "from emmc_rig.model.masks import Picture",
    "Picture(kind='picture', path=path).draw(1, 4, 4, 10.0)",
)
SETTINGS = "from emmc_rig.model.reading import read_yaml", "read_yaml(path, ValueError)"
SCENE = "from emmc_rig.formats.scenes import open_scene", "open_scene(str(path))"


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (
            png(600, 447_392, 1, 3, bytes(1_800_000), interlace=1),
            "pixels, more than 1842 bytes can hold",
        ),
        (png(16_384, 16_384, 255, 2, bytes(1_800_000)), "255 bits a sample of colour type 2"),
        (png(16_384, 16_384, 8, 5, bytes(1_800_000)), "8 bits a sample of colour type 5"),
        (png(8, 8, 8, 2, bytes(200), damage=1), "cut short or damaged"),
    ],
    ids=["unpacks to too much", "depth", "colour type", "checksum"],
)
def test_a_png_is_checked_whole_before_it_is_unpacked(tmp_path, content, complaint):
    (tmp_path / "view_0_0.png").write_bytes(content)
    said, megabytes, seconds = watched(*VIEWS, tmp_path)
    assert said.startswith("SceneError: ")
    assert complaint in said
    assert (megabytes < 50, seconds < 2) == (True, True), (megabytes, seconds)


def test_a_mask_of_another_format_that_claims_too_much_is_not_unpacked(tmp_path):
    path = tmp_path / "mask.bmp"
    head = struct.pack("<IHHI", 54, 0, 0, 54)
    sizes = struct.pack("<IiiHHIIiiII", 40, 9_500, 9_500, 1, 24, 0, 0, 0, 0, 0, 0)
    path.write_bytes(b"BM" + head + sizes)
    said, megabytes, _ = watched(*MASK, path)
    assert "9500 x 9500 pixels, more than 54 bytes can hold" in said
    assert megabytes < 50


def deflated(size_bytes, head=b""):
    """As many zeros behind a head, packed by deflate, a thousandth of it in memory."""
    packer = zlib.compressobj(9)
    parts = [packer.compress(head)]
    parts += [packer.compress(bytes(2**20)) for _ in range(size_bytes // 2**20)]
    return b"".join([*parts, packer.compress(bytes(size_bytes % 2**20)), packer.flush()])


def hdf5(path, shape, chunk, dtype, packed, filters):
    """A file with one chunk as it is packed; filters: as often as deflate is to be undone."""
    with h5py.File(path, "w") as file:
        made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        made.set_chunk(chunk)
        for _ in range(filters):
            made.set_deflate(9)
        space = h5py.h5s.create_simple(shape, (h5py.h5s.UNLIMITED,) * len(shape))
        kind = h5py.h5t.py_create(np.dtype(dtype))
        data_set = h5py.h5d.create(file.id, b"light_field", kind, space, made)
        data_set.write_direct_chunk((0,) * len(shape), packed)


WHOLE = (3, 3, 1024, 2900, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "chunk", "dtype", "packed", "filters", "complaint"),
    [
        (WHOLE, WHOLE, "u1", 80_179_200, 1, "does not fit into its file"),
        (WHOLE, WHOLE, "f4", 320_716_800, 1, "does not fit into its file"),
        ((2, 2, 8, 8, 3), WHOLE, "f4", 320_716_800, 1, "chunks of 3.21e+08 bytes"),
        ((2, 2, 8, 8, 3), (2, 2, 8, 8, 3), "u1", 600_000_000, 2, "in another way"),
    ],
    ids=["codes", "floats", "chunk larger than its data", "packed twice"],
)
def test_hdf5_is_checked_before_it_is_unpacked(
    tmp_path, shape, chunk, dtype, packed, filters, complaint
):
    path = tmp_path / "scene.h5"
    data = deflated(packed)
    hdf5(path, shape, chunk, dtype, zlib.compress(data) if filters == 2 else data, filters)
    said, megabytes, seconds = watched(*HDF5, path)
    assert said.startswith("SceneError: ")
    assert complaint in said
    assert (megabytes < 50, seconds < 2) == (True, True), (megabytes, seconds)


@pytest.mark.parametrize("packing", [{"scaleoffset": 0}, {"compression": "szip"}])
def test_a_filter_that_allocates_what_the_file_says_is_refused(tmp_path, packing):
    path = tmp_path / "scene.h5"
    with h5py.File(path, "w") as file:
        try:
            file.create_dataset("light_field", data=np.zeros((2, 2, 8, 8, 3), "i4"), **packing)
        except ValueError:
            pytest.skip("this HDF5 packs no szip")
    said, _, _ = watched(*HDF5, path)
    assert "packed in another way than by gzip or lzf, once; copy it again" in said.replace(")", "")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[" + "1, " * 1_300_000 + "1]", "larger than 1 MB: not settings"),
        ("[" * 900_000, "nest"),
        ("a: 1" + ":1" * 400_000, "a number of 800001 characters"),
    ],
    ids=["flat", "deep", "a number"],
)
def test_settings_that_are_no_settings_are_refused_at_once(tmp_path, text, complaint):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    said, megabytes, seconds = watched(*SETTINGS, path)
    assert complaint in said
    assert (megabytes < 60, seconds < 2) == (True, True), (megabytes, seconds)


def tiff(rows, columns):
    """A TIFF of zeros, float32 RGB, in one strip."""
    strip = deflated(12 * rows * columns)
    tags = [
        (256, 4, columns), (257, 4, rows), (258, 3, 32), (259, 3, 8), (262, 3, 2), (273, 4, 200),
        (277, 3, 3), (278, 4, rows), (279, 4, len(strip)), (339, 3, 3),
    ]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
    return head.ljust(200, b"\0") + strip


def mat(shape):
    """A MAT file of zeros, uint16."""
    size = 2 * int(np.prod(shape))
    dims = struct.pack("<II5i4x", 5, 20, *shape)
    body = struct.pack("<IIII", 6, 8, 11, 0) + dims + struct.pack("<HH4s", 1, 2, b"LF")
    inner = struct.pack("<II", 14, len(body) + 8 + size) + body + struct.pack("<II", 4, size)
    packed = deflated(size, inner)
    head = b"MATLAB 5.0".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    return head + struct.pack("<II", 15, len(packed)) + packed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("views/view_0_0.tif", lambda: tiff(8000, 8000)),
        ("light_field.mat", lambda: mat((3, 3, 4000, 4000, 3))),
    ],
)
def test_decoders_without_a_limit_get_one(tmp_path, name, make):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(make())
    asked = path.parent if name.startswith("views/") else path
    said, megabytes, _ = watched(*SCENE, asked)
    assert said.startswith(("AppError: ", "SceneError: "))
    assert "it unpacks to more than a file of its size can hold" in said
    assert megabytes < 850, megabytes


@pytest.mark.slow
def test_a_zarr_group_without_its_shards_is_not_read_whole(tmp_path):
    zarr = pytest.importorskip("zarr", reason="needs the extra `zarr`")
    group = zarr.create_group(tmp_path / "scene.zarr", zarr_format=3)
    group.create_array("light_field", shape=(3, 3, 2000, 3000, 3), dtype="f4")
    said, megabytes, _ = watched(*SCENE, tmp_path / "scene.zarr")
    assert said.startswith("SceneError: ")
    assert "does not fit into its files" in said
    assert megabytes < 300


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_a_view_whose_name_holds_another_number_is_named_at_once(tmp_path, ending):
    for name in ("view_0_0", "view_0_1", "view_99999_99999"):
        (tmp_path / f"{name}.{ending}").write_bytes(png(2, 2, 8, 2, bytes(14)))
    said, megabytes, seconds = watched(*SCENE, tmp_path)
    assert (
        f"3 views do not fill 100000x100000, as view_99999_99999.{ending} asks for; names are "
        "view_ROW_COL, rows and columns counted from 0: rename it or move it away"
    ) in said
    assert (megabytes < 300, seconds < 10) == (True, True), (megabytes, seconds)


# Specifications of devices

CHARACTERS = "[]{}:,=*&!|>%@`'\"\\\n\t\0\ud800é#?-~1.e "
SPECS = (
    "zaber:/dev/x,microstep_um=0.5", "grbl:/dev/x,tolerance_um=5", "apt:/dev/x,actuator=Z825B",
    "mm:x.cfg,homes=no", "stage.yaml", "x:1,a=b",
)  # fmt: skip


@pytest.mark.slow
@given(
    st.sampled_from(SPECS),
    st.lists(
        st.tuples(st.integers(0, 40), st.integers(0, 3), st.text(CHARACTERS, max_size=3)),
        max_size=4,
    ),
)
@settings(max_examples=300 * FUZZ, deadline=None)
@example("zaber:/dev/x,microstep_um=", [(26, 0, "[1")])
@example("zaber:/dev/x,microstep_um=", [(26, 0, "\x00")])
@example("zaber:/dev/x,microstep_um=", [(26, 0, "&a [*a]")])
def test_whatever_a_device_is_called_it_is_understood_or_refused_in_one_line(spec, changes):
    for place, cut, put in changes:
        spec = spec[:place] + put + spec[place + cut :]
    for read in (
        parse_stage,
        parse_camera,
        lambda entry: rig_description(entry, ImagedRig(scene="near-planar")),
    ):
        said = ""
        try:
            read(spec)
        except AppError as fault:
            said = str(fault)
        assert "\n" not in said


# Psi and RAW files


def flipped_camera(path):
    """Flip bytes of the camera's text in a saved Psi, so that it is no UTF-8."""
    data = path.read_bytes()
    place = data.index(b'"title"')
    path.write_bytes(data[:place] + b"\xff\xfe" + data[place + 2 :])


def test_a_psi_whose_camera_is_no_text_any_more_is_damaged(tmp_path):
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), (16, 16))
    path = tmp_path / "psi.h5"
    psi.save(path)
    flipped_camera(path)
    for read in (lambda: Psi.load(path), StoredPsi(path).verify, StoredPsi(path).load):
        with pytest.raises(SensingError, match=r"psi\.h5: damaged \(its checksum differs\)"):
            read()


@pytest.mark.parametrize("change", [{"binning": 0}, {"weights": (2, 3)}])
def test_a_psi_of_another_shape_is_refused_when_it_is_opened(tmp_path, change):
    path = tmp_path / "psi.h5"
    build_imaging_matrix(find_camera("rgbw-bayer-1shot"), (16, 16)).save(path)
    with h5py.File(path, "a") as file:
        if "binning" in change:
            file.attrs["binning"] = 0
        else:
            del file["weights"]
            file["weights"] = np.zeros(change["weights"])
    for read in (Psi.load, StoredPsi):
        with pytest.raises(SensingError) as fault:
            read(path)
        assert "\n" not in str(fault.value)


class _Rawpy:
    """A decoder that fails in a way of its own."""

    def __init__(self, fault):
        self.fault = fault

    def imread(self, stream):
        raise self.fault


@pytest.mark.parametrize(
    "fault",
    [RuntimeError("RAW image is not flat"), OSError("x\ny"), KeyError(b"cfa"), RecursionError()],
)
def test_whatever_libraw_raises_is_a_frame_that_cannot_be_decoded(monkeypatch, fault):
    monkeypatch.setattr("emmc_rig.drivers.raw.rawpy", _Rawpy(fault))
    with pytest.raises(RawFrameError, match="LibRaw cannot decode it") as refused:
        decode_raw(b"FUJIFILMCCD-RAW " + bytes(200))
    assert "\n" not in str(refused.value)


def test_a_dng_of_colour_pixels_is_refused_as_such():
    file = io.BytesIO()
    tags = [(50706, "B", 4, (1, 4, 0, 0), True), (50708, "s", 0, "test", True)]
    tifffile.imwrite(
        file, np.full((64, 80, 3), 900, np.uint16), photometric=34892, extratags=tags, metadata=None
    )
    with pytest.raises(RawFrameError, match="it holds colour pixels, not one mosaic"):
        decode_raw(file.getvalue())


def test_a_raw_file_that_claims_more_than_its_bytes_hold_is_not_unpacked(tmp_path):
    data = bytearray(encode_dng(np.zeros((64, 80), np.uint16), "rggb", 0, 4095, 0.01))
    with tifffile.TiffFile(stream := io.BytesIO(data), mode="r+") as tiff:
        tags = tiff.pages.first.tags
        tags[259].overwrite(34892)  # lossy, of which nothing says how short it may be
        tags[256].overwrite(20_000)
        tags[257].overwrite(20_000)
    (tmp_path / "x.dng").write_bytes(stream.getvalue())
    said, megabytes, _ = watched(
        "from emmc_rig.drivers.raw import decode_raw",
        "decode_raw(path.read_bytes())",
        tmp_path / "x.dng",
    )
    assert "cannot hold 20000x20000 pixels" in said
    assert megabytes < 100


@pytest.mark.parametrize("buffered", [True, False])
def test_arrays_come_from_the_child_whether_or_not_python_buffers_its_output(
    tmp_path, monkeypatch, buffered
):
    """PYTHONUNBUFFERED, set on many machines, makes another kind of file of the child's output."""
    if buffered:
        monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    else:
        monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    np.savez(tmp_path / "a.npz", frames=np.arange(12).reshape(3, 4))
    found, _ = read_in_child("npz", [tmp_path / "a.npz"])
    np.testing.assert_array_equal(found, np.arange(12).reshape(3, 4))
