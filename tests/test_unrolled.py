"""The unrolled network: its data step, its file, its training, and how it is refused."""

import sys
from pathlib import Path

import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.model.errors import ModelError
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.progress import Silent
from reconstruction.errors import ReconstructionError
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.methods.unrolled import shipped_weights
from reconstruction.unrolled.weights import Architecture, NetworkWeights
from simulators.random_worlds import random_world
from simulators.raycaster import tabulated
from simulators.scenes import render, rendered

SMALL = Architecture(views=(3, 3), channels=4, blocks=1, stages=2)


@pytest.fixture
def torch():
    """PyTorch, of the extra `learned`."""
    return pytest.importorskip("torch")


@pytest.fixture
def untrained(torch, tmp_path):
    """The file of a small network for 3x3 views, as training begins."""
    from reconstruction.unrolled.learning import Learner

    path = tmp_path / "small.h5"
    Learner(SMALL, 0).weights("untrained").save(path)
    return path


def using(path):
    return MethodSettings.model_validate({"unrolled": {"weights": str(path)}, "screening": False})


@pytest.mark.parametrize(("shots", "colours", "binning"), [(1, 1, 1), (3, 1, 1), (2, 3, 2)])
def test_the_network_sees_psi_as_psi_is(torch, random_psi, shots, colours, binning):
    from reconstruction.unrolled.network import captured

    psi = random_psi(shots, (3, 3), (8, 10), stored=colours, binning=binning)
    light_field = np.random.default_rng(0).random(psi.light_field_shape, dtype=np.float32)
    frames = psi.forward(light_field)
    capture = captured(psi, frames, np.ones_like(frames), np.ones(frames.shape, bool))
    as_views = torch.from_numpy(light_field).flatten(0, 1).permute(0, 3, 1, 2)
    np.testing.assert_allclose(capture.forward(as_views), frames, rtol=1e-4)
    back = capture.adjoint(torch.from_numpy(frames)).permute(0, 2, 3, 1)
    expected = psi.adjoint(frames).reshape(back.shape)
    np.testing.assert_allclose(back, expected, rtol=1e-4, atol=1e-5)
    solved = capture.solved(torch.from_numpy(frames), torch.tensor(1.0))
    ridge = np.asarray(capture.variance) + 1e-6
    np.testing.assert_allclose(solved, psi.solver(ridge)(frames), rtol=2e-3)


def test_every_stage_ends_with_a_light_field_that_explains_the_frames(untrained, random_psi):
    psi = random_psi(1, (3, 3), (9, 11))
    truth = np.random.default_rng(1).random(psi.light_field_shape, dtype=np.float32)
    frames = psi.forward(truth)
    result = reconstruct("unrolled", psi, frames, 1e-4, settings=using(untrained))
    miss = np.abs(psi.forward(result.light_field) - frames)
    assert np.median(miss) < 0.01 * frames.mean()  # but for values cut to [0, 1]
    assert result.steps == SMALL.stages


def test_a_dimmer_scene_gives_the_same_but_dimmer(untrained, random_psi):
    psi = random_psi(1, (3, 3), (8, 8))
    truth = 0.5 * np.random.default_rng(1).random(psi.light_field_shape, dtype=np.float32)
    bright, dim = (
        reconstruct("unrolled", psi, psi.forward(truth) * c, 1e-3 * c, settings=using(untrained))
        for c in (1.0, 1 / 16)
    )
    np.testing.assert_allclose(16 * dim.light_field, bright.light_field, atol=1e-4)


def test_readings_that_are_not_usable_do_not_matter(untrained, random_psi):
    psi = random_psi(1, (3, 3), (8, 8))
    frames = psi.forward(np.full(psi.light_field_shape, 0.4, np.float32))
    usable = np.ones(frames.shape, bool)
    usable[0, 3, 4] = False
    wrong = frames.copy()
    wrong[0, 3, 4] = 7
    one, other = (
        reconstruct("unrolled", psi, y, 1e-3, settings=using(untrained), usable=usable).light_field
        for y in (frames, wrong)
    )
    np.testing.assert_array_equal(one, other)


def test_a_network_for_other_views_is_refused(untrained, random_psi):
    psi = random_psi(1, (5, 5), (8, 8))
    frames = psi.forward(np.full(psi.light_field_shape, 0.4, np.float32))
    with pytest.raises(ReconstructionError, match="a network for 3x3 views, Psi has 5x5"):
        reconstruct("unrolled", psi, frames, 1e-3, settings=using(untrained))


def test_without_pytorch_the_method_says_how_to_get_it(monkeypatch, random_psi):
    monkeypatch.setitem(sys.modules, "torch", None)
    psi = random_psi(1, (5, 5), (8, 8))
    with pytest.raises(ReconstructionError, match=r"pip install 'emmc-rig\[learned\]'"):
        reconstruct("unrolled", psi, psi.forward(np.ones(psi.light_field_shape, "f4")), 0.01)


def made(path):
    arrays = {"enter.weight": np.arange(6, dtype=np.float32).reshape(2, 3)}
    weights = NetworkWeights(SMALL, arrays, "by hand")
    weights.save(path)
    return weights


def test_weights_come_back_as_they_were_written(tmp_path):
    written = made(tmp_path / "a.h5")
    read = NetworkWeights.load(tmp_path / "a.h5")
    assert (read.architecture, read.provenance) == (SMALL, "by hand")
    np.testing.assert_array_equal(read.arrays["enter.weight"], written.arrays["enter.weight"])


@pytest.mark.parametrize("what", ["array0", "provenance", "architecture"])
def test_weights_that_were_tampered_with_are_refused(tmp_path, what):
    import h5py

    path = tmp_path / "a.h5"
    made(path)
    with h5py.File(path, "r+") as file:
        if what == "array0":
            file["array0"][0, 0] = 0.5  # pyright: ignore[reportIndexIssue]
        elif what == "provenance":
            del file["provenance"]
            file["provenance"] = "by another hand"
        else:
            file.attrs["architecture"] = SMALL.model_copy(update={"stages": 3}).model_dump_json()
    with pytest.raises(ReconstructionError, match="SHA-256 differs"):
        NetworkWeights.load(path)


@pytest.mark.parametrize(
    ("content", "says"), [(None, "no such file"), (b"weights", "cannot be read")]
)
def test_a_file_that_is_no_network_is_refused(tmp_path, content, says):
    path = tmp_path / "a.h5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ReconstructionError, match=says):
        NetworkWeights.load(path)


def test_random_worlds_are_the_seeds_and_have_parallax():
    one, same, other = (
        rendered(tabulated(random_world(np.random.default_rng(seed))), (3, 3), (32, 40))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.light_field, same.light_field)
    assert np.abs(one.light_field - other.light_field).mean() > 0.02
    assert np.ptp(one.disparity_px) > 0


@pytest.fixture
def training(torch, tmp_path, monkeypatch):
    """Make a short training of a small network."""
    from emmc_rig.processing.network_training import NetworkTraining, train_network

    module = sys.modules["emmc_rig.processing.network_training"]
    monkeypatch.setattr(module, "WORLD_SIZE", (24, 32))
    monkeypatch.setattr(module, "WORLDS", 2)
    small = SMALL.model_copy(update={"views": (5, 5)})

    def train(name, steps, **others):
        clock = others.pop("clock", lambda: 0.0)
        settings = NetworkTraining(
            tmp_path / name, ("rgbw-bayer-1shot", "rgbw-mono"), small, steps, crop=20, **others
        )
        return train_network(settings, Silent(), clock)[0]

    return train


def test_the_same_seed_trains_the_same_weights_also_when_it_was_stopped(training, tmp_path):
    whole = training("whole.h5", 4)
    ticks = iter(range(1000))
    training("parts.h5", 4, minutes=0.05, clock=lambda: next(ticks))
    assert (tmp_path / "parts.checkpoint.pt").exists()
    (tmp_path / "parts.h5").unlink()
    parts = training("parts.h5", 4, resume=True)
    assert not (tmp_path / "parts.checkpoint.pt").exists()
    other = training("other.h5", 4, seed=1)
    for name, array in whole.arrays.items():
        np.testing.assert_array_equal(array, parts.arrays[name])
    assert any((array != other.arrays[name]).any() for name, array in whole.arrays.items())


@pytest.fixture
def two_scenes(tmp_path):
    """Files of two light fields, one bright and one dark."""
    import h5py

    for name, level in (("bright", 0.8), ("dark", 0.1)):
        truth = level * np.random.default_rng(0).random((5, 5, 24, 32, 3), dtype=np.float32)
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["light_field"] = truth
    return tuple(str(tmp_path / f"{name}.h5") for name in ("bright", "dark"))


def test_a_network_learns_from_scenes_and_says_from_which(training, two_scenes):
    worlds = training("worlds.h5", 3)
    both = training("both.h5", 3, scenes=two_scenes)
    one = training("one.h5", 3, scenes=two_scenes, leave_out=("bright",))
    assert '"bright"' in both.provenance
    assert '"bright"' not in one.provenance
    assert '"scenes"' not in worlds.provenance
    for first, second in ((worlds, both), (both, one)):
        assert any((first.arrays[name] != second.arrays[name]).any() for name in first.arrays)


def test_a_crop_of_a_scene_is_what_the_network_sees(torch, two_scenes):
    from emmc_rig.processing import network_training as module

    training = module.NetworkTraining(
        Path("n.h5"), ("conventional",), Architecture(), 1, scenes=two_scenes[1:], crop=20
    )
    scenes = module.opened_scenes(training, Silent())
    seen = []
    for step in range(12):
        _, truth = module.example(training, [find_camera("conventional")], step, scenes)
        seen.append(float(truth.max()))
    # The dark scene holds at most 0.1, random worlds more.
    assert 4 <= sum(one <= 0.1 for one in seen) < 12


def test_a_colour_blind_camera_learns_grey(torch):
    from emmc_rig.processing import network_training as module

    for name, grey in (("coded-aperture-random", True), ("rgbw-mono", False)):
        training = module.NetworkTraining(Path("n.h5"), (name,), Architecture(), 1, crop=20)
        _, truth = module.example(training, [find_camera(name)], 0)
        assert bool((truth == truth[:, :1]).all()) is grey


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"leave_out": ("dark",)}, "which is not given"),
        ({"scenes": ("nowhere.h5",)}, "nowhere.h5"),
    ],
)
def test_scenes_that_cannot_be_learned_from_are_refused(training, changed, says):
    with pytest.raises((AppError, ModelError), match=says):
        training("a.h5", 1, **changed)


def test_a_scene_smaller_than_a_crop_is_refused(torch, two_scenes, tmp_path):
    from emmc_rig.processing.network_training import NetworkTraining, train_network

    large = NetworkTraining(
        tmp_path / "n.h5", ("rgbw-mono",), Architecture(), 1, scenes=two_scenes, crop=48
    )
    with pytest.raises(AppError, match="crops of 48x48"):
        train_network(large, Silent())


def test_what_would_spoil_a_training_is_refused_before_it_begins(training, tmp_path):
    with pytest.raises(AppError, match="no checkpoint to resume"):
        training("a.h5", 2, resume=True)
    with pytest.raises(AppError, match=r"ends in \.h5"):
        training("a.pt", 2)
    (tmp_path / "b.checkpoint.pt").write_bytes(b"torn")
    with pytest.raises(AppError, match="--resume"):
        training("b.h5", 2)
    with pytest.raises(ReconstructionError, match="no checkpoint of this training"):
        training("b.h5", 2, resume=True)


def test_training_lowers_the_error(torch, random_psi):
    from reconstruction.unrolled.learning import Learner
    from reconstruction.unrolled.network import captured

    psi = find_camera("scenario-ii-cfa").psi((16, 16))
    truth = render("near-planar", (5, 5), (16, 16)).light_field
    frames = psi.forward(truth)
    usable = np.ones(frames.shape, bool)
    capture = captured(psi, frames, np.full_like(frames, 1e-6), usable)
    target = torch.from_numpy(truth).flatten(0, 1).permute(0, 3, 1, 2)
    learner = Learner(Architecture(channels=8, blocks=1, stages=2), 0)
    for _ in range(60):
        learner.step(capture, target)
    assert learner.losses_db[-1] > learner.losses_db[0] + 1


def test_the_shipped_network_sees_more_than_a_smooth_picture(torch):
    from reconstruction.choices import smooth_guess

    truth = render("deep-occlusions", (5, 5), (64, 80)).light_field
    camera = find_camera("scenario-ii-cfa")
    psi = camera.psi((64, 80))
    shots = camera.expose(truth, 0, psi)
    found = reconstruct("unrolled", psi, shots.readings, shots.noise_sigma, usable=shots.usable)
    smooth = np.broadcast_to(smooth_guess(psi, shots.readings, shots.usable), truth.shape)
    assert psnr_db(found.light_field, truth) > psnr_db(smooth, truth) + 2
    assert shipped_weights().stat().st_size < 2 << 20


def test_the_command_trains_and_says_what_it_wrote(torch, run, tmp_path):
    arguments = ("train", "--network", "--out", "n.h5", "--steps", 2, "--camera", "rgbw-mono")
    code, out, err = run(*arguments)
    assert code == 0, err
    assert "after 2 of 2 steps" in out
    assert '"steps": 2' in NetworkWeights.load(tmp_path / "n.h5").provenance
    code, _, err = run(*arguments)
    assert code == 1
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--views", "3x3"), "5x5 views, the network has 3x3"),
        (("--camera", "rgbw-mon"), "rgbw-mono"),
    ],
)
def test_wrong_cameras_are_refused_in_one_line(torch, run, arguments, says):
    code, _, err = run("train", "--network", "--out", "n.h5", *arguments)
    assert code == 1
    assert says in err
    assert len(err.strip().splitlines()) == 1
