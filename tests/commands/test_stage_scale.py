"""An axis whose scale is unknown, or contradicted, never moves; one that is known goes there."""

import io
from dataclasses import replace

import pytest
import yaml

from drivers.apt import ACTUATORS
from drivers.clock import SYSTEM_CLOCK
from drivers.errors import ScaleError, SpeedLimitError
from drivers.grbl import FACTORY_STEPS_PER_MM, GrblStage
from drivers.stage import StageSettings
from drivers.zaber import ZaberStage
from emmc_rig.bench.hardware import open_stage
from emmc_rig.bench.stage_config import parse_stage
from emmc_rig.commands.stage_scale import fit_step_length, measure, scale_settings
from emmc_rig.errors import AppError
from simulators.clock import ManualClock
from simulators.grbl import BENCH_AXES, GrblController
from simulators.wire import PtyServer
from simulators.zaber import AxisSpec, ZaberChain

COARSE = AxisSpec(travel_um=150_000.0, microstep_um=0.49609375, backlash_um=0.0)
"""The X-LSQ150B, ten times as coarse as the usual screw; no table here has its id."""
LSQ150A = replace(COARSE, microstep_um=0.09921875)
LHM = replace(COARSE, microstep_um=0.1240234375)
AXES = {"x": (1, 1)}
SLOPPY = StageSettings(approach_um=0.0)


def chain(spec, **identity):
    return ZaberChain(ManualClock(), {(1, 1): spec}, **identity)


def stage(device, *arguments, **options):
    return ZaberStage(
        device.transport(), AXES, *arguments, clock=device._clock, settings=SLOPPY, **options
    )


def is_sent_home_and_to(device, opened, target_um):
    opened.home()
    assert opened.move_to_um({"x": target_um})["x"] == pytest.approx(target_um, abs=0.5)
    assert device.position_um(1, 1) == pytest.approx(target_um, abs=0.5)


def test_an_unknown_model_is_refused_before_any_byte_of_motion():
    device = chain(COARSE)
    sent = []
    feed = device.feed
    device.feed = lambda data: sent.append(data) or feed(data)
    with pytest.raises(ScaleError, match=r"device id 65535.*resolution 64.*devices scale"):
        stage(device)
    assert sent
    assert all(b" get " in data or b" set comm." in data for data in sent)
    assert device.position_um(1, 1) == COARSE.start_um


@pytest.mark.parametrize(
    ("spec", "identity"),
    [
        (LSQ150A, {"models": {1: 50105}}),
        (LHM, {"models": {1: 50081}}),
        (LHM, {"models": {1: 30342}, "peripherals": {(1, 1): 43211}}),
    ],
)
@pytest.mark.parametrize("resolution", [64, 16, 256])
def test_a_known_model_goes_where_it_is_sent_at_any_resolution(spec, identity, resolution):
    device = chain(spec, **identity)
    device.feed(b"/1 1 set resolution %d\n" % resolution)
    opened = stage(device)
    assert opened.resolution("x") == resolution
    is_sent_home_and_to(device, opened, 5_000.0)


def test_a_stated_scale_serves_where_the_model_is_unknown():
    device = chain(COARSE)
    is_sent_home_and_to(device, stage(device, COARSE.microstep_um), 5_000.0)


def test_a_stated_scale_that_the_model_contradicts_is_refused():
    with pytest.raises(ScaleError, match=r"0.496094 um.*X-LSQ150A.*0.0992187 um"):
        stage(chain(LSQ150A, models={1: 50105}), 0.49609375)


def test_modified_hardware_is_not_taken_for_its_model():
    device = chain(COARSE, models={1: 50105}, modified={1})
    with pytest.raises(ScaleError, match="modified hardware"):
        stage(device)
    is_sent_home_and_to(device, stage(device, COARSE.microstep_um), 5_000.0)


def test_a_rotary_stage_is_refused_by_name_whatever_is_stated():
    device = chain(COARSE, models={1: 30342}, peripherals={(1, 1): 46657})
    with pytest.raises(ScaleError, match="a rotary stage"):
        stage(device, 1.0)


def test_a_scale_stated_for_another_resolution_is_refused_also_after_a_reconnect():
    device = chain(COARSE)
    opened = stage(device, COARSE.microstep_um, resolution=64)
    device.feed(b"/1 1 set resolution 128\n")
    with pytest.raises(ScaleError, match="stated for resolution 64, but it has 128"):
        opened.reconnect()
    with pytest.raises(ScaleError, match="set resolution 64"):
        stage(device, COARSE.microstep_um, resolution=64)


def test_the_fastest_speed_is_what_the_firmware_steps_or_what_was_stated():
    device = chain(LSQ150A, models={1: 50105})
    opened = stage(device)
    full_step_um = 1_270.0 / 200  # its screw has 1.27 mm a turn
    assert opened.top_speed_um_s("x") == pytest.approx(1e4 * full_step_um)
    with pytest.raises(SpeedLimitError):
        opened.set_speed_um_s("x", 1.01e4 * full_step_um)
    opened.set_speed_um_s("x", 0.99e4 * full_step_um)
    slow = replace(SLOPPY, top_speeds_um_s={"x": 3_000.0})
    opened = ZaberStage(device.transport(), AXES, clock=device._clock, settings=slow)
    assert opened.speed_um_s("x") == pytest.approx(3_000.0, rel=1e-3)
    with pytest.raises(SpeedLimitError, match="up to 3000"):
        opened.set_speed_um_s("x", 3_001.0)


def grbl(real_steps_per_mm, **options):
    clock = ManualClock()
    spec = replace(BENCH_AXES["X"], microstep_um=1e3 / real_steps_per_mm)
    device = GrblController(clock, dict.fromkeys("XYZ", spec))
    settings = StageSettings(tolerance_um=5.0)
    return GrblStage(device.transport(), {"x": "X"}, clock, settings, **options)


def test_grbls_factory_scale_counts_as_never_set_until_it_is_confirmed():
    with pytest.raises(ScaleError, match=r"\$100=250 steps per mm is the firmware's default"):
        grbl(FACTORY_STEPS_PER_MM)
    assert grbl(FACTORY_STEPS_PER_MM, steps_per_mm={"x": 250.0}).steps_per_mm("x") == 250.0
    assert grbl(800.0).steps_per_mm("x") == 800.0


def test_a_stated_scale_that_grbl_contradicts_is_refused():
    with pytest.raises(ScaleError, match=r"send it `\$100=400`"):
        grbl(800.0, steps_per_mm={"x": 400.0})


def test_an_apt_axis_without_an_actuator_is_refused():
    with pytest.raises(AppError, match="x must not move, its actuator is not stated"):
        parse_stage("apt:/dev/ttyUSB0")
    with open_stage("simulated:apt") as opened:
        assert opened.top_speed_um_s("x") == ACTUATORS["z825"].top_speed_um_s == 2_600.0


@pytest.mark.parametrize(
    ("spec", "reported"),
    [
        ("zaber:/dev/ttyUSB0,microstep_um", "write NAME=VALUE"),
        ("zaber:/dev/ttyUSB0,microstep=1", "did you mean 'microstep_um'"),
        ("zaber:/dev/ttyUSB0,microstep_um=-1", "greater than 0"),
        ("apt:/dev/ttyUSB0,actuator=z9", "use one of z806"),
    ],
)
def test_faults_of_settings_behind_a_port_are_one_line(spec, reported):
    with pytest.raises(AppError, match=reported):
        parse_stage(spec)


def test_settings_behind_a_port_are_those_of_a_file(tmp_path):
    (tmp_path / "rig.yaml").write_text(
        yaml.safe_dump({"protocol": "zaber", "port": "p", "microstep_um": 0.5, "settle_s": 1})
    )
    assert parse_stage("zaber:p,microstep_um=0.5,settle_s=1") == parse_stage(
        str(tmp_path / "rig.yaml")
    )


def test_a_ruler_measures_the_step_that_nobody_knew():
    device = chain(COARSE)
    opened = stage(device, in_microsteps=True)
    opened.home(["x"])
    steps, readings = measure(opened, "x", 20_000, 5, lambda _: device.position_um(1, 1) + 77.0)
    assert max(steps) - min(steps) == pytest.approx(20_000, abs=1)
    found = fit_step_length(steps, readings)
    assert found.um_per_step == pytest.approx(COARSE.microstep_um, rel=1e-5)
    assert not found.reversed
    assert scale_settings(parse_stage("zaber:p"), opened, "x", found.um_per_step) == {
        "microstep_um": {"x": pytest.approx(0.496094)},
        "resolution": {"x": 64},
    }


@pytest.mark.parametrize(
    ("steps", "readings", "reported"),
    [
        ([0, 100], [0, 1], "read at least 3"),
        ([5, 5, 5], [0, 1, 2], "do not differ"),
        ([0, 100, 200], [0, float("nan"), 2], "no number"),
        ([0, 100, 200, 300], [3, 0, 2, 1], "do not follow the axis"),
    ],
)
def test_readings_that_measure_nothing_are_refused(steps, readings, reported):
    with pytest.raises(AppError, match=reported):
        fit_step_length(steps, readings)


@pytest.fixture
def quick_port():
    spec = replace(COARSE, travel_um=25_000.0, max_speed_um_s=90_000.0, acceleration_um_s2=1e7)
    with PtyServer(ZaberChain(SYSTEM_CLOCK, {(1, 1): spec})) as server:
        yield server.port


@pytest.mark.slow
def test_the_command_asks_then_measures_and_writes_a_file_that_opens_the_stage(
    run, quick_port, monkeypatch, tmp_path
):
    port = f"zaber:{quick_port}"
    assert run("devices", "info", "--stage", port)[0] == 1
    monkeypatch.setattr("sys.stdin", io.StringIO("n\n"))
    assert run("devices", "scale", "1.1", 10_000, "--stage", port)[0] == 1
    answers = ["y", *(f"{100 + 2480.47 * number:.0f}" for number in range(3))]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(answers) + "\n"))
    command = ("scale", "1.1", 10_000, "--stage", port, "--places", 3, "--out", "rig.yaml")
    code, out, err = run("devices", *command)
    assert code == 0, err
    assert "0.4961 um a count" in out
    written = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert written["microstep_um"] == {"1.1": 0.4961}
    assert written["resolution"] == {"1.1": 64}
    assert run("devices", "info", "--stage", "rig.yaml")[0] == 0
    code, _, err = run("devices", *command)
    assert (code, "exists: name another file" in err) == (1, True)


@pytest.mark.parametrize(
    ("arguments", "code", "reported"),
    [
        (["1.1", 5], 1, "too few"),
        (["1.1", 10**9, "--yes"], 1, "counts of travel"),
        (["mask_x", 500, "--yes"], 1, "use one of 1.1"),
    ],
)
def test_a_wrong_call_of_scale_is_one_line(run, quick_port, arguments, code, reported):
    result = run("devices", "scale", *arguments, "--stage", f"zaber:{quick_port}")
    assert result[0] == code
    assert reported in result[2]
