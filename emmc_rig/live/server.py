"""A page over HTTP with a secret in its address; GET requests change nothing.

Every path begins with a random token, and the host must be one of this computer's names for
itself, so that no other page in the browser can reach it (cross-site requests, DNS rebinding).

States are pushed (server-sent events), the newest only. A request that must not wait has a thread
of its own. Connections are few and requests have a time limit, so that a page leaves file
descriptors to the capture beside it, whatever a browser or a stranger does.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Any

import uvicorn
from jinja2 import ChoiceLoader, PackageLoader
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.live.served_page import Page, Picture
from emmc_rig.model.json_text import parse_json
from emmc_rig.report.page import ENVIRONMENT, TEMPLATES

LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")
PATIENCE_S = 10.0
REQUEST_S = 5.0
"""From connecting, or from an answer, until a whole request has arrived."""
READING_S = 20.0
"""An answer of which a client has read nothing for so long is given up, on Linux by its kernel."""
LAST_STATE_S = 1.0
"""For clients to read the last state once the server ends."""
MOST_CONNECTIONS = 128
"""An eighth of the 1,024 files that Linux lets a program open; a browser opens six."""
MOST_WAITING = 64
"""Connections taken at once, before the first of them is counted."""
LONGEST_BODY = 1 << 17
PAUSE_S = 0.04
"""At least between two states that are pushed."""
MOST_VIEWS = 16
"""Whose last picture is kept; those asked for least recently go first."""
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
PARTS_FOUND = ChoiceLoader([PackageLoader("emmc_rig.live", ""), TEMPLATES])
PARTS = ENVIRONMENT.overlay(loader=PARTS_FOUND)
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' blob: data:; form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def new_token() -> str:
    """Return a secret for an address."""
    return secrets.token_urlsafe(18)


def address(host: str, port: int, token: str) -> str:
    """Return what to open for a page that is served there."""
    shown = "127.0.0.1" if host in EVERYWHERE else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{port}/{token}/"


def names_of(host: str) -> tuple[str, ...]:
    """Return the valid names of a server there, see `application`."""
    if host in ("127.0.0.1", "::1", "localhost"):
        return LOCAL_HOSTS
    return ("*",) if host in EVERYWHERE else (*LOCAL_HOSTS, f"[{host}]" if ":" in host else host)


def application(
    page: Page,
    token: str,
    read_only: bool = False,
    hosts: tuple[str, ...] = LOCAL_HOSTS,
    to_act: str = "start a page that may act",
) -> Starlette:
    """Return the ASGI application.

    hosts: names of this server in valid requests ("*": any). to_act: advice in the refusal of an
    action on a read-only page.
    """
    ending, known = asyncio.Event(), (-1, b"")
    made: dict[Hashable, tuple[int, bytes]] = {}
    one_picture = ThreadPoolExecutor(1, thread_name_prefix="live pictures")
    at_once = ThreadPoolExecutor(1, thread_name_prefix="live urgent request")

    def encoded_state() -> bytes:
        """Return the state as JSON, encoded once for all who ask."""
        nonlocal known
        page.touch()
        if known[0] != page.state["version"]:
            parts = {**page.state.snapshot(), "read_only": read_only}
            data = json.dumps(parts, allow_nan=False, separators=(",", ":"))
            known = parts["version"], data.encode()
        return known[1]

    def encoded_picture(wanted: Picture) -> bytes:
        """Return a picture, encoded once for all who ask; called in one thread."""
        number, data = made.pop(wanted.key, (-1, b""))
        if number != wanted.number:
            data = wanted.make()
        made[wanted.key] = wanted.number, data
        while len(made) > MOST_VIEWS:
            del made[next(iter(made))]
        return data

    def guarded(
        answer: Callable[[Request], Awaitable[Response]],
    ) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            try:
                given = request.path_params.get("token", "")
                if not secrets.compare_digest(given.encode(), token.encode()):
                    raise HTTPException(403, "wrong token: open the address that emmc-rig printed")
                response = await answer(request)
            except HTTPException as refusal:
                response = PlainTextResponse(f"{refusal.detail}\n", refusal.status_code)
            except ERRORS as fault:
                response = PlainTextResponse(f"{fault}\n", 400)
            except ClientDisconnect:
                response = Response(status_code=400)  # who asked has gone, and hears nothing
            response.headers.update(HEADERS)
            return response

        return endpoint

    async def shown(request: Request) -> Response:
        name = request.path_params.get("name", "") or page.files[0]
        if request.method != "GET":
            raise HTTPException(405, f"{name!r} takes no POST: an order is at do/ORDER")
        if name in page.pictures:
            wanted = page.pictures[name](request.query_params)
            if wanted is None:
                raise HTTPException(503, "nothing to show yet")
            loop = asyncio.get_running_loop()
            data = await loop.run_in_executor(one_picture, encoded_picture, wanted)
            return Response(data, media_type=wanted.media_type)
        if name not in page.files:
            raise HTTPException(404, f"no page {name!r}")
        if name.endswith(".html"):
            text = PARTS.get_template(name).render(poster=None)
        else:
            text = PARTS_FOUND.get_source(PARTS, name)[0]
        return Response(text, media_type=TYPES[name[name.rindex(".") :]])

    async def state(request: Request) -> Response:
        return Response(encoded_state(), media_type="application/json")

    async def events(request: Request) -> Response:
        async def states() -> AsyncIterator[bytes]:
            while True:
                version = page.state["version"]
                yield b"data: " + encoded_state() + b"\n\n"
                if ending.is_set():  # also then: the last state says how it ended
                    return
                asked_s = time.monotonic()
                while not ending.is_set() and time.monotonic() - asked_s < PATIENCE_S:
                    with suppress(TimeoutError):
                        await asyncio.wait_for(ending.wait(), PAUSE_S)
                    if page.state["version"] > version:
                        break

        return StreamingResponse(states(), media_type="text/event-stream")

    async def act(request: Request) -> Response:
        if request.method != "POST":
            raise HTTPException(405, "nothing is done by GET: send POST")
        if read_only:
            raise HTTPException(403, f"read-only: {to_act} to act")
        origin = request.headers.get("origin")
        page_origin = f"{request.url.scheme}://{request.headers.get('host')}"
        if origin not in (None, page_origin):
            raise HTTPException(403, f"not from this page but from {origin}")
        name = request.path_params["order"]
        if name not in page.orders:
            raise HTTPException(404, f"no order {name!r}: {', '.join(page.orders)}")
        order, values = page.orders[name], await _body(request)
        threads = at_once if order.urgent else None
        loop = asyncio.get_running_loop()
        return JSONResponse(await loop.run_in_executor(threads, order.carry_out, name, values))

    made_app = Starlette(
        routes=[
            Route("/{token}/state", guarded(state), methods=["GET"]),
            Route("/{token}/events", guarded(events), methods=["GET"]),
            Route("/{token}/do/{order}", guarded(act), methods=["GET", "POST"]),
            Route("/{token}/", guarded(shown), methods=["GET"]),
            Route("/{token}/{name:path}", guarded(shown), methods=["GET", "POST"]),
            Route("/{rest:path}", guarded(shown), methods=["GET", "POST"]),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))],
    )
    made_app.state.ending = ending
    return made_app


def listening_socket(host: str = "127.0.0.1", port: int = 0) -> socket.socket:
    """Return a socket to serve at; raises AppError where that is not possible."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as fault:
        why = getattr(fault, "strerror", None) or str(fault)
        raise AppError(
            f"cannot serve at {host} port {port} ({why}): choose another port or host"
        ) from fault
    if sys.platform == "linux":  # accepted connections inherit it
        waited_ms = round(1e3 * READING_S)
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, waited_ms)
    return listening


class Connection(H11Protocol):
    """A connection that is closed if too many are open, or if no whole request comes in time."""

    _time_limit: asyncio.TimerHandle

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._time_limit = self.loop.call_later(REQUEST_S, self._close_without_request)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()

    def on_response_complete(self) -> None:
        """Begin to wait for the next request."""
        self._time_limit.cancel()
        self._time_limit = self.loop.call_later(REQUEST_S, self._close_without_request)
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for no request any more."""
        self._time_limit.cancel()
        super().connection_lost(exc)

    def _close_without_request(self) -> None:
        if self.cycle is None or self.cycle.more_body or self.cycle.response_complete:
            self.transport.close()


class Server(uvicorn.Server):
    """Serves an application: `run(sockets=[...])`, until `should_exit`."""

    def __init__(self, app: Starlette) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=Connection,
                backlog=MOST_WAITING,
                # Warnings are about requests that no browser sends: a flood would fill the log.
                log_level="error",
                access_log=False,
                lifespan="off",
                server_header=False,
                timeout_graceful_shutdown=round(2 * LAST_STATE_S),
            )
        )
        self._ending: asyncio.Event = app.state.ending

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Push the last state; a client that has not read it after `LAST_STATE_S` is cut off."""
        self._ending.set()
        asyncio.get_running_loop().call_later(LAST_STATE_S, self._close_all)
        await super().shutdown(sockets)

    def _close_all(self) -> None:
        for connection in list(self.server_state.connections):
            assert isinstance(connection, Connection)
            connection.transport.abort()


@contextmanager
def served(app: Starlette, host: str = "127.0.0.1") -> Iterator[int]:
    """Serve in a thread of its own until the block ends; yield the port. Raises AppError."""
    with listening_socket(host) as listening:
        server = Server(app)
        sockets = {"sockets": [listening]}
        thread = Thread(target=server.run, kwargs=sockets, name="live server", daemon=True)
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join(PATIENCE_S)


async def _body(request: Request) -> dict[str, Any]:
    """Return the JSON object sent; a form of another site cannot send this content type."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "send JSON")
    data = b""
    async for chunk in request.stream():  # to its end: an earlier answer can be lost on its way
        if len(data) <= LONGEST_BODY:
            data += chunk
    if len(data) > LONGEST_BODY:
        raise HTTPException(413, f"more than {LONGEST_BODY} bytes")
    try:
        values = parse_json(data or b"{}", "the request", ValueError)
    except ValueError as fault:
        raise HTTPException(400, "not JSON") from fault
    if not isinstance(values, dict):
        raise HTTPException(400, "send a JSON object")
    return values
