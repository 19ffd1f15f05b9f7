"""Who is connected: the newest first, one at a time, and whoever sends half a request makes room.

However many connect, nobody waits for them: what is accepted costs nothing until its turn comes.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable

from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

MOST_CONNECTIONS = 512
"""A browser has six at most; half of the 1,024 files that a process may have open by default."""
MOST_QUEUED = 128
"""Accepted, and no request read yet."""
MOST_ACCEPTED = 1024
"""At a time; one of them has its turn between two looks at requests."""
LONGEST_REQUEST_S = 10.0
"""For its head, from the connection or the answer before on, and again for the rest of it."""
SWEEP_S = 1.0
RETRY_S = 1.0
"""Until connections are accepted again by a process that may open no more files."""


class Connections:
    """Accepts at a listening socket, in a running loop, until closed.

    made: returns the protocol of a new connection.
    """

    def __init__(self, listening: socket.socket, made: Callable[[], H11Protocol]) -> None:
        self._listening, self._made = listening, made
        self._loop = asyncio.get_running_loop()
        self._queued: deque[socket.socket] = deque()
        self._serving: asyncio.Task[None] | None = None
        self._open: dict[H11Protocol, tuple[RequestResponseCycle | None, float]] = {}
        """Oldest first, with the last request that came whole, and since when it is the last."""
        listening.listen(socket.SOMAXCONN)
        listening.setblocking(False)
        self._loop.add_reader(listening, self._accept)
        self._timer = self._loop.call_later(SWEEP_S, self._sweep)

    def close(self) -> None:
        """Accept nobody any more, and let nobody go on who sends half a request."""
        self._timer.cancel()
        self._loop.remove_reader(self._listening)
        while self._queued:
            self._queued.pop().close()
        for connection in [one for one in self._open if _sends(one)]:
            self._end(connection)

    def _accept(self) -> None:
        """Accept all who ask; beyond MOST_QUEUED the oldest of them go."""
        for _ in range(MOST_ACCEPTED):
            try:
                link, _ = self._listening.accept()
            except BlockingIOError:
                break
            except ConnectionError:
                continue
            except OSError:  # no more open files are allowed
                self._loop.remove_reader(self._listening)
                self._loop.call_later(RETRY_S, self._resume)
                break
            self._queued.append(link)
            if len(self._queued) > MOST_QUEUED:
                self._queued.popleft().close()
        if self._serving is None or self._serving.done():
            self._serving = self._loop.create_task(self._serve())

    def _resume(self) -> None:
        if not self._timer.cancelled():
            self._loop.add_reader(self._listening, self._accept)

    async def _serve(self) -> None:
        """Let those who were accepted send their requests; the loop goes on between two of them."""
        while self._queued:
            link = self._queued.pop()
            link.setblocking(False)
            try:
                _, connection = await self._loop.connect_accepted_socket(self._made, link)
            except OSError:
                link.close()
                continue
            if len(self._open) >= MOST_CONNECTIONS:
                self._look()
            while len(self._open) >= MOST_CONNECTIONS:
                # A page that is looked at comes back by itself.
                self._end(next((one for one in self._open if _sends(one)), next(iter(self._open))))
            self._open[connection] = connection.cycle, self._loop.time()

    def _look(self) -> None:
        """Forget who is gone, and note who has sent another whole request since."""
        now_s = self._loop.time()
        for connection, (last, _) in [*self._open.items()]:
            if connection.transport.is_closing():
                del self._open[connection]
            elif connection.cycle is not last or not _sends(connection):
                self._open[connection] = connection.cycle, now_s

    def _sweep(self) -> None:
        self._look()
        now_s = self._loop.time()
        for connection, (_, since_s) in [*self._open.items()]:
            if now_s - since_s > LONGEST_REQUEST_S:
                self._end(connection)
        self._timer = self._loop.call_later(SWEEP_S, self._sweep)

    def _end(self, connection: H11Protocol) -> None:
        self._open.pop(connection, None)
        connection.transport.abort()


def _sends(connection: H11Protocol) -> bool:
    """Whether a request, or the rest of one, is still to come."""
    cycle = connection.cycle
    return cycle is None or cycle.response_complete or cycle.more_body
