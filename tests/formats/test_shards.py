"""Zarr groups that workers write shard by shard: the numbers of the HDF5 files, and read again."""

import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from pools import Here
from programs import program

from emmc_rig.commands.simulate import simulate_into
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import open_scene
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.reconstructing import open_frames, reconstruct_undrawn
from emmc_rig.reconstruction.method import BlockSettings
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.tv import TVSettings
from emmc_rig.store import psi as psis
from emmc_rig.store import shards
from emmc_rig.store.folders import result_folder
from emmc_rig.store.psi import StoredPsi, read_frames

CAMERA, SIZE, SCENE = "rgbw-bayer-1shot", (64, 80), "deep-occlusions"
SETTINGS = MethodSettings(
    blocks=BlockSettings(whole=1000, side=32, blend=4), tv=TVSettings(max_steps=5)
)


def reconstructed(frames, out, **more):
    with result_folder(out, "reconstruct", resumes=True) as new:
        capture, pool = opened_capture(frames), Here(backwards=True)
        return reconstruct_undrawn(
            capture, new, "tv", settings=SETTINGS, truth=SCENE, pool=pool, **more
        )[0]


@pytest.fixture
def frames(tmp_path):
    (tmp_path / "frames").mkdir()
    simulate_into(tmp_path / "frames", SCENE, CAMERA, find_camera(CAMERA), SIZE, 0)
    return tmp_path / "frames"


@pytest.mark.slow
def test_shards_hold_what_the_file_holds_and_open_as_a_scene(frames, tmp_path, monkeypatch):
    zarr = pytest.importorskip("zarr", reason="needs the extra `zarr`")
    monkeypatch.setattr(shards, "SHARD", 32)
    monkeypatch.setattr(shards, "CHUNK", 16)
    plain = reconstructed(frames, tmp_path / "plain")
    sharded = reconstructed(frames, tmp_path / "sharded", as_zarr=True)
    for figure in ("psnr_db", "ssim", "replicate_psnr_db"):
        assert sharded[figure] == pytest.approx(plain[figure], rel=1e-12)
    with h5py.File(tmp_path / "plain/light_field.h5") as file:
        expected = np.asarray(file["light_field"])
    group = tmp_path / "sharded/result.zarr"
    stored = zarr.open_group(group, mode="r")["light_field"]
    assert (stored.metadata.zarr_format, stored.shards[2:4], stored.chunks[:4]) == (
        3, (32, 32), (1, 1, 16, 16),
    )  # fmt: skip
    np.testing.assert_array_equal(stored[...], expected)
    np.testing.assert_array_equal(np.asarray(open_scene(str(group), views=(5, 5))), expected)
    assert not (tmp_path / "sharded/light_field.h5").exists()


@pytest.mark.slow
def test_psi_in_shards_gives_the_bytes_of_psi_in_a_file(frames, tmp_path, monkeypatch):
    zarr = pytest.importorskip("zarr", reason="needs the extra `zarr`")
    monkeypatch.setattr(psis, "SHARD", 32)
    monkeypatch.setattr(psis, "CHUNK", 16)
    sharded = tmp_path / "sharded"
    sharded.mkdir()
    simulate_into(sharded, SCENE, CAMERA, find_camera(CAMERA), SIZE, 0, as_zarr=True)
    assert sorted(path.name for path in sharded.iterdir()) == [
        "frames.zarr", "metrics.json", "psi.zarr",
    ]  # fmt: skip
    weights = zarr.open_group(sharded / "psi.zarr", mode="r")["weights"]
    assert weights.shards == (1, 5, 5, 32, 1, 32)
    results = [
        reconstructed(folder, tmp_path / f"from-{folder.name}") for folder in (frames, sharded)
    ]
    assert results[0]["psi_sha256"] == results[1]["psi_sha256"]
    from_frames, two = (tmp_path / f"from-{name}/light_field.h5" for name in ("frames", "sharded"))
    assert from_frames.read_bytes() == two.read_bytes()
    whole, _ = open_frames(sharded)
    np.testing.assert_array_equal(whole.weights, open_frames(frames)[0].weights)


@pytest.mark.parametrize("name", ["weights", "colour"])
def test_a_missing_part_of_psi_is_one_line_and_others_are_read(frames, name, monkeypatch):
    pytest.importorskip("zarr", reason="needs the extra `zarr`")
    monkeypatch.setattr(psis, "SHARD", 32)
    monkeypatch.setattr(psis, "CHUNK", 16)
    psi = StoredPsi(frames / "psi.h5").load()
    psis.save_shards(psi, frames / "psi.zarr")
    parts = sorted(part for part in (frames / "psi.zarr" / name / "c").rglob("*") if part.is_file())
    parts[-1].unlink()
    saved = psis.StoredPsi(frames / "psi.zarr")
    here = slice(0, 30), slice(0, 60)
    np.testing.assert_array_equal(saved.window(*here).weights, psi.window(*here).weights)
    code, _, err = program("reconstruct", frames, "--method", "tv", "--out", frames / "out")
    assert (code, "psi.zarr: a file of it is missing; copy" in err) == (1, True), err
    assert "Traceback" not in err
    assert not (frames / "out").exists()


@pytest.mark.parametrize(
    ("gone", "says"),
    [
        ("readings/c", "a file of it is missing; copy"),
        ("deviation/c", "a file of it is missing; copy"),
        ("usable/c", "a file of it is missing; copy"),
        ("usable", "one that cannot be read"),
    ],
)
def test_frames_in_shards_that_lost_a_part_are_refused(tmp_path, gone, says):
    pytest.importorskip("zarr", reason="needs the extra `zarr`")
    simulate_into(tmp_path, SCENE, CAMERA, find_camera(CAMERA), SIZE, 0, as_zarr=True)
    shutil.rmtree(tmp_path / "frames.zarr" / gone)
    with pytest.raises(AppError, match=f"frames.zarr: .*{says}"):
        read_frames(tmp_path)


def test_without_the_extra_or_without_the_array_one_line_says_so(tmp_path, monkeypatch):
    pytest.importorskip("zarr", reason="needs the extra `zarr`")
    with pytest.raises(AppError, match="no array light_field"):
        shards.load_light_field(tmp_path)
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(AppError, match=r"pip install 'emmc-rig\[zarr\]'"):
        shards.created_group(Path(tmp_path / "new"))
