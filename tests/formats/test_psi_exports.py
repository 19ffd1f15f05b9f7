"""Psi in files for others: read without the libraries that wrote it, it makes the same frames."""

import json
import struct
import zlib

import numpy as np
import pytest
from programs import program

import emmc_rig as emmc
from emmc_rig.errors import AppError
from emmc_rig.formats import psi_exports

MAT_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8"}
MAT_TYPES |= {12: "<i8", 13: "<u8", 16: "u1", 17: "<u2"}
MATRIX, COMPRESSED = 14, 15
SPARSE, CHARACTERS = 5, 4


def elements(data):
    """Yield (type, bytes) of the elements of a MAT file, version 5, or of one of its matrices.

    Source: MathWorks, "MAT-File Format", chapter 1.
    """
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind >> 16:  # small: size and type in one word, four bytes of data
            yield kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]
            at += 8
            continue
        body = data[at + 8 : at + 8 + size]
        at += 8 + size
        if kind == COMPRESSED:
            yield from elements(zlib.decompress(body))
        else:
            yield kind, body
            at += -at % 8


def numbers(element):
    kind, data = element
    return np.frombuffer(data, MAT_TYPES[kind])


def read_mat(path):
    """Return the variables of a MAT file; of a sparse one (shape, rows, column starts, values)."""
    found = {}
    for kind, body in elements(path.read_bytes()[128:]):
        assert kind == MATRIX
        flags, shape, name, *parts = elements(body)
        cls, shape = numbers(flags)[0] & 0xFF, numbers(shape)
        parts = [numbers(part) for part in parts]
        if cls == SPARSE:
            value = (shape, *parts)
        elif cls == CHARACTERS:
            value = "".join(map(chr, parts[0]))
        else:
            value = parts[0].reshape(shape, order="F")
        found[name[1].decode()] = value
    return found


def product(starts, others, values, x, rows):
    """Return a matrix, stored by rows (rows=None) or by columns, times a vector, by entries."""
    line = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    y = np.zeros(len(starts) - 1 if rows is None else rows)
    if rows is None:
        np.add.at(y, line, values * x[others])
    else:
        np.add.at(y, others, values * x[line])
    return y


@pytest.fixture(scope="module", params=["rgbw-bayer-2shots", "rgbw-mono"])
def folder(request, tmp_path_factory):
    """The folder of `simulate`."""
    folder = tmp_path_factory.mktemp(request.param) / "frames"
    how = ("--camera", request.param, "--size", "24x32", "--out", str(folder))
    assert program("simulate", *how)[0] == 0
    return folder


@pytest.mark.slow
def test_numpy_alone_gets_the_frames_of_psi_from_npz(folder, tmp_path):
    code, _, err = program("export", "psi", str(folder), "--out", str(tmp_path / "out"))
    assert code == 0, err
    psi, frames = emmc.open_frames(folder)
    layout = json.loads((tmp_path / "out/layout.json").read_text())
    with np.load(tmp_path / "out/psi.npz") as held:
        assert held["format"].item() == b"csr"
        starts, others, values, shape = (held[k] for k in ("indptr", "indices", "data", "shape"))
    light_field = np.random.default_rng(0).random(layout["light_field_shape"])
    assert tuple(shape) == (np.prod(layout["frames_shape"]), light_field.size)
    y = product(starts, others, values, light_field.ravel(), None)
    np.testing.assert_allclose(y.reshape(layout["frames_shape"]), psi @ light_field, rtol=1e-6)
    with np.load(tmp_path / "out/frames.npz") as held:
        np.testing.assert_array_equal(held["readings"], frames.readings)
        np.testing.assert_array_equal(held["deviation"], frames.deviation)
        np.testing.assert_array_equal(held["usable"], frames.usable)


@pytest.mark.slow
def test_a_reader_of_mat_files_gets_the_frames_of_psi(folder, tmp_path):
    where = ("export", "psi", str(folder), "--format", "mat", "--out", str(tmp_path / "out"))
    code, _, err = program(*where)
    assert code == 0, err
    psi, frames = emmc.open_frames(folder)
    held = read_mat(tmp_path / "out/psi.mat")
    shape, rows, starts, values = held["Psi"]
    light_field = np.random.default_rng(0).random(held["light_field_shape"].ravel())
    x = np.transpose(light_field, (4, 3, 2, 1, 0)).ravel(order="F")  # as `order` has it in MATLAB
    assert "permute(light_field, 5:-1:1)" in held["order"]
    y = product(starts, rows, values, x, shape[0])
    np.testing.assert_allclose(y, (psi @ light_field).ravel(), rtol=1e-6)
    np.testing.assert_array_equal(held["readings"].ravel(), frames.readings.ravel())
    np.testing.assert_array_equal(held["usable"].ravel(), frames.usable.ravel())


def test_the_file_of_a_psi_is_exported_without_frames(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    psi = emmc.Psi.from_weights(np.random.default_rng(0).random((1, 1, 3, 4, 6)))
    psi.save("psi.h5")
    code, said, err = program("export", "psi", "psi.h5")
    assert code == 0, err
    assert "wrote Psi(1 shot, 1x3 views, 4x6, one colour a pixel" in said
    written = {path.name for path in (tmp_path / "emmc-psi-npz").iterdir()}
    assert written == {"psi.npz", "layout.json", "metrics.json", "files.json"}
    assert program("export", "psi", "--out", "again")[0] == 0  # the one in this folder


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("export", "psi", "nowhere"), 1, "nowhere: no such file"),
        (("export", "psi", "noise.h5"), 1, "noise.h5: "),
        (("export", "psi", "noise.h5", "--format", "tiff"), 2, "there are npz, mat"),
        (("export", "near-planar", "noise.h5"), 2, "export one light field at a time"),
    ],
)
def test_what_is_no_psi_is_refused_and_nothing_is_written(tmp_path, monkeypatch, words, code, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "noise.h5").write_bytes(bytes(range(256)))
    got, _, err = program(*words)
    assert got == code
    assert said in " ".join(err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["noise.h5"]


def test_a_psi_that_mat_files_do_not_hold_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(psi_exports, "LARGEST_MAT_BYTES", 100)
    psi = emmc.Psi.from_weights(np.ones((1, 1, 3, 4, 6)))
    with pytest.raises(AppError, match="more than a MAT file holds: export npz"):
        psi_exports.write_mat(tmp_path, psi, None)
