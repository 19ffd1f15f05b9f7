"""The simulated still camera on a TCP port: PTP/IP, so that other programs can take pictures.

Listens on this computer only. Source: CIPA DC-005 (PTP over TCP/IP), clauses 2 and 3.
"""

from __future__ import annotations

import itertools
import socket
import struct
import threading
from contextlib import suppress

from drivers.ptp_codec import Kind, Message
from simulators.ptp import Answer, PtpCameraSimulator

HOST, PORT = "127.0.0.1", 15740
PACKET = struct.Struct("<II")
MOST_BYTES = 1 << 24
DATA_BYTES = 1 << 18
EVENT_POLL_S = 0.05
DATA_FOLLOWS = 2

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
        self._threads: list[threading.Thread] = []
        self._connections = itertools.count(1)
        self._open: set[int] = set()
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
                name = "EMMC simulated camera\x00".encode("utf-16-le")
                number = next(self._connections)
                hello = struct.pack("<I", number) + GUID + name + struct.pack("<I", VERSION)
                self._open.add(number)
                try:
                    _send(connection, INIT_COMMAND_ACK, hello)
                    self._answer_requests(connection)
                finally:
                    self._open.discard(number)
            elif kind == INIT_EVENT and len(payload) == 4:
                _send(connection, INIT_EVENT_ACK)
                self._send_events(connection, struct.unpack("<I", payload)[0])
            else:
                _send(connection, INIT_FAIL, struct.pack("<I", 1))

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
        """Send events as long as the command connection of that number lasts: no later one's."""
        while number in self._open and not self._ended.is_set():
            event = self._camera.wait_event(EVENT_POLL_S)
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


def _send(connection: socket.socket, kind: int, payload: bytes = b"") -> None:
    connection.settimeout(None)
    connection.sendall(PACKET.pack(PACKET.size + len(payload), kind) + payload)
    connection.settimeout(EVENT_POLL_S)
