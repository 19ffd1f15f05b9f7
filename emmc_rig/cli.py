"""The command line: it registers the commands; 0 done, 1 failed, 2 wrong usage, 130 Ctrl-C."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any, NoReturn

import typer

from emmc_rig.commands.calibrate import calibrate
from emmc_rig.commands.cameras import cameras
from emmc_rig.commands.capture import capture
from emmc_rig.commands.chart import chart
from emmc_rig.commands.demo import demo
from emmc_rig.commands.design import design
from emmc_rig.commands.devices import app as devices
from emmc_rig.commands.examples import examples_of
from emmc_rig.commands.export import export
from emmc_rig.commands.figure import figure
from emmc_rig.commands.import_ import import_
from emmc_rig.commands.live import live
from emmc_rig.commands.mask import mask
from emmc_rig.commands.modes import ModalCommand, UsageError
from emmc_rig.commands.output import in_shell, say
from emmc_rig.commands.reconstruct import reconstruct
from emmc_rig.commands.session import app as session
from emmc_rig.commands.simulate import simulate
from emmc_rig.commands.stability import stability
from emmc_rig.commands.tables import tables
from emmc_rig.errors import ERRORS, StoppedError, WrongUsageError
from emmc_rig.model.errors import RemovedSettingWarning, ViewOrderWarning
from emmc_rig.version import __version__

INTERRUPTED = 130

app = typer.Typer(
    name="emmc-rig",
    help="Compressed light-field acquisition: model, rig, calibration, reconstruction.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
GROUPS: dict[str, tuple[typer.Typer | Callable[..., None], ...]] = {
    "Bench": (devices, live, capture, session, calibrate, mask, import_),
    "Results": (demo, reconstruct, export, figure, simulate, cameras),
    "Studies": (chart, stability, tables, design),
}
"""Commands by the panel of the help that lists them."""


def help_of_group(context: typer.Context) -> None:
    """Show the help of a group that is called without a command."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


for panel, commands in GROUPS.items():
    for command in commands:
        if isinstance(command, typer.Typer):
            for member in command.registered_commands:
                name = member.name or getattr(member.callback, "__name__", "")
                member.cls = ModalCommand
                member.epilog = examples_of(f"{command.info.name} {name.replace('_', '-')}")
            command.callback(invoke_without_command=True, help=command.info.help)(help_of_group)
            app.add_typer(command, rich_help_panel=panel)
        else:
            name = command.__name__.rstrip("_")  # `import` is a word of Python's
            app.command(name, cls=ModalCommand, rich_help_panel=panel, epilog=examples_of(name))(
                command
            )


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="print the version")] = False,
) -> None:
    """Compressed light-field acquisition: model, rig, calibration, reconstruction."""
    if version:
        typer.echo(f"emmc-rig {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo("start: emmc-rig demo")
    help_of_group(context)


def main() -> None:
    """Run the program; an error of `ERRORS` becomes a line without a traceback."""
    # Matplotlib warns in two lines where the home is read-only, and works all the same.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        with _warnings_as_notes():
            code = app(args=_typed(), prog_name="emmc-rig", standalone_mode=False) or 0
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        sys.exit(code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("stopped by Ctrl-C; nothing was written", INTERRUPTED)
    except StoppedError as stop:
        _fail(in_shell(stop), INTERRUPTED)
    except WrongUsageError as fault:
        _fail(in_shell(fault), 2)
    except ERRORS as fault:
        _fail(in_shell(fault), 1)
    except MemoryError:
        _fail("not enough memory: use a smaller --size or fewer shots", 1)
    except UsageError as fault:
        _fail(_usage_line(fault), 2)


def _usage_line(fault: typer.BadParameter) -> str:
    """Return wrong usage as one line; typer's own messages get the command that helps."""
    said = fault.format_message().removeprefix("Invalid value: ").removesuffix(".")
    if isinstance(fault, typer.BadParameter) and fault.param is None:
        return said
    command = fault.ctx.command_path if fault.ctx else "emmc-rig"
    said = said.removeprefix("Invalid value for ").replace("Input should", "should")
    joined = "" if said.endswith("?") else ";"
    return f"{said[0].lower()}{said[1:]}{joined} `{command} -h` shows what it takes"


def _typed() -> list[str]:
    """Return the words of the command line; `help COMMAND` is taken as `COMMAND --help`."""
    words = sys.argv[1:]
    if words[:1] != ["help"]:
        return words
    return [*words[1:], "--help"] if words[1:] else []


@contextmanager
def _warnings_as_notes() -> Iterator[None]:
    """Show the program's own warnings as a line, once each, and all others as before."""
    with warnings.catch_warnings():
        otherwise = warnings.showwarning

        def shown(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if issubclass(category, (RemovedSettingWarning, ViewOrderWarning)):
                say("note", message)
            else:
                otherwise(message, category, *where)

        warnings.showwarning = shown
        for shown_once in (RemovedSettingWarning, ViewOrderWarning):
            warnings.simplefilter("default", shown_once)
        yield


def _fail(message: str, code: int) -> NoReturn:
    say("emmc-rig", message, "bold red")
    sys.exit(code)
