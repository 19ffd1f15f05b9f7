"""The command line: exit codes, one clear line for every fault, nothing half-written."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import typer
import yaml
from programs import PROGRAM, done, refused
from view_files import save_views

import emmc_rig as emmc
from emmc_rig import cli
from emmc_rig.commands.examples import EXAMPLES
from emmc_rig.version import __version__

SMALL = ["--size", "24x32"]
COMMANDS = typer.main.get_command(cli.app).commands  # pyright: ignore[reportAttributeAccessIssue]


def leftovers(folder):
    return [path.name for path in folder.rglob(".*")]


@pytest.mark.slow
def test_a_picture_is_drawn_without_a_word_on_a_home_that_takes_no_files(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file/home"))
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    drawn = subprocess.run(
        [*PROGRAM, "cameras", "rgbw-bayer-1shot", "--out", "drawn"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert (drawn.returncode, drawn.stderr) == (0, "")
    assert (tmp_path / "drawn/camera.png").is_file()


@pytest.mark.slow
def test_the_demo_writes_a_whole_result(run, tmp_path):
    out = done(run("demo", *SMALL, "--shots", 1, "--out", "result"))
    assert "dB" in out
    made = {path.name for path in (tmp_path / "result").iterdir()}
    assert {"metrics.json", "report.html", "light_field.h5", "psi.h5", "frames.h5"} <= made
    assert json.loads((tmp_path / "result/metrics.json").read_text())["shots"] == 1
    assert not leftovers(tmp_path)


@pytest.mark.slow
def test_cameras_are_listed_and_drawn(run, tmp_path):
    out = done(run("cameras"))
    assert "rgbw-bayer" in out
    done(run("cameras", "rgbw-mono", "--out", "sheet"))
    assert (tmp_path / "sheet/camera.png").stat().st_size > 10_000
    assert emmc.camera(tmp_path / "sheet/camera.yaml") == emmc.camera("rgbw-mono")
    assert json.loads((tmp_path / "sheet/metrics.json").read_text())["light_efficiency"] > 0.3


def test_a_camera_s_views_that_its_pupil_cuts_are_named(run, tmp_path):
    lens = {"pupil": {"diameter_mm": 25}}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump({"title": "round", "lens": lens}))
    code, out, said = run("cameras", "c.yaml", "--out", "sheet")
    assert code == 0
    assert "views (0, 0), (0, 4), (4, 0), (4, 4) 14 % open" in " ".join((out + said).split())


def test_a_folder_of_views_is_imaged(run, tmp_path):
    save_views(tmp_path / "views", np.random.default_rng(0).random((2, 2, 24, 32, 3)))
    mask = {"distance_mm": 0.12, "cell_um": 48, "pattern": {"kind": "random_rgbw"}}
    camera = {"title": "a camera", "views": [2, 2], "sensor": {"cfa": "rggb"}, "masks": {"m": mask}}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(camera))
    out = done(run("simulate", "--scene", "views", "--camera", "c.yaml", "--out", "r"))
    assert "1 frame, " in out


def test_version_and_help_are_printed(run):
    assert run("--version")[:2] == (0, f"emmc-rig {__version__}\n")
    out = done(run("--help"))
    panels = re.findall(r"─ (\w+) ─", out)
    assert panels == ["Options", "Bench", "Results", "Studies"]
    listed = re.findall(r"^│ ([a-z]+) ", out, re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)


@pytest.mark.parametrize("typed", [(), ("help",)])
def test_who_types_no_command_learns_where_to_start(run, typed):
    out = done(run(*typed))
    assert out.startswith("start: emmc-rig demo\n")
    assert "Usage: emmc-rig [OPTIONS] COMMAND" in out


@pytest.mark.parametrize("group", ["devices", "session"])
def test_a_group_without_a_command_shows_its_help(run, group):
    assert done(run(group)) == done(run(group, "--help"))


def test_help_is_asked_for_in_three_ways(run):
    wanted = done(run("devices", "jog", "--help"))
    assert wanted == done(run("devices", "jog", "-h")) == done(run("help", "devices", "jog"))


def _leaves(command, words=()):
    """Yield a group's commands, with the words that call them."""
    for name, member in getattr(command, "commands", {}).items():
        if getattr(member, "commands", None):
            yield from _leaves(member, (*words, name))
        else:
            yield (*words, name), member


def test_each_help_ends_with_two_examples_that_can_be_typed(run):
    every = dict(_leaves(typer.main.get_command(cli.app)))
    unused = set(EXAMPLES)
    for words, command in every.items():
        mine = [line for line in EXAMPLES if tuple(line.split()[: len(words)]) == words]
        assert len(mine) == 2, words
        unused -= set(mine)
        for line in mine:
            typed = shlex.split(line.split(" | ")[0])[len(words) :]
            command.make_context(" ".join(words), typed).close()
    assert not unused
    out = done(run("devices", "jog", "-h"))
    assert out.rstrip().endswith("emmc-rig devices jog x --to 12000 --stage bench.yaml")


@pytest.mark.parametrize("line", [x for x in EXAMPLES if x.startswith("devices") and "--rig" in x])
def test_examples_with_the_simulated_rig_run(run, line):
    done(run(*shlex.split(line)))


@pytest.mark.parametrize("camera", [x.split()[3] for x in EXAMPLES if "camera --camera" in x])
def test_examples_name_cameras_that_there_are(run, camera):
    code, _, err = run("devices", "camera", "--camera", camera)
    assert code == 1
    assert "no such camera driver" not in err


def _wrong(words, err):
    """Assert that wrong usage is said in one line, which names the help of the same command."""
    assert err.count("\n") == 1, err
    assert err.startswith("emmc-rig: "), err
    assert err.endswith(f"; `{' '.join(('emmc-rig', *words))} -h` shows what it takes\n"), err


def test_wrong_usage_of_every_command_is_a_line_and_code_2(run):
    required = 0
    groups = [(), ("devices",), ("session",)]
    every = dict(_leaves(typer.main.get_command(cli.app)))
    for words in (*groups, *every):
        code, _, err = run(*words, "--nosuch")
        assert (code, "no such option: --nosuch" in err) == (2, True), err
        _wrong(words, err)
    for words in groups:
        code, _, err = run(*words, "nosuch")
        assert (code, "no such command 'nosuch'" in err) == (2, True), err
        _wrong(words, err)
    said = run("dem")[2]
    assert said.endswith("'dem'. Did you mean 'demo'? `emmc-rig -h` shows what it takes\n"), said
    for words, command in every.items():
        for option in [known for known in command.params if not getattr(known, "is_flag", True)][
            :1
        ]:
            code, _, err = run(*words, option.opts[-1])
            assert (code, "requires an argument" in err) == (2, True), err
            _wrong(words, err)
        if needed := [known for known in command.params if known.required]:
            code, _, err = run(*words)
            assert (code, f"'{needed[0].metavar or needed[0].opts[0]}'" in err) == (2, True), err
            _wrong(words, err)
            required += 1
    assert required > 5


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (("capture", "--seed", "x"), "'--seed': should be a valid integer"),
        (("capture", "--seed", "-1"), "'--seed': should be greater than or equal to 0"),
        (("devices", "jog", "x", "far"), "'distance_um': should be a valid number"),
        (("devices", "free", "x", "--direction", "left"), "not one of 'up', 'down'"),
        (("demo", "extra"), "unexpected extra argument"),
    ],
)
def test_a_wrong_number_or_choice_is_a_line_and_code_2(run, typed, said):
    code, _, err = run(*typed)
    assert (code, said in err) == (2, True), err
    _wrong(typed[: 1 + (typed[0] == "devices")], err)


def test_paths_are_called_path_in_every_help(run):
    named = 0
    for words in dict(_leaves(typer.main.get_command(cli.app))):
        out = done(run(*words, "-h"))
        assert not re.search(r"<[^>]*[Pp]ath\]?>|\b(FILE|FOLDER|DIR)\b", out), (words, out)
        named += "PATH" in out
    assert named > 15


def test_a_shell_completes_commands():
    asked = {"_EMMC_RIG_COMPLETE": "complete_bash", "COMP_WORDS": "emmc-rig ca", "COMP_CWORD": "1"}
    found = subprocess.run(PROGRAM, env=os.environ | asked, capture_output=True, text=True)
    assert found.stdout.split() == ["capture", "calibrate", "cameras"]


@pytest.mark.slow
def test_ctrl_c_stops_with_130_and_leaves_nothing(tmp_path):
    process = subprocess.Popen(
        [*PROGRAM, "demo", "--size", "96x128", "--out", "r"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    deadline = time.monotonic() + 60
    while not leftovers(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Ctrl-C" in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_ctrl_c_in_any_stage_leaves_nothing(run, monkeypatch, tmp_path):
    from emmc_rig import demo

    for stage in ("simulated_session", "measure_psi", "write_metrics"):

        def interrupted(*arguments, **settings):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(demo, stage, interrupted)
            code, _, err = run("demo", *SMALL, "--out", "r")
        assert code == 130
        assert "Ctrl-C" in err
        assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_leaves_nothing(run, monkeypatch, tmp_path):
    from emmc_rig import demo

    def full(*arguments, **settings):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(demo, "write_metrics", full)
    assert "No space left" in refused(run("demo", *SMALL, "--shots", 1, "--out", "r"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["export", "figure"])
def test_the_size_in_the_environment_reaches_exported_scenes(run, monkeypatch, tmp_path, command):
    monkeypatch.setenv("EMMC_SIZE", "24x32")
    done(run(command, "near-planar", "--out", "r"))
    metrics = json.loads((tmp_path / "r/metrics.json").read_text())
    assert metrics.get("shape", [5, 5, 24, 32, 3]) == [5, 5, 24, 32, 3]
    assert "views of 24x32 pixels" in metrics.get("caption", "views of 24x32 pixels")
