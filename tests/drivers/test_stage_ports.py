"""Ports: an adapter is found under a new name, a refusal names the holder, every wait ends."""

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest
import serial
from serial.tools import list_ports
from stage_rigs import JumpingClock
from tcp_server import TcpServer

from emmc_rig.drivers import ports
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import (
    UDEV_RULE,
    GarbledReplyError,
    PortBusyError,
    PortGoneError,
    PortNotFoundError,
    PortPermissionError,
    TransportTimeoutError,
)
from emmc_rig.drivers.ports import find_port, guess_of, holder_of, list_serial_ports
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.drivers.transport import SerialTransport
from emmc_rig.drivers.zaber import ZaberStage
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.wire import PtyServer
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

HOLD_A_PORT = (
    "import sys, time; from emmc_rig.drivers.transport import SerialTransport; "
    "transport = SerialTransport(sys.argv[1]); print('held', flush=True); time.sleep(60)"
)


@pytest.fixture
def usb_ports(monkeypatch):
    """Return a list of made-up USB ports that pyserial then finds."""
    found = []
    monkeypatch.setattr(list_ports, "comports", lambda: found)
    return found


def usb_port(device, serial_number="A1", vid: int | None = 0x0403, pid: int | None = 0x6001):
    return SimpleNamespace(
        device=str(device),
        description="USB serial",
        vid=vid,
        pid=pid,
        serial_number=serial_number,
        manufacturer="FTDI",
    )


@pytest.fixture
def served():
    with PtyServer(ZaberChain(ManualClock())) as server:
        yield server


def test_a_port_is_found_by_the_serial_number_of_its_adapter(usb_ports):
    usb_ports += [usb_port("/dev/ttyUSB0", "A1"), usb_port("/dev/ttyUSB1", "B2")]
    assert find_port("usb:B2") == "/dev/ttyUSB1"
    with pytest.raises(PortNotFoundError, match="usb:C3 does not exist"):
        find_port("usb:C3")


def test_a_pattern_must_mean_one_port(tmp_path):
    (tmp_path / "usb-FTDI-0").touch()
    assert find_port(f"{tmp_path}/usb-*") == f"{tmp_path}/usb-FTDI-0"
    (tmp_path / "usb-FTDI-1").touch()
    with pytest.raises(PortNotFoundError, match="means more than one"):
        find_port(f"{tmp_path}/usb-*")
    with pytest.raises(PortNotFoundError, match="does not exist"):
        find_port(f"{tmp_path}/serial-*")


def test_names_and_urls_are_taken_as_they_are():
    assert find_port("/dev/ttyUSB7") == "/dev/ttyUSB7"
    assert find_port("socket://localhost:4001?x=*") == "socket://localhost:4001?x=*"


def test_what_usually_answers_is_guessed_from_the_adapter(usb_ports):
    usb_ports += [
        usb_port("/dev/a", vid=0x0403, pid=0xFAF0),
        usb_port("/dev/b", vid=0x2341, pid=0x0043),
        usb_port("/dev/c", vid=0x0403, pid=0x6001),
        usb_port("/dev/d", vid=None, pid=None),
    ]
    assert [guess_of(port) for port in list_serial_ports()] == ["apt", "grbl", "", ""]


def test_a_port_opened_by_name_is_found_again_under_another_name(tmp_path, usb_ports):
    chain = ZaberChain(ManualClock())
    first, second = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1"
    with PtyServer(chain) as server:
        first.symlink_to(server.port)
        usb_ports.append(usb_port(first, "A1"))
        transport = SerialTransport(str(first), timeout_s=0.2)
        first.unlink()
        second.symlink_to(server.port)
        usb_ports[:] = [usb_port(second, "A1"), usb_port(tmp_path / "ttyUSB2", "Z9")]
        transport.reopen()
        transport.write(b"/1 0 1 get device.id\n")
        assert transport.read_until(b"\n").startswith(b"@01 0 01 OK")
        transport.close()


def test_another_device_under_the_old_name_is_not_taken_for_ours(tmp_path, usb_ports, served):
    port = tmp_path / "ttyUSB0"
    port.symlink_to(served.port)
    usb_ports.append(usb_port(port, "A1"))
    transport = SerialTransport(str(port))
    usb_ports[:] = [usb_port(port, "B2")]
    with pytest.raises(PortNotFoundError):
        transport.reopen()


def test_a_port_that_comes_back_late_is_waited_for(tmp_path):
    clock = JumpingClock()
    chain = ZaberChain(clock, {(1, 1): AxisSpec()})
    with PtyServer(chain, tmp_path / "stage") as server:
        transport = SerialTransport(f"{tmp_path}/sta*", timeout_s=0.2)
        stage = ZaberStage(
            transport, {"x": (1, 1)}, AxisSpec().microstep_um, clock, StageSettings()
        )
        chain.unplug()
        while server.is_open:
            time.sleep(0.001)
        with pytest.raises(PortGoneError):
            stage.is_homed("x")
        tries = []

        def sleep_and_plug_in(duration_s):
            tries.append(duration_s)
            if len(tries) == 3:
                chain.replug()
            time.sleep(0.01)

        clock.sleep = sleep_and_plug_in
        stage.reconnect(wait_s=30.0)
        assert len(tries) >= 3
        assert not stage.is_homed("x")
        stage.close()


@pytest.mark.parametrize(
    "use",
    [
        lambda wire: wire.write(b"/1\n"),
        lambda wire: wire.waiting(),
        lambda wire: wire.discard_input(),
        lambda wire: wire.read_until(b"\n"),
    ],
)
def test_a_wire_in_memory_is_dead_from_the_unplugging_until_it_is_opened_again(use):
    chain = ZaberChain(ManualClock())
    wire = chain.transport()
    chain.unplug()
    with pytest.raises(PortGoneError):
        use(wire)
    with pytest.raises(PortNotFoundError):
        wire.reopen()
    chain.replug()
    with pytest.raises(PortGoneError):
        use(wire)
    wire.reopen()
    wire.write(b"/1 0 1\n")
    assert wire.read_until(b"\n").startswith(b"@01 0 01 OK")
    wire.close()
    with pytest.raises(PortGoneError):
        use(wire)


def test_the_second_process_on_a_port_hears_who_holds_it(served):
    command = [sys.executable, "-c", HOLD_A_PORT, served.port]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "held\n"
            with pytest.raises(PortBusyError, match="close the program that holds it") as caught:
                SerialTransport(served.port)
            assert f"(pid {holder.pid})" in str(caught.value)
            assert os.path.basename(sys.executable) in caught.value.holder
        finally:
            holder.send_signal(signal.SIGKILL)
    SerialTransport(served.port).close()


def test_a_lock_names_its_holder_even_where_open_files_may_not_be_seen(served, monkeypatch):
    transport = SerialTransport(served.port)
    monkeypatch.setattr(ports, "pids_with_open_file", lambda device: iter(()))
    assert holder_of(served.port).endswith(f"(pid {os.getpid()})")
    transport.close()


def test_a_port_that_nobody_holds_has_no_holder(tmp_path):
    (tmp_path / "port").touch()
    assert holder_of(str(tmp_path / "port")) == ""


def test_a_forbidden_port_names_the_udev_rule_that_helps(monkeypatch, served):
    def forbid(self):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial.Serial, "open", forbid)
    with pytest.raises(PortPermissionError, match=rf"copy {UDEV_RULE} to /etc/udev/rules"):
        SerialTransport(served.port)


def test_the_udev_rule_covers_every_kind_of_device_and_is_well_formed():
    rule = re.compile(r'(?:(?:[A-Z]+(?:\{[\w.]+\})?)(?:==|!=|=|\+=|:=)"[^"]*"(?:, )?)+')
    lines = UDEV_RULE.read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    assert all(rule.fullmatch(line) for line in rules), rules
    text = "\n".join(rules)
    for kind in ("0403|2939", "faf0", ":060101:", ":ef05", "ID_MM_DEVICE_IGNORE"):
        assert kind in text
    assert text.count('TAG+="uaccess", RUN{builtin}+="uaccess"') == 3


def test_a_write_to_a_device_that_never_reads_ends_in_time():
    device, line = os.openpty()
    transport = SerialTransport(os.ttyname(line), write_timeout_s=0.1)
    with pytest.raises(TransportTimeoutError, match=r"within 0\.1 s"):
        transport.write(b"x" * 1_000_000)
    transport.close()
    os.close(device)
    os.close(line)


def test_a_device_that_drips_bytes_without_end_is_a_timeout(monkeypatch):
    with PtyServer(ZaberChain(ManualClock())) as server:
        transport = SerialTransport(server.port, timeout_s=0.1)

        def drip(self, size=1):
            time.sleep(0.005)
            return b"x"

        monkeypatch.setattr(serial.Serial, "read", drip)
        with pytest.raises(TransportTimeoutError, match="only b'xx"):
            transport.read_until(b"\n")
        with pytest.raises(GarbledReplyError, match="never falls silent"):
            transport.discard_until_quiet()
        transport.close()


def test_flow_control_is_asked_for_where_the_port_has_it_and_missed_where_not(served):
    transport = SerialTransport(served.port, flow_control=True, timeout_s=0.2)
    transport.write(b"/1 0 1 get device.id\n")
    assert transport.read_until(b"\n").startswith(b"@01 0 01 OK")
    transport.close()


def test_a_simulator_on_tcp_is_reached_by_url_and_missed_when_it_is_gone():
    with TcpServer(ZaberChain(ManualClock())) as server:
        transport = SerialTransport(server.port, timeout_s=0.2)
        transport.write(b"/1 0 1 get device.id\n")
        assert transport.read_until(b"\n").startswith(b"@01 0 01 OK")
        transport.close()
    with pytest.raises(PortNotFoundError, match="cannot be reached"):
        SerialTransport(server.port)


def test_a_url_that_pyserial_does_not_know_is_no_port():
    with pytest.raises(PortNotFoundError, match="is no port"):
        SerialTransport("teapot://kitchen")


def test_a_second_client_of_a_tcp_stage_hears_that_it_is_busy_and_the_first_goes_on():
    chain = ZaberChain(SYSTEM_CLOCK, {(1, 1): AxisSpec()})
    with TcpServer(chain) as server:
        first = SerialTransport(server.port, timeout_s=2.0)
        first.write(b"/1 0 01\n")
        first.read_until(b"\n")
        second = SerialTransport(server.port, timeout_s=2.0)
        with pytest.raises(PortBusyError, match="another program over the network"):
            second.read_until(b"\n")
        second.close()
        first.write(b"/1 0 02\n")
        assert b"@01 0 02 OK" in first.read_until(b"\n")
        first.close()


class Chatterbox:
    """Firmware that always has more to say."""

    unplugged, plugs = False, 1
    said = 0

    def feed(self, data):
        return b""

    def due(self):
        self.said += 1
        return bytes(1 << 20)

    def next_due_s(self):
        return 0.0


@pytest.mark.parametrize("served_on", [PtyServer, TcpServer])
def test_a_host_that_reads_nothing_keeps_no_simulator_from_ending(served_on):
    firmware = Chatterbox()
    server = served_on(firmware)
    server.__enter__()
    with serial.serial_for_url(server.port, timeout=0):
        said = 0
        while not said or said != firmware.said:  # until it waits for the host
            said = firmware.said
            time.sleep(0.2)
        ended = threading.Thread(target=server.__exit__, args=(None, None, None), daemon=True)
        ended.start()
        ended.join(20)
        assert not ended.is_alive()


def test_a_flood_is_shortened_in_the_message():
    assert len(str(GarbledReplyError(bytes(100_000), "no reply"))) < 400
    assert "(100000 bytes)" in str(TransportTimeoutError("p", 1.0, bytes(100_000)))
