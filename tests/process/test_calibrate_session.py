"""A session's whiteboards to Psi: planned by `calibrate --plan`, captured, fitted, used."""

import json
import shutil
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from programs import exit_code, program
from simulated_calibration import CalibrateSettings, rig_to_calibrate, true_psi

from emmc_rig.bench.hardware import NO_FLAWS
from emmc_rig.captures.plan import load_plan
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.sensing import Psi
from emmc_rig.session import board_sets
from emmc_rig.session.board_sets import camera_of
from emmc_rig.session.session import Session
from emmc_rig.simulators.bench import MountingErrors
from emmc_rig.simulators.effects import flawed
from emmc_rig.store.folders import Listing

pytestmark = pytest.mark.slow

SIZE = (32, 48)
RIG = ("--rig", "simulated", "--scene", "near-planar", "--size", "32x48", "--rays", "1024")


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A folder with a plan of `calibrate --plan` and its session."""
    folder = tmp_path_factory.mktemp("calibrated")
    plan = ("calibrate", "--plan", "--size", "32x48", "--out", folder / "plan")
    assert exit_code(*plan) == 0
    out = folder / "session"
    assert exit_code("capture", folder / "plan" / "plan.yaml", *RIG, "--out", out) == 0
    return folder


def test_a_session_is_calibrated_and_finds_the_mask_where_the_bench_has_it(captured, capsys):
    out = captured / "calibration"
    assert exit_code("calibrate", captured / "session", "--out", out) == 0
    reported = capsys.readouterr().out
    assert "x noise variance (limit 1.5)" in reported
    metrics = json.loads((out / "metrics.json").read_text())
    judged = metrics["held_out"][metrics["chosen"]]
    assert judged["relative_error"] < 0.01
    found = {name: metric["value"] for name, metric in metrics["parameters"].items()}
    errors = MountingErrors()
    assert (found["offset_x_um"], found["offset_y_um"]) == pytest.approx(errors.offset_um, abs=0.2)
    assert np.degrees(found["rotation_rad"]) == pytest.approx(errors.rotation_deg, abs=0.01)
    session = Session(captured / "session")
    design = build_imaging_matrix(camera_of(session), SIZE)
    psi = Psi.load(out / "psi.h5")
    assert design.relative_difference(psi) > 10 * judged["relative_error"]
    assert "session" in (out / "report.html").read_text()


def test_the_method_free_takes_the_same_session(captured):
    out = captured / "free"
    assert exit_code("calibrate", captured / "session", "--method", "free", "--out", out) == 0
    surest = json.loads((captured / "calibration" / "metrics.json").read_text())
    assert surest["chosen"] in ("combined", "free")
    free, both = (Psi.load(item / "psi.h5") for item in (out, captured / "calibration"))
    assert free.relative_difference(both) < 0.01


def test_the_sensor_is_characterised_by_the_session_that_calibrates_it(captured, capsys):
    out = captured / "sensor"
    assert exit_code("calibrate", captured / "session", "--sensor", "--out", out) == 0
    reported = capsys.readouterr().out
    # The series of exposures ends below saturation, which gives a lower bound of the capacity.
    assert "Saturation capacity, at least" in reported
    figures = json.loads((out / "sensor.json").read_text())
    assert figures["Saturation capacity"]["remark"] == "at least"
    noise = find_camera("rgbw-bayer-1shot").sensor.noise
    gain, read = (figures[name] for name in ("Overall system gain K", "Temporal dark noise"))
    assert abs(gain["value"] - noise.gain_dn_per_electron) < 4 * gain["deviation"]
    assert gain["value"] == pytest.approx(noise.gain_dn_per_electron, rel=0.1)
    assert read["value"] == pytest.approx(noise.read_noise_electrons, rel=0.3)
    assert len(figures["Photon transfer curve"]["signal_dn"]) >= 16
    for name in ("DSNU", "PRNU"):
        assert figures[name]["value"] >= 0
    assert figures["Exposures of the linearity"]["value"] == 4
    page = (out / "report.html").read_text()
    for drawn in ("Photon transfer curve", "Linearity"):
        assert f'alt="{drawn}"' in page


def test_whiteboards_for_shots_or_stages_that_are_not_there_are_refused(tmp_path, capsys):
    for wrong, line in (
        ({"shots": [3]}, "none of the 1 shots"),
        ({"open": [{"mask_um": [0, 0], "valid": True}]}, "validation"),
    ):
        path = tmp_path / "plan.yaml"
        plan = {"camera": "rgbw-bayer-1shot", "shots": [{}], "whiteboards": wrong}
        path.write_text(yaml.safe_dump(plan))
        assert exit_code("capture", path, *RIG, "--out", tmp_path / "out") == 1
        assert line in capsys.readouterr().err.replace("\n", " ")


EFFECTS = "lamp,response,crosstalk,board,dark"


def test_a_session_corrects_what_is_wrong_with_lamp_sensor_and_board(tmp_path, capsys):
    """Error of Psi against the coefficients that the bench's own rays integrate to."""
    plan, session, out = (tmp_path / name for name in ("plan", "session", "calibration"))
    assert exit_code("calibrate", "--plan", "--size", "32x48", "--out", plan) == 0
    taken = ("capture", plan / "plan.yaml", *RIG, "--flaws", EFFECTS, "--out", session)
    assert exit_code(*taken) == 0
    assert exit_code("calibrate", session, "--out", out) == 0
    reported = capsys.readouterr().out
    for named in ("lamp drifted", "response loses", "colour filters", "white board is uneven"):
        assert f"finding: the {named}" in reported.replace("the sensor's", "the")
    assert "not measured" not in reported
    camera, flaws = find_camera("rgbw-bayer-1shot"), flawed(NO_FLAWS, EFFECTS.split(","))
    settings = CalibrateSettings("", camera, SIZE, flaws=flaws, rays=1024)
    true = true_psi(camera, *rig_to_calibrate(settings))
    psi = Psi.load(out / "psi.h5")
    with h5py.File(out / "calibration.h5") as stored:
        deviation, good = (np.asarray(stored[name]) for name in ("deviation", "good"))
    off = np.where(good[:, None, :], psi.weights - true, 0)
    stated = np.linalg.norm(deviation) / np.linalg.norm(true)
    assert np.linalg.norm(off) / np.linalg.norm(true) < min(1.25 * stated, 0.01)


def test_what_a_rig_cannot_take_is_left_out_of_the_plan_and_named(tmp_path, capsys):
    plan, out = tmp_path / "plan", tmp_path / "session"
    without = ("--skip", "lamp,response,colours,turned")
    assert exit_code("calibrate", "--plan", "--size", "32x48", *without, "--out", plan) == 0
    whiteboards = load_plan(plan / "plan.yaml").whiteboards
    assert whiteboards is not None
    assert whiteboards.lamp_checks == whiteboards.colours == whiteboards.turned == 0
    rig = (*RIG[:-1], "256")  # a third of them passes a corner of the lens
    assert exit_code("capture", plan / "plan.yaml", *rig, "--out", out) == 0
    capsys.readouterr()
    assert exit_code("calibrate", out, "--route", "mixed") == 0
    assert capsys.readouterr().out.count("not measured") == 4
    assert exit_code("calibrate", out, "--route", "best") == 1
    assert "use one of auto, parametric, mixed, free" in capsys.readouterr().err.replace("\n", " ")
    assert exit_code("calibrate", out, "--sensor", "--out", tmp_path / "sheet") == 1
    assert "two references at each of four (it has" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "sheet").exists()
    assert exit_code("calibrate", "--sensor", "--out", tmp_path / "sheet") == 2
    assert exit_code("calibrate", "--plan", "--skip", "hue", "--out", tmp_path / "x") == 1
    assert "colours" in capsys.readouterr().err


def used_psi(folder):
    return Psi.load(folder / "psi.h5").checksum()


@pytest.fixture
def own_session(captured, tmp_path):
    """A copy of the session, without calibrations and reconstructions of other tests."""
    left_out = shutil.ignore_patterns("calibration", "reconstruction")
    return Path(shutil.copytree(captured / "session", tmp_path / "session", ignore=left_out))


def decoded_by(monkeypatch, *words):
    """What a command says, and how many sessions it opens and frames it decodes."""
    counts = Counter()

    def counted(name, function):
        def call(*given, **named):
            counts[name] += 1
            return function(*given, **named)

        return call

    monkeypatch.setattr(Session, "__init__", counted("opened", Session.__init__))
    monkeypatch.setattr(board_sets, "decode_frame", counted("decoded", board_sets.decode_frame))
    code, out, err = program(*words)
    assert code == 0, err
    monkeypatch.undo()
    return out + err, counts


def test_reconstruct_takes_the_calibration_that_was_made_and_names_it(own_session, monkeypatch):
    assert exit_code("calibrate", own_session, "--method", "parametric") == 0
    said, counts = decoded_by(monkeypatch, "reconstruct", own_session, "--method", "tv")
    assert "method parametric" in said
    assert counts == {"opened": 1, "decoded": 1}
    parametric = used_psi(own_session / "calibration")
    assert used_psi(own_session / "reconstruction") == parametric
    metrics = json.loads((own_session / "reconstruction" / "metrics.json").read_text())
    assert metrics["psi_sha256"] == parametric
    # Asked for again, it is there; another is made on demand.
    said, counts = decoded_by(monkeypatch, "calibrate", own_session, "--method", "parametric")
    assert "nothing new to measure" in said
    assert counts == {"opened": 1}
    assert exit_code("calibrate", own_session, "--method", "free") == 0
    assert exit_code("reconstruct", own_session, "--method", "tv") == 0
    assert used_psi(own_session / "reconstruction") == used_psi(own_session / "calibration")
    assert used_psi(own_session / "calibration") != parametric


def test_reconstruct_stores_the_calibration_that_it_measures(own_session, monkeypatch):
    said, counts = decoded_by(monkeypatch, "reconstruct", own_session, "--method", "tv")
    frames = len(Session(own_session).stored)
    assert counts["opened"] == 1
    assert counts["decoded"] <= frames
    assert (own_session / "calibration" / "report.html").is_file()
    first = (own_session / "reconstruction" / "light_field.h5").read_bytes()
    said, counts = decoded_by(monkeypatch, "reconstruct", own_session, "--method", "tv")
    assert counts == {"opened": 1, "decoded": 1}
    assert "method auto" in said
    assert (own_session / "reconstruction" / "light_field.h5").read_bytes() == first


def test_a_calibration_of_other_frames_is_measured_again_by_its_method(own_session):
    assert exit_code("calibrate", own_session, "--method", "parametric") == 0
    product = own_session / "calibration" / "product.json"
    stated = json.loads(product.read_text())
    stated["psi"]["digest"] = "0" * 64
    product.write_text(json.dumps(stated))
    # Whatever is in the way of storing it, the reconstruction is made and says so.
    code, out, err = program("reconstruct", own_session, "--method", "tv")
    assert code == 0, err
    assert "other frames" in " ".join((out + err).split())
    assert "not stored" in " ".join((out + err).split())
    shutil.rmtree(own_session / "calibration")
    assert exit_code("calibrate", own_session, "--method", "parametric") == 0
    kept = used_psi(own_session / "calibration")
    (own_session / "calibration" / "product.json").unlink()
    listing = own_session / "calibration" / "files.json"
    listed = Listing.read(own_session / "calibration")
    assert listed is not None
    files = {name: sha for name, sha in listed.files.items() if name != "product.json"}
    listing.write_text(Listing(listed.command, files).text())
    code, out, err = program("reconstruct", own_session, "--method", "tv")
    assert code == 0, err
    assert "measured again, method parametric" in " ".join((out + err).split())
    assert used_psi(own_session / "calibration") == kept
