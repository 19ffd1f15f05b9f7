"""`emmc_rig.open_result`: what was saved opens again, whichever folder holds a light field."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import emmc_rig as emmc
from emmc_rig.commands.simulate import simulate_into
from emmc_rig.errors import AppError
from emmc_rig.formats.exports import open_export, open_film
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.reconstructing import reconstruct_undrawn
from emmc_rig.reconstruction import methods
from emmc_rig.reconstruction.verdict.rules import Verdict
from emmc_rig.store.folders import result_folder
from emmc_rig.store.results import write_metrics

SIZE = (24, 32)
OLD = Path(__file__).parent / "result-of-0.4.0"
"""Made by `Result.save` of version 0.4.0 before results kept their frames, without its pictures."""
TWICE = """
import emmc_rig as emmc
psi = emmc.camera("rgbw-bayer-1shot").psi((24, 32))
frames = psi @ emmc.scene("near-planar", size=(24, 32))
for _ in range(2):
    result = emmc.reconstruct(psi, frames, "tv")
    print(result.seconds, result.metrics().get("compiling_seconds", 0.0))
"""


@pytest.fixture(scope="module")
def result():
    camera, scene = emmc.camera("rgbw-bayer-2shots"), emmc.scene("deep-occlusions", size=SIZE)
    psi = camera.psi(SIZE)
    settings = {"adaptive": {"stride": 4}, "screening": True}
    return emmc.reconstruct(
        psi, camera.expose(scene, 0, psi), "adaptive-fast", settings=settings
    )  # fmt: skip


@pytest.fixture(scope="module")
def saved(result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "out"
    result.save(folder)
    return folder


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder, name = tmp_path_factory.mktemp("frames"), "rgbw-bayer-1shot"
    simulate_into(folder, "deep-occlusions", name, emmc.camera(name), SIZE, 0)
    return folder


def same(result, other):
    """Assert that two results are equal in arrays, figures and words."""
    np.testing.assert_array_equal(result.light_field, other.light_field)
    assert result.maps.keys() == other.maps.keys()
    for name, values in result.maps.items():
        np.testing.assert_array_equal(values, other.maps[name])
    np.testing.assert_array_equal(result.misfit, other.misfit)
    for name in ("method", "status", "advice", "seconds", "stated_db", "stated_interval_db",
                 "dictionary", "view_axes"):  # fmt: skip
        assert getattr(result, name) == getattr(other, name), name
    assert result.verdict.words == other.verdict.words
    assert json.dumps(result.verdict.as_dict()) == json.dumps(other.verdict.as_dict())
    assert repr(result) == repr(other)


def test_a_saved_result_opens_as_it_was(result, saved, tmp_path):
    opened = emmc.open_result(saved)
    same(opened, result)
    assert opened.metrics() == json.loads((saved / "metrics.json").read_text())
    truth = np.asarray(emmc.scene("deep-occlusions", size=SIZE))
    assert opened.compare(truth) == result.compare(truth)
    assert opened.psi.checksum() == result.psi.checksum()
    for name in ("readings", "deviation", "usable"):
        np.testing.assert_array_equal(getattr(opened.frames, name), getattr(result.frames, name))
    assert len(opened.figure().axes) == len(result.figure().axes)
    assert opened.viewer() == result.viewer()
    opened.save(tmp_path / "again")
    same(emmc.open_result(tmp_path / "again"), result)
    assert emmc.open_result(tmp_path / "again").metrics() == opened.metrics()


def test_open_frames_opens_those_of_a_result(result, saved):
    psi, frames = emmc.open_frames(saved)
    np.testing.assert_array_equal(frames.readings, result.frames.readings)
    assert psi.checksum() == result.psi.checksum()
    with pytest.raises(AppError, match=r"^nowhere: no such folder; name a session"):
        emmc.open_frames("nowhere")


def test_metrics_say_what_made_them(result, frames, tmp_path):
    metrics = result.metrics()
    assert metrics["settings"] == {"adaptive": {"stride": 4}}
    assert metrics["frames_sha256"] == result.frames.sha256
    assert len(metrics["frames_sha256"]) == len(metrics["psi_sha256"]) == 64
    assert metrics["threads"] >= 1
    assert metrics["versions"]["emmc-rig"] == emmc.__version__
    root = Path(emmc.__file__).parents[1]
    if (root / ".git").exists():
        asked = ("git", "-C", str(root), "rev-parse", "HEAD")
        head = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
        assert metrics["commit"].removesuffix("-dirty") == head
    fewer = result.frames.usable.copy()
    fewer[0, 0, 0] = False
    other = emmc.Frames(result.frames.readings, result.frames.deviation, fewer)
    assert other.sha256 != result.frames.sha256
    # Every command writes the same of itself.
    write_metrics(tmp_path, {"figure": 1})
    written = json.loads((tmp_path / "metrics.json").read_text())
    assert {"command", "versions", "threads"} <= written.keys()
    assert written.get("commit") == metrics.get("commit")


def test_what_the_command_wrote_opens_with_the_psi_beside_its_frames(frames, tmp_path):
    source = tmp_path / "frames"
    shutil.copytree(frames, source)
    (tmp_path / "out").mkdir()
    capture = opened_capture(source)
    metrics, _ = reconstruct_undrawn(capture, tmp_path / "out", "tv", truth="deep-occlusions")
    opened = emmc.open_result(tmp_path / "out")
    assert opened.metrics()["psnr_db"] == metrics["psnr_db"]
    assert opened.verdict.level == metrics["verdict"]["level"]
    assert opened.psi.checksum() == metrics["psi_sha256"]
    shutil.rmtree(source)
    alone = emmc.open_result(tmp_path / "out")
    assert alone.frames.sha256 == metrics["frames_sha256"]
    with pytest.raises(AppError, match=r"the Psi of this result is not there; put it beside"):
        _ = alone.psi
    alone.save(tmp_path / "again")
    np.testing.assert_array_equal(
        emmc.open_result(tmp_path / "again").light_field, opened.light_field
    )
    assert not (tmp_path / "again/psi.h5").exists()


def test_a_result_of_an_earlier_version_opens_without_its_frames():
    opened = emmc.open_result(OLD)
    with h5py.File(OLD / "light_field.h5") as file:
        np.testing.assert_array_equal(opened.light_field, np.asarray(file["light_field"]))
    written = json.loads((OLD / "metrics.json").read_text())
    assert opened.metrics() == written
    assert opened.verdict.level == written["verdict"]["level"]
    assert opened.stated_db is written["stated_db"] is None
    assert opened.seconds == written["seconds"]
    assert opened.disparity is not None
    assert opened.disparity.shape == opened.misfit.shape == opened.light_field.shape[2:4]
    assert "viewer-data" in opened.viewer()
    asked = (
        lambda: opened.frames, lambda: emmc.open_frames(OLD), lambda: emmc.open_frames(OLD, "psi")
    )  # fmt: skip
    for ask in asked:
        with pytest.raises(
            AppError, match=r"without its frames, which emmc_rig\.open_result opens"
        ):
            ask()


def test_the_seconds_of_a_demo_are_those_of_its_reconstruction_without_compiling(tmp_path):
    folder = tmp_path / "demo"
    shutil.copytree(OLD, folder)
    written = json.loads((folder / "metrics.json").read_text())
    written |= {"seconds": {"scene": 1.0, "reconstruct": 5.0}, "compiling_seconds": 2.0}
    (folder / "metrics.json").write_text(json.dumps(written))
    assert emmc.open_result(folder).seconds == 3.0


def test_a_verdict_of_version_0_2_lacks_figures_that_are_none_now():
    written = json.loads((OLD / "metrics.json").read_text())["verdict"]
    for name in ("over_flat", "parallax", "view_axes", "relief", "colour_error"):
        del written["features"][name]
    written["features"]["missed"] = 0.1
    verdict = Verdict.from_dict(written)
    assert verdict.level == written["level"]
    assert verdict.evidence.parallax is None
    assert verdict.evidence.method == "adaptive-fast"


def test_a_frame_of_a_film_opens_with_the_psi_of_its_shot(result, tmp_path):
    film, place = tmp_path / "film", tmp_path / "film/frames/000003"
    place.mkdir(parents=True)
    result.psi.save(film / "psi.h5")
    second = result.psi.of_shots([1], "")
    taken = emmc.Frames(*(getattr(result.frames, name)[1:] for name in
                          ("readings", "deviation", "usable")))  # fmt: skip
    result = emmc.reconstruct(second, taken, "adaptive-fast")
    of_film = {"frame": 3, "time_s": 0.5, "segment": 0, "shot": 2}
    result.write(place, {**result.metrics(), **of_film})
    times_s = [0.0, 0.2, 0.4, 0.5]
    write_metrics(film, {"film": {"frames": 4, "rate": 5.0, "times_s": times_s}})
    opened = emmc.open_result(place)
    same(opened, result)
    np.testing.assert_array_equal(opened.frames.readings, taken.readings)
    assert np.array_equal(open_film(film).opened(3).light_field, result.light_field)
    with pytest.raises(AppError, match=r"a film; open a frame of it"):
        emmc.open_result(film)


def test_a_result_as_zarr_opens_as_one_as_hdf5(result, saved, tmp_path):
    pytest.importorskip("zarr")
    from emmc_rig.store.shards import create_array, created_group

    with result_folder(tmp_path / "out", "reconstruct") as folder:
        group = created_group(folder / "result.zarr")
        group.attrs["view_axes"] = "angle,angle"
        arrays = {"light_field": result.light_field, **result.maps, "misfit": result.misfit}
        for name, values in arrays.items():
            axes = 2 if name in ("light_field", "sigma") else 0
            create_array(group, name, values.shape, values.dtype, axes)
            group[name][...] = values
        for name in ("metrics.json", "frames.h5"):
            shutil.copy(saved / name, folder)
    same(emmc.open_result(tmp_path / "out"), result)
    shown = open_export(str(tmp_path / "out"))
    np.testing.assert_array_equal(shown.light_field, result.light_field)
    np.testing.assert_array_equal(shown.disparity, result.disparity)


def test_what_is_no_result_is_refused_in_one_line(frames, saved, tmp_path):
    def refused(folder, words):
        with pytest.raises(AppError, match=words) as fault:
            emmc.open_result(folder)
        assert "\n" not in str(fault.value)

    refused(frames, "holds frames, no light field")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", r"holds no light field, neither light_field\.h5 nor result\.zarr")
    damaged = tmp_path / "damaged"
    shutil.copytree(saved, damaged)
    for text, words in (
        ("{", r"metrics\.json: cannot be read"),
        ("[]", r"metrics\.json: cannot be read"),
        ('{"method": "tv"}', r"metrics\.json: not that of a result \(seconds\)"),
    ):
        (damaged / "metrics.json").write_text(text)
        refused(damaged, words)
    (damaged / "metrics.json").unlink()
    refused(damaged, r"metrics\.json: cannot be read")


def test_the_seconds_of_a_result_are_those_of_its_steps(monkeypatch):
    clock = SimpleNamespace(s=0.0)
    monkeypatch.setattr(methods, "running_s", lambda: clock.s)

    def step(progress):
        clock.s += 0.5

    psi = emmc.camera("rgbw-bayer-1shot").psi((24, 32))
    frames = psi @ emmc.scene("near-planar", size=(24, 32))
    result = emmc.reconstruct(psi, frames, "tv", on_step=step)
    assert result.seconds == result.metrics()["seconds"] == clock.s
    assert clock.s >= 0.5 * result.solved.steps > 0


@pytest.mark.slow
def test_seconds_are_of_the_method_alone_and_compilation_is_stated_apart(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    ran = subprocess.run(
        [sys.executable, "-c", TWICE], capture_output=True, text=True, check=True, timeout=500
    )
    (first_s, compiling_s), (then_s, no_more_s) = (
        map(float, line.split()) for line in ran.stdout.splitlines()
    )
    assert compiling_s > 1
    assert no_more_s < 0.2 * compiling_s
    assert first_s < 0.3 * compiling_s
    assert first_s < 3 * then_s + 1
