"""An axis of unknown or contradicted scale never moves; any other goes to its target."""

from dataclasses import replace

import pytest
import yaml

from emmc_rig.bench.device_config import parse_stage
from emmc_rig.bench.hardware import open_stage
from emmc_rig.drivers.apt import ACTUATORS
from emmc_rig.drivers.errors import ScaleError, SpeedLimitError
from emmc_rig.drivers.grbl import FACTORY_STEPS_PER_MM, GrblStage
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.drivers.zaber import ZaberStage
from emmc_rig.errors import AppError
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.grbl import BENCH_AXES, GrblController
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

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
    with pytest.raises(ScaleError, match=r"device id 65535.*resolution 64.*Zaber Launcher"):
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
