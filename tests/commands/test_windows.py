"""The program under rules of Windows, see helpers/windows/sitecustomize.py; no Windows is here."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import yaml
from programs import PROGRAM

from emmc_rig.bench.device_config import parse_camera
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import shipped_camera_files
from emmc_rig.process.reconstructing import open_frames
from emmc_rig.session.board_sets import decoded
from emmc_rig.session.session import Session

RULES = Path(__file__).parents[1] / "helpers/windows"
CAMERA = "rgbw-bayer-1shot"
RIG = ("--rig", "simulated", "--size", "32x40")
PLAN = {
    "camera": "mine.yaml",
    "shots": [{"exposure_s": 0.02}],
    "whiteboards": None,
    "darks": {"repeats": 2},
}


@pytest.fixture
def run(tmp_path):
    """Run commands of the program in a folder, each in a process of its own."""
    environment = {
        **os.environ,
        "EMMC_WINDOWS": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(RULES), os.environ.get("PYTHONPATH", "")]),
        "PYTHONWARNDEFAULTENCODING": "1",
        "PYTHONIOENCODING": "cp1252",  # of output that is no terminal
    }

    def run(*words, code=0):
        ended = subprocess.run(
            [*PROGRAM, *words],
            cwd=tmp_path, env=environment, capture_output=True, timeout=600,
        )  # fmt: skip
        said = (ended.stdout + ended.stderr).decode("cp1252")
        assert ended.returncode == code, said
        return said

    return run


@pytest.mark.slow
def test_the_demo_runs(tmp_path, run):
    run("demo", "--size", "48x64", "--out", "demo")
    assert (tmp_path / "demo/report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_a_bench_is_captured_imported_and_reconstructed(tmp_path, run):
    camera = yaml.safe_load(shipped_camera_files()[CAMERA].read_text("utf-8"))
    camera.setdefault("sensor", {})["noise"] = {"electrons_per_s": 310_000.0}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(camera))
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    run("capture", "plan.yaml", *RIG, "--out", "captured")
    session = Session(tmp_path / "captured")
    table = ["file,kind,shot,exposure_s"]
    for frame, raw in zip(session.frames, decoded(session, session.frames), strict=True):
        shot = "" if frame.kind == "dark" else frame.bench.shot
        table.append(f"{frame.id}.mat,{frame.kind},{shot},{raw.exposure_s!r}")
        scipy.io.savemat(tmp_path / f"{frame.id}.mat", {"frame": raw.mosaic})
    (tmp_path / "table.csv").write_text("\n".join(table))
    run("import", "table.csv", "--camera", "mine.yaml", "--out", "imported")
    captured, imported = (open_frames(tmp_path / name)[1] for name in ("captured", "imported"))
    assert np.array_equal(captured.readings, imported.readings)
    run("simulate", "--camera", "mine.yaml", "--size", "32x40", "--out", "simulated")
    (tmp_path / "blocks.yaml").write_text("blocks: {side: 20}")
    for _ in range(2):  # the second result replaces the first
        run(
            "reconstruct", "imported", "--psi", "simulated/psi.h5", "--method", "tv", "--settings",
            "blocks.yaml", "--workers", "2", "--memory", "8GiB", "--out", "result",
        )  # fmt: skip
    metrics = json.loads((tmp_path / "result/metrics.json").read_text("utf-8"))
    assert metrics["workers"] == 2, metrics


def test_a_path_that_begins_with_a_drive_names_no_driver():
    with pytest.raises(AppError, match="no such file"):
        parse_camera(r"C:\bench\camera.yaml")


def test_what_needs_a_pseudo_terminal_is_refused_in_a_line(run):
    said = run("devices", "probe", "--rig", "simulated:zaber", code=1)
    assert "pseudo-terminal" in said
    assert "Traceback" not in said
