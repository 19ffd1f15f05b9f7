"""The command line: exit codes, one clear line for every fault, nothing half-written."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import typer
import yaml
from programs import done, one_line, refused

from emmc_rig import cli
from emmc_rig.version import __version__

SMALL = ["--size", "24x32"]
COMMANDS = typer.main.get_command(cli.app).commands  # pyright: ignore[reportAttributeAccessIssue]


def views_in(folder, rows=2, columns=2, size=(24, 32)):
    folder.mkdir()
    rng = np.random.default_rng(0)
    for row, column in np.ndindex(rows, columns):
        picture = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"view_{row}_{column}.png"), picture)
    return folder


def camera_file(path, **changes):
    base = {
        "title": "a camera",
        "views": [2, 2],
        "sensor": {"cfa": "rggb"},
        "masks": {"code": {"distance_mm": 0.12, "cell_um": 48, "pattern": {"kind": "random_rgbw"}}},
    }
    path.write_text(yaml.safe_dump({**base, **changes}))
    return path


def leftovers(folder):
    return [path.name for path in folder.rglob(".*")]


@pytest.mark.slow
def test_the_demo_writes_a_whole_result(run, tmp_path):
    out = done(run("demo", *SMALL, "--shots", 1, "--out", "result"))
    assert "dB" in out
    made = {path.name for path in (tmp_path / "result").iterdir()}
    assert {"metrics.json", "report.html", "light_field.h5", "psi.h5", "frames.h5"} <= made
    assert json.loads((tmp_path / "result/metrics.json").read_text())["shots"] == 1
    assert not leftovers(tmp_path)


def test_an_output_that_cannot_be_written_is_one_line(run, tmp_path):
    (tmp_path / "file").write_text("")
    for out in ("file", "file/inside", "/proc/emmc"):
        assert f"{out}: " in refused(run("simulate", *SMALL, "--out", out))


@pytest.mark.slow
def test_cameras_are_listed_and_drawn(run, tmp_path):
    out = done(run("cameras"))
    assert "rgbw-bayer" in out
    done(run("cameras", "rgbw-mono", "--out", "sheet"))
    assert (tmp_path / "sheet/camera.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "sheet/metrics.json").read_text())["light_efficiency"] > 0.3


def test_a_folder_of_views_is_imaged(run, tmp_path):
    views_in(tmp_path / "views")
    camera_file(tmp_path / "c.yaml")
    out = done(run("simulate", "--scene", "views", "--camera", "c.yaml", "--out", "r"))
    assert "1 frame(s)" in out


def test_faults_of_scenes_are_one_line(run, tmp_path):
    views_in(tmp_path / "gap")
    (tmp_path / "gap/view_0_1.png").unlink()
    views_in(tmp_path / "mixed")
    cv2.imwrite(str(tmp_path / "mixed/view_1_1.png"), np.zeros((9, 9, 3), np.uint8))
    views_in(tmp_path / "broken")
    (tmp_path / "broken/view_1_0.png").write_text("no picture")
    views_in(tmp_path / "single", 1, 2)
    (tmp_path / "empty").mkdir()
    for scene, reported in {
        "gap": "view_0_1",
        "mixed": "view_1_1",
        "broken": "view_1_0",
        "single": "1x2 views",
        "empty": "view_",
        "nowhere": "deep-occlusions",
    }.items():
        assert reported in refused(run("demo", "--scene", scene, "--out", "r"))
    assert not (tmp_path / "r").exists()
    assert not leftovers(tmp_path)


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"viewss": [2, 2]}, "did you mean 'views'"),
        ({"sensor": {"cfa": "rggg"}}, "unknown CFA 'rggg'"),
        (
            {"masks": {"m": {"distance_mm": 60, "cell_um": 9, "pattern": {"kind": "open"}}}},
            "further away than the lens",
        ),
        (
            {
                "masks": {
                    "m": {
                        "distance_mm": 1,
                        "cell_um": 9,
                        "pattern": {"kind": "parameters", "cells": [[1, 0], [0, 1]]},
                    }
                }
            },
            "smaller than the beam",
        ),
        (
            {
                "masks": {
                    "m": {
                        "distance_mm": 50,
                        "cell_um": 5000,
                        "pattern": {"kind": "parameters", "cells": [[0, 0], [0, 0]]},
                    }
                }
            },
            "no light reaches the sensor in shot 0",
        ),
    ],
)
def test_faults_of_cameras_are_one_line(run, tmp_path, changes, reported):
    camera_file(tmp_path / "c.yaml", **changes)
    for command in ("demo", "simulate"):
        assert reported in refused(run(command, *SMALL, "--camera", "c.yaml", "--out", "r"))
    assert not (tmp_path / "r").exists()


def test_unknown_names_and_sizes_are_one_line(run):
    code, _, err = run("demo", "--camera", "rgbw-bayer-3shot", "--out", "r")
    assert (code, "rgbw-bayer-3shots" in one_line(err)) == (1, True)
    code, _, err = run("demo", "--size", "tiny", "--out", "r")
    assert (code, "192x256" in one_line(err)) == (2, True)
    code, _, err = run("demo", "--camera", "learned-aperture", "--shots", 9, "--out", "r")
    assert (code, "more_shots_step_um" in one_line(err)) == (1, True)


def test_solver_settings_that_make_no_sense_are_one_line(run, tmp_path):
    settings = tmp_path / "settings.yaml"
    for name, value in (("mu", -1), ("mu", ".nan"), ("chroma_weight", 0)):
        settings.write_text(f"tv: {{{name}: {value}}}\n")
        assert f"tv.{name}" in refused(run("reconstruct", "frames", "--settings", settings))


def test_wrong_usage_is_exit_code_2(run):
    for arguments in (
        ["demo", "--sceen", "x"],
        ["no-such-command"],
        ["chart", "--repeats", 0],
        ["demo", "--shots", 0],
    ):
        code, _, err = run(*arguments)
        assert code == 2
        assert "Traceback" not in err


def test_version_and_help_are_printed(run):
    assert run("--version")[:2] == (0, f"emmc-rig {__version__}\n")
    out = done(run("--help"))
    panels = re.findall(r"─ (\w+) ─", out)
    assert panels == ["Options", "Bench", "Results", "Studies"]
    listed = re.findall(r"^│ ([a-z]+) ", out, re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)


@pytest.mark.slow
def test_ctrl_c_stops_with_130_and_leaves_nothing(tmp_path):
    command = [sys.executable, "-c", "from emmc_rig.cli import main; main()"]
    process = subprocess.Popen(
        [*command, "demo", "--size", "96x128", "--out", "r"],
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


def test_an_export_says_what_is_missing_of_what_it_was_given(run, tmp_path):
    assert run("simulate", "--size", "32x32", "--out", "taken")[0] == 0
    for given, reported in {
        "taken": "holds frames, no light field yet; run `emmc-rig reconstruct taken`",
        "near-plana": "did you mean 'near-planar'?",
        "nothing": "no folder or file 'nothing', and no built-in scene: known are",
    }.items():
        assert reported in refused(run("export", given, "--out", "r"))
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("command", ["export", "figure"])
def test_the_size_in_the_environment_reaches_exported_scenes(run, monkeypatch, tmp_path, command):
    monkeypatch.setenv("EMMC_SIZE", "24x32")
    done(run(command, "near-planar", "--out", "r"))
    metrics = json.loads((tmp_path / "r/metrics.json").read_text())
    assert metrics.get("shape", [5, 5, 24, 32, 3]) == [5, 5, 24, 32, 3]
    assert "views of 24x32 pixels" in metrics.get("caption", "views of 24x32 pixels")


@pytest.mark.parametrize(
    "typed",
    [
        ["reconstruct", "nowhere"],
        ["calibrate", "nowhere"],
        ["calibrate", "--drift", "taken", "--known", "nowhere"],
        ["session", "list", "nowhere"],
        ["session", "show", "nowhere"],
        ["session", "verify", "nowhere"],
        ["session", "sheet", "nowhere"],
    ],
)
def test_a_folder_that_is_not_there_is_said_so_with_what_to_do(run, typed):
    code, _, err = run(*typed)
    assert code == 1
    assert "nowhere: no such folder; " in one_line(err)
    assert one_line(err).partition("; ")[2]


@pytest.mark.parametrize("command", [["demo"], ["reconstruct", "taken"]])
def test_a_dictionary_that_the_method_would_not_read_is_refused(run, command):
    code, _, err = run(*command, "--dictionary", "nothing.h5")
    assert code == 2
    assert "no effect on --method adaptive" in err
