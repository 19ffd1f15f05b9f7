"""USB: bytes pass whole whatever their packets, and every fault of the bus is one clear line."""

import array
import os

import pytest

from emmc_rig.drivers.errors import (
    UsbClaimedError,
    UsbGoneError,
    UsbNotFoundError,
    UsbPermissionError,
    UsbStalledError,
    UsbTimeoutError,
    UsbTransferError,
)
from emmc_rig.drivers.usb import BULK, INTERRUPT, find_holders, list_devices, open_device
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.usb import (
    DeviceSpec,
    EndpointSpec,
    InterfaceSpec,
    SimulatedUsb,
    StallError,
    UnpluggedError,
    UsbFunction,
)

KIND = (0xFF, 1, 2)
OUT, IN, EVENTS = 0x02, 0x81, 0x83


class Echo(UsbFunction):
    """Says what `messages` holds; keeps what it hears, at most `bite` bytes at a time."""

    def __init__(self, serial="E1", bite=1 << 20, empty_packets=True):
        self.spec = DeviceSpec(
            0x1234,
            0x5678,
            "EMMC",
            "Echo",
            serial,
            (
                InterfaceSpec(
                    KIND,
                    (EndpointSpec(OUT), EndpointSpec(IN), EndpointSpec(EVENTS, INTERRUPT, 64)),
                ),
            ),
        )
        self.messages, self.events, self.heard = [], [], []
        self.bite, self.empty_packets = bite, empty_packets
        self.powered = 0

    def plugged(self):
        self.powered += 1

    def bulk_out(self, endpoint, data):
        self.heard.append(data[: self.bite])
        return min(len(data), self.bite)

    def bulk_in(self, endpoint, length, timeout_s):
        if not self.messages:
            return None
        message = self.messages.pop(0)
        if isinstance(message, Exception):
            raise message
        return message

    def ends_with_empty_packet(self, endpoint):
        return self.empty_packets

    def interrupt(self, endpoint, length, timeout_s):
        return self.events.pop(0) if self.events else None

    def control(self, request_type, request, value, index, data):
        return bytes((request, value, index))


@pytest.fixture
def clock():
    return ManualClock()


@pytest.fixture
def echo():
    return Echo()


@pytest.fixture
def bus(clock, echo):
    return SimulatedUsb(clock, echo)


def pipes(bus):
    device = open_device(KIND, backend=bus)
    interface = device.claim(KIND)
    return device, interface.pipe(BULK, False), interface.pipe(BULK, True)


def test_a_device_is_listed_with_its_names(bus):
    (listing,) = list_devices(KIND, bus)
    assert (listing.maker, listing.model, listing.serial) == ("EMMC", "Echo", "E1")
    assert listing.name == "Echo 1234:5678 (bus 1, address 1)"


def test_a_device_is_chosen_by_its_serial_number(clock):
    bus = SimulatedUsb(clock, Echo("A"), Echo("B"))
    with open_device(KIND, serial="B", backend=bus) as device:
        assert device.listing.address == 2
    with pytest.raises(UsbNotFoundError, match=r"no camera with serial C .*serial A.*serial B"):
        open_device(KIND, serial="C", backend=bus, wanted="camera")


@pytest.mark.parametrize("size", [1, 511, 512, 513, 1024, 5000])
@pytest.mark.parametrize("room", [512, 1024, 8192])
def test_a_message_arrives_whole_in_transfers_of_any_room(bus, echo, size, room):
    message = os.urandom(size)
    echo.messages = [message]
    _, _, pipe = pipes(bus)
    got = b""
    while len(got) < size:
        got += pipe.read(room, 1.0)
    assert got == message


def test_an_empty_packet_ends_a_message_of_whole_packets(bus, echo):
    echo.messages = [bytes(512), b"next"]
    _, _, pipe = pipes(bus)
    assert pipe.read(1024, 1.0) == bytes(512)
    assert pipe.read(1024, 1.0) == b"next"


def test_without_empty_packets_two_messages_run_together(clock):
    echo = Echo(empty_packets=False)
    echo.messages = [bytes(512), b"next"]
    _, _, pipe = pipes(SimulatedUsb(clock, echo))
    assert pipe.read(1024, 1.0) == bytes(512) + b"next"


def test_a_transfer_cut_short_by_time_returns_what_came(clock):
    echo = Echo(empty_packets=False)
    echo.messages = [bytes(512)]
    _, _, pipe = pipes(SimulatedUsb(clock, echo))
    assert len(pipe.read(1024, 0.25)) == 512
    assert clock.now_s() == 0.25


def test_silence_is_a_timeout_that_costs_the_time_it_says(bus, clock):
    _, _, pipe = pipes(bus)
    with pytest.raises(UsbTimeoutError, match=r"silent for 0\.5 s"):
        pipe.read(512, 0.5)
    assert clock.now_s() == 0.5


def test_a_buffer_of_broken_packets_is_refused_before_it_can_overflow(bus):
    _, _, pipe = pipes(bus)
    with pytest.raises(ValueError, match="whole packets of 512"):
        pipe.read_into(array.array("B", bytes(100)), 1.0)


def test_a_device_that_takes_a_little_at_a_time_gets_everything(clock):
    echo = Echo(bite=700)
    _, pipe, _ = pipes(SimulatedUsb(clock, echo))
    data = os.urandom(2048)
    pipe.write(data, 1.0, end=True)
    assert b"".join(echo.heard) == data
    assert echo.heard[-1] == b""


def test_no_empty_packet_follows_a_short_one(bus, echo):
    _, pipe, _ = pipes(bus)
    pipe.write(bytes(513), 1.0, end=True)
    assert echo.heard == [bytes(513)]


def test_a_device_that_takes_nothing_is_a_timeout_that_says_how_far_it_came(clock):
    echo = Echo(bite=0)
    _, pipe, _ = pipes(SimulatedUsb(clock, echo))
    with pytest.raises(UsbTimeoutError) as caught:
        pipe.write(bytes(100), 0.5)
    assert caught.value.done == 0


def test_a_stall_lasts_until_it_is_cleared(bus, echo):
    echo.messages = [StallError(), b"again"]
    _, _, pipe = pipes(bus)
    for _ in range(2):
        with pytest.raises(UsbStalledError, match="endpoint 0x81"):
            pipe.read(512, 1.0)
    pipe.clear_halt()
    assert pipe.read(512, 1.0) == b"again"


def test_an_unplugged_device_is_gone_and_comes_back_at_another_address(bus, echo):
    echo.messages = [UnpluggedError()]
    device, _, pipe = pipes(bus)
    with pytest.raises(UsbGoneError, match="plug it in"):
        pipe.read(512, 1.0)
    with pytest.raises(UsbNotFoundError):
        open_device(KIND, backend=bus)
    device.close()
    bus.plug(echo)
    assert open_device(KIND, backend=bus).listing.address == 2
    with pytest.raises(UsbGoneError):
        pipe.read(512, 1.0)


def test_a_device_without_permission_names_the_rule_that_gives_it(bus, echo):
    bus.plug_of(echo).denied = True
    assert not list_devices(KIND, bus)[0].accessible
    with pytest.raises(UsbPermissionError, match=r"99-emmc-rig\.rules"):
        open_device(KIND, backend=bus)


def processes(folder, holder, pid):
    """A /proc in which a program holds device 1 of bus 1."""
    (folder / str(pid) / "fd").mkdir(parents=True)
    (folder / str(pid) / "comm").write_text(holder + "\n")
    (folder / str(pid) / "fd" / "3").symlink_to("/dev/null")
    (folder / str(pid) / "fd" / "7").symlink_to("/dev/bus/usb/001/001")
    return folder


@pytest.mark.parametrize(
    ("holder", "advice"),
    [
        ("gvfs-gphoto2-vo", "systemctl --user stop gvfs-gphoto2"),
        ("gphoto2", "end gphoto2"),
        ("stranger", "close that program"),
    ],
)
def test_a_claimed_device_is_reported_with_its_holder_and_how_to_free_it(
    bus, echo, tmp_path, holder, advice
):
    bus.plug_of(echo).claims[0] = "desktop"
    proc = processes(tmp_path, holder, 4321)
    device = open_device(KIND, backend=bus, proc=proc)
    with pytest.raises(UsbClaimedError, match=advice) as caught:
        device.claim(KIND)
    assert "\n" not in str(caught.value)
    assert caught.value.holders == (f"{holder} (process 4321)",)
    bus.plug_of(echo).claims.clear()
    device.claim(KIND)


def test_a_claimed_device_whose_holder_is_hidden_names_the_desktop(bus, echo, tmp_path):
    bus.plug_of(echo).claims[0] = "desktop"
    with pytest.raises(UsbClaimedError, match=r"another program.*file manager"):
        open_device(KIND, backend=bus, proc=tmp_path).claim(KIND)


def test_this_program_is_not_among_the_holders(tmp_path):
    assert find_holders(1, 1, processes(tmp_path, "me", os.getpid())) == ()


def test_the_second_to_claim_is_refused(bus):
    with open_device(KIND, backend=bus) as first:
        first.claim(KIND)
        with pytest.raises(UsbClaimedError):
            open_device(KIND, backend=bus).claim(KIND)
    open_device(KIND, backend=bus).claim(KIND)


def test_the_kernels_driver_is_put_aside_and_comes_back(bus, echo):
    bus.plug_of(echo).kernel_driver = True
    with open_device(KIND, backend=bus) as device:
        device.claim(KIND)
        assert not bus.plug_of(echo).kernel_driver
    assert bus.plug_of(echo).kernel_driver


def test_what_is_under_way_can_be_drained(bus, echo):
    echo.messages = [bytes(700), bytes(512)]
    _, _, pipe = pipes(bus)
    assert pipe.drain() == 1212


def test_a_device_that_never_falls_silent_is_an_error(bus, echo):
    echo.bulk_in = lambda endpoint, length, timeout_s: bytes(512)
    _, _, pipe = pipes(bus)
    with pytest.raises(UsbTransferError, match="never falls silent"):
        pipe.drain(most=1 << 20)


def test_a_closed_device_is_gone_and_may_be_closed_again(bus):
    device, pipe, _ = pipes(bus)
    device.close()
    device.close()
    with pytest.raises(UsbGoneError):
        pipe.write(b"x", 1.0)


def test_an_interface_or_pipe_that_is_missing_is_named(bus):
    device = open_device(KIND, backend=bus)
    with pytest.raises(UsbNotFoundError, match="class 06/01/01"):
        device.claim((6, 1, 1))
    with pytest.raises(UsbNotFoundError, match="interrupt out endpoint"):
        device.claim(KIND).pipe(INTERRUPT, False)
