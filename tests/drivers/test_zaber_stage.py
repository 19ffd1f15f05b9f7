"""The Zaber stage against simulated firmware; `tests/conformance` has it on every wire."""

import errno
from dataclasses import replace

import pytest
import serial

from emmc_rig.drivers.errors import (
    CommandRefusedError,
    EmergencyStopError,
    GarbledReplyError,
    LimitExceededError,
    LostPositionError,
    NotHomedError,
    PortGoneError,
    TransportTimeoutError,
)
from emmc_rig.drivers.stage import (
    DEFAULT_SETTINGS,
    Stage,
    StageSettings,
)
from emmc_rig.drivers.transport import SerialTransport
from emmc_rig.drivers.zaber import ZaberStage, find_devices
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.wire import MemoryTransport, PtyServer
from emmc_rig.simulators.zaber import BENCH_AXES, AxisSpec, ZaberChain

AXES = {"mask_x": (1, 1), "mask_y": (1, 2), "aperture_x": (2, 1), "aperture_y": (2, 2)}
SPEC = AxisSpec()
MICROSTEP_UM = SPEC.microstep_um
TIMEOUT_S = 0.15


class Bench:
    """A simulated chain, the wire to it, and what the wire carried."""

    def __init__(self, axes=BENCH_AXES):
        self.clock = ManualClock()
        self.chain = ZaberChain(self.clock, axes)
        self.transport = self.chain.transport(TIMEOUT_S)
        self.sent = []
        self._feed = self.chain.feed
        self.chain.feed = self._record

    def _record(self, data):
        self.sent += data.decode("ascii").splitlines()
        return self._feed(data)

    def stage(self, settings=DEFAULT_SETTINGS, **arguments) -> Stage:
        options = {"axes": AXES, "microstep_um": MICROSTEP_UM, "clock": self.clock} | arguments
        return ZaberStage(self.transport, settings=settings, **options)

    def stops_sent(self):
        return [line for line in self.sent if " stop" in line]


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def stage(bench):
    homed = bench.stage()
    homed.home()
    bench.sent.clear()
    return homed


def test_homing_one_axis_leaves_the_others_where_they_are(bench):
    stage = bench.stage()
    stage.home(["mask_y"])
    assert stage.is_homed("mask_y")
    assert not stage.is_homed("mask_x")
    assert bench.chain.position_um(1, 1) == SPEC.start_um


def test_axes_that_move_together_take_as_long_as_the_longest(stage, bench):
    start_s = bench.clock.now_s()
    stage.move_to_um({"mask_x": 7000.0, "mask_y": 7000.0, "aperture_x": 7000.0})
    ideal_s = 7000.0 / SPEC.max_speed_um_s + SPEC.max_speed_um_s / SPEC.acceleration_um_s2
    settings = DEFAULT_SETTINGS
    assert ideal_s <= bench.clock.now_s() - start_s <= ideal_s + 2 * settings.poll_s + 0.05


def test_limits_leave_room_for_the_approach_and_obey_soft_limits(bench):
    stage = bench.stage(StageSettings(soft_limits_um={"mask_y": (100.0, 900.0)}))
    low_um, high_um = stage.limits_um("mask_x")
    assert low_um == 10.0
    assert high_um == pytest.approx(SPEC.travel_um, abs=MICROSTEP_UM)
    assert stage.limits_um("mask_y") == (110.0, 900.0)


@pytest.mark.parametrize("target_um", [9.9, 25_401.0, float("nan"), float("inf")])
def test_one_target_beyond_the_limits_and_nothing_is_sent(stage, bench, target_um):
    with pytest.raises(LimitExceededError, match="mask_y cannot go"):
        stage.move_to_um({"mask_x": 500.0, "mask_y": target_um})
    assert bench.sent == []


@pytest.mark.parametrize("fault", ["drop_command", "drop_reply", "garble_reply"])
def test_homing_is_asked_for_again_when_the_answer_is_lost(bench, fault):
    stage = bench.stage()
    strike_at_first(bench, fault, " home")
    stage.home(["mask_x"])
    assert stage.is_homed("mask_x")
    assert len([line for line in bench.sent if " home" in line]) == 2


def test_alerts_between_command_and_reply_are_tolerated(bench):
    stage = bench.stage()
    for device in (1, 2):
        bench.chain.feed(b"/%d 0 set comm.alert 1\n" % device)
    stage.home()
    read_um = stage.move_to_um({"mask_x": 300.0, "mask_y": 400.0})
    assert read_um["mask_y"] == pytest.approx(400.0, abs=MICROSTEP_UM)


def test_a_device_that_is_not_there_shows_at_construction(bench):
    with pytest.raises(TransportTimeoutError):
        bench.stage(axes={"focus": (7, 1)})


def test_an_axis_the_device_does_not_have_shows_at_construction(bench):
    with pytest.raises(CommandRefusedError, match="check the axis numbers") as caught:
        bench.stage(axes={"focus": (1, 5)})
    assert (caught.value.reply, caught.value.axis) == ("BADAXIS", "focus")


def test_waiting_until_settled_outlasts_a_move_that_something_else_started(stage, bench):
    bench.chain.feed(b"/1 1 move abs 20000\n")
    stage.wait_until_settled(["mask_x"])
    assert stage.position_um("mask_x") == pytest.approx(20000 * MICROSTEP_UM)


@pytest.mark.parametrize(
    "stale", [b"@01 1 00 OK IDLE -- 77", b"@02 1 99 OK IDLE -- 7", b"#01 0 hi"]
)
def test_a_reply_to_another_message_is_not_taken_for_ours(stage, bench, stale):
    feed = bench.chain.feed
    bench.chain.feed = lambda data: with_checksum(stale) + feed(data)
    assert stage.position_um("mask_x") == 0.0


def test_a_reply_without_the_promised_checksum_is_not_believed(stage, bench):
    feed = bench.chain.feed
    bench.chain.feed = lambda data: feed(data).partition(b":")[0] + b"\r\n"
    with pytest.raises(GarbledReplyError, match="missing"):
        stage.position_um("mask_x")


def test_an_operating_system_error_on_the_port_means_that_it_is_gone(monkeypatch):
    with PtyServer(ZaberChain(ManualClock())) as server:
        transport = SerialTransport(server.port)

        def fail(self, data):
            raise OSError(errno.EIO, "Input/output error")

        monkeypatch.setattr(serial.Serial, "write", fail)
        with pytest.raises(PortGoneError):
            transport.write(b"/\n")
        transport.close()


def test_bytes_of_an_incomplete_answer_wait_for_the_rest():
    class Halves:
        unplugged = False
        plugs = 1
        answers = iter([b"@01 1 10 OK", b" IDLE -- 0\r\n"])

        def feed(self, data):
            return next(self.answers)

        def due(self):
            return b""

        def next_due_s(self):
            return None

    transport = MemoryTransport(Halves(), ManualClock())
    transport.write(b"/\n")
    with pytest.raises(TransportTimeoutError) as caught:
        transport.read_until(b"\n")
    assert caught.value.partial == b"@01 1 10 OK"
    transport.write(b"/\n")
    assert transport.read_until(b"\n") == b"@01 1 10 OK IDLE -- 0\r\n"


def test_an_emergency_stop_is_named_and_homing_enables_the_motors_again(stage, bench):
    strike_at_first(bench, "emergency_stop", " move ")
    with pytest.raises((EmergencyStopError, CommandRefusedError)) as caught:
        stage.move_to_um({"mask_x": 5000.0})
    assert "release the" in str(caught.value)
    with pytest.raises(EmergencyStopError, match="make the bench safe") as caught:
        stage.wait_until_settled(["mask_x"])
    assert caught.value.reply == "FH"
    with pytest.raises(NotHomedError):
        stage.move_to_um({"mask_x": 5000.0})
    stage.home()
    stage.move_to_um({"mask_x": 5000.0})


def test_an_axis_that_was_pushed_has_lost_its_position(stage, bench):
    stage.move_to_um({"mask_x": 700.0})
    bench.chain.displace(1, 1, 25.0)
    with pytest.raises(LostPositionError, match="displaced while it stood still"):
        stage.move_to_um({"mask_x": 800.0})
    with pytest.raises(NotHomedError):
        stage.position_um("mask_x")
    stage.home(["mask_x"])
    stage.move_to_um({"mask_x": 800.0})
    assert bench.chain.position_um(1, 1) == pytest.approx(800.0, abs=MICROSTEP_UM)


def test_a_target_that_the_firmware_refuses_is_not_success(stage, bench):
    bench.chain.feed(b"/1 1 set limit.max 20000\n")
    with pytest.raises(CommandRefusedError, match="check units and limits") as caught:
        stage.move_to_um({"mask_x": 5000.0})
    assert (caught.value.axis, caught.value.reply) == ("mask_x", "BADDATA")
    assert caught.value.command.startswith("move abs ")
    assert bench.chain.position_um(1, 1) == pytest.approx(0.0, abs=SPEC.backlash_um)


def test_firmware_without_checksums_is_read_twice(bench):
    feed = bench.chain.feed
    answers = []

    def no_checksum(data):
        if b"comm.checksum" in data:
            data = data.replace(b"comm.checksum", b"comm.chexksum").partition(b":")[0] + b"\n"
        answer = feed(data)
        answers.append(answer)
        return answer.partition(b":")[0] + b"\r\n" if answer else answer

    bench.chain.feed = no_checksum
    stage = bench.stage()
    stage.home(["mask_x"])
    answers.clear()
    assert stage.position_um("mask_x") == 0.0
    assert len(answers) == 2


def test_devices_are_found_with_their_axes(bench):
    found = find_devices(bench.transport, bench.clock)
    assert [(device.address, device.axis_count) for device in found] == [(1, 2), (2, 2)]
    assert found[0].serial_number != found[1].serial_number
    assert found[0].firmware == "7.38"


def test_nothing_distinguishes_two_devices_with_one_address():
    clock = ManualClock()
    first, second = ZaberChain(clock, {(1, 1): SPEC}), ZaberChain(clock, {(1, 1): SPEC})
    feed = first.feed
    first.feed = lambda data: feed(data) + second.feed(data)
    with pytest.raises(GarbledReplyError, match="renumber them"):
        find_devices(first.transport(), clock)


def test_homing_is_given_time_for_its_own_slower_speed():
    bench = Bench({(1, 1): replace(SPEC, start_um=25_000.0)})
    bench.chain.feed(b"/1 1 set limit.approach.maxspeed 10000\n")
    stage = bench.stage(axes={"mask_x": (1, 1)})
    start_s = bench.clock.now_s()
    stage.home()
    # 25 mm at 10000 / 1.6384 microsteps/s take 86 s
    assert bench.clock.now_s() - start_s == pytest.approx(86.0, abs=1.0)
    assert stage.is_homed("mask_x")


def strike_at_first(bench, fault, words):
    """Arm the fault just before the first command that contains `words` reaches the firmware."""
    feed = bench.chain.feed
    armed = []

    def watch(data):
        if words in data.decode("ascii") and not armed:
            armed.append(True)
            bench.chain.faults.inject(fault)
        return feed(data)

    bench.chain.feed = watch


def with_checksum(message):
    """Return the message as it goes over the wire, with the checksum its body asks for."""
    return message + b":%02X\r\n" % (-sum(message[1:]) & 0xFF)
