"""`emmc-rig devices`: alike on simulated and real stages, stopped by every interruption."""

import io
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from programs import PROGRAM, done, one_line, wait_until
from serial.tools import list_ports
from stage_rigs import QUICK_HOMING

from emmc_rig.bench.device_config import parse_stage
from emmc_rig.bench.hardware import SIMULATED_SCALES, open_stage, probe_port
from emmc_rig.drivers.apt import ACTUATORS, AptAxis, AptStage
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.drivers.transport import SerialTransport
from emmc_rig.drivers.zaber import ZaberStage
from emmc_rig.errors import AppError
from emmc_rig.simulators.apt import Z825, AptController
from emmc_rig.simulators.grbl import BENCH_AXES, GrblController
from emmc_rig.simulators.wire import PtyServer
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

Z825_MOTOR = ACTUATORS["z825"]
PATIENCE_S = 20.0
QUICK = AxisSpec(max_speed_um_s=100_000.0, acceleration_um_s2=1e7, start_um=500.0)


@pytest.fixture
def run(run, monkeypatch):
    """Run `emmc-rig devices` in this process: exit code, standard output and standard error."""
    monkeypatch.setenv("COLUMNS", "150")
    return partial(run, "devices")


def usb_port(device, product):
    return SimpleNamespace(
        device=device,
        vid=0x0403,
        pid=product,
        serial_number="A1",
        description="FT232R",
        manufacturer="FTDI",
    )


@pytest.mark.parametrize("rig", ["simulated", "simulated:grbl", "simulated:apt"])
def test_a_simulated_stage_is_shown_homed_and_jogged(run, rig):
    code, out, _ = run("info", "--rig", rig)
    assert (code, "unknown" in out) == (0, True)
    code, out, _ = run("home", "--rig", rig)
    assert (code, "unknown" in out) == (0, False)
    axis = "mask_x" if rig == "simulated" else "x"
    place = -5000 if "grbl" in rig else 5000
    out = done(run("jog", "--rig", rig, "--home", "--to", "--speed", 900, axis, "--", place))
    assert abs(float(out.split()[2]) - place) < 1.0


@pytest.mark.parametrize("number", ["-1000", "-1e3", "-.5", "-0.25"])
def test_a_number_that_begins_with_a_minus_is_no_option(run, number):
    out = done(run("jog", "--rig", "simulated:grbl", "x", number, "--home"))
    assert float(out.split()[2]) == pytest.approx(-1000 + float(number), abs=2.6)
    code, _, err = run("jog", "--rig", "simulated:grbl", "x", number, "--hom")
    assert (code, "no such option" in err) == (2, True)


@pytest.mark.parametrize("place", [("-6000",), ("--", "-6000"), ("-6e3",)])
def test_a_negative_position_is_no_option_either(run, place):
    out = done(run("jog", "--rig", "simulated:grbl", "--home", "--to", "x", *place))
    assert float(out.split()[2]) == pytest.approx(-6000, abs=2.6)


def test_an_axis_that_is_not_homed_is_told_a_command_that_succeeds(run):
    code, _, err = run("jog", "--rig", "simulated:grbl", "x", -1000)
    assert code == 1
    advised = one_line(err).split("`")[1].split()
    assert advised[:2] == ["emmc-rig", "devices"]
    assert run(*advised[2:])[0] == 0


@pytest.fixture
def on_a_switch():
    """A Grbl on a port, whose axis X stands on the switch at the lower end of its travel."""
    axes = {"X": replace(QUICK, microstep_um=0.5, start_um=0.0), "Y": QUICK}
    device = GrblController(SYSTEM_CLOCK, axes, settings=QUICK_HOMING)
    with PtyServer(device) as server:
        yield device, f"grbl:{server.port}"


def advised(text):
    """Return what to type after `emmc-rig devices`, of each command in a text."""
    return [words.split() for words in re.findall(r"`emmc-rig devices ([^`]*)`", text)]


def test_every_advice_from_a_limit_switch_leads_off_it(run, on_a_switch):
    device, stage = on_a_switch
    code, _, err = run("home", "--stage", stage)
    assert (code, advised(err)) == (1, [["free", "x", "--stage", stage]])
    (free,) = advised(err)
    code, _, err = run(*free, "--yes")
    assert (code, "add --direction up at the lower end" in one_line(err)) == (1, True)
    assert device.position_um("X") == pytest.approx(0.0, abs=QUICK.backlash_um)
    out = done(run(*free, "--direction", "up", "--yes"))
    assert "+0.5 mm" in out
    assert device.position_um("X") == pytest.approx(500.0, abs=QUICK.backlash_um + 1)
    done(run(*advised(out)[0]))


def test_a_person_is_asked_for_the_direction_and_before_each_step(run, on_a_switch, monkeypatch):
    device, stage = on_a_switch
    for said, code in (("up\nn\n", 1), ("sideways\nup\ny\n", 0)):
        monkeypatch.setattr(sys, "stdin", io.StringIO(said))
        assert device.position_um("X") == pytest.approx(0.0, abs=QUICK.backlash_um)
        assert run("free", "x", "--stage", stage)[0] == code
    assert device.position_um("X") == pytest.approx(500.0, abs=QUICK.backlash_um + 1)


def test_a_jog_sees_the_pressed_switch_before_it_advises_homing(run, on_a_switch):
    stage = on_a_switch[1]
    code, _, err = run("jog", "x", -1000, "--stage", stage)
    assert (code, f"`emmc-rig devices free x --stage {stage}`" in one_line(err)) == (1, True)


def test_no_axis_is_moved_off_a_switch_that_is_not_pressed(run):
    out = done(run("free", "x", "--rig", "simulated:grbl"))
    assert "no pressed limit switch of x" in out
    code, _, err = run("free", "z", "--rig", "simulated:grbl")
    assert (code, "no axis 'z'" in one_line(err)) == (1, True)


def test_the_stages_of_a_rigs_file_are_those_of_its_captures(run, tmp_path):
    (tmp_path / "rig.yaml").write_text("stage: [simulated:grbl, simulated:apt]\ncamera: a\n")
    code, _, err = run("info", "--stage", "rig.yaml")
    assert (code, "two stages have an axis x" in one_line(err)) == (1, True)
    (tmp_path / "rig.yaml").write_text("stage: simulated:grbl\ncamera: simulated\n")
    assert "unknown" in done(run("info", "--stage", "rig.yaml"))
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench/rig.yaml").write_text("stage: stage.yaml\ncamera: simulated\n")
    (tmp_path / "bench/stage.yaml").write_text("{protocol: grbl, port: /dev/no-such-port}\n")
    code, _, err = run("info", "--stage", "bench/rig.yaml")
    assert code == 1
    assert "/dev/no-such-port" in err


@pytest.mark.slow
def test_a_real_port_works_alike(run):
    with PtyServer(ZaberChain(SYSTEM_CLOCK, {(1, 1): QUICK, (1, 2): QUICK})) as server:
        stage = f"zaber:{server.port},microstep_um=0.047625"
        assert "unknown" in run("info", "--stage", stage)[1]
        code, _, err = run("jog", "--stage", stage, "1.2", 100)
        assert (code, "home it in the same command" in one_line(err)) == (1, True)
        assert run("home", "--stage", stage, "1.2")[0] == 0
        out = done(run("jog", "--stage", stage, "1.2", 100))
        assert out.startswith("1.2 at 100.")
        out = run("info", "--stage", stage)[1]
        assert out.count("unknown") == 1


def test_names_are_wired_to_axes_in_a_file(run, tmp_path):
    with PtyServer(ZaberChain(SYSTEM_CLOCK, {(3, 1): QUICK}), tmp_path / "port") as _:
        wiring = {
            "protocol": "zaber",
            "port": f"{tmp_path}/por*",
            "axes": {"mask_x": [3, 1]},
            "microstep_um": 0.047625,
            "speeds_um_s": {"mask_x": 20_000},
            "soft_limits_um": {"mask_x": [100, 900]},
        }
        (tmp_path / "rig.yaml").write_text(yaml.safe_dump(wiring))
        assert run("home", "--stage", "rig.yaml")[0] == 0
        code, out, _ = run("info", "--stage", "rig.yaml")
        assert (code, "110 to 900" in out, "20000" in out) == (0, True, True)
        code, _, err = run("jog", "--stage", "rig.yaml", "mask_x", 901)
        assert (code, "choose 110 to 900 um" in one_line(err)) == (1, True)


@pytest.mark.slow
def test_apt_axes_may_be_on_ports_of_their_own(tmp_path):
    spec = replace(Z825, max_speed_um_s=50_000.0, acceleration_um_s2=1e6, start_um=150.0)
    first, second = (AptController(SYSTEM_CLOCK, {0x50: spec}) for _ in range(2))
    with PtyServer(first) as server_x, PtyServer(second) as server_y:
        wiring = {
            "protocol": "apt",
            "axes": {
                "mask_x": {"port": server_x.port, "actuator": "z825"},
                "mask_y": {"port": server_y.port, "actuator": "z812"},
            },
        }
        (tmp_path / "rig.yaml").write_text(yaml.safe_dump(wiring))
        with open_stage(str(tmp_path / "rig.yaml")) as stage:
            stage.home()
            stage.move_to_um({"mask_x": 500.0, "mask_y": 700.0})
            assert stage.limits_um("mask_y") == (10.0, 12_000.0)
    assert first.position_um() == pytest.approx(500.0, abs=0.1)
    assert second.position_um() == pytest.approx(700.0, abs=0.1)


def test_the_rigs_own_chain_gets_the_rigs_own_names():
    with (
        PtyServer(ZaberChain(SYSTEM_CLOCK)) as server,
        open_stage(f"zaber:{server.port}{SIMULATED_SCALES['zaber']}") as stage,
    ):
        assert stage.axes == ("mask_x", "mask_y", "aperture_x", "aperture_y")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("protocol", "firmware", "reported"),
    [
        ("zaber", ZaberChain, "axes 2"),
        ("grbl", GrblController, "version 1.1h"),
        ("apt", AptController, "KDC101, serial number 27000001"),
    ],
)
def test_probing_names_what_answers(run, protocol, firmware, reported):
    with PtyServer(firmware(SYSTEM_CLOCK)) as server:
        code, out, _ = run("probe", server.port)
    assert code == 0
    assert f"{server.port}: {protocol}: " in out
    assert reported in out


def test_probing_names_a_grbl_whose_numbers_cannot_be_read(run):
    device = GrblController(SYSTEM_CLOCK)
    device._coordinates = lambda position_mm, unit: "0;000,0;000,0;000"
    with PtyServer(device) as server:
        out = done(run("probe", server.port))
    assert "grbl: garbled reply" in out
    assert "'0;000' is not a number" in " ".join(out.split())


def test_probing_asks_a_known_adapter_in_its_own_protocol_only(monkeypatch):
    chain = ZaberChain(SYSTEM_CLOCK)
    asked = []
    chain.feed = lambda data: asked.append(data) or b""
    with PtyServer(chain) as server:
        adapter = usb_port(server.port, 0xFAF0)
        monkeypatch.setattr(list_ports, "comports", lambda: [adapter])
        assert probe_port(server.port) == ""
    assert asked
    assert all(data == bytes.fromhex("05 00 00 00 50 01") for data in asked)


def test_ports_are_listed_with_their_holder(run, monkeypatch):
    with PtyServer(ZaberChain(SYSTEM_CLOCK)) as server:
        port = usb_port(server.port, 0x6001)
        monkeypatch.setattr(list_ports, "comports", lambda: [port])
        held = SerialTransport(server.port)
        code, out, _ = run("list")
        held.close()
        assert code == 0
        for part in (server.port, "0403:6001", "A1", "FT232R", f"(pid {os.getpid()})"):
            assert part in " ".join(out.split())
    monkeypatch.setattr(list_ports, "comports", list)
    assert "no serial port" in run("list")[1]


def test_the_udev_rule_is_printed(run):
    code, out, _ = run("udev-rule")
    assert (code, out.splitlines()[-1]) == (0, 'LABEL="emmc_rig_end"')


@pytest.mark.parametrize(
    ("wiring", "reported"),
    [
        ({"protocol": "zaber", "port": "p", "axis": {}}, "did you mean 'axes'"),
        ({"protocol": "zaber", "port": "p", "microstep_um": -1}, "greater than 0"),
        ({"protocol": "zaber"}, "port"),
        ({"protocol": "grbl", "port": "p", "axes": {"x": "Q"}}, "axes.x"),
        ({"protocol": "apt", "axes": {"x": {"port": "p", "actuator": "z9"}}}, "use one of z806"),
        ({"port": "p"}, "protocol must be one of"),
    ],
)
def test_faults_of_a_stage_file_are_one_line(tmp_path, wiring, reported):
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(wiring))
    with pytest.raises(AppError, match=reported):
        parse_stage(str(path))


def test_a_setting_that_the_stage_cannot_have_is_one_line(tmp_path):
    with pytest.raises(AppError, match="loosen it"):
        open_stage("simulated:grbl", {"tolerance_um": 0.1})


def homed_zaber(clock=SYSTEM_CLOCK):
    spec = replace(QUICK, max_speed_um_s=2_000.0, acceleration_um_s2=1e5, start_um=50.0)
    chain = ZaberChain(clock, {(1, 1): spec})
    with ZaberStage(chain.transport(), {"x": (1, 1)}, spec.microstep_um, clock) as stage:
        stage.home()
    return chain, lambda: chain.position_um(1, 1), ["1.1", "20000"]


def homed_apt(clock=SYSTEM_CLOCK):
    device = AptController(clock, {0x50: replace(Z825, start_um=290.0)})
    settings = StageSettings(approach_um=0.0)
    with AptStage({"x": AptAxis(device.transport(), Z825_MOTOR)}, clock, settings) as stage:
        stage.home()
    return device, device.position_um, ["x", "20000"]


def fresh_grbl(clock=SYSTEM_CLOCK):
    spec = replace(BENCH_AXES["X"], max_speed_um_s=20_000.0, start_um=24_500.0)
    device = GrblController(clock, {"X": spec, "Y": spec}, settings={24: 600, 25: 1200, 110: 120})
    travel_um = spec.travel_um
    distance = ["--home", "x", "--", "-20000"]
    return device, lambda: travel_um - device.position_um("X"), distance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("protocol", "make", "number"),
    [
        ("zaber", homed_zaber, signal.SIGINT),
        ("apt", homed_apt, signal.SIGTERM),
        ("grbl", fresh_grbl, signal.SIGHUP),
    ],
)
def test_every_way_to_interrupt_a_move_stops_the_stage_and_leaves_it_stopped(
    protocol, make, number
):
    device, distance_um, jog = make()
    with PtyServer(device) as server:
        stage = f"{protocol}:{server.port}{SIMULATED_SCALES[protocol]}"
        command = [*PROGRAM, "devices", "jog", "--stage", stage, *jog]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            try:
                wait_until(lambda: distance_um() > 1500.0 or process.poll() is not None)
                process.send_signal(number)
                out, err = process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()
        assert (process.returncode, out) == (130, ""), err
        assert "the stage was stopped" in err
        assert "Traceback" not in err
        time.sleep(0.7)  # the slowest of them takes 0.6 s to come to rest
        stopped_um = distance_um()
        time.sleep(0.2)
        assert distance_um() == stopped_um
        assert 1500.0 < stopped_um < 19_000.0


def test_a_stage_that_vanishes_in_a_move_is_an_error_that_says_it_could_not_be_stopped(run):
    device, _, jog = homed_zaber()
    device.faults.inject("unplug", when=lambda occasion: b" move " in occasion.command)
    with PtyServer(device) as server:
        stage = f"zaber:{server.port}{SIMULATED_SCALES['zaber']}"
        code, _, err = run("jog", "--stage", stage, *jog)
    assert code == 1
    assert "went away" in one_line(err)
    assert "could not be stopped" in one_line(err)


def test_every_test_that_the_list_of_troubles_names_exists():
    root = Path(__file__).parents[2]
    named = set(re.findall(r"`(test_\w+)`", (root / "tests/drivers/README.md").read_text()))
    places = (root / "tests", root / "emmc_rig/bench/conformance")
    written = "".join(path.read_text() for place in places for path in place.rglob("*.py"))
    assert len(named) > 10
    assert [name for name in sorted(named) if f"def {name}(" not in written] == []


@pytest.mark.slow
def test_list_and_probe_know_the_simulated_rig(run):
    listed = done(run("list", "--rig", "simulated"))
    assert "ptp:S1" in listed
    assert "simulated:grbl" in listed
    for protocol, answer in (("zaber", "zaber: device 1"), ("grbl", "grbl: "), ("apt", "KDC101")):
        code, probed, reported = run("probe", "--rig", f"simulated:{protocol}")
        assert code == 0
        assert answer in probed
        assert reported == ""
    assert run("probe", "--rig", "mine")[0] == 2


def test_a_simulated_rig_has_a_camera_too(run, tmp_path):
    reported = done(run("snap", "--rig", "simulated", "--out", tmp_path / "snaps"))
    assert "frame-0001.dng: 240x320 rggb" in reported.replace("\n", "")
    assert (tmp_path / "snaps" / "frame-0001.dng").stat().st_size > 240 * 320
