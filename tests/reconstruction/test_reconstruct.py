"""`emmc-rig reconstruct`: a folder of frames in, a light field out, by any method."""

import json

import h5py
import numpy as np
import pytest

from emmc_rig.commands.simulate import simulate_into
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.lightfield import load_hdf5
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.reconstructing import (
    load_settings,
    reconstruct_captures,
)
from emmc_rig.process.result import Result
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.adaptive.joint import TextureSettings
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.dictionary import Dictionary, open_dictionary
from emmc_rig.reconstruction.errors import DictionaryError, ReconstructionError
from emmc_rig.store.psi import read_frames

SCENE, CAMERA, SIZE = "deep-occlusions", "rgbw-bayer-2shots", (36, 44)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    simulate_into(folder, SCENE, CAMERA, find_camera(CAMERA), SIZE, 0)
    return folder


def reconstructed(folder, out, method, **given):
    """Return the metrics of a folder's frames, reconstructed as the command does."""
    places = [(opened_capture(folder), out)]
    ((_, outcome),) = reconstruct_captures(
        places, None, None, None, Watcher(), method=method, **given
    )
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


@pytest.mark.parametrize(("method", "dictionary"), [("tv", None), ("dict-admm", "lambertian")])
def test_frames_become_a_light_field_with_a_page_and_metrics(frames, tmp_path, method, dictionary):
    metrics = reconstructed(frames, tmp_path, method, dictionary_spec=dictionary, truth=SCENE)
    light_field = load_hdf5(tmp_path / "light_field.h5")
    assert light_field.shape == (5, 5, *SIZE, 3)
    assert metrics["method"] == method
    assert metrics["psnr_db"] > 12
    assert json.loads((tmp_path / "metrics.json").read_text())["noise_sigma"] > 0
    assert "Where it is wrong" in (tmp_path / "report.html").read_text()


def test_a_result_is_on_the_disk_before_its_page_is_drawn(frames, tmp_path, monkeypatch):
    def stopped(*_, **named):
        raise KeyboardInterrupt

    out = tmp_path / "out"
    monkeypatch.setattr(Result, "draw", stopped)
    places = [(opened_capture(frames), out)]
    with pytest.raises(KeyboardInterrupt):
        list(reconstruct_captures(places, None, None, None, Watcher(), method="tv"))
    assert load_hdf5(out / "light_field.h5").shape == (5, 5, *SIZE, 3)
    assert json.loads((out / "metrics.json").read_text())["method"] == "tv"
    monkeypatch.undo()
    ((_, metrics),) = reconstruct_captures(places, None, None, None, Watcher(), method="tv")
    assert not isinstance(metrics, Exception)
    assert metrics["method"] == "tv"
    assert (out / "report.html").is_file()


def test_the_noise_level_is_that_of_the_usable_pixels(frames):
    capture = read_frames(frames)
    with h5py.File(frames / "frames.h5") as file:
        deviation = np.asarray(file["deviation"])
        error = np.asarray(file["readings"]) - np.asarray(file["noise_free"])
    assert capture.usable.all()
    assert capture.noise_sigma == pytest.approx(np.sqrt(np.mean(deviation**2)))
    # Over 3,168 pixels the spread is known to 1.3 per cent.
    assert capture.noise_sigma == pytest.approx(error.std(), rel=0.06)


def test_folders_that_hold_no_capture_are_refused(frames, tmp_path):
    with pytest.raises(AppError, match=r"holds no frames\.h5"):
        reconstructed(tmp_path, tmp_path / "out", "tv")
    whole = (frames / "frames.h5").read_bytes()
    (tmp_path / "frames.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(AppError, match="cannot be read"):
        read_frames(tmp_path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["readings"] = np.zeros((1, 2, 2))
    (tmp_path / "frames.h5").unlink()
    (tmp_path / "other.h5").rename(tmp_path / "frames.h5")
    with pytest.raises(AppError, match="deviation"):
        read_frames(tmp_path)


def test_settings_come_from_yaml_and_a_misspelt_key_names_the_nearest(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("tv: {mu: 0.01}\nsparse: {stride: 3, solver: {max_steps: 7}}\n")
    settings = load_settings(path)
    assert settings.tv.mu == 0.01
    assert settings.sparse.stride == 3
    assert settings.sparse.solver.max_steps == 7
    path.write_text("sparse: {solver: {max_step: 7}}\n")
    with pytest.raises(AppError, match="max_steps"):
        load_settings(path)
    path.write_text("tv: {mu: -1}\n")
    with pytest.raises(AppError, match="mu"):
        load_settings(path)


def test_dictionaries_come_by_name_or_file(tmp_path):
    assert open_dictionary(None, (5, 5), 1).kind == "lambertian"
    made = open_dictionary("lambertian", (5, 5), 1)
    assert made.patch_shape == (5, 5, 9, 9, 3)
    made.save(tmp_path / "own.h5")
    loaded = open_dictionary(str(tmp_path / "own.h5"), (5, 5), 1)
    np.testing.assert_array_equal(loaded.atoms, made.atoms)
    assert open_dictionary("lambertian", (5, 5), 2).patch_shape[2:4] == (8, 8)
    with pytest.raises(DictionaryError, match="no such file"):
        open_dictionary("nowhere.h5", (5, 5), 1)


def test_a_dictionary_for_other_views_is_refused(frames, tmp_path):
    atoms = np.random.default_rng(0).normal(size=(10, 3, 3, 9, 9, 3))
    Dictionary.normalised(atoms, "ksvd").save(tmp_path / "small.h5")
    with pytest.raises(DictionaryError, match="3x3 views"):
        reconstructed(
            frames, tmp_path / "out", "dict-admm", dictionary_spec=str(tmp_path / "small.h5")
        )


def test_a_misspelt_method_is_reported_first(tmp_path):
    with pytest.raises(ReconstructionError, match="did you mean 'tv'"):
        reconstructed(tmp_path, tmp_path / "out", "tvv")


@pytest.mark.slow
def test_the_adaptive_method_writes_what_it_found_beside_the_light_field(frames, tmp_path):
    settings = load_settings(None).model_copy(
        update={"adaptive": AdaptiveSettings(texture=TextureSettings(steps=3, refine_steps=1))}
    )
    metrics = reconstructed(frames, tmp_path, "adaptive", settings=settings, truth=SCENE)
    assert metrics["psnr_db"] > 12
    with h5py.File(tmp_path / "maps.h5") as file:
        shapes = {name: values.shape for name, values in file.items()}
    assert shapes == {
        "disparity": SIZE,
        "disparity_sigma": SIZE,
        "misfit": SIZE,
        "texture": SIZE,
        "sigma": (5, 5, *SIZE),
    }
