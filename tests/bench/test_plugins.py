"""Stages and cameras of other packages: found, opened by name, and held to the suites."""

import io
import os
import subprocess
import sys
import tomllib
from contextlib import closing
from pathlib import Path

import pytest
from programs import PROGRAM

from emmc_rig.bench.hardware import open_camera, open_lights, open_stage
from emmc_rig.bench.rig_config import ImagedRig, opened_rig, rig_description
from emmc_rig.drivers.errors import LightError, LimitExceededError
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera

EXAMPLE = Path(__file__).parents[2] / "docs/example_plugin"
BROKEN = """
from emmc_rig_example.simulator import open_simulated

def liar(address, settings, clock):
    stage = open_simulated(address, settings, clock)
    position_um = stage.position_um
    stage.position_um = lambda axis: position_um(axis) + 5.0
    return stage

def fails(address, settings, clock):
    raise RuntimeError("the library\\nis not there")
"""
BROKEN_POINTS = {
    "emmc_rig.stages": {
        "liar": "broken:liar",
        "fails": "broken:fails",
        "absent": "no_such_module:open",
        "zaber": "broken:liar",
    }
}


def put_metadata(folder, name, points):
    """What pip writes of a package, for `importlib.metadata` to find on the path."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [
        line
        for group, entries in points.items()
        for line in (f"[{group}]", *(f"{entry} = {place}" for entry, place in entries.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The example, as its pyproject.toml says, and a package whose plug-ins are broken."""
    folder = tmp_path / "site"
    folder.mkdir()
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    put_metadata(folder, "emmc_rig_example", project["entry-points"])
    put_metadata(folder, "broken", BROKEN_POINTS)
    (folder / "broken.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.syspath_prepend(str(EXAMPLE))
    return folder


def test_a_stage_of_a_plug_in_is_opened_by_name_with_our_settings(installed, tmp_path):
    with open_stage("example-simulated:") as stage:
        stage.home()
        assert stage.move_to_um({"x": 1200.0})["x"] == pytest.approx(1200.0, abs=0.1)
    file = tmp_path / "stage.yaml"
    file.write_text("{protocol: example-simulated, soft_limits_um: {x: [0, 500]}}")
    with open_stage(str(file)) as stage:
        stage.home()
        with pytest.raises(LimitExceededError):
            stage.move_to_um({"x": 501.0})


def test_lights_of_a_plug_in_take_their_options_from_the_rigs_file(installed, tmp_path):
    file = tmp_path / "brightness"
    spec = {"protocol": "dimmer", "port": str(file), "options": {"level": 200}}
    with closing(open_lights(spec)) as lights:
        assert lights.set("white") == "200"
        assert file.read_text() == "200\n"
        file.unlink()
        file.mkdir()
        with pytest.raises(LightError, match=r"cannot be set to off .*Is a directory"):
            lights.set("off")
    with pytest.raises(AppError, match=r"plug-in dimmer \(emmc_rig_example 1.0\).*'levl'"):
        open_lights(spec | {"options": {"levl": 3}})


def test_a_camera_of_a_plug_in_takes_its_options_from_a_file(installed, tmp_path):
    program = tmp_path / "take.py"
    program.write_text(
        "import sys, numpy\nfrom emmc_rig.drivers.dng import encode_dng\n"
        "data = encode_dng(numpy.full((30, 40), 9, 'u2'), 'rggb', 0, 255, 0.02)\n"
        "open(sys.argv[1] + '/frame.dng', 'wb').write(data)\n"
    )
    file = tmp_path / "camera.yaml"
    file.write_text(
        f"{{kind: command, address: '{sys.executable} {program} {{folder}}',"
        " file: frame.dng, shape: [30, 40], cfa: rggb}"
    )
    with closing(open_camera(str(file))) as camera:
        camera.set_exposure_s(0.02)
        assert camera.snap().mosaic.shape == (30, 40)
    # Also in the rig's file itself, or beside it.
    rig = tmp_path / "rig.yaml"
    for camera in (file.read_text(), "camera.yaml"):
        rig.write_text(f"{{camera: {camera}, by_hand: false}}")
        described = rig_description(str(rig), ImagedRig(scene="near-planar"))
        with opened_rig(described, find_camera("rgbw-bayer-1shot"), pytest.fail) as opened:
            assert opened.camera.shape == (30, 40)
    rig.write_text("{camera: {file: frame.dng}}")
    described = rig_description(str(rig), ImagedRig(scene="near-planar"))
    with pytest.raises(AppError, match="the rig's camera: name the camera's driver, such as"):
        open_camera(described["camera"])
    file.write_text("{kind: command, address: x, flie: frame.dng}")
    with pytest.raises(AppError, match=r"plug-in command \(emmc_rig_example 1.0\).*'flie'"):
        open_camera(str(file))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fails", "could not open its device: the library is not there"),
        ("absent", "cannot be loaded: No module named 'no_such_module'"),
    ],
)
def test_a_plug_in_that_does_not_work_is_one_line(installed, name, message):
    with pytest.raises(AppError, match=message) as caught:
        open_stage(f"{name}:")
    assert "\n" not in str(caught.value)


def test_a_plug_in_replaces_no_protocol_of_ours_and_two_of_one_name_are_refused(installed):
    with pytest.raises(AppError, match="apt, mm, absent, example, example-simulated, fails, liar"):
        open_stage("zaber:")
    put_metadata(installed, "other", {"emmc_rig.stages": {"example": "broken:liar"}})
    with pytest.raises(AppError, match=r"other 1.0.*uninstall all but one"):
        open_stage("example:/dev/null")


def test_the_commands_take_a_plug_in_as_any_other_stage(installed, run):
    code, out, _ = run("devices", "jog", "--stage", "example-simulated:", "--home", "x", "750")
    assert (code, out) == (0, "x at 750.000 um\n")
    code, _, error = run("devices", "conform", "nobody:")
    assert (code, error.count("\n")) == (1, 1)
    assert "nobody:" in error
    code, _, error = run("devices", "conform", "ptp:", "--as", "stage")
    assert (code, error) == (1, "emmc-rig: --as stage: ptp: is a camera: leave --as out\n")


def conform(installed, *arguments, answer=""):
    paths = os.pathsep.join((str(installed), str(EXAMPLE), os.environ.get("PYTHONPATH", "")))
    return subprocess.run(
        [*PROGRAM, "devices", "conform", *arguments],
        env=os.environ | {"PYTHONPATH": paths},
        input=answer,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.slow
def test_a_plug_in_that_behaves_conforms(installed):
    done = conform(installed, "example-simulated:", answer="y\n")
    assert done.returncode == 0, done.stdout
    assert "11 passed" in done.stdout


@pytest.mark.slow
def test_a_stage_that_reads_to_be_elsewhere_does_not_conform(installed):
    done = conform(installed, "liar:", "--yes")
    assert done.returncode == 1
    assert "test_axes_move_together_to_where_they_are_sent FAILED" in done.stdout
    assert "failed the conformance tests of a stage" in done.stderr


def test_nothing_moves_unless_somebody_says_that_the_way_is_free(installed, run, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("n\n"))
    code, _, error = run("devices", "conform", "example-simulated:")
    assert code == 1
    assert "Is the way free?" in error
    assert error.endswith("emmc-rig: nothing was moved\n")
