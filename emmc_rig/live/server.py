"""The set-up page over HTTP: a secret in its address, nothing done by GET, nothing of others.

Every path begins with a random token, and the host must be one of this computer's names for
itself, so that no other page in the browser can reach it (cross-site requests, DNS rebinding).

Requests that wait for news hold no thread, and are answered a few at a time: what stops the stage
has a thread of its own and finds the loop free between them, however many look on.
"""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import Awaitable, Callable, Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from emmc_rig.errors import AppError
from emmc_rig.live.picture import KINDS, View, disparity_png, encoded, picture
from emmc_rig.live.watch import Watch

LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")
PATIENCE_S = 10.0
LARGEST = 1e12
"""No position, exposure or number of pixels comes near it."""
LONGEST_BODY = 4096
PAUSE_S, PAUSE_EACH_S = 0.04, 0.002
"""At least between two rounds of answers to those who wait for news, and more for each of them."""
AT_ONCE = 4
"""Answers between which the loop looks for other requests."""
MOST_VIEWS = 16
"""Whose last picture is kept; those asked for least recently go first."""
PAGE = {
    "": ("page.html", "text/html"),
    "page.css": ("page.css", "text/css"),
    "page.js": ("page.js", "text/javascript"),
}
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


class _RefusedError(Exception):
    """A request that is not answered as asked: status and one line."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class _News:
    """Wakes requests that wait for a newer state; used in the server's loop alone."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: list[asyncio.Future[None]] = []
        self._woken: list[asyncio.Future[None]] = []
        self._round_planned = False
        self._encoded: tuple[int, bytes] = (-1, b"")
        watch.listen(self._heard)

    async def newer(self, after: int, patience_s: float) -> None:
        """Return when the state is newer than `after`, or patience ends."""
        self._loop = asyncio.get_running_loop()
        if after <= 0:
            return
        future = self._loop.create_future()
        self._waiting.append(future)
        if self._watch.version > after:
            self._plan_round()
        with suppress(TimeoutError):
            await asyncio.wait_for(future, patience_s)

    def state(self, **more: Any) -> bytes:
        """Return the state as JSON, encoded once for all who ask."""
        version = self._watch.version
        if self._encoded[0] != version:
            state = self._watch.state()
            data = json.dumps({**state, **more}, allow_nan=False, separators=(",", ":"))
            self._encoded = (state["version"], data.encode())
        else:
            self._watch.newest()
        return self._encoded[1]

    def _heard(self) -> None:
        """Plan a round; called by whichever thread changed the state."""
        loop = self._loop
        if loop is not None and not self._round_planned:
            with suppress(RuntimeError):  # the loop has ended, and nobody waits
                loop.call_soon_threadsafe(self._plan_round)

    def _plan_round(self) -> None:
        if self._loop is not None and not self._round_planned:
            self._round_planned = True
            self._loop.call_later(PAUSE_S + PAUSE_EACH_S * len(self._waiting), self._begin_round)

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

    async def of(self, what: Hashable, number: int, make: Callable[[], bytes]) -> bytes:
        """Return the picture called `what` of a frame as new as `number` or being encoded now."""
        known, future = self._made.pop(what, (-1, None))
        if future is None or (future.done() and known != number) or _failed(future):
            known, future = number, asyncio.get_running_loop().run_in_executor(self._thread, make)
        self._made[what] = known, future
        while len(self._made) > MOST_VIEWS:
            del self._made[next(iter(self._made))]
        return await asyncio.shield(future)


def _failed(future: asyncio.Future[bytes]) -> bool:
    return future.done() and (future.cancelled() or future.exception() is not None)


def application(
    watch: Watch, token: str, read_only: bool = False, hosts: tuple[str, ...] = LOCAL_HOSTS
) -> Starlette:
    """Return the ASGI application; hosts: names under which it may be asked for ("*": any)."""
    actions = _actions(watch)
    news, encoder = _News(watch), _Encoder()
    stopping = ThreadPoolExecutor(1, thread_name_prefix="live stop request")

    def guarded(
        answer: Callable[[Request], Awaitable[Response]],
    ) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            try:
                given = request.path_params.get("token", "")
                if not secrets.compare_digest(given.encode(), token.encode()):
                    raise _RefusedError(
                        403, "wrong token: open the address that `emmc-rig live` printed"
                    )
                response = await answer(request)
            except _RefusedError as refusal:
                response = PlainTextResponse(f"{refusal}\n", refusal.status)
            except AppError as fault:
                response = PlainTextResponse(f"{fault}\n", 400)
            response.headers.update(HEADERS)
            return response

        return endpoint

    async def page(request: Request) -> Response:
        name = request.path_params.get("name", "")
        if name not in PAGE:
            raise _RefusedError(404, f"no page {name!r}")
        file, kind = PAGE[name]
        text = files("emmc_rig.live").joinpath(file).read_text(encoding="utf-8")
        return Response(text, media_type=kind)

    async def state(request: Request) -> Response:
        after = _number(request.query_params, "after", 0, int)
        await news.newer(after, PATIENCE_S)
        return Response(news.state(read_only=read_only), media_type="application/json")

    async def shown(request: Request) -> Response:
        view = _view(request.query_params)
        newest = watch.newest()
        if newest is None:
            raise _RefusedError(503, "no frame yet")

        def make() -> bytes:
            frame = watch.frame()
            assert frame is not None
            return encoded(picture(frame, view))

        data = await encoder.of(view, newest.number, make)
        return Response(data, media_type="image/jpeg")

    async def views(request: Request) -> Response:
        pictures = None if watch.light_field is None else watch.light_field.pictures()
        if pictures is None:
            raise _RefusedError(503, "no light field yet")
        data = await encoder.of("views", pictures.number, lambda: encoded(pictures.sheet))
        return Response(data, media_type="image/jpeg")

    async def disparity(request: Request) -> Response:
        pictures = None if watch.light_field is None else watch.light_field.pictures()
        if pictures is None:
            raise _RefusedError(503, "no light field yet")
        data = await encoder.of(
            "disparity", pictures.number, lambda: disparity_png(pictures.disparity)
        )
        return Response(data, media_type="image/png")

    async def act(request: Request) -> Response:
        if request.method != "POST":
            raise _RefusedError(405, "nothing is done by GET: send POST")
        if read_only:
            raise _RefusedError(403, "read-only: start `emmc-rig live` without --read-only to act")
        origin = request.headers.get("origin")
        if origin is not None and origin.partition("://")[2] != request.headers.get("host"):
            raise _RefusedError(403, f"not from this page but from {origin}")
        name = request.path_params["action"]
        if name not in actions:
            raise _RefusedError(404, f"no action {name!r}: {', '.join(actions)}")
        values = await _body(request)
        try:
            if name == "stop":
                await asyncio.get_running_loop().run_in_executor(
                    stopping, lambda: actions[name](**values)
                )
            else:
                await run_in_threadpool(lambda: actions[name](**values))
        except TypeError as fault:
            raise _RefusedError(400, f"{name}: these are not its values ({fault})") from fault
        return JSONResponse({"done": name})

    async def stranger(request: Request) -> Response:
        raise _RefusedError(403, "wrong token")

    return Starlette(
        routes=[
            Route("/{token}/state", guarded(state), methods=["GET"]),
            Route("/{token}/picture.jpg", guarded(shown), methods=["GET"]),
            Route("/{token}/views.jpg", guarded(views), methods=["GET"]),
            Route("/{token}/disparity.png", guarded(disparity), methods=["GET"]),
            Route("/{token}/do/{action}", guarded(act), methods=["GET", "POST"]),
            Route("/{token}/", guarded(page), methods=["GET"]),
            Route("/{token}/{name}", guarded(page), methods=["GET"]),
            Route("/{rest:path}", guarded(stranger), methods=["GET", "POST"]),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))],
    )


def _actions(watch: Watch) -> Mapping[str, Callable[..., None]]:
    def exposure(seconds: float) -> None:
        watch.set_exposure_s(_finite(seconds))

    def gain(factor: float) -> None:
        watch.set_gain(_finite(factor))

    def jog(axis: str, distance_um: float) -> None:
        watch.jog(str(axis), _finite(distance_um))

    def go(axis: str, place_um: float) -> None:
        watch.go(str(axis), _finite(place_um))

    def home() -> None:
        watch.home()

    def centre() -> None:
        watch.centre()

    def stop() -> None:
        watch.stop()

    def look(target: str) -> None:
        watch.look_at(target)

    def reference(taken: bool) -> None:
        watch.take_reference(taken)

    def autoexpose() -> None:
        watch.auto_expose()

    def refocus() -> None:
        watch.forget_focus()

    known = (
        exposure, gain, autoexpose, jog, go, home, centre, stop, look, reference, refocus,
    )  # fmt: skip
    return {action.__name__: action for action in known}


def _finite(value: object) -> float:
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
        values = json.loads(data or b"{}")
    except (ValueError, RecursionError) as fault:
        raise _RefusedError(400, "not JSON") from fault
    if not isinstance(values, dict):
        raise _RefusedError(400, "send a JSON object")
    return values


def _number(query: Mapping[str, str], name: str, default: float, kind: type = float) -> Any:
    try:
        value = kind(query.get(name, default))
        if not abs(value) < LARGEST:
            raise OverflowError
        return value
    except (ValueError, OverflowError) as fault:
        raise _RefusedError(400, f"{name}={query[name]}: a number is wanted") from fault


def _view(query: Mapping[str, str]) -> View:
    kind = query.get("kind", "colour")
    if kind not in KINDS:
        raise _RefusedError(400, f"kind={kind}: choose one of {', '.join(KINDS)}")
    whole = View()
    return replace(
        whole,
        kind=kind,
        x=_number(query, "x", whole.x),
        y=_number(query, "y", whole.y),
        part=_number(query, "part", whole.part),
        longest_px=_number(query, "px", whole.longest_px, int),
        marked=query.get("marked", "1") != "0",
        bright=query.get("bright", "0") != "0",
    )
