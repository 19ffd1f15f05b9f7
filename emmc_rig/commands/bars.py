"""Progress of a long command: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from emmc_rig.errors import StoppedError

if TYPE_CHECKING:
    from reconstruction.result import Progress as SolverProgress

console = Console(stderr=True)


class Bars:
    """A `Watcher` that draws progress bars on a terminal, and plain lines elsewhere."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task: TaskID | None = None

    def begin(self, stage: str, steps: int | None) -> None:
        """Finish the stage before and start a bar."""
        self.finish()
        self._task = self._progress.add_task(stage, total=steps, detail="")
        if not console.is_terminal:
            console.print(stage)

    def step(self, detail: str) -> None:
        """Advance the current bar."""
        if self._task is not None:
            self._progress.update(self._task, advance=1, detail=detail)

    def advance(self, progress: SolverProgress) -> None:
        """Show how far a solver is."""
        if self._task is not None:
            change = progress.relative_change
            detail = "" if change is None else f"change {change:.1e}"
            self._progress.update(
                self._task, completed=progress.step, total=progress.total, detail=detail
            )

    def line(self, text: str) -> None:
        """Print a result in words."""
        print(text, flush=True)

    def note(self, label: str, text: object) -> None:
        """Print what is missing, apart from the results."""
        say(label, text)

    def table(self, heads: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
        """Print a table."""
        show_table(heads, rows, title)

    def finish(self) -> None:
        """Fill the current bar: a solver may stop before its last step."""
        if self._task is not None:
            done = self._progress.tasks[-1].completed or 1
            self._progress.update(self._task, total=done, completed=done, detail="")


def show_table(heads: Sequence[Any], rows: Iterable[Sequence[Any]], title: str = "") -> None:
    """Print a table to standard output. heads: names, or columns of rich."""
    table = Table(*heads, title=title or None, box=SIMPLE)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def say(label: str, message: object, style: str = "yellow") -> None:
    """Print one line to standard error; brackets in the message are brackets, not markup."""
    line = Text.assemble((f"{label}:", style), " ", str(message))
    console.print(line, highlight=False, soft_wrap=True)


@contextmanager
def shown_bars() -> Iterator[Bars]:
    """Yield bars, drawn until the block ends; the last one is filled if it ends well.

    A KeyboardInterrupt that says what is kept becomes a StoppedError.
    """
    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[detail]}"),
        console=console,
        disable=not console.is_terminal,
    ) as progress:
        bars = Bars(progress)
        try:
            yield bars
        except KeyboardInterrupt as stop:
            if str(stop):
                raise StoppedError(str(stop)) from stop
            raise
        bars.finish()
