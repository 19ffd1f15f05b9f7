"""The command `emmc-rig live`: a local page that shows the camera and moves the stage."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from emmc_rig.commands.options import RigOption, RigSceneOption, RigSizeOption
from emmc_rig.errors import AppError

if TYPE_CHECKING:
    from emmc_rig.live.watch import Watch

EVERYWHERE = ("0.0.0.0", "::")


def live(
    rig: RigOption = None,
    camera: Annotated[
        str | None, typer.Option("--camera", help="ptp:SERIAL, u3v:SERIAL, folder:DIR or simulated")
    ] = None,
    stage: Annotated[
        str | None, typer.Option("--stage", help="zaber:PORT, grbl:PORT, apt:PORT or a YAML file")
    ] = None,
    design: Annotated[
        str, typer.Option("--design", help="the masks in a simulated rig: see `emmc-rig cameras`")
    ] = "rgbw-bayer-1shot",
    scene: RigSceneOption = "deep-occlusions",
    size: RigSizeOption = None,
    host: Annotated[str, typer.Option("--host", help="address to serve at")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any that is free")] = 0,
    read_only: Annotated[
        bool, typer.Option("--read-only", help="the page shows, and moves and sets nothing")
    ] = False,
    browser: Annotated[bool, typer.Option("--open", help="open the page in a browser")] = False,
) -> None:
    """Show the camera on a local page: histogram, focus, mask alignment, jog. Ctrl-C ends."""
    from emmc_rig.live.server import LOCAL_HOSTS, application, new_token

    if rig is not None and (camera or stage):
        raise typer.BadParameter("name either --rig, or --camera and --stage")
    listening = _listen(host, port)
    with closing(listening), _watch(rig, camera, stage, design, scene, size) as watch:
        token = new_token()
        number = listening.getsockname()[1]
        shown = "127.0.0.1" if host in EVERYWHERE else f"[{host}]" if ":" in host else host
        address = f"http://{shown}:{number}/{token}/"
        typer.echo(address)
        hosts = LOCAL_HOSTS
        if host not in ("127.0.0.1", "::1", "localhost"):
            hosts = ("*",) if host in EVERYWHERE else (*LOCAL_HOSTS, shown)
            typer.echo(
                "careful: others in the network who know this address can "
                + ("look" if read_only else "look and move the stage"),
                err=True,
            )
        if browser:
            import webbrowser

            webbrowser.open(address)
        _serve(application(watch, token, read_only, hosts), listening, watch.start)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as fault:
        why = getattr(fault, "strerror", None) or str(fault)
        raise AppError(
            f"cannot serve at {host} port {port} ({why}): choose another --port or --host"
        ) from fault


@contextmanager
def _watch(
    rig: str | None,
    camera: str | None,
    stage: str | None,
    design: str,
    scene: str,
    size: str | None,
) -> Iterator[Watch]:
    """Yield a Watch over opened devices, which end with it."""
    from emmc_rig.live.watch import Watch
    from emmc_rig.rig.hardware import SimulatedRig, open_camera, open_stage

    with ExitStack() as stack:
        if rig is not None:
            from emmc_rig.files.cameras import find_camera
            from emmc_rig.files.results import parse_size
            from emmc_rig.rig.rig_config import ImagedRig, opened_rig, rig_description

            imaged = ImagedRig(scene=scene, size=parse_size(size), real_time=True)
            opened = stack.enter_context(
                opened_rig(rig_description(rig, imaged), find_camera(design), _nobody)
            )
            look, targets = None, ()
            if isinstance(opened, SimulatedRig):
                opened.attendant.set_lamp("white")
                look, targets = opened.attendant.place, ("scene", "whiteboard")
            centre_um = dict(opened.zero_um)
            if "aperture_x" in centre_um:
                centre_um["aperture_x"] += opened.window_um
            watch = Watch(opened.camera, opened.stage, look, targets, centre_um)
        else:
            device = stack.enter_context(closing(open_camera(camera or "ptp:")))
            driven = stack.enter_context(open_stage(stage)) if stage is not None else None
            watch = Watch(device, driven)
        stack.callback(watch.close)
        yield watch


def _nobody(what: str) -> None:
    """Ask for nothing: a page that only shows and jogs needs no lamp changed."""


def _serve(app: object, listening: socket.socket, begin: Callable[[], None]) -> None:
    """Serve until Ctrl-C or SIGTERM, which are how it is meant to end."""
    import uvicorn

    config = uvicorn.Config(
        app,  # pyright: ignore[reportArgumentType]
        log_level="warning",
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    begin()
    try:
        uvicorn.Server(config).run(sockets=[listening])
    except KeyboardInterrupt:
        typer.echo("ended; the stage stands")
