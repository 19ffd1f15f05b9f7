"""Modes of commands: an option that changes what a command does, and the options of each mode.

An option that would be ignored is refused: wrong usage, in one line.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand
from typer.main import get_command

from emmc_rig.commands.output import emit, in_shell, json_wanted
from emmc_rig.errors import ERRORS

MODES: dict[str, dict[str, set[str]]] = {
    "calibrate": {
        "drift": {"known", "out"},
        "session": {"method", "sensor", "out"},
        "plan": {"camera", "size", "target", "skip", "few", "frames", "out"},
    },
    "capture": {"new": {"out"}},
    "demo": {"own_data": {"seed"}},
    "export": {"list_formats": set()},
    "reconstruct": {"list_methods": set()},
    "stability": {"faults": set()},
}
"""By command and mode, as its function names them: what else may be given."""
NEEDS: dict[str, dict[str, str | tuple[str, ...]]] = {
    "calibrate": {"known": "drift", "frames": "plan", "sensor": "session"},
    "cameras": {"out": "name"},
    "export": {"truth": "result"},
}
"""By command and option: the option, or options, that it depends on."""
RENAMED = {"calibrate": {"--route": "--method", "--leave-out": "--skip"}}
"""By command: options of earlier versions, which scripts use, and their new names."""
_NEGATIVE = re.compile(r"-\.?\d")
_PATH = re.compile(r"<(list\[)?path\]?>", re.IGNORECASE)
UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__bases__[0])
"""Of click, which typer brings under a name of its own; it exports this subclass alone."""
SIMULATED_ONLY = ("scene", "size", "seed", "rays", "flaws", "real_time")


class ModalCommand(TyperCommand):
    """A command that refuses what its mode ignores, and takes --json."""

    def __init__(self, *args: Any, params: list | None = None, **more: Any) -> None:
        super().__init__(*args, params=[*(params or ()), _json_option()], **more)
        for parameter in self.params:
            _name_path(parameter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; options of earlier versions are taken under their new names.

        A word such as -5 is a number: no option of any command begins with a digit.
        """
        renamed = RENAMED.get(self.name or "", {})
        words = [_under_new_name(word, renamed) for word in args]
        # A number with a space before it looks like no option; text is taken without the space.
        words = [f" {word}" if _NEGATIVE.match(word) else word for word in words]
        try:
            left = super().parse_args(ctx, words)
        except UsageError as fault:  # the parser's have no context: they name no command
            fault.ctx = fault.ctx or ctx
            raise
        for name, value in ctx.params.items():
            if isinstance(value, str) and _NEGATIVE.match(value.lstrip()):
                ctx.params[name] = value.lstrip()
        return left

    def invoke(self, ctx: Any) -> Any:
        """Run it; raises BadParameter."""
        before = json_wanted.set(ctx.params.pop("json"))
        try:
            return self._run(ctx)
        except ERRORS as fault:
            if json_wanted.get():
                emit("error", text=in_shell(fault))
            raise
        finally:
            json_wanted.reset(before)

    def _run(self, ctx: Any) -> Any:
        given = given_names(ctx)
        for mode, used in MODES.get(self.name or "", {}).items():
            if mode in given:
                refuse(ctx, given - used - {mode}, f"with {option_of(ctx, mode)}")
                break
        for name, needed in NEEDS.get(self.name or "", {}).items():
            modes = (needed,) if isinstance(needed, str) else needed
            if name in given and not given.intersection(modes):
                where = " or ".join(option_of(ctx, mode) for mode in modes)
                refuse(ctx, (name,), f"without {where}")
        return super().invoke(ctx)


def _under_new_name(word: str, renamed: Mapping[str, str]) -> str:
    """Return a word of the command line, `--old` or `--old=value` under its new name."""
    option, equals, value = word.partition("=")
    return renamed.get(option, option) + equals + value


def _name_path(parameter: Any) -> None:
    """Let the help call a parameter's type PATH where it is one, as other programs do."""
    shown = parameter.display_type
    parameter.display_type = lambda context: _PATH.sub("PATH", shown(context))


def _json_option() -> Any:
    """Return --json as typer would make it of a command's parameter."""
    alone = typer.Typer(add_completion=False)

    @alone.command()
    def command(
        json: Annotated[
            bool, typer.Option("--json", help="print progress, results and errors as lines of JSON")
        ] = False,
    ) -> None:
        pass

    return get_command(alone).params[0]


def given_names(context: typer.Context) -> set[str]:
    """Return the parameters that were typed, as the command's function names them."""
    return {
        name
        for name in context.params
        if getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE"
    }


def refuse(context: typer.Context, names: Iterable[str], where: str) -> None:
    """Raise BadParameter if any parameters are named; where: the mode that ignores them."""
    options = sorted(option_of(context, name) for name in names)
    if options:
        raise typer.BadParameter(f"{', '.join(options)}: no effect {where}; leave it out")


def option_of(context: typer.Context, name: str) -> str:
    """Return a parameter as it is typed."""
    (parameter,) = (known for known in context.command.params if known.name == name)
    return max(parameter.opts, key=len) if name not in parameter.opts else name.upper()
