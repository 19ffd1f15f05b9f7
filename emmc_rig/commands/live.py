"""The command `emmc-rig live`: a local page that shows the camera and moves the stage."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from emmc_rig.commands.modes import given_names, refuse
from emmc_rig.commands.options import (
    SIMULATED_PANEL,
    HostOption,
    MethodOption,
    RigOption,
    RigSceneOption,
    RigSizeOption,
    StageOption,
)
from emmc_rig.commands.output import say, shown_progress, tell
from emmc_rig.drivers.cameras import CAMERA_HELP
from emmc_rig.errors import AppError

if TYPE_CHECKING:
    from emmc_rig.calibration.scale import Scale
    from emmc_rig.drivers.camera import Camera as DeviceCamera
    from emmc_rig.drivers.stage import Stage
    from emmc_rig.live.light_field import LiveLightField
    from emmc_rig.live.watch import Watch
    from emmc_rig.model.camera import Camera

DESIGN = "design"


def live(
    context: typer.Context,
    rig: RigOption = None,
    camera: Annotated[
        str | None, typer.Option("--camera", help=f"{CAMERA_HELP} or simulated")
    ] = None,
    stage: StageOption = None,
    design: Annotated[
        str,
        typer.Option(
            "--design",
            help="the camera whose masks are in it, see `emmc-rig cameras`",
            rich_help_panel=SIMULATED_PANEL,
        ),
    ] = "rgbw-bayer-1shot",
    scene: RigSceneOption = "deep-occlusions",
    size: RigSizeOption = None,
    psi: Annotated[
        str | None,
        typer.Option(
            "--psi",
            help="show the light field too, by a session, a calibration's folder, psi.h5, or "
            "`design`",
        ),
    ] = None,
    method: MethodOption = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan",
            help="a plan to write the exposure into; all else goes into the file of --rig",
        ),
    ] = None,
    host: HostOption = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="port of the page; 0: any that is free")
    ] = 0,
    read_only: Annotated[
        bool, typer.Option("--read-only", help="the page moves and sets nothing")
    ] = False,
    browser: Annotated[bool, typer.Option("--open", help="open the page in a browser")] = False,
) -> None:
    """Set up the bench on a local page: centre the mask, exposure, align, focus, save.

    It shows the light field too, where Psi is known. Ctrl-C ends.
    """
    from emmc_rig.live.server import (
        LOCAL_HOSTS,
        Server,
        address,
        application,
        listening_socket,
        names_of,
        new_token,
    )

    if rig is not None and (camera or stage):
        raise typer.BadParameter("name either --rig, or --camera and --stage")
    if rig != "simulated":
        refuse(context, given_names(context) & {"scene", "size"}, "without --rig simulated")
    if read_only and plan is not None:
        refuse(context, ("plan",), "with --read-only")
    if rig == "simulated":
        psi = psi or DESIGN
    if method is not None and psi is None:
        raise typer.BadParameter("--method needs --psi")
    listening, wants = listening_socket(host, port), "" if read_only else saving_wants(plan, rig)
    with closing(listening), ExitStack() as opened:
        with shown_progress("open the devices"):
            watch = opened.enter_context(
                _watch(rig, camera, stage, design, scene, size, psi, method, plan, wants)
            )
        token = new_token()
        found = address(host, listening.getsockname()[1], token)
        tell(found)
        if wants:
            tell(wants.replace("`", ""))
        hosts = names_of(host)
        if hosts != LOCAL_HOSTS:
            does = "look" if read_only else "look and move the stage"
            say("careful", f"others in the network who know this address can {does}")
        if browser:
            import webbrowser

            webbrowser.open(found)
        watch.start()
        try:
            to_act = "start `emmc-rig live` without --read-only"
            Server(application(watch, token, read_only, hosts, to_act)).run(sockets=[listening])
        except KeyboardInterrupt:
            tell("ended; the stage does not move")


def saving_wants(plan: Path | None, rig: str | None) -> str:
    """Return the options that saving needs beside those given, in words; "" for none."""
    from emmc_rig.bench.hardware import SIMULATED

    missing = ["`--plan PLAN` (exposure)"] if plan is None else []
    if rig in (None, SIMULATED):
        missing.append("`--rig FILE` (centre, mask, focus)")
    return f"Saving needs {' and '.join(missing)}." if missing else ""


@contextmanager
def _watch(
    rig: str | None,
    camera: str | None,
    stage: str | None,
    design: str,
    scene: str,
    size: str | None,
    psi: str | None,
    method: str | None,
    plan: Path | None,
    wants: str,
) -> Iterator[Watch]:
    """Yield a Watch over opened devices, which end with it."""
    from emmc_rig.bench.hardware import SIMULATED
    from emmc_rig.captures.plan import load_plan
    from emmc_rig.formats.cameras import find_camera
    from emmc_rig.live.save import Files
    from emmc_rig.live.watch import Watch

    described, scale = find_camera(design), _scale(psi)
    files = Files(plan, None if rig is None or rig == SIMULATED else Path(rig))
    words = ("emmc-rig", "capture", str(plan), "--rig", rig or "")
    following = shlex.join(words) if plan and rig else ""
    if plan is not None:
        load_plan(plan)
    with ExitStack() as stack:
        if rig is None:
            devices = _named_devices(stack, camera, stage)
        else:
            devices = _devices_of_rig(stack, rig, described, scene, size)
        field = _light_field(psi, scale, method, described, devices.camera.shape)
        watch = Watch(
            devices.camera, devices.stage, devices.place, devices.targets, devices.centre_um,
            described, field, files, following, wants,
        )  # fmt: skip
        stack.callback(watch.close)
        yield watch


class _Devices(NamedTuple):
    """What a page shows and moves.

    place: puts a target before the camera; None where a person does. centre_um: position of each
    axis at which the masks and the aperture are centred.
    """

    camera: DeviceCamera
    stage: Stage | None
    place: Callable[..., None] | None = None
    targets: tuple[str, ...] = ()
    centre_um: Mapping[str, float] | None = None


def _devices_of_rig(
    stack: ExitStack, rig: str, design: Camera, scene: str, size: str | None
) -> _Devices:
    """Open the devices of a rig until the stack closes; a simulated one with its aperture open."""
    from emmc_rig.bench.hardware import SimulatedRig
    from emmc_rig.bench.rig_config import ImagedRig, opened_rig, rig_description
    from emmc_rig.store.results import parse_size

    imaged = ImagedRig(scene=scene, size=parse_size(size), real_time=True)
    opened = stack.enter_context(opened_rig(rig_description(rig, imaged), design, _nobody))
    place, targets = None, ()
    if isinstance(opened, SimulatedRig) or opened.lights is not None:
        opened.set_lamp("white")
    if isinstance(opened, SimulatedRig):
        open_um = {"aperture_x": opened.window_um, "aperture_y": 0.0}
        by_hand = {axis: um for axis, um in open_um.items() if axis not in opened.stage.axes}
        opened.attendant.move(by_hand)
        place, targets = opened.attendant.place, ("scene", "whiteboard")
    centre_um = dict(opened.zero_um)
    if "aperture_x" in centre_um:
        centre_um["aperture_x"] += opened.window_um
    moved = opened.stage if opened.stage.axes else None
    return _Devices(opened.camera, moved, place, targets, centre_um)


def _named_devices(stack: ExitStack, camera: str | None, stage: str | None) -> _Devices:
    """Open a camera, by default a USB camera, and a stage if one is named."""
    from emmc_rig.bench.hardware import open_camera, open_stage
    from emmc_rig.drivers.errors import UsbNotFoundError

    try:
        device = stack.enter_context(closing(open_camera(camera or "ptp:")))
    except UsbNotFoundError as fault:
        raise AppError(f"{fault}; to try the page without a camera: --rig simulated") from fault
    return _Devices(device, None if stage is None else stack.enter_context(open_stage(stage)))


def _scale(psi: str | None) -> Scale | None:
    """Return what --psi names; None where nothing, or the design, which needs the camera's size."""
    if psi is None or psi == DESIGN:
        return None
    from emmc_rig.live.light_field import live_scale

    return live_scale(Path(psi))


def _light_field(
    psi: str | None,
    scale: Scale | None,
    method: str | None,
    design: Camera,
    pixels: tuple[int, int],
) -> LiveLightField | None:
    """Return what reconstructs while the camera watches; None without a Psi."""
    if psi is None:
        return None
    from emmc_rig.calibration.scale import designed_scale
    from emmc_rig.live.light_field import LiveLightField
    from emmc_rig.reconstruction.methods import DEFAULT_METHOD, find_method

    chosen = method or DEFAULT_METHOD
    if find_method(chosen).needs_dictionary:
        raise AppError(f"--method {chosen} needs a dictionary: choose a method that needs none")
    if scale is None:
        k = design.sensor.binning
        scale = designed_scale(design.psi((pixels[0] * k, pixels[1] * k)))
    expected = scale.psi.frames_shape[1:]
    if expected != tuple(pixels):
        raise AppError(
            f"--psi {psi}: for frames of {expected[0]}x{expected[1]} pixels, but the camera sends "
            f"{pixels[0]}x{pixels[1]}: name the Psi of this camera"
        )
    return LiveLightField(scale, chosen)


def _nobody(what: str) -> None:
    """Ask for nothing: a page that only shows and jogs needs no lamp changed."""
