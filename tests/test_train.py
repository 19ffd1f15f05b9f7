"""`emmc-rig train`: scenes chosen by name, a dictionary and its picture, stopped and resumed."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial

import cv2
import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.model.lightfield import save_hdf5
from emmc_rig.processing import training as train
from emmc_rig.processing.training import checkpoint_path, draw_atoms, find_sources
from reconstruction.dictionary import Dictionary
from simulators.scenes import SCENES

SMALL = ["--atoms", 24, "--patches", 120, "--patch", "4x4", "--sparsity", 3, "--iterations", 3]


@pytest.fixture
def run(run):
    """Run `emmc-rig train` in this process: exit code, standard output and standard error."""
    return partial(run, "train")


@pytest.fixture
def scenes(tmp_path):
    """Make a folder of three scenes, `cat`, `dog` and `emu`."""
    rng = np.random.default_rng(0)
    folder = tmp_path / "scenes"
    for name in ("cat", "dog"):
        save_hdf5(folder / f"{name}.h5", rng.random((2, 2, 20, 24, 3), dtype=np.float32), {})
    (folder / "emu").mkdir()
    for v, u in np.ndindex(2, 2):
        picture = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"emu/view_{v}_{u}.png"), picture)
    (folder / "notes.txt").write_text("not a scene")
    return folder


def one_line(text):
    lines = [line for line in text.strip().splitlines() if line.startswith("emmc-rig:")]
    assert len(lines) == 1, text
    assert "Traceback" not in text
    return lines[0]


@pytest.mark.parametrize("kind", ["ksvd", "online", "separable"])
def test_training_writes_a_dictionary_with_its_history_and_a_picture(run, scenes, tmp_path, kind):
    code, out, err = run("--scenes", scenes, "--out", "made/d.h5", "--kind", kind, *SMALL)
    assert code == 0, err
    assert "24 atoms from 120 patches of 3 scene(s)" in out
    made = Dictionary.load(tmp_path / "made/d.h5")
    assert made.kind == kind
    assert made.checked((2, 2), (4, 4), 3).size == 24
    reported = json.loads(made.provenance)
    assert reported["scenes"] == ["cat", "dog", "emu"]
    assert [done["step"] for done in reported["history"]] == [1, 2, 3]
    assert reported["history"][-1]["coded_rmse"] < reported["history"][0]["coded_rmse"]
    assert reported["settings"]["seed"] == reported["patches"]["seed"] == 0
    assert min(reported["learning_seconds"], reported["peak_memory_gib"]) > 0
    assert "numpy" in reported["versions"]
    assert sorted(p.name for p in (tmp_path / "made").iterdir()) == ["d.h5", "d.png"]
    picture = cv2.imread(str(tmp_path / "made/d.png"))
    assert picture is not None
    assert picture.size > 24 * 4 * 4 * 3


def test_the_same_seed_gives_the_same_atoms(run, scenes, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert run("--scenes", scenes, "--out", f"{name}.h5", "--seed", seed, *SMALL)[0] == 0
    a, b, c = (Dictionary.load(tmp_path / f"{name}.h5").atoms for name in "abc")
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


def test_a_scene_left_out_is_not_read(run, scenes, tmp_path):
    (scenes / "dog.h5").write_text("this would fail if it were read")
    code, *_ = run("--scenes", scenes, "--leave-out", "dog", "--out", "d.h5", *SMALL)
    assert code == 0
    reported = json.loads(Dictionary.load(tmp_path / "d.h5").provenance)
    assert (reported["scenes"], reported["left_out"]) == (["cat", "emu"], ["dog"])


def test_without_scenes_the_built_in_ones_are_used_with_several_seeds():
    sources = find_sources((), ("dark",))
    assert {source.name for source in sources} == set(SCENES) - {"dark"}
    assert len(sources) == train.BUILT_IN_SEEDS * (len(SCENES) - 1)
    assert len(set(sources)) == len(sources)


def test_a_built_in_scene_is_trained_on(run, tmp_path, monkeypatch):
    monkeypatch.setattr(train, "BUILT_IN_SEEDS", 1)
    assert run("--scenes", "dark", "--out", "d.h5", *SMALL)[0] == 0
    reported = json.loads(Dictionary.load(tmp_path / "d.h5").provenance)
    assert reported["sources"] == ["dark, seed 0"]


def test_the_middle_views_can_be_asked_for(run, tmp_path):
    save_hdf5(tmp_path / "wide.h5", np.random.default_rng(0).random((4, 5, 20, 24, 3)), {})
    code, _, err = run("--scenes", "wide.h5", "--views", "3x3", "--out", "d.h5", *SMALL)
    assert code == 0, err
    assert Dictionary.load(tmp_path / "d.h5").patch_shape == (3, 3, 4, 4, 3)


def test_folders_scenes_and_names_mix(scenes):
    sources = find_sources((str(scenes), "dark", str(scenes / "emu"), str(scenes / "cat.h5")), ())
    names = [source.name for source in sources]
    assert names == ["cat", "dog", "emu", "dark", "dark", "dark", "emu", "cat"]


@pytest.mark.parametrize(
    ("leave_out", "reported"),
    [
        (["dogs"], "did you mean 'dog'"),
        (["xyzzy"], "there are cat, dog, emu"),
        (["cat", "dog", "emu"], "no scene to train on"),
    ],
)
def test_names_to_leave_out_must_exist_and_leave_something(scenes, leave_out, reported):
    with pytest.raises(AppError, match=reported):
        find_sources((str(scenes),), leave_out)


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["--patch", "9"], "9x9"),
        (["--views", "5"], "5x5"),
        (["--views", "3x3"], "cannot give 3x3"),
        (["--patch", "30x4"], "less than a patch of 30x4"),
        (["--atoms", 0], "atoms"),
        (["--atoms", 500], "120 patches for 500 atoms"),
        (["--sparsity", 25], "sparsity of 25"),
        (["--iterations", 0], "iterations"),
        (["--kind", "kvsd"], "ksvd, online, separable"),
        (["--scenes", "nowhere"], "no scene 'nowhere'"),
        (["--scenes", "empty"], "holds no scenes"),
        (["--leave-out", "dgo"], "did you mean 'dog'"),
        (["--out", "d.png"], "ends in .h5"),
        (["--out", "file/d.h5"], "cannot be written"),
        (["--out", "other.h5"], "exists already"),
        (["--resume"], "no checkpoint"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(run, scenes, tmp_path, arguments, reported):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "other.h5").write_text("precious")
    before = sorted(p.name for p in tmp_path.iterdir())
    code, _, err = run("--scenes", scenes, "--out", "d.h5", *SMALL, *arguments)
    assert code == (2 if reported in ("9x9", "5x5") else 1)  # an example of how to write the option
    assert reported in one_line(err)
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert (tmp_path / "other.h5").read_text() == "precious"


def test_wrong_usage_is_exit_code_2(run):
    assert run("--scenes", "dark")[0] == 2
    assert run("--out", "d.h5", "--atoms", "many")[0] == 2


@pytest.mark.parametrize("kind", ["ksvd", "online", "separable"])
def test_ctrl_c_leaves_a_checkpoint_and_resuming_gives_the_same(
    run, scenes, tmp_path, monkeypatch, kind
):
    arguments = ["--scenes", scenes, "--kind", kind, *SMALL]
    assert run("--out", "whole.h5", *arguments)[0] == 0
    learn, state = train.LEARNERS[kind]

    def stopped(rows, shape, settings, start, on_step):
        def stop(done):
            on_step(done)
            if len(done.history) == 2:
                raise KeyboardInterrupt

        return learn(rows, shape, settings, start, stop)

    with monkeypatch.context() as patch:
        patch.setitem(train.LEARNERS, kind, (stopped, state))
        code, _, err = run("--out", "d.h5", *arguments)
    assert code == 130
    assert "after step 2 of 3" in one_line(err)
    assert "--resume" in err
    assert not (tmp_path / "d.h5").exists()
    assert checkpoint_path(tmp_path / "d.h5").exists()

    code, _, err = run("--out", "d.h5", *arguments)
    assert code == 1
    assert "--resume" in one_line(err)
    code, _, err = run("--out", "d.h5", *arguments, "--resume", "--seed", 4)
    assert code == 1
    assert "seed" in one_line(err)

    assert run("--out", "d.h5", *arguments, "--resume")[0] == 0
    whole, resumed = (Dictionary.load(tmp_path / name) for name in ("whole.h5", "d.h5"))
    np.testing.assert_array_equal(resumed.atoms, whole.atoms)
    assert json.loads(resumed.provenance)["history"] == json.loads(whole.provenance)["history"]
    assert not checkpoint_path(tmp_path / "d.h5").exists()


def test_ctrl_c_before_the_first_step_leaves_nothing(run, scenes, tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setitem(train.LEARNERS, "ksvd", (interrupted, train.LEARNERS["ksvd"][1]))
        code, _, err = run("--scenes", scenes, "--out", "d.h5", *SMALL)
    assert code == 130
    assert "nothing was written" in one_line(err)
    assert [p.name for p in tmp_path.iterdir()] == ["scenes"]


def test_a_checkpoint_is_written_now_and_then(scenes, tmp_path, monkeypatch):
    class Quiet:
        def begin(self, stage, steps):
            pass

        def step(self, detail):
            pass

    saved = []
    monkeypatch.setattr(train, "save_checkpoint", lambda path, state, _: saved.append(state))
    ticks = iter(np.arange(0, 10_000, 25.0))
    chosen = {
        "patches": {"rows": 4, "columns": 4, "count": 120},
        "learning": {"atoms": 24, "sparsity": 3, "iterations": 9},
    }
    settings = train.train_settings(
        tmp_path / "d.h5", [str(scenes)], [], None, "ksvd", chosen, False
    )
    train.train(settings, Quiet(), lambda: float(next(ticks)))
    assert 1 < len(saved) < 9


def test_a_real_interrupt_is_survived(scenes, tmp_path):
    command = [sys.executable, "-c", "from emmc_rig.cli import main; main()", "train"]
    arguments = ["--scenes", scenes, "--out", "d.h5", *SMALL, "--iterations", 100_000, "--json"]
    process = subprocess.Popen(
        [*command, *map(str, arguments)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    for line in process.stdout:
        event = json.loads(line)
        if (event["event"], event.get("stage")) == ("step", "learning"):
            break
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Ctrl-C" in one_line(err)
    assert not (tmp_path / "d.h5").exists()


def test_the_picture_shows_centre_view_and_epi_of_every_atom():
    atoms = np.zeros((2, 3, 3, 4, 5, 3), np.float32)
    atoms[0] = 1
    for u in range(3):
        atoms[1, 1, u, 2, 1 + u, 0] = 1  # a red dot that moves one pixel per view
    picture = draw_atoms(Dictionary.normalised(atoms, "dct"))[1::3, 1::3, ::-1]
    grey, red, white = [128, 128, 128], [255, 128, 128], [255, 255, 255]
    tile_high = 4 + 1 + 3
    assert (picture[:4, :5] == white).all()
    dot = np.argwhere((picture == red).all(axis=-1)) - np.argwhere(
        (picture == white).all(axis=-1)
    ).min(axis=0)
    right = dot[:, 1].min() // 6 * 6 if dot[:, 1].min() > 5 else 0
    down = 0 if right else tile_high + 1
    places = {(int(y) - down, int(x) - right) for y, x in dot}
    assert len(places) == 4
    assert (picture == grey).all(axis=-1).any()
    rows = sorted(y for y, _ in places)
    assert rows == [2, 5, 6, 7]
    slope = [x for y, x in sorted(places) if y >= 5]
    assert np.diff(slope).tolist() == [1, 1]
