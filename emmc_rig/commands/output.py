"""Output of commands: progress on a terminal, results in words; with --json all as JSON lines.

Progress goes to standard error, and only to a terminal. With `--json` standard output has one JSON
object a line, and nothing else:

| event | facts |
|---|---|
| `stage` | `stage`, `steps`: a stage begins; null for an unknown number of steps |
| `step` | `stage`, `done`, `steps`, `detail` |
| `message` | `text`: a result in words |
| `note` | `label`, `text`: a warning, or what is missing |
| `table` | `title`, `heads`, `rows` |
| `result` | result of the command: `out`, `metrics` as in metrics.json, or other facts |
| `error` | `text`: the command failed |
"""

from __future__ import annotations

import json
import shlex
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.box import SIMPLE
from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from emmc_rig.drivers.errors import (
    ALL_AXES,
    AxisFaultError,
    DriverError,
    NotHomedError,
    PositionMismatchError,
    PressedSwitchError,
)
from emmc_rig.model.errors import AdvisedError
from emmc_rig.progress import Watcher

if TYPE_CHECKING:
    from emmc_rig.study.points import Study

console = Console(stderr=True)
json_wanted: ContextVar[bool] = ContextVar("json_wanted", default=False)
"""Whether the running command was given --json."""
PACE_S = 300.0
"""Of a bar, over which its pace is averaged: a study's point may take a minute."""
WORDS = {
    "name-frame": "such as --frame 0",
    "reconstruct": "run `emmc-rig reconstruct {about}`",
    "capture": "go on with: emmc-rig capture {about}",
    "capture-edited": "an edited copy of the plan: emmc-rig capture COPY.yaml --out {about}",
    "name-rig": "such as --rig simulated",
    "other-devices": "say so by --other-devices",
    "new-plan": "`emmc-rig capture --new CAMERA` writes one",
    "plan-whiteboards": "`emmc-rig calibrate --plan` writes a plan that has them",
    "plan-open-whiteboards": "`emmc-rig calibrate --plan --skip aperture` writes such a plan",
    "list-cameras": "`emmc-rig cameras` lists the shipped ones",
    "list-sessions": "`emmc-rig session list` shows the sessions there are",
    "list-formats": "`emmc-rig export --list` marks them",
}
"""What helps against an error, by its `Advice`, in words of the command line."""
TO_HOME = (NotHomedError, AxisFaultError, PositionMismatchError)
VERDICT_COLOURS = {"trust": "green", "cannot tell": "cyan", "doubt": "yellow", "do not use": "red"}


def tell(text: str = "", style: str | None = None) -> None:
    """Show a result in words. style: its colour."""
    if json_wanted.get():
        emit("message", text=text)
    else:
        typer.secho(text, fg=style)


def show_reason(level: str, what: str, remedy: str, figure: float) -> None:
    """Print one reason in a line."""
    tell(f"{level}: {what}; {remedy}", VERDICT_COLOURS[level])


def show_verdict(metrics: Mapping[str, Any]) -> None:
    """Print the verdict of metrics.json, a line for each reason, and the accuracy."""
    from emmc_rig.reconstruction.verdict.rules import CONSISTENT
    from emmc_rig.store.results import stated_words, worse_words

    verdict, worse = metrics["verdict"], worse_words(metrics)
    if not verdict["reasons"]:
        words = f"trust with care: {CONSISTENT}, but {worse}" if worse else f"trust: {CONSISTENT}"
        tell(words, VERDICT_COLOURS["doubt" if worse else "trust"])
    for reason in verdict["reasons"]:
        show_reason(**reason)
    if stated := stated_words(metrics):
        tell(f"estimated accuracy: {stated}")


def say(label: str, text: object, style: str = "yellow") -> None:
    """Print one line to standard error; brackets in the text are brackets, not markup."""
    if json_wanted.get():
        emit("note", label=label, text=str(text))
        return
    line = Text.assemble((f"{label}:", style), " ", str(text))
    console.print(line, highlight=False, soft_wrap=True)


def show(drawn: RenderableType) -> None:
    """Print what rich draws to standard output; a script has it in the result."""
    if not json_wanted.get():
        Console().print(drawn)


def show_table(heads: Sequence[Any], rows: Iterable[Sequence[Any]], title: str = "") -> None:
    """Print a table to standard output. heads: names, or columns of rich."""
    if json_wanted.get():
        names = [str(getattr(head, "header", head)) for head in heads]
        plain = [[Text.from_markup(str(cell)).plain for cell in row] for row in rows]
        emit("table", title=title, heads=names, rows=plain)
        return
    table = Table(*heads, title=title or None, box=SIMPLE)
    for row in rows:
        table.add_row(*row)
    show(table)


def show_study(study: Study, out: Path) -> None:
    """Show the tables of a study, reasons why points are excluded, and its page; out: as typed."""
    for item in study.shown():
        if isinstance(item, str):
            tell(item)
        else:
            show_table(item.heads, item.rows, item.title)
    for line in study.excluded():
        say("excluded", line)
    tell(f"{study.seconds:.0f} s; open {out / study.page}")
    give_result(out)


def give_result(out: Path | None = None, **facts: Any) -> None:
    """Give the command's result to a script; out: a folder with metrics.json, or a file."""
    if not json_wanted.get():
        return
    if out is not None:
        from emmc_rig.store.result_files import METRICS, read_metrics

        if (out / METRICS).is_file():
            facts = {"metrics": read_metrics(out), **facts}
        facts = {"out": str(out), **facts}
    emit("result", **facts)


def emit(event: str, **facts: Any) -> None:
    """Print an event as one line of JSON."""
    print(json.dumps({"event": event, **facts}, allow_nan=False), flush=True)


def in_shell(fault: BaseException) -> str:
    """Return an error's line and notes, with the commands or flags that help against its cause."""
    return "; ".join([str(fault), *getattr(fault, "__notes__", ()), *dict.fromkeys(_typed(fault))])


def _typed(fault: BaseException | None) -> Iterator[str]:
    while fault is not None:
        if isinstance(fault, AdvisedError) and fault.advice is not None:
            yield WORDS[fault.advice].format(about=shlex.quote(str(fault.about)))
        if isinstance(fault, PressedSwitchError):
            yield f"free it by `{free_command(fault.axis, fault.stage, fault.away)}`"
        elif isinstance(fault, TO_HOME):
            axes = "" if fault.axis == ALL_AXES else fault.axis
            yield f"home by `{on_stage('home', axes, fault.stage)}`"
        fault = fault.__cause__


@contextmanager
def naming_stage(stage: str) -> Iterator[None]:
    """Let a driver's error, and what it causes, carry how its stage was named on the command line.

    The advice against the error then names the same stage.
    """
    try:
        yield
    except Exception as error:
        fault: BaseException | None = error
        while fault is not None:
            if isinstance(fault, DriverError):
                fault.about(stage=stage)
            fault = fault.__cause__
        raise


def free_command(axis: str, stage: str, away: str = "") -> str:
    """Return the command that moves an axis off its limit switch. away: up or down, if known."""
    return on_stage("free", f"{axis} --direction {away}" if away else axis, stage)


def on_stage(command: str, arguments: str, stage: str) -> str:
    """Return a command of `emmc-rig devices` for a stage. stage: as it was named, "" if unknown."""
    option = "--rig" if stage.startswith("simulated") else "--stage"
    words = ("emmc-rig devices", command, arguments, option, shlex.quote(stage or "STAGE"))
    return " ".join(filter(None, words))


class Shown(Watcher):
    """A watcher of a command: shows notes, and no progress."""

    def tell(self, message: str) -> None:
        """Print a note."""
        say("note", message)

    def finish(self) -> None:
        """End the last stage."""


class Lines(Shown):
    """Progress as lines of JSON."""

    def __init__(self) -> None:
        self._stage: str | None = None
        self._steps: float | None = None
        self._done: float = 0
        self._lock = threading.Lock()

    def begin(self, stage: str, steps: int | None = None) -> None:
        """Print a line."""
        self._stage, self._steps, self._done = stage, steps, 0
        emit("stage", stage=stage, steps=steps)

    def step(self, detail: str = "") -> None:
        """Print a line."""
        with self._lock:
            self._print(self._done + 1, self._steps, detail)

    def at(self, done: float, steps: float | None, detail: str = "") -> None:
        """Print a line."""
        with self._lock:
            self._print(done, steps, detail)

    def _print(self, done: float, steps: float | None, detail: str) -> None:
        self._done = done
        emit("step", stage=self._stage, done=done, steps=steps, detail=detail)


class Bars(Shown):
    """Progress as bars on a terminal."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task: TaskID | None = None

    def begin(self, stage: str, steps: int | None = None) -> None:
        """Finish the stage before and start a bar."""
        self.finish()
        self._task = self._progress.add_task(stage, total=steps, detail="")

    def step(self, detail: str = "") -> None:
        """Advance the current bar."""
        if self._task is not None:
            self._progress.update(self._task, advance=1, detail=detail)

    def at(self, done: float, steps: float | None, detail: str = "") -> None:
        """Set the current bar."""
        if self._task is not None:
            self._progress.update(self._task, completed=done, total=steps, detail=detail)

    def finish(self) -> None:
        """Fill the current bar: a solver may stop before its last step."""
        if self._task is not None:
            done = self._progress.tasks[-1].completed or 1
            self._progress.update(self._task, total=done, completed=done, detail="")


class TimeLeft(TimeRemainingColumn):
    """Time left of a bar whose number of steps is known, from the pace of its latest steps."""

    def render(self, task: Task) -> Text:
        """Return the time left, or an empty text while it is unknown and at the end."""
        known = task.time_remaining is not None and not task.finished
        return super().render(task).append(" left") if known else Text()


def columns(*after_time: ProgressColumn) -> tuple[ProgressColumn, ...]:
    """Return what a bar shows: stage, share, steps, time, further columns, and a detail."""
    return (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        *after_time,
        TextColumn("[dim]{task.fields[detail]}"),
    )


@contextmanager
def shown_progress(stage: str | None = None) -> Iterator[Shown]:
    """Yield what shows progress until the block ends; a stage named here has begun.

    The last bar is filled if the block ends well.
    """
    with Progress(
        *columns(TimeLeft()), console=console, disable=not console.is_terminal,
        speed_estimate_period=PACE_S,
    ) as progress:  # fmt: skip
        shown = (
            Lines() if json_wanted.get() else Bars(progress) if console.is_terminal
            else Shown()
        )  # fmt: skip
        if stage is not None:
            shown.begin(stage)
        yield shown
        shown.finish()
