"""Psi in files for others: it makes the same frames."""

import json

import numpy as np
import pytest
import scipy.io
from programs import program
from scipy import sparse

import emmc_rig as emmc
from emmc_rig.errors import AppError
from emmc_rig.formats import psi_exports


@pytest.fixture(scope="module", params=["rgbw-bayer-2shots", "rgbw-mono"])
def folder(request, tmp_path_factory):
    """The folder of `simulate`."""
    folder = tmp_path_factory.mktemp(request.param) / "frames"
    how = ("--camera", request.param, "--size", "24x32", "--out", str(folder))
    assert program("simulate", *how)[0] == 0
    return folder


@pytest.mark.slow
def test_scipy_gets_the_frames_of_psi_from_npz(folder, tmp_path):
    code, _, err = program("export", "psi", str(folder), "--out", str(tmp_path / "out"))
    assert code == 0, err
    psi, frames = emmc.open_frames(folder)
    layout = json.loads((tmp_path / "out/layout.json").read_text())
    matrix = sparse.load_npz(tmp_path / "out/psi.npz")
    light_field = np.random.default_rng(0).random(layout["light_field_shape"])
    y = matrix @ light_field.ravel()
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
    held = scipy.io.loadmat(tmp_path / "out/psi.mat")
    light_field = np.random.default_rng(0).random(held["light_field_shape"].ravel())
    x = np.transpose(light_field, (4, 3, 2, 1, 0)).ravel(order="F")  # as `order` has it in MATLAB
    assert "permute(light_field, 5:-1:1)" in held["order"].item()
    np.testing.assert_allclose(held["Psi"] @ x, (psi @ light_field).ravel(), rtol=1e-6)
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
