"""PTP/IP: one initiator at a time, and events go to its event connection alone."""

import socket
import struct
from contextlib import ExitStack
from typing import ClassVar

import numpy as np
import ptpip_server as ptpip
import pytest
from ptpip_server import PtpIpServer

from drivers.clock import SystemClock
from drivers.ptp_codec import Code, EventCode, Operation
from simulators.ptp import PtpCameraSimulator

PATIENCE_S = 10.0
MOSAIC = np.zeros((40, 48), np.uint16)


@pytest.fixture
def server():
    camera = PtpCameraSimulator(lambda exposure_s: MOSAIC, SystemClock())
    with PtpIpServer(camera) as opened, ExitStack() as sockets:
        Connection.sockets = sockets
        yield opened


class Connection:
    sockets: ClassVar[ExitStack]

    def __init__(self, server, kind, payload):
        self.socket = socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S)
        self.sockets.enter_context(self.socket)
        self.send(kind, payload)

    def send(self, kind, payload):
        self.socket.sendall(struct.pack("<II", 8 + len(payload), kind) + payload)

    def read(self):
        length, kind = struct.unpack("<II", self.take(8))
        return kind, self.take(length - 8)

    def take(self, count):
        data = b""
        while len(data) < count:
            piece = self.socket.recv(count - len(data))
            assert piece, "hung up"
            data += piece
        return data

    def ask(self, operation, *parameters):
        """Return the code of the response; data are passed over."""
        numbers = struct.pack(f"<{len(parameters)}I", *parameters)
        self.send(ptpip.REQUEST, struct.pack("<IHI", 1, operation, 1) + numbers)
        while True:
            kind, payload = self.read()
            if kind == ptpip.RESPONSE:
                return int.from_bytes(payload[:2], "little")


def connect(server):
    command = Connection(server, ptpip.INIT_COMMAND, bytes(16) + "t\0".encode("utf-16-le"))
    kind, payload = command.read()
    assert kind == ptpip.INIT_COMMAND_ACK
    return command, int.from_bytes(payload[:4], "little")


def listen(server, number):
    events = Connection(server, ptpip.INIT_EVENT, struct.pack("<I", number))
    assert events.read() == (ptpip.INIT_EVENT_ACK, b"")
    return events


def capture(command, events):
    assert command.ask(Operation.OPEN_SESSION, 1) == Code.OK
    assert command.ask(Operation.INITIATE_CAPTURE, 0, 0) == Code.OK
    seen = []
    while EventCode.CAPTURE_COMPLETE not in seen:
        kind, payload = events.read()
        assert kind == ptpip.EVENT
        seen.append(int.from_bytes(payload[:2], "little"))
    assert EventCode.OBJECT_ADDED in seen


def test_a_session_after_one_that_just_hung_up_gets_its_own_events(server):
    for _ in range(3):
        command, number = connect(server)
        events = listen(server, number)
        capture(command, events)
        command.socket.close()  # without CloseSession; its event connection stays open


def test_events_of_a_session_that_left_are_not_given_to_the_next(server):
    command, number = connect(server)
    listen(server, number)
    assert command.ask(Operation.OPEN_SESSION, 1) == Code.OK
    assert command.ask(Operation.INITIATE_CAPTURE, 0, 0) == Code.OK
    command.socket.close()
    command, number = connect(server)
    events = listen(server, number)
    assert command.ask(Operation.OPEN_SESSION, 1) == Code.OK
    assert command.ask(Operation.GET_STORAGE_IDS) == Code.OK
    events.socket.settimeout(0.3)
    with pytest.raises(TimeoutError):
        events.read()


@pytest.mark.slow
def test_a_second_initiator_hears_that_the_camera_is_busy(server):
    command, number = connect(server)
    second = Connection(server, ptpip.INIT_COMMAND, bytes(16) + b"t\0\0\0")
    assert second.read() == (ptpip.INIT_FAIL, struct.pack("<I", ptpip.BUSY))
    capture(command, listen(server, number))


def test_an_event_connection_of_no_session_is_refused(server):
    stray = Connection(server, ptpip.INIT_EVENT, struct.pack("<I", 7))
    assert stray.read() == (ptpip.INIT_FAIL, struct.pack("<I", ptpip.UNKNOWN_CONNECTION))
