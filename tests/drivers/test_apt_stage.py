"""What is APT's own: no acknowledgements, no checksums, bays, complaints and status bits."""

import pytest

from emmc_rig.drivers import apt_codec as codec
from emmc_rig.drivers.apt import ACTUATORS, AptAxis, AptStage
from emmc_rig.drivers.apt_codec import Id, StatusBit
from emmc_rig.drivers.errors import (
    AxisFaultError,
    CommandRefusedError,
    DriverError,
    LimitSwitchError,
    LostPositionError,
    NotHomedError,
    TransportTimeoutError,
)
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.simulators.apt import HOME_OFFSET_UM, Z825, AptController
from emmc_rig.simulators.clock import ManualClock

Z825_MOTOR = ACTUATORS["z825"]
PLAIN = StageSettings(approach_um=0.0)


class Bench:
    def __init__(self, bays=None, swapped=False):
        self.clock = ManualClock()
        self.device = AptController(self.clock, bays, swapped)
        self.transport = self.device.transport()

    def stage(self, settings=PLAIN, **axes):
        return AptStage(axes or {"x": AptAxis(self.transport, Z825_MOTOR)}, self.clock, settings)

    def homed(self, settings=PLAIN):
        stage = self.stage(settings)
        stage.home()
        return stage

    def ask(self, question, answer, param1=1):
        """Send a message as another program would; return the answer."""
        reported = self.device.feed(codec.encode(question, codec.USB_UNIT, param1))
        messages = []
        while reported:
            length = codec.HEADER_SIZE + codec.data_length(reported[: codec.HEADER_SIZE])
            messages.append(codec.decode(reported[:length]))
            reported = reported[length:]
        return next(message for message in messages if message.id == answer)


@pytest.fixture
def bench():
    return Bench()


def test_homing_ends_above_the_switch_by_the_offset(bench):
    bench.homed()
    assert bench.device.position_um() == pytest.approx(0.0, abs=0.05)
    status = codec.decode_status(bench.ask(Id.MOT_REQ_DCSTATUSUPDATE, Id.MOT_GET_DCSTATUSUPDATE))
    assert status.bits & StatusBit.HOMED
    assert not status.bits & codec.LIMIT_SWITCHES


def test_homing_again_does_not_believe_the_bit_of_the_last_time(bench):
    stage = bench.homed()
    bench.device.faults.inject(
        "drop_command",
        when=lambda occasion: occasion.command[:2] == b"\x43\x04",
    )
    with pytest.raises(LostPositionError, match="homing never began") as caught:
        stage.home()
    assert caught.value.command == "MOT_MOVE_HOME"
    assert not stage.is_homed("x")
    with pytest.raises(NotHomedError):
        stage.move_to_um({"x": 500.0})


@pytest.mark.parametrize("swapped", [False, True])
def test_a_controller_that_swaps_destination_and_source_is_understood(swapped):
    bench = Bench(swapped=swapped)
    stage = bench.homed()
    assert stage.move_to_um({"x": 1000.0})["x"] == pytest.approx(1000.0, abs=0.1)


def test_bays_of_a_rack_are_axes_of_one_port():
    bench = Bench({0x21: Z825, 0x22: Z825})
    stage = bench.stage(
        x=AptAxis(bench.transport, Z825_MOTOR, destination=0x21),
        y=AptAxis(bench.transport, Z825_MOTOR, destination=0x22),
    )
    stage.home()
    stage.move_to_um({"x": 1000.0, "y": 2000.0})
    assert bench.device.position_um(0x21) == pytest.approx(1000.0, abs=0.1)
    assert bench.device.position_um(0x22) == pytest.approx(2000.0, abs=0.1)


def test_controllers_on_ports_of_their_own_are_one_stage():
    first, second = Bench(), Bench()
    second.clock = first.clock
    second.device = AptController(first.clock)
    axes = {
        "x": AptAxis(first.transport, Z825_MOTOR),
        "y": AptAxis(second.device.transport(), Z825_MOTOR),
    }
    stage = AptStage(axes, first.clock, PLAIN)
    stage.home()
    stage.move_to_um({"x": 700.0, "y": 900.0})
    assert first.device.position_um() == pytest.approx(700.0, abs=0.1)
    assert second.device.position_um() == pytest.approx(900.0, abs=0.1)


def test_a_position_that_a_flipped_bit_made_is_not_believed(bench):
    stage = bench.homed()
    stage.move_to_um({"x": 1000.0})
    for bit in range(10):
        bench.device.faults.inject("garble_reply")
        try:
            read_um = stage.position_um("x")
        except DriverError:
            continue
        assert read_um == pytest.approx(1000.0, abs=0.1), bit


def test_a_motor_that_is_not_connected_is_a_complaint_with_its_words(bench):
    stage = bench.homed()
    bench.device.faults.inject("motor_unplugged")
    with pytest.raises(CommandRefusedError, match="motor not connected") as caught:
        stage.move_to_um({"x": 5000.0})
    assert caught.value.command == "MOT_MOVE_ABSOLUTE"
    assert caught.value.axis == "x"


def test_a_limit_switch_short_of_the_target_is_named_and_not_success(bench):
    short = Bench({codec.USB_UNIT: Z825.__class__(**{**vars(Z825), "travel_um": 9_000.0})})
    stage = short.homed()
    with pytest.raises(LimitSwitchError, match="limit switch reached"):
        stage.move_to_um({"x": 12_000.0})
    assert short.device.position_um() == pytest.approx(9_000.0 - HOME_OFFSET_UM, abs=0.1)
    assert not stage.is_homed("x")


def test_a_channel_that_was_switched_off_is_a_fault(bench):
    stage = bench.homed()
    bench.device.feed(codec.encode(Id.MOD_SET_CHANENABLESTATE, codec.USB_UNIT, 1, codec.DISABLE))
    with pytest.raises((AxisFaultError, CommandRefusedError)):
        stage.move_to_um({"x": 500.0})
    stage.home()
    stage.move_to_um({"x": 500.0})


def test_the_controllers_own_backlash_correction_is_off(bench):
    bench.device.feed(
        codec.encode(Id.MOT_SET_GENMOVEPARAMS, codec.USB_UNIT, data=codec.encode_position(1, 3000))
    )
    bench.stage()
    reported = bench.ask(Id.MOT_REQ_GENMOVEPARAMS, Id.MOT_GET_GENMOVEPARAMS)
    assert reported.data == codec.encode_position(1, 0)


def test_updates_that_nobody_asked_this_driver_for_do_no_harm(bench):
    stage = bench.homed()
    bench.device.feed(codec.encode(Id.HW_START_UPDATEMSGS, codec.USB_UNIT))
    for target_um in (500.0, 4000.0, 20.0):
        stage.move_to_um({"x": target_um})
        assert bench.device.position_um() == pytest.approx(target_um, abs=3.1)


def test_a_speed_reaches_the_controller_in_its_own_units(bench):
    stage = bench.stage()
    stage.set_speed_um_s("x", 1000.0)
    reported = codec.decode_velocity(bench.ask(Id.MOT_REQ_VELPARAMS, Id.MOT_GET_VELPARAMS))
    assert reported.maximum == 767_367
    assert stage.speed_um_s("x") == pytest.approx(1000.0, rel=1e-5)


def test_a_controller_that_is_not_there_shows_at_construction(bench):
    rack = Bench({0x21: Z825, 0x22: Z825})
    with pytest.raises(TransportTimeoutError) as caught:
        rack.stage(z=AptAxis(rack.transport, Z825_MOTOR, destination=0x25))
    assert (caught.value.axis, caught.value.command) == ("z", "MOT_REQ_VELPARAMS")
