"""A page over HTTP: a secret in its address, nothing done by GET, nothing of others.

Every path begins with a random token, and the host must be one of this computer's names for
itself, so that no other page in the browser can reach it (cross-site requests, DNS rebinding).

States are pushed (server-sent events): each is encoded once and written to all who look, the
newest only. A request that must not wait has a thread of its own.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Thread
from typing import Any, Protocol

import uvicorn
from jinja2 import ChoiceLoader, PackageLoader
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.live.connections import Connections
from emmc_rig.model.json_text import parse_json
from emmc_rig.pages.page import ENVIRONMENT, TEMPLATES

LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")
PATIENCE_S = 10.0
LARGEST = 1e12
"""No position, exposure or number of pixels comes near it."""
LONGEST_BODY = 1 << 17
PAUSE_S = 0.04
"""At least between two states that are pushed."""
AT_ONCE = 4
"""Clients written to between which the loop looks for other requests."""
MOST_VIEWS = 16
"""Whose last picture is kept; those asked for least recently go first."""
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
COMMON_FILES = ("page.css", "viewer.css", "common.js", "viewer.js", "field.js")
"""Of every page; the viewer is that of the reports."""
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


@dataclass(frozen=True)
class Picture:
    """What is encoded once for all who ask: key and number name it, make returns its bytes."""

    key: Hashable
    number: int
    make: Callable[[], bytes]
    media_type: str = "image/jpeg"


Query = Mapping[str, str]
Pictured = Callable[[Query], Picture | None]
Action = Callable[..., Mapping[str, Any] | None]
"""Both raise AppError with one line."""


class Page(Protocol):
    """What is served; every member may be used by any thread."""

    @property
    def files(self) -> tuple[str, ...]:
        """Files of the package `emmc_rig.live` or templates; the first is the page itself."""
        ...

    @property
    def pictures(self) -> Mapping[str, Pictured]:
        """By name; each takes a query, and returns None while there is none."""
        ...

    @property
    def actions(self) -> Mapping[str, Action]:
        """By name, what POST does; a mapping returned is part of the answer."""
        ...

    @property
    def urgent(self) -> frozenset[str]:
        """The actions that wait for no other."""
        ...

    @property
    def version(self) -> int:
        """Grows with every change of the state."""
        ...

    def state(self) -> dict[str, Any]:
        """Return the state, plain data with its `version`."""
        ...

    def touch(self) -> None:
        """Note that the page is being viewed."""
        ...

    def listen(self, listener: Callable[[], None]) -> None:
        """Let `listener` be called after every change, by whichever thread made it."""
        ...


def new_token() -> str:
    """Return a secret for an address."""
    return secrets.token_urlsafe(18)


class _RefusedError(Exception):
    """A request that is not answered as asked: status and one line."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class _News:
    """Wakes those who wait for a newer state; used in the server's loop alone."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: list[asyncio.Future[None]] = []
        self._woken: list[asyncio.Future[None]] = []
        self._round_planned = self.closed = False
        self._encoded: tuple[int, bytes] = (-1, b"")
        page.listen(self._heard)

    def close(self) -> None:
        """Let nobody wait any longer."""
        self.closed = True
        self._begin_round()

    async def newer(self, after: int) -> None:
        """Return when the state is newer than `after`, or patience ends."""
        self._loop = asyncio.get_running_loop()
        if self.closed:
            return
        future = self._loop.create_future()
        self._waiting.append(future)
        if self._page.version > after:
            self._plan_round()
        with suppress(TimeoutError):
            await asyncio.wait_for(future, PATIENCE_S)

    def state(self, **more: Any) -> tuple[int, bytes]:
        """Return version and state as JSON, encoded once for all who ask."""
        self._page.touch()
        if self._encoded[0] != self._page.version:
            state = self._page.state()
            data = json.dumps({**state, **more}, allow_nan=False, separators=(",", ":"))
            self._encoded = (state["version"], data.encode())
        return self._encoded

    def _heard(self) -> None:
        """Plan a round; called by whichever thread changed the state."""
        loop = self._loop
        if loop is not None and not self._round_planned:
            with suppress(RuntimeError):  # the loop has ended, and nobody waits
                loop.call_soon_threadsafe(self._plan_round)

    def _plan_round(self) -> None:
        if self._loop is not None and not self._round_planned:
            self._round_planned = True
            self._loop.call_later(PAUSE_S, self._begin_round)

    def _begin_round(self) -> None:
        self._round_planned = False
        self._woken += self._waiting
        self._waiting = []
        self._answer_some()

    def _answer_some(self) -> None:
        some, self._woken = self._woken[:AT_ONCE], self._woken[AT_ONCE:]
        for future in some:
            if not future.done():
                future.set_result(None)
        if self._woken and self._loop is not None:
            self._loop.call_soon(self._answer_some)


class _Encoder:
    """Encodes each picture once for all who ask, of the newest frame when its turn comes."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="live pictures")
        self._made: dict[Hashable, tuple[int, asyncio.Future[bytes]]] = {}

    async def of(self, wanted: Picture) -> bytes:
        """Return a picture as new as it is named, or being encoded now."""
        known, future = self._made.pop(wanted.key, (-1, None))
        if future is None or (future.done() and known != wanted.number) or _failed(future):
            known = wanted.number
            future = asyncio.get_running_loop().run_in_executor(self._thread, wanted.make)
        self._made[wanted.key] = known, future
        while len(self._made) > MOST_VIEWS:
            del self._made[next(iter(self._made))]
        return await asyncio.shield(future)


def _failed(future: asyncio.Future[bytes]) -> bool:
    return future.done() and (future.cancelled() or future.exception() is not None)


def application(
    page: Page,
    token: str,
    read_only: bool = False,
    hosts: tuple[str, ...] = LOCAL_HOSTS,
    to_act: str = "start `emmc-rig live` without --read-only",
) -> Starlette:
    """Return the ASGI application; hosts: names under which it may be asked for ("*": any).

    to_act: what somebody has to do who wants to act on a page that is read-only.
    """
    news, encoder = _News(page), _Encoder()
    at_once = ThreadPoolExecutor(1, thread_name_prefix="live urgent request")

    def guarded(
        answer: Callable[[Request], Awaitable[Response]],
    ) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            try:
                given = request.path_params.get("token", "")
                if not secrets.compare_digest(given.encode(), token.encode()):
                    raise _RefusedError(403, "wrong token: open the address that emmc-rig printed")
                response = await answer(request)
            except _RefusedError as refusal:
                response = PlainTextResponse(f"{refusal}\n", refusal.status)
            except ERRORS as fault:
                response = PlainTextResponse(f"{fault}\n", 400)
            except ClientDisconnect:
                response = Response(status_code=400)  # who asked has gone, and hears nothing
            response.headers.update(HEADERS)
            return response

        return endpoint

    async def shown(request: Request) -> Response:
        name = request.path_params.get("name", "") or page.files[0]
        if name in page.pictures:
            wanted = page.pictures[name](request.query_params)
            if wanted is None:
                raise _RefusedError(503, "nothing to show yet")
            return Response(await encoder.of(wanted), media_type=wanted.media_type)
        if name not in page.files:
            raise _RefusedError(404, f"no page {name!r}")
        if name.endswith(".html"):
            text = PARTS.get_template(name).render(poster=None)
        else:
            text = PARTS_FOUND.get_source(PARTS, name)[0]
        return Response(text, media_type=TYPES[name[name.rindex(".") :]])

    async def state(request: Request) -> Response:
        after = number_of(request.query_params, "after", 0, int)
        if after > 0:
            await news.newer(after)
        return Response(news.state(read_only=read_only)[1], media_type="application/json")

    async def events(request: Request) -> Response:
        async def states() -> AsyncIterator[bytes]:
            version, data = news.state(read_only=read_only)
            yield b"data: " + data + b"\n\n"
            while not news.closed:
                await news.newer(version)
                # Also when nobody waits any longer: the last state says how it ended.
                version, data = news.state(read_only=read_only)
                yield b"data: " + data + b"\n\n"

        return StreamingResponse(states(), media_type="text/event-stream")

    async def act(request: Request) -> Response:
        if request.method != "POST":
            raise _RefusedError(405, "nothing is done by GET: send POST")
        if read_only:
            raise _RefusedError(403, f"read-only: {to_act} to act")
        origin = request.headers.get("origin")
        page_origin = f"{request.url.scheme}://{request.headers.get('host')}"
        if origin not in (None, page_origin):
            raise _RefusedError(403, f"not from this page but from {origin}")
        name = request.path_params["action"]
        if name not in page.actions:
            raise _RefusedError(404, f"no action {name!r}: {', '.join(page.actions)}")
        values = await _body(request)

        def call() -> Mapping[str, Any]:
            return page.actions[name](**values) or {}

        try:
            if name in page.urgent:
                done = await asyncio.get_running_loop().run_in_executor(at_once, call)
            else:
                done = await run_in_threadpool(call)
        except TypeError as fault:
            raise _RefusedError(400, f"{name}: these are not its values ({fault})") from fault
        return JSONResponse({"done": name, **done})

    async def wrong_token(request: Request) -> Response:
        raise _RefusedError(403, "wrong token")

    made = Starlette(
        routes=[
            Route("/{token}/state", guarded(state), methods=["GET"]),
            Route("/{token}/events", guarded(events), methods=["GET"]),
            Route("/{token}/do/{action}", guarded(act), methods=["GET", "POST"]),
            Route("/{token}/", guarded(shown), methods=["GET"]),
            Route("/{token}/{name}", guarded(shown), methods=["GET"]),
            Route("/{rest:path}", guarded(wrong_token), methods=["GET", "POST"]),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))],
    )
    made.state.close = news.close
    return made


def listening_socket(host: str = "127.0.0.1", port: int = 0) -> socket.socket:
    """Return a socket to serve at; raises AppError where that is not possible."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as fault:
        why = getattr(fault, "strerror", None) or str(fault)
        raise AppError(
            f"cannot serve at {host} port {port} ({why}): choose another --port or --host"
        ) from fault


class Server(uvicorn.Server):
    """Serves an application: `run(sockets=[...])`, until `should_exit`."""

    def __init__(self, app: Starlette) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http="h11",
                log_level="warning",
                access_log=False,
                lifespan="off",
                server_header=False,
                timeout_graceful_shutdown=1,
            )
        )
        self._close = app.state.close
        self._accepting: list[Connections] = []

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept connections at these sockets: see `emmc_rig.live.connections`."""
        await super().startup(sockets=[])
        self._accepting = [Connections(one, self._connection) for one in sockets or []]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what is pushed, then what else is under way."""
        self._close()
        for one in self._accepting:
            one.close()
        await super().shutdown(sockets)

    def _connection(self) -> H11Protocol:
        return H11Protocol(self.config, self.server_state, self.lifespan.state)


@contextmanager
def served(app: Starlette) -> Iterator[int]:
    """Serve on this computer in a thread of its own until the block ends; yield the port."""
    with listening_socket() as listening:
        server = Server(app)
        thread = Thread(target=server.run, kwargs={"sockets": [listening]}, name="live server")
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join(PATIENCE_S)


def finite(value: object) -> float:
    """Return a number that somebody sent; raises AppError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise AppError(f"{value!r} is not a number")
    if not abs(value) < LARGEST:
        raise AppError("the value is not finite")
    return float(value)


async def _body(request: Request) -> dict[str, Any]:
    """Return the JSON object sent; a form of another site cannot send this content type."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise _RefusedError(415, "send JSON")
    data = b""
    async for chunk in request.stream():
        data += chunk
        if len(data) > LONGEST_BODY:
            raise _RefusedError(413, f"more than {LONGEST_BODY} bytes")
    try:
        values = parse_json(data or b"{}", "the request", ValueError)
    except ValueError as fault:
        raise _RefusedError(400, "not JSON") from fault
    if not isinstance(values, dict):
        raise _RefusedError(400, "send a JSON object")
    return values


def number_of(query: Mapping[str, str], name: str, default: float, kind: type = float) -> Any:
    """Return a number of a query; raises AppError for anything else."""
    try:
        value = kind(query.get(name, default))
        if not abs(value) < LARGEST:
            raise OverflowError
        return value
    except (ValueError, OverflowError) as fault:
        raise AppError(f"{name}={query[name]}: a number is wanted") from fault
