"""`emmc-rig devices`: lists connected devices, and moves or exposes by hand.

Every command works alike on a real stage (`--stage`) and on a simulated one (`--rig simulated`).
Ctrl-C, SIGTERM, a closed terminal or an error during a move stops the stage and leaves it stopped.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from emmc_rig.captures.control import signals_interrupt
from emmc_rig.commands.conform import conform
from emmc_rig.commands.device_cameras import register, simulated_protocol
from emmc_rig.commands.options import StageOption
from emmc_rig.commands.output import (
    free_command,
    give_result,
    naming_stage,
    on_stage,
    say,
    show_table,
    shown_progress,
    tell,
)
from emmc_rig.drivers.cameras import CAMERAS
from emmc_rig.drivers.stage import Direction
from emmc_rig.errors import AppError

if TYPE_CHECKING:
    from emmc_rig.captures.bench_check import Ability
    from emmc_rig.drivers.stage import Stage

app = typer.Typer(
    name="devices",
    help="List, test and move stages, cameras and lights.",
)

RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig", help="simulated, simulated:grbl or simulated:apt, instead of real devices"
    ),
]
AxesArgument = Annotated[list[str] | None, typer.Argument(help="names of axes (default: all)")]


OFF_SWITCH_STEP_UM = 500.0
"""A step off a limit switch; a switch's way is a few times as long."""
MOST_STEPS_OFF_SWITCH = 6
"""3 mm, further than a switch is mostly pressed: it may be stuck, or the direction wrong."""


register(app)
app.command()(conform)


@app.command("list")
def list_devices(rig: RigOption = None) -> None:
    """List the serial ports and USB cameras of this computer."""
    from emmc_rig.drivers.clock import SYSTEM_CLOCK
    from emmc_rig.drivers.ports import guess_of, holder_of, list_serial_ports

    if rig is not None:
        from emmc_rig.bench.device_config import PROTOCOLS
        from emmc_rig.bench.hardware import simulated_bus

        simulated_protocol(rig)
        _list_cameras(simulated_bus(SYSTEM_CLOCK))
        show_table(("stage",), [(f"--rig simulated:{protocol}",) for protocol in PROTOCOLS])
        return
    _list_cameras()
    ports = list_serial_ports()
    if not ports:
        tell("no serial port: plug a stage in, or try --rig simulated")
        return
    rows = []
    for port in ports:
        known = port.vid is not None and port.pid is not None
        usb_id = f"{port.vid:04x}:{port.pid:04x}" if known else ""
        named = port.device, usb_id, port.serial_number or "", port.description or ""
        rows.append((*named, guess_of(port), holder_of(port.device)))
    show_table(("port", "USB id", "serial number", "description", "guess", "held by"), rows)


def _list_cameras(backend: Any = None) -> None:
    """Print the cameras that are plugged in; `backend`: of pyusb."""
    from emmc_rig.drivers.errors import DriverError
    from emmc_rig.drivers.usb import list_devices as list_usb

    try:
        found = [
            (kind, device)
            for kind, protocol in CAMERAS.items()
            if protocol.interface
            for device in list_usb(protocol.interface, backend)
        ]
    except DriverError as fault:
        tell(f"USB cameras cannot be listed: {fault}")
        return
    if not found:
        tell("no USB camera: plug one in and switch it on, or try --camera simulated")
        return
    refused = "no: see `emmc-rig devices udev-rule`"
    show_table(
        ("camera", "maker", "model", "may be opened"),
        [
            (
                f"{kind}:{device.serial}",
                device.maker,
                device.model,
                "yes" if device.accessible else refused,
            )
            for kind, device in found
        ],
    )


@app.command()
def probe(
    ports: Annotated[
        list[str] | None,
        typer.Argument(help="ports to ask (default: those with a known USB adapter)"),
    ] = None,
    rig: RigOption = None,
) -> None:
    """Ask serial ports which stage answers; nothing moves."""
    from emmc_rig.bench.hardware import probe_port, probe_simulated
    from emmc_rig.drivers.ports import guess_of, list_serial_ports

    # Silence in all protocols but one is what a probe expects.
    with _errors_only(logging.getLogger("emmc_rig.drivers")):
        if rig is not None:
            protocol = simulated_protocol(rig)
            tell(f"simulated:{protocol}: {probe_simulated(protocol)}")
            return
        chosen = ports or [port.device for port in list_serial_ports() if guess_of(port)]
        if not chosen:
            raise AppError("no port with a known adapter: name the ports to ask")
        with shown_progress() as progress:
            progress.begin("ask", len(chosen))
            for port in chosen:
                tell(f"{port}: {probe_port(port) or 'no answer in Zaber ASCII, Grbl or APT'}")
                progress.step(port)


@contextmanager
def _errors_only(logger: logging.Logger) -> Iterator[None]:
    """Keep warnings of a logger silent for a while; its level before comes back."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


@app.command()
def check(
    rig: Annotated[str, typer.Argument(help="simulated, or the YAML file of a rig")],
    camera: Annotated[
        str,
        typer.Option(
            "--camera", help="only this camera, with every calibration: shipped, or a YAML file"
        ),
    ] = "",
) -> None:
    """List which cameras and calibrations a rig can do."""
    from emmc_rig.bench.hands import NoAttendant
    from emmc_rig.bench.rig_config import ImagedRig, opened_rig, rig_description
    from emmc_rig.captures.bench_check import ability
    from emmc_rig.formats.cameras import find_camera
    from emmc_rig.model.camera import shipped_camera_files

    names = (
        [camera]
        if camera
        else [name for name in sorted(shipped_camera_files()) if find_camera(name).masks]
    )
    described = rig_description(rig, ImagedRig(scene="deep-occlusions", size=(48, 64), rays=16))
    with opened_rig(described, find_camera(names[0]), lambda wish: None) as opened:
        axes = opened.stage.axes
        hands = not isinstance(opened.attendant, NoAttendant)
        identity = opened.camera.identity
        lights = "by hand" if opened.lights is None else ", ".join(opened.lights.colours)
        show_table(
            ("part", rig),
            [
                ("stage axes", ", ".join(axes) or "none"),
                ("camera", f"{identity.maker} {identity.model} {identity.serial}".strip()),
                ("lights", lights if hands or opened.lights else "nothing (by_hand: false)"),
                ("moved by hand", "what no axis moves" if hands else "nothing (by_hand: false)"),
            ],
        )
    with shown_progress() as progress:
        progress.begin("cameras", len(names))
        found = []
        for name in names:
            found.append(ability(name, find_camera(name), axes, hands))
            progress.step(name)
    if camera:
        _show_camera(found[0])
    else:
        _show_cameras(found, axes)
    give_result(
        rig=rig,
        axes=list(axes),
        cameras={
            fit.camera: {
                "shots": fit.shots,
                "calibration": fit.best.name,
                "relative_error": fit.best.error,
                "moves_by_hand": fit.hands(fit.best) + fit.by_hand,
            }
            for fit in found
        },
    )


def _show_camera(found: Ability) -> None:
    """Print every calibration of a camera on a rig."""
    from emmc_rig.captures.bench_check import shown_error

    tell(
        f"{found.camera}: {found.shots} of {found.of_shots} shots, {found.by_hand} mask moves by "
        "hand"
    )
    rows = [
        (
            way.name,
            ", ".join(way.axes) or "none",
            f"{found.hands(way)} moves" if way.name in found.possible else "not possible",
            shown_error(way.error),
        )
        for way in found.calibrations
    ]
    show_table(("calibration", "axes", "by hand", "calibration error"), rows)


def _show_cameras(found: Sequence[Ability], axes: Sequence[str]) -> None:
    """Print the best calibration of each camera on a rig with these axes."""
    from emmc_rig.captures.bench_check import shown_error

    heads = ("camera", "shots", "calibration", "by hand", "calibration error", "with one more axis")
    rows = [
        (
            fit.camera,
            f"{fit.shots} of {fit.of_shots}",
            fit.best.name,
            f"{fit.hands(fit.best) + fit.by_hand} moves",
            shown_error(fit.best.error),
            fit.more(axes),
        )
        for fit in found
    ]
    show_table(heads, rows)


@app.command()
def lights(
    colour: Annotated[
        str | None, typer.Argument(help="off, white, red, green or blue (default: list them)")
    ] = None,
    rig: Annotated[str, typer.Option("--rig", help="simulated, or the YAML file of a rig")] = "",
) -> None:
    """List a rig's lights, or switch them by hand; nothing moves."""
    from emmc_rig.bench.hardware import SIMULATED, open_lights
    from emmc_rig.bench.rig_config import ImagedRig, rig_description

    if not rig:
        raise typer.BadParameter("name the YAML file of a rig, or --rig simulated")
    spec: Any = SIMULATED
    if rig != SIMULATED:
        spec = rig_description(rig, ImagedRig(scene="deep-occlusions")).get("lights")
    if spec is None:
        raise AppError(
            f"{rig}: names no lights, so a person switches them: describe them under lights:"
        )
    with shown_progress("lights"), closing(open_lights(spec)) as opened:
        answer = "" if colour is None else opened.set(colour)
        name, colours = opened.name, opened.colours
    if colour is None:
        show_table(("lights", "colours"), [(name, ", ".join(colours))])
    else:
        tell(f"{name}: {colour}, confirmed by {answer!r}")
    give_result(lights=name, colours=list(colours), colour=colour, answer=answer)


@app.command()
def info(stage: StageOption = None, rig: RigOption = None) -> None:
    """Show a stage's axes: homed, position, limits, speed."""
    with _opened(stage, rig) as opened:
        _show(opened)


@app.command()
def home(axes: AxesArgument = None, stage: StageOption = None, rig: RigOption = None) -> None:
    """Home the axes of a stage, and show where they are."""
    with _opened(stage, rig) as opened:
        with shown_progress("home"):
            opened.home(axes or None)
        _show(opened)


@app.command()
def jog(
    axis: Annotated[str, typer.Argument(help="name of the axis")],
    distance_um: Annotated[float, typer.Argument(help="distance in um; with --to the position")],
    to: Annotated[
        bool, typer.Option("--to", help="move to this position instead of by this distance")
    ] = False,
    home_first: Annotated[
        bool,
        typer.Option("--home", help="home it first, with all other axes where none is homed alone"),
    ] = False,
    speed_um_s: Annotated[
        float | None, typer.Option("--speed", help="um/s (default: the axis's own)")
    ] = None,
    stage: StageOption = None,
    rig: RigOption = None,
) -> None:
    """Move an axis by a distance (-5: back), or to a position."""
    from emmc_rig.drivers.errors import NotHomedError, PressedSwitchError

    with _opened(stage, rig) as opened:
        if speed_um_s is not None:
            opened.set_speed_um_s(axis, speed_um_s)
        with shown_progress("home" if home_first else "move") as progress:
            if home_first:
                opened.home([axis])
                progress.begin("move")
            move = opened.move_to_um if to else opened.move_by_um
            try:
                at_um = move({axis: distance_um})[axis]
            except NotHomedError as fault:
                for switched, away in pressed_switches(opened).items():
                    raise PressedSwitchError(switched, away or "") from None
                # After homing, a distance may lead out of the travel; a place within never does.
                place_um = distance_um if to else sum(opened.limits_um(axis)) / 2
                words = f"{axis} {place_um:g} --to --home"
                raise AppError(
                    f"{fault.what}: home it in the same command, as "
                    f"`{on_stage('jog', words, rig or stage or '')}`"
                ) from None
        tell(f"{axis} at {at_um:.3f} um")
        give_result(axis=axis, at_um=at_um)


@app.command()
def free(
    axis: Annotated[str, typer.Argument(help="name of the axis")],
    direction: Annotated[
        Direction | None,
        typer.Option(
            "--direction",
            help="off the switch; up: to larger positions (default: as the stage reports)",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask before each step")] = False,
    stage: StageOption = None,
    rig: RigOption = None,
) -> None:
    """Move an axis off its limit switch, in slow steps of 0.5 mm, each after a question."""
    with _opened(stage, rig) as opened:
        pressed = pressed_switches(opened)
        if axis not in pressed:
            opened.limits_um(axis)  # of an axis that the stage has
            tell(f"the stage reports no pressed limit switch of {axis}: nothing was moved")
            give_result(axis=axis, pressed=False, moved_um=0.0)
            return
        named, switched = rig or stage or "", cast("Any", opened)
        away = direction or pressed[axis] or _asked_direction(axis, yes)
        for steps in range(1, MOST_STEPS_OFF_SWITCH + 1):
            question = f"Move {axis} {away} by {OFF_SWITCH_STEP_UM / 1e3:g} mm?"
            if not yes and not typer.confirm(question, err=True):
                raise AppError(f"{axis} still stands on its limit switch")
            moved_um = away.sign * steps * OFF_SWITCH_STEP_UM
            # The release of the switch is an alarm, which is no news here.
            with _errors_only(logging.getLogger("emmc_rig.drivers")):
                released = switched.move_off_switch(axis, away, OFF_SWITCH_STEP_UM)
            if released:
                left = [other for other in pressed_switches(opened) if other != axis]
                then = free_command(left[0], named) if left else on_stage("home", "", named)
                tell(f"{axis} is off its limit switch after {moved_um / 1e3:+g} mm; next: `{then}`")
                give_result(axis=axis, pressed=False, moved_um=moved_um)
                return
        raise AppError(
            f"the switch of {axis} is still pressed after {moved_um / 1e3:+g} mm: look whether the "
            "axis moves away from it, and whether the switch or its wiring is stuck (Grbl: $5 says "
            "which level counts as pressed)"
        )


def pressed_switches(stage: Stage) -> dict[str, Direction | None]:
    """Return the axes on a limit switch, and the direction off it; {}: none, or not reported."""
    return getattr(stage, "pressed_switches", dict)()


def _asked_direction(axis: str, yes: bool) -> Direction:
    """Return the direction that leads off a switch, from a person; raises AppError without one.

    yes: no question may be asked.
    """
    unknown = (
        f"{axis} stands on a limit switch, and the controller does not report at which end of the "
        "travel"
    )
    if not yes:
        say("note", f"{unknown}: look where it stands")
        try:
            question = "Up or down: which direction leads off the switch"
            return Direction(typer.prompt(question, type=Direction, err=True))
        except typer.Abort:  # no terminal to ask at
            pass
    raise AppError(
        f"{unknown}: look where it stands, and add --direction up at the lower end, or --direction "
        "down at the upper end"
    )


@app.command("udev-rule")
def udev_rule() -> None:
    """Print the udev rule that lets users open the devices (Linux)."""
    from emmc_rig.drivers.errors import UDEV_RULE

    tell(UDEV_RULE.read_text(encoding="utf-8").removesuffix("\n"))


@contextmanager
def _opened(stage: str | None, rig: str | None) -> Iterator[Stage]:
    """Yield the chosen stage; a stage that moves is stopped when the block is left by an error."""
    from emmc_rig.bench.hardware import open_stage

    if (stage is None) == (rig is None):
        raise typer.BadParameter("name a stage by --stage, or --rig simulated")
    if rig is not None:
        simulated_protocol(rig)
    logging.basicConfig(format="emmc-rig: %(message)s", level=logging.WARNING)
    with signals_interrupt(), open_stage(rig or stage or "") as opened:
        try:
            with naming_stage(rig or stage or ""):
                yield opened
        except KeyboardInterrupt as stop:
            notes = getattr(stop, "__notes__", ["the stage was stopped"])
            say("stopped", "; ".join(notes))
            raise


def _show(stage: Stage) -> None:
    from emmc_rig.drivers.errors import NotHomedError

    rows, axes = [], {}
    for axis in stage.axes:
        low_um, high_um = stage.limits_um(axis)
        try:
            axes[axis] = stage.position_um(axis)
            homed, position = "yes", f"{axes[axis]:.3f}"
        except NotHomedError:
            axes[axis], homed, position = None, "no", "unknown"
        speeds = f"{stage.speed_um_s(axis):g}", f"{stage.top_speed_um_s(axis):g}"
        rows.append((axis, homed, position, f"{low_um:g} to {high_um:g}", *speeds))
    show_table(("axis", "homed", "position um", "limits um", "speed um/s", "up to"), rows)
    give_result(positions_um=axes)
