"""The verdict at the end of a command that reconstructs, with a line for each reason."""

from __future__ import annotations

from emmc_rig.commands.output import tell

VERDICT_COLOURS = {"trust": "green", "cannot tell": "cyan", "doubt": "yellow", "do not use": "red"}


def show_reason(level: str, what: str, remedy: str, figure: float) -> None:
    """Print one reason in a line."""
    tell(f"{level}: {what}; {remedy}", VERDICT_COLOURS[level])


def show_verdict(verdict: dict) -> None:
    """Print a verdict, a line for each reason."""
    colour = VERDICT_COLOURS[verdict["level"]]
    if not verdict["reasons"]:
        tell("trust: the light field agrees with frames, Psi and noise", colour)
    for reason in verdict["reasons"]:
        show_reason(**reason)
