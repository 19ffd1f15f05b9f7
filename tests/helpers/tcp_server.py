"""Simulated firmware on TCP, by a URL that pyserial opens."""

import socket
from contextlib import suppress

from emmc_rig.drivers.transport import IN_USE
from emmc_rig.simulators.wire import READ_SIZE, PtyServer


class TcpServer(PtyServer):
    """Serves one client at a time; a second gets a line that the port is in use, as of ser2net."""

    address = ("127.0.0.1", 0)
    _client = None

    def _open(self):
        self._listener = socket.create_server(self.address)
        self.address = self._listener.getsockname()[:2]
        self.port = f"socket://{self.address[0]}:{self.address[1]}"

    def _close(self):
        self._hang_up()
        self._listener.close()

    def _sources(self):
        return [self._listener] if self._client is None else [self._client, self._listener]

    def _read(self, source):
        if source is self._listener:
            accepted, _ = self._listener.accept()
            if self._client is None:
                accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                accepted.setblocking(False)
                self._client = accepted
                return b""
            with accepted, suppress(OSError):
                accepted.sendall(IN_USE + b"\r\n")
                accepted.shutdown(socket.SHUT_WR)
            return b""
        data = b""
        with suppress(ConnectionError):
            data = source.recv(READ_SIZE)
        if not data:
            self._hang_up()
        return data

    def _write(self, data):
        if self._client is not None:
            try:
                self._send(self._client, self._client.send, data)
            except ConnectionError:
                self._hang_up()

    def _hang_up(self):
        if self._client is not None:
            self._client.close()
            self._client = None
