"""The simulated still camera on a TCP port: PTP/IP, so that other programs can take pictures.

Listens on this computer only, to one initiator at a time: a session and its event
connection end with its command connection. Source: CIPA DC-005 (PTP over TCP/IP), clauses 2
and 3.
"""

from __future__ import annotations

import select
import socket
import struct
import threading
from contextlib import suppress

from emmc_rig.drivers.ptp_codec import Kind, Message
from emmc_rig.simulators.ptp import Answer, PtpCameraSimulator

HOST, PORT = "127.0.0.1", 15740
PACKET = struct.Struct("<II")
MOST_BYTES = 1 << 24
DATA_BYTES = 1 << 18
EVENT_POLL_S = 0.05
LEAVE_S = 1.0
"""How long a new initiator waits for the one before it to hang up."""
DATA_FOLLOWS = 2
UNKNOWN_CONNECTION, BUSY = 1, 2
"""Reasons of an INIT_FAIL: rejected, or another initiator is connected."""

INIT_COMMAND, INIT_COMMAND_ACK, INIT_EVENT, INIT_EVENT_ACK, INIT_FAIL = 1, 2, 3, 4, 5
REQUEST, RESPONSE, EVENT, START_DATA, DATA, CANCEL, END_DATA, PROBE, PROBE_ANSWER = range(6, 15)
GUID = b"EMMC simulated  "
VERSION = 0x00010000


class PtpIpServer:
    """Serves one camera while its `with` block lasts; `port` is where. The clock must be real."""

    def __init__(self, camera: PtpCameraSimulator, port: int = 0) -> None:
        self._camera = camera
        self._listener = socket.create_server((HOST, port))
        self._listener.settimeout(EVENT_POLL_S)
        self.port: int = self._listener.getsockname()[1]
        self._ended = threading.Event()
        self._initiator = threading.Lock()
        self._connections = 0
        self._connected = 0
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    def __enter__(self) -> PtpIpServer:
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._listener.close()

    def _start(self, target, *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, name="PTP/IP", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._ended.is_set():
            with suppress(TimeoutError):
                connection, _ = self._listener.accept()
                self._start(self._serve, connection)

    def _serve(self, connection: socket.socket) -> None:
        """Greet a connection and serve what it turns out to be."""
        with connection, suppress(ConnectionError):
            connection.settimeout(EVENT_POLL_S)
            kind, payload = self._receive(connection)
            if kind == INIT_COMMAND:
                self._serve_initiator(connection)
            elif kind == INIT_EVENT and len(payload) == 4:
                self._send_events(connection, int.from_bytes(payload, "little"))
            else:
                _refuse(connection, UNKNOWN_CONNECTION)

    def _serve_initiator(self, connection: socket.socket) -> None:
        """Serve a command connection under a number of its own, while no other is served."""
        if not self._initiator.acquire(timeout=LEAVE_S):
            _refuse(connection, BUSY)
            return
        try:
            self._connections += 1
            self._connected = self._connections
            name = "EMMC simulated camera\x00".encode("utf-16-le")
            number = struct.pack("<I", self._connected)
            _send(connection, INIT_COMMAND_ACK, number + GUID + name + struct.pack("<I", VERSION))
            self._answer_requests(connection)
        finally:
            self._connected = 0
            self._camera.end_session()
            self._initiator.release()

    def _answer_requests(self, connection: socket.socket) -> None:
        while True:
            kind, payload = self._receive(connection)
            if kind == PROBE:
                _send(connection, PROBE_ANSWER)
            if kind != REQUEST or len(payload) < 10:
                continue
            phase, code, transaction = struct.unpack_from("<IHI", payload)
            count = (len(payload) - 10) // 4
            parameters = struct.unpack_from(f"<{count}I", payload, 10)
            data = self._receive_data(connection) if phase == DATA_FOLLOWS else b""
            request = Message(Kind.COMMAND, code, transaction, parameters)
            self._send_answer(connection, transaction, self._camera.respond(request, data))

    def _receive_data(self, connection: socket.socket) -> bytes:
        parts = []
        while True:
            kind, payload = self._receive(connection)
            if kind in (DATA, END_DATA):
                parts.append(payload[4:])
            if kind in (END_DATA, CANCEL):
                return b"".join(parts)

    def _send_answer(self, connection: socket.socket, transaction: int, answer: Answer) -> None:
        number = struct.pack("<I", transaction)
        if answer.data is not None:
            data = memoryview(answer.data)
            _send(connection, START_DATA, number + struct.pack("<Q", len(data)))
            while len(data) > DATA_BYTES:
                _send(connection, DATA, number + bytes(data[:DATA_BYTES]))
                data = data[DATA_BYTES:]
            _send(connection, END_DATA, number + bytes(data))
        parameters = struct.pack(f"<{len(answer.parameters)}I", *answer.parameters)
        _send(connection, RESPONSE, struct.pack("<HI", answer.code, transaction) + parameters)

    def _send_events(self, connection: socket.socket, number: int) -> None:
        """Pass events on as long as both connections of that number last."""
        if number != self._connected:
            _refuse(connection, UNKNOWN_CONNECTION)
            return
        _send(connection, INIT_EVENT_ACK)
        while self._connected == number and not self._ended.is_set() and not _left(connection):
            event = self._camera.wait_event(0.0)
            if event is None:
                self._ended.wait(EVENT_POLL_S)
                continue
            numbers = struct.pack(f"<{len(event.parameters)}I", *event.parameters)
            _send(connection, EVENT, struct.pack("<HI", event.code, event.transaction) + numbers)

    def _receive(self, connection: socket.socket) -> tuple[int, bytes]:
        length, kind = PACKET.unpack(self._read(connection, PACKET.size))
        if not PACKET.size <= length <= MOST_BYTES:
            raise ConnectionError(f"a packet of {length} bytes")
        return kind, self._read(connection, length - PACKET.size)

    def _read(self, connection: socket.socket, count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            if self._ended.is_set():
                raise ConnectionError("the server ends")
            with suppress(TimeoutError):
                piece = connection.recv(count - len(data))
                if not piece:
                    raise ConnectionError("the other side left")
                data += piece
        return bytes(data)


def _left(connection: socket.socket) -> bool:
    """Return whether the other side has hung up."""
    readable, _, _ = select.select([connection], [], [], 0)
    return bool(readable) and not connection.recv(1, socket.MSG_PEEK)


def _refuse(connection: socket.socket, reason: int) -> None:
    _send(connection, INIT_FAIL, struct.pack("<I", reason))


def _send(connection: socket.socket, kind: int, payload: bytes = b"") -> None:
    connection.settimeout(None)
    connection.sendall(PACKET.pack(PACKET.size + len(payload), kind) + payload)
    connection.settimeout(EVENT_POLL_S)
