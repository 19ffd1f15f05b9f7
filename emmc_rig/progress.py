"""Who watches a long run: its stages and steps, shown by whoever cares, or by nobody."""

from __future__ import annotations

from typing import Protocol


class Watcher(Protocol):
    """Whoever shows the progress of a long run."""

    def begin(self, stage: str, steps: int | None) -> None:
        """A stage begins; steps is None where it is not known how many there will be."""
        ...

    def step(self, detail: str) -> None:
        """One step of the current stage is done."""
        ...


class Silent:
    """A watcher that shows nothing."""

    def begin(self, stage: str, steps: int | None) -> None:
        """Ignore it."""

    def step(self, detail: str) -> None:
        """Ignore it."""
