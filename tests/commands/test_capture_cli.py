"""`emmc-rig capture` and `emmc-rig session`: whole sessions, and one clear line for every fault."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from capture_rigs import frame_in, frames_in
from programs import PROGRAM, done, one_line, program, refused, wait_until

from emmc_rig.drivers.raw import decode_raw
from emmc_rig.session.lock import held
from emmc_rig.session.session import Session
from emmc_rig.session.verify import sessions_in

RIG = ["--rig", "simulated", "--scene", "near-planar", "--size", "24x32"]
PATIENCE_S = 60.0
PLAN = {
    "title": "two shots, one of them a bracket",
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": [0.02, 0.08]}, {"repeats": 2}],
    "whiteboards": {"repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}


@pytest.fixture
def run(run, monkeypatch):
    """Run the program in this process: exit code, standard output and standard error."""
    monkeypatch.setenv("COLUMNS", "160")
    return run


def plan_file(folder, **changes):
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump({**PLAN, **changes}))
    return path


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A folder with a plan and its complete session."""
    folder = tmp_path_factory.mktemp("captured")
    out, _ = capture(plan_file(folder))
    assert "complete: 62 frames verified" in out
    return folder


@pytest.fixture
def copy(captured, tmp_path):
    """A copy of the complete session, for tests that change it."""
    return shutil.copytree(captured / "plan-session", tmp_path / "copy")


def capture(*arguments):
    """Capture without a terminal; returns standard output and standard error."""
    code, out, err = program("capture", *arguments, *RIG)
    assert code == 0, err
    return out, err


def test_two_captures_of_one_plan_are_the_same_byte_for_byte(captured):
    _, err = capture(captured / "plan.yaml", "--out", captured / "again")
    assert "62 frames to take, about" in err
    assert "saturated" not in err  # progress is for a terminal
    assert "\x1b" not in err
    first, other = (frames_in(Session(captured / name)) for name in ("plan-session", "again"))
    assert first == other


def test_running_a_complete_session_again_takes_nothing(captured, run):
    os.chdir(captured)
    code, out, err = run("capture", "plan-session")
    assert code == 0
    assert "0 taken" in out
    assert "62 of 62 frames are captured already" in err


def test_a_session_is_listed_shown_and_verified(captured, run):
    os.chdir(captured)
    out = done(run("session", "list"))
    assert "plan-session" in out
    assert "62/62" in out
    _, out, _ = run("session", "show", "plan-session")
    assert "two shots, one of them a bracket" in out
    assert "whiteboard   50 of 50" in out
    out = done(run("session", "verify", "plan-session"))
    assert "complete: 62 frames" in out


def test_a_damaged_frame_fails_the_verification_and_is_taken_again(copy, run):
    session = Session(copy)
    path = session.path_of(session.stored["shot-1-e0-r1"])
    good = path.read_bytes()
    path.write_bytes(good[:-100])
    code, out, err = run("session", "verify", copy)
    assert code == 1
    assert "shot-1-e0-r1" in out
    assert "61 of 62 frames are good" in one_line(err)
    out = done(run("capture", copy))
    assert "1 taken" in out
    assert frame_in(path.read_bytes()) == frame_in(good)


KILLED_EXPORT = """
import os, signal, sys
from pathlib import Path
from emmc_rig.progress import Watcher
from emmc_rig.session.export import export_hdf5
from emmc_rig.session.session import Session
watcher = Watcher()
watcher.step = lambda frame: os.kill(os.getpid(), signal.SIGKILL)
export_hdf5(Session(Path(sys.argv[1])), Path(sys.argv[2]), watcher=watcher)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGKILL")
def test_an_export_that_is_killed_leaves_no_part_after_the_next_one(captured, run, tmp_path):
    session, path = captured / "plan-session", tmp_path / "x.h5"
    typed = [sys.executable, "-c", KILLED_EXPORT, str(session), str(path)]
    assert subprocess.run(typed, check=False).returncode == -signal.SIGKILL
    assert not path.exists()
    done(run("session", "export", session, "--out", path))
    assert list(tmp_path.iterdir()) == [path]


def test_a_session_goes_on_with_another_stage_only_where_that_is_meant(copy, run, monkeypatch):
    monkeypatch.setattr("emmc_rig.simulators.zaber.FIRST_SERIAL_NUMBER", 900)
    journal = (copy / "journal.jsonl").read_bytes()
    code, _, err = run("capture", copy)
    assert code == 1
    assert "was begun with mask_x on" in one_line(err)
    assert "or say that other devices are meant; say so by --other-devices" in one_line(err)
    assert (copy / "journal.jsonl").read_bytes() == journal
    assert run("capture", copy, "--other-devices")[0] == 0
    assert run("capture", copy)[0] == 0


def test_frames_are_exported_as_dng_files_by_the_command(captured, run, tmp_path):
    session, out = captured / "plan-session", tmp_path / "dng"
    for _ in range(2):  # what an earlier export wrote is replaced
        told = done(run("session", "export", session, "--dng", "--out", out))
        assert "wrote 62 DNG files" in told
    assert len(list(out.glob("*.dng"))) == 62
    code, _, _ = run("session", "export", session, "--dng", "--compress", "--out", tmp_path / "x")
    assert code == 2
    assert not (tmp_path / "x").exists()


def test_an_export_has_the_names_of_nexus_and_the_frames_of_the_camera(captured, run):
    os.chdir(captured)
    done(run("session", "export", "plan-session", "--out", "x.h5", "--compress"))
    with h5py.File("x.h5") as file:
        entry: Any = file[file.attrs["default"]]
        kinds = {}
        entry.visititems(lambda name, node: kinds.update({name: node.attrs.get("NX_class")}))
        assert entry.attrs["NX_class"] == "NXentry"
        assert kinds["instrument/detector"] == "NXdetector"
        assert kinds["instrument/mask"] == "NXpositioner"
        assert entry["data"].attrs["signal"] == "data"
        frames = entry["data/data"]
        assert frames.shape == (62, 24, 32)
        ids = entry["data/frame_id"].asstr()[:].tolist()
        assert entry["instrument/mask/x"].attrs["units"] == "um"
        places = entry["instrument/mask/x"][:]
        assert places[ids.index("shot-1-e0-r0")] == pytest.approx(270, abs=0.5)
        times_s = entry["instrument/detector/count_time"][:]
        assert times_s[ids.index("shot-0-e1-r0")] == pytest.approx(0.08)
        warmth_c = entry["environment/stage device 1"]
        assert warmth_c.attrs["units"] == "C"
        assert set(warmth_c[:]) == {31.4}
        assert set(entry["data/notes"].asstr()[:]) == {"{}"}
        stored = Session(Path("plan-session")).stored
        assert entry["data/time"].asstr()[:].tolist() == [stored[name].wall for name in ids]
        exposed = frames[ids.index("shot-0-e1-r0")]
    session = Session(captured / "plan-session")
    raw = decode_raw(session.read("shot-0-e1-r0"))
    np.testing.assert_array_equal(exposed, raw.mosaic)


def test_the_metrics_lie_beside_what_was_captured(captured):
    metrics = json.loads((captured / "plan-session" / "metrics.json").read_text())
    assert metrics["complete"]
    assert metrics["frames"] == metrics["stored"] == 62
    assert metrics["retries"] == 0
    assert metrics["runs"][0]["frames"] == 62
    assert 0 <= metrics["runs"][0]["writing_s"] < metrics["runs"][0]["seconds"]


def test_the_report_opens_offline_and_shows_frames_and_times(captured):
    page = (captured / "plan-session" / "report.html").read_text()
    assert page.count("<img ") == 62
    assert "data:image/jpeg;base64," in page
    assert " s moving, " in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert 'src="http' not in page
    assert "{{" not in page


@pytest.mark.slow
def test_a_session_is_reconstructed_as_it_is(captured, run, tmp_path):
    settings = tmp_path / "s.yaml"
    settings.write_text("tv: {max_steps: 3}")
    session = captured / "plan-session"
    done(run("reconstruct", session, "--settings", settings, "--out", "r"))
    metrics = json.loads(Path("r/metrics.json").read_text())
    assert metrics["shots"] == 2
    assert 0 < metrics["noise_sigma"] < 0.1
    assert Path("r/psi.h5").is_file()


def test_the_psi_of_a_session_is_that_of_the_demo_s_road(captured):
    from emmc_rig.formats.cameras import find_camera
    from emmc_rig.model.camera import build_imaging_matrix
    from emmc_rig.session.readings import session_frames

    psi, taken = session_frames(Session(captured / "plan-session"))
    design = build_imaging_matrix(find_camera("rgbw-bayer-2shots"), (24, 32))
    # The masks sit off by 6.5 um and more, which the design does not know.
    assert 0 < design.relative_difference(psi) < 0.6
    assert taken.usable.all()
    assert np.isfinite(taken.deviation).all()


def test_a_plan_for_a_camera_is_written_once(run, tmp_path):
    out = done(run("capture", "--new", "rgbw-bayer-3shots"))
    assert "wrote plan.yaml" in out
    assert yaml.safe_load((tmp_path / "plan.yaml").read_text())["camera"] == "rgbw-bayer-3shots"
    assert "exists already" in refused(run("capture", "--new", "rgbw-bayer-3shots"))


def test_a_dry_run_reports_what_it_will_take_and_makes_nothing(run, tmp_path):
    plan_file(tmp_path)
    code, _, err = run("capture", "plan.yaml", *RIG, "--dry-run")
    assert code == 0
    assert "62 frames to take, about" in err
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yaml"]


def test_an_edited_plan_holds_for_what_is_not_taken_yet(copy, run, tmp_path):
    taken = {path.name: path.read_bytes() for path in (copy / "frames").iterdir()}
    shots = [{"exposure_s": [0.02, 0.06]}, {"exposure_s": 0.03, "repeats": 3}]
    plan_file(tmp_path, shots=shots, settle_s=0.25)
    code, out, err = run("capture", "plan.yaml", "--out", copy)
    assert code == 0, err
    assert "62 frames taken stay, 3 of them exposed as before" in err
    assert "1 taken in" in out
    now = {path.name: path.read_bytes() for path in (copy / "frames").iterdir()}
    assert len(now) == 63
    assert {name: now[name] for name in taken} == taken
    session = Session(copy)
    assert session.stored["shot-1-e0-r2"].exposure_s == 0.03
    assert session.stored["shot-1-e0-r2"].plan == 1
    code, out, _ = run("session", "show", copy)
    assert "plan 0       62 frames, by plan.yaml" in out
    assert "plan 1       1 frames, by amended-1-plan.yaml" in out
    assert "settle_s is 0.25, not 0.0" in out
    assert run("session", "list", copy)[1].count("63/63") == 1
    assert run("session", "verify", copy)[0] == 0
    assert run("session", "export", copy, "--out", "x.h5")[0] == 0
    with h5py.File("x.h5") as file:
        plans = file["entry/data/plan"]
        assert isinstance(plans, h5py.Dataset)
        assert np.sum(plans[:]) == 1
    assert run("capture", copy)[1].count("0 taken in") == 1


def test_a_plan_edited_inside_the_session_is_reported(copy, run):
    (copy / "plan.yaml").write_text("camera: conventional\nshots: [{}]\n")
    assert "was changed after the session began" in refused(run("capture", copy))
    code, out, _ = run("session", "verify", copy)
    assert code == 1
    assert "was changed after the session began" in out


def test_a_session_that_another_program_holds_is_left_to_it(captured, run):
    with held(captured / "plan-session"):
        assert f"(process {os.getpid()} on " in refused(run("capture", captured / "plan-session"))
        assert run("session", "show", captured / "plan-session")[0] == 0


def test_a_disk_without_room_is_reported_before_anything_is_made(run, tmp_path, monkeypatch):
    from emmc_rig.model.files import Disk

    plan_file(tmp_path)
    monkeypatch.setattr(Disk, "free_bytes", lambda self, folder: 4_190_000)
    code, _, err = run("capture", "plan.yaml", *RIG)
    assert code == 1
    needed = "62 frames need about 442 kB, "
    lacking = "and 100 MB stay reserved: 96.3 MB more than the 4.19 MB that are free; make room"
    assert needed in one_line(err)
    assert lacking in err
    assert not (tmp_path / "plan-session").exists()


def test_work_by_hand_without_a_terminal_is_reported(run, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    plan_file(tmp_path)
    axes = dict.fromkeys(("mask_x", "mask_y", "aperture_x", "aperture_y"), 12_700.0)
    rig = {"stage": "simulated", "camera": "simulated", "zero_um": axes, "window_um": 1000.0}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    assert "somebody has to switch the lamp off" in refused(
        run("capture", "plan.yaml", "--rig", "rig.yaml")
    )


SHOTS = ("shot-0-e0-r0", "shot-0-e1-r0")
BARE = "stage: simulated\ncamera: 'folder:recorded'\nby_hand: false\n"
PAGE = """
zero_um: {mask_x: 12700, mask_y: 12700, aperture_x: 25000, aperture_y: 25000}
window_um: 50000
"""
"""As docs/capture.md has them of a real rig."""


@pytest.fixture
def recorded(captured, tmp_path):
    """A folder with the files of a session, its plan, and the shortest rig's file that replays."""
    shutil.copytree(captured / "plan-session" / "frames", tmp_path / "recorded")
    (tmp_path / "rig.yaml").write_text(BARE)
    plan_file(tmp_path)
    return tmp_path / "recorded"


@pytest.mark.parametrize("more", ["", PAGE])
def test_a_recorded_session_is_replayed_as_the_page_says(captured, recorded, run, tmp_path, more):
    (tmp_path / "rig.yaml").write_text(BARE + more)
    done(run("capture", "plan.yaml", "--rig", "rig.yaml"))
    again = Session(tmp_path / "plan-session")
    assert frames_in(again) == frames_in(Session(captured / "plan-session"))


def test_a_file_that_is_missing_is_named_and_the_session_goes_on(captured, recorded, run, tmp_path):
    lost = next(recorded.glob("*-shot-0-e1-r0.dng"))
    data = lost.read_bytes()
    lost.unlink()
    code, _, err = run("capture", "plan.yaml", "--rig", "rig.yaml")
    assert code == 130
    assert "recorded: no file is known to be shot-0-e1-r0 (0.08 s)" in err
    assert "1 of 62 frames are still to be taken" in one_line(err)
    (recorded / "shot-0-e1-r0.dng").write_bytes(data)
    done(run("capture", "plan.yaml"))
    again = Session(tmp_path / "plan-session")
    assert frames_in(again) == frames_in(Session(captured / "plan-session"))


def test_files_of_any_name_are_taken_in_order_where_all_exposures_agree(
    captured, recorded, run, tmp_path
):
    plan_file(tmp_path, whiteboards=None, shots=[{"exposure_s": [0.02, 0.08]}])
    theirs = {
        frame_id: path.rename(recorded / f"{number}.dng").read_bytes()
        for number, frame_id in enumerate(("dark-0-r0", "dark-0-r1", *SHOTS))
        for path in recorded.glob(f"*-{frame_id}.dng")
    }
    for path in recorded.glob("*-*.dng"):
        path.unlink()
    done(run("capture", "plan.yaml", "--rig", "rig.yaml"))
    again = Session(tmp_path / "plan-session")
    assert [again.read(name) for name in SHOTS] == [theirs[name] for name in SHOTS]
    (recorded / "0.dng").unlink()
    assert "name them after the frames" in refused(
        run("capture", "plan.yaml", "--rig", "rig.yaml", "--out", "other")
    )
    assert not (tmp_path / "other").exists()


def started_capture(folder):
    """Start a long capture; return its process once some frames are taken."""
    plan_file(folder, darks={"repeats": 300})
    command = [*PROGRAM, "capture", "plan.yaml", *RIG, "--real-time"]
    process = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True)
    journal = folder / "plan-session" / "journal.jsonl"
    wait_until(
        lambda: journal.exists() and journal.read_bytes().count(b'"kind":"frame"') > 2, PATIENCE_S
    )
    return process


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals are sent")
@pytest.mark.parametrize(
    ("signals", "line"),
    [
        ([signal.SIGINT], "frames are still to be taken; go on with"),
        ([signal.SIGTERM], "stopped at once; what was captured is kept"),
    ],
)
def test_an_interrupted_capture_says_how_to_go_on(tmp_path, signals, line):
    process = started_capture(tmp_path)
    for number in signals:
        process.send_signal(number)
        time.sleep(0.02)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, err
    assert line in one_line(err)
    session = Session(tmp_path / "plan-session")
    assert 2 < len(session.stored) < 300
    assert next(sessions_in(tmp_path)).name == "plan-session"


def test_sessions_are_listed_with_verdict_and_psnr_below_a_folder(captured, run, tmp_path):
    shutil.copytree(captured / "plan-session", tmp_path / "a/one")
    shutil.copytree(captured / "plan-session", tmp_path / "b/two")
    results = tmp_path / "a/one/reconstruction"
    results.mkdir()
    reported = {"verdict": {"level": "doubt"}, "stated_db": 27.5}
    (results / "metrics.json").write_text(json.dumps(reported))
    _, out, _ = run("session", "list", tmp_path, "--json")
    first, second = json.loads(out.splitlines()[-1])["sessions"]
    assert (first["name"], first["verdict"], first["stated_db"]) == ("one", "doubt", 27.5)
    assert (second["name"], second["verdict"], second["stated_db"]) == ("two", "", None)
    assert first["camera"] == PLAN["camera"]
    _, out, _ = run("session", "list", tmp_path)
    assert "a/one" in out
    assert "27.5" in out
