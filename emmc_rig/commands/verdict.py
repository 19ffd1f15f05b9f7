"""How a command ends that reconstructs: the verdict, a line for each reason."""

from __future__ import annotations

import typer

VERDICT_COLOURS = {"trust": "green", "doubt": "yellow", "do not use": "red"}


def show_reason(level: str, what: str, remedy: str, figure: float) -> None:
    """Print one reason in a line."""
    typer.secho(f"{level}: {what}; {remedy}", fg=VERDICT_COLOURS[level])


def end_with_verdict(verdict: dict, strict: bool) -> None:
    """Print a verdict, a line for each reason; strict: exit with 1 if it is not to be used."""
    colour = VERDICT_COLOURS[verdict["level"]]
    if not verdict["reasons"]:
        typer.secho("trust: nothing in frames, Psi and light field speaks against it", fg=colour)
    for reason in verdict["reasons"]:
        show_reason(**reason)
    if strict and verdict["level"] == "do not use":
        raise typer.Exit(1)
