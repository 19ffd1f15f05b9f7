"""The method `unrolled`: data step, file, training, refusals.

Needs PyTorch, and the plug-in installed: pip install --no-deps ./benchmarks/unrolled_plugin
"""

import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, reconstruct
from emmc_rig.reconstruction.problem import smooth_guess
from emmc_rig.simulators.scenes import render

torch = pytest.importorskip("torch", reason="the network needs PyTorch")
pytest.importorskip("emmc_rig_unrolled", reason="the plug-in is not installed")

from emmc_rig_unrolled import SHIPPED  # noqa: E402
from emmc_rig_unrolled.network import captured  # noqa: E402
from emmc_rig_unrolled.weights import Architecture, NetworkWeights  # noqa: E402
from random_worlds import world  # noqa: E402
from train_network import Learner, TrainingData, train  # noqa: E402

SMALL = Architecture(views=(3, 3), channels=4, blocks=1, stages=2)


def random_psi(shots, views, size, stored=1, binning=1):
    """Return a Psi of random weights, of pixels that see random colours."""
    rng = np.random.default_rng(0)
    weights = rng.uniform(0, 1, (shots, *views, size[0], stored, size[1])).astype(np.float32)
    colour = rng.integers(0, 3, (shots, *size), dtype=np.uint8) if stored == 1 else None
    return Psi(weights, colour, binning)


@pytest.fixture
def untrained(tmp_path):
    """The file of a small network for 3x3 views, as training begins."""
    learner = Learner(SMALL, 0)
    arrays = {name: values.numpy() for name, values in learner.average.items()}
    NetworkWeights(SMALL, arrays, "untrained").save(tmp_path / "small.h5")
    return tmp_path / "small.h5"


def test_the_plug_in_is_a_method_like_any_other():
    assert METHODS["unrolled"].installed


def using(path):
    return MethodSettings.model_validate({"unrolled": {"weights": str(path)}, "screening": False})


@pytest.mark.parametrize(("shots", "colours", "binning"), [(1, 1, 1), (3, 1, 1), (2, 3, 2)])
def test_the_network_sees_psi_as_psi_is(shots, colours, binning):
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
    expected = np.einsum("styx,tyx->syx", psi.inverted_blocks(ridge), frames)
    np.testing.assert_allclose(solved, expected, rtol=2e-3)


def test_every_stage_ends_with_a_light_field_that_explains_the_frames(untrained):
    psi = random_psi(1, (3, 3), (9, 11))
    truth = np.random.default_rng(1).random(psi.light_field_shape, dtype=np.float32)
    frames = psi.forward(truth)
    result = reconstruct("unrolled", psi, even_frames(frames, 1e-4), settings=using(untrained))
    miss = np.abs(psi.forward(result.light_field) - frames)
    assert np.median(miss) < 0.01 * frames.mean()  # but for values cut to [0, 1]
    assert result.steps == SMALL.stages


def test_a_dimmer_scene_gives_the_same_but_dimmer(untrained):
    psi = random_psi(1, (3, 3), (8, 8))
    truth = 0.5 * np.random.default_rng(1).random(psi.light_field_shape, dtype=np.float32)
    bright, dim = (
        reconstruct(
            "unrolled",
            psi,
            even_frames(psi.forward(truth) * c, 1e-3 * c),
            settings=using(untrained),
        )
        for c in (1.0, 1 / 16)
    )
    np.testing.assert_allclose(16 * dim.light_field, bright.light_field, atol=1e-4)


def test_readings_that_are_not_usable_do_not_matter(untrained):
    psi = random_psi(1, (3, 3), (8, 8))
    frames = psi.forward(np.full(psi.light_field_shape, 0.4, np.float32))
    usable = np.ones(frames.shape, bool)
    usable[0, 3, 4] = False
    wrong = frames.copy()
    wrong[0, 3, 4] = 7
    first, other = (
        reconstruct(
            "unrolled", psi, even_frames(y, 1e-3, usable), settings=using(untrained)
        ).light_field
        for y in (frames, wrong)
    )
    np.testing.assert_array_equal(first, other)


def test_a_network_for_other_views_is_refused(untrained):
    psi = random_psi(1, (5, 5), (8, 8))
    frames = psi.forward(np.full(psi.light_field_shape, 0.4, np.float32))
    with pytest.raises(ReconstructionError, match="a network for 3x3 views, Psi has 5x5"):
        reconstruct("unrolled", psi, even_frames(frames, 1e-3), settings=using(untrained))


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
    ("content", "says"), [(None, "no such file"), (b"weights", "of an unknown format")]
)
def test_a_file_that_is_no_network_is_refused(tmp_path, content, says):
    path = tmp_path / "a.h5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ReconstructionError, match=says):
        NetworkWeights.load(path)


def test_random_worlds_are_the_seeds_and_have_parallax():
    first, other = (world(seed, 0, (3, 3)) for seed in (1, 2))
    assert np.abs(first - other).mean() > 0.02
    assert np.abs(first[0, 0] - first[2, 2]).mean() > 1e-3
    world.cache_clear()
    np.testing.assert_array_equal(world(1, 0, (3, 3)), first)


@pytest.fixture
def two_scenes(tmp_path):
    """Files of two light fields, one bright and one dark."""
    import h5py

    for name, level in (("bright", 0.8), ("dark", 0.1)):
        truth = level * np.random.default_rng(0).random((5, 5, 24, 32, 3), dtype=np.float32)
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["light_field"] = truth
    return [str(tmp_path / f"{name}.h5") for name in ("bright", "dark")]


SMALL_5X5 = SMALL.model_copy(update={"views": (5, 5)})


def test_the_same_seed_trains_the_same_weights_also_when_it_was_stopped(tmp_path, monkeypatch):
    data = TrainingData.opened(["rgbw-bayer-1shot", "rgbw-mono"], [], 20, 0)
    whole = train(tmp_path / "whole.h5", data, SMALL_5X5, 4)
    step = Learner.step

    def stopped(learner, *given):
        if len(learner.losses_db) == 2:
            raise KeyboardInterrupt
        return step(learner, *given)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "step", stopped)
        with pytest.raises(SystemExit, match="goes on"):
            train(tmp_path / "parts.h5", data, SMALL_5X5, 4)
    assert (tmp_path / "parts.checkpoint.pt").exists()
    with pytest.raises(AppError, match="other settings"):
        train(tmp_path / "parts.h5", data, SMALL_5X5.model_copy(update={"channels": 6}), 4)
    parts = train(tmp_path / "parts.h5", data, SMALL_5X5, 4)
    assert not (tmp_path / "parts.checkpoint.pt").exists()
    other = train(tmp_path / "other.h5", TrainingData(data.cameras, {}, 20, 1), SMALL_5X5, 4)
    for name, array in whole.arrays.items():
        np.testing.assert_array_equal(array, parts.arrays[name])
    assert any((array != other.arrays[name]).any() for name, array in whole.arrays.items())


def test_a_crop_of_a_scene_is_what_the_network_sees(two_scenes):
    data = TrainingData.opened(["conventional"], two_scenes[1:], 20, 0)
    brightest = [float(data.example(step)[1].max()) for step in range(12)]
    # The dark scene holds at most 0.1, random worlds more.
    assert 4 <= sum(level <= 0.1 for level in brightest) < 12


def test_a_colour_blind_camera_learns_grey():
    for name, grey in (("coded-aperture-random", True), ("rgbw-mono", False)):
        _, truth = TrainingData.opened([name], [], 20, 0).example(0)
        assert bool((truth == truth[:, :1]).all()) is grey


def test_a_scene_smaller_than_a_crop_is_refused(two_scenes):
    with pytest.raises(AppError, match="crops of 48x48"):
        TrainingData.opened(["rgbw-mono"], two_scenes, 48, 0)


def test_training_lowers_the_error():
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


def test_the_shipped_network_sees_more_than_a_smooth_picture():
    truth = render("deep-occlusions", (5, 5), (64, 80)).light_field
    camera = find_camera("scenario-ii-cfa")
    psi = camera.psi((64, 80))
    shots = camera.expose(truth, 0, psi)
    found = reconstruct("unrolled", psi, shots)
    smooth = np.broadcast_to(smooth_guess(psi, shots.readings, shots.usable), truth.shape)
    assert psnr_db(found.light_field, truth) > psnr_db(smooth, truth) + 2
    assert SHIPPED.stat().st_size < 2 << 20
