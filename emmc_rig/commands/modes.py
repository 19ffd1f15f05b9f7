"""Modes of commands: options that make a command do something else, and those that it takes then.

An option that would be ignored is refused: wrong usage, in one line.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import typer
from typer.core import TyperCommand

TIMED = {"camera", "size", "repeats", "out"}
STUDIED = {"scene", "camera", "size", "out"}
MODES: dict[str, dict[str, set[str]]] = {
    "calibrate": {"drift": {"known", "out"}, "session": {"route", "sensor", "out"}},
    "capture": {"schema": set(), "new": {"out"}},
    "chart": {
        "solvers": {"camera", "dictionary", "out"},
        "peers": TIMED,
        "kernels": TIMED,
        "guard": STUDIED,
        "live": STUDIED,
        "stated": STUDIED,
        "ablation": STUDIED | {"seed"},
        "constants": STUDIED | {"seed"},
        "next_shot": STUDIED | {"seed", "until"},
    },
    "export": {"list_formats": set()},
    "reconstruct": {"list_methods": set()},
    "stability": {
        "faults": set(),
        "verdicts": STUDIED | {"fast", "fault", "method", "seed"},
        "worst": STUDIED | {"fast", "method", "dictionary", "seed"},
    },
}
"""By command and mode, as its function names them: what else may be given."""
SIMULATED_ONLY = ("scene", "size", "seed", "rays", "flaws", "real_time")


class ModalCommand(TyperCommand):
    """A command that refuses what its mode ignores."""

    def invoke(self, ctx: Any) -> Any:
        """Run it; raises BadParameter."""
        given = given_names(ctx)
        for mode, used in MODES.get(self.name or "", {}).items():
            if mode in given:
                refuse(ctx, given - used - {mode}, f"with {option_of(ctx, mode)}")
                break
        return super().invoke(ctx)


def given_names(context: typer.Context) -> set[str]:
    """Return the parameters that were typed, as the command's function names them."""
    return {
        name
        for name in context.params
        if getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE"
    }


def refuse(context: typer.Context, names: Iterable[str], where: str) -> None:
    """Raise BadParameter where there are such parameters; where: in what case they do nothing."""
    options = sorted(option_of(context, name) for name in names)
    if options:
        raise typer.BadParameter(f"{', '.join(options)}: no effect {where}; leave it out")


def option_of(context: typer.Context, name: str) -> str:
    """Return a parameter as it is typed."""
    (parameter,) = (one for one in context.command.params if one.name == name)
    return max(parameter.opts, key=len) if name not in parameter.opts else name.upper()
