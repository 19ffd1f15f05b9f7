"""Whatever axes and camera a bench has, the commands of docs/day-one.md lead to a light field."""

import json
import re
import shlex
from pathlib import Path

import pytest
import yaml
from programs import done

from emmc_rig.session.session import Session

SIZE = ("--size", "32x40")
LEFT_OUT = "lamp,response,colours,turned"
CAMERAS = {"rgbw-bayer-1shot": LEFT_OUT + ",mask", "rgbw-bayer-2shots": LEFT_OUT}
AXES = {
    "none": [],
    "one": ["mask_x"],
    "two": ["mask_x", "mask_y"],
    "four": ["mask_x", "mask_y", "aperture_x", "aperture_y"],
}


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """Plans with the pinhole before every view, for a fixed and for a moving mask."""
    from programs import program

    found = {}
    for camera, left_out in CAMERAS.items():
        folder = tmp_path_factory.mktemp("planned") / "first"
        code, _, err = program(
            "calibrate", "--plan", "--camera", camera, *SIZE, "--leave-out", left_out,
            "--out", str(folder),
        )  # fmt: skip
        assert code == 0, err
        found[camera] = folder / "plan.yaml"
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axes", "camera"),
    [
        ("none", "ptp"),
        ("one", "u3v"),
        ("two", "ptp"),
        ("four", "u3v"),
        ("none", "folder"),
        ("four", "folder"),
    ],
)
def test_a_bench_comes_to_a_light_field(axes, camera, planned, tmp_path, run):
    described = {"kind": "simulated", "axes": AXES[axes], "hands_um": 100}
    if camera == "u3v":
        described["usb_camera"] = "u3v"
        if axes == "four":
            described["second_stage"] = AXES["four"][2:]
    rig, folder = tmp_path / "rig.yaml", tmp_path / "bench"
    plan = planned[list(CAMERAS)[axes in ("two", "four")]]
    rig.write_text(yaml.safe_dump(described))

    def did(*words):
        out = done(run(*words))
        return out

    did("capture", plan, "--rig", rig, *SIZE, "--out", folder)
    if camera == "folder":
        rig.write_text(
            yaml.safe_dump(
                {"stage": "simulated", "camera": f"folder:{folder}/frames", "by_hand": False}
            )
        )
        folder = tmp_path / "replayed"
        did("capture", plan, "--rig", rig, "--out", folder)
    session = Session(folder)
    assert session.is_complete
    by_hand = {axis for entry in session.stored.values() for axis in entry.deviation_um}
    if camera != "folder":
        lacking = {"aperture_x", "aperture_y"} - {*AXES[axes]}
        assert by_hand & {"aperture_x", "aperture_y"} == lacking
    did("calibrate", folder)
    told = json.loads((folder / "calibration" / "metrics.json").read_text())["findings"]
    # The frames alone show that hands put the pinhole, in an import as well.
    moved_by_hand = "aperture_x" not in AXES[axes]
    assert any("pinholes stand up to" in finding for finding in told) == moved_by_hand
    did("reconstruct", folder, "--method", "adaptive-fast")
    verdict = json.loads((folder / "reconstruction" / "metrics.json").read_text())["verdict"]
    assert verdict["level"] != "do not use", verdict["reasons"]


@pytest.mark.slow
def test_day_one_as_typed_ends_in_good_calibrations(tmp_path, monkeypatch, run):
    page = (Path(__file__).parents[2] / "docs" / "day-one.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for name, text in re.findall(r"```yaml\n# (\S+)\n(.*?)```", page, re.DOTALL):
        Path(name).write_text(text, encoding="utf-8")
    commands = re.findall(r"^emmc-rig (.+)$", page[page.index("**Third hour") :], re.MULTILINE)
    assert len(commands) == 8
    for command in commands:
        done(run(*shlex.split(command)))
    for folder, least, most in (("two", 1.0, 2.5), ("none", 3.0, 5.0)):
        found = json.loads(Path(folder, "calibration", "metrics.json").read_text())
        stated = re.match(r"calibration good: .* error stated ([\d.]+)%", found["why"])
        assert stated, found["why"]
        assert least < float(stated[1]) < most
        assert not any("distance differs" in line for line in found["findings"]), folder
        rebuilt = json.loads(Path(folder, "reconstruction", "metrics.json").read_text())
        assert rebuilt["verdict"]["level"] == "trust", folder
