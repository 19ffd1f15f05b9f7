"""What shows the stages and steps of a long run: the interface, and one that shows nothing."""

from __future__ import annotations

from typing import Protocol


class Watcher(Protocol):
    """Shows the progress of a long run."""

    def begin(self, stage: str, steps: int | None) -> None:
        """Begin a stage; steps: how many it will have, None where that is not known."""
        ...

    def step(self, detail: str) -> None:
        """Show that one step of the current stage is done."""
        ...


class Silent:
    """A watcher that shows nothing."""

    def begin(self, stage: str, steps: int | None) -> None:
        """Ignore it."""

    def step(self, detail: str) -> None:
        """Ignore it."""
