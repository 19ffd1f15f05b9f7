"""Sources that are read beside every frame, such as temperatures, with a thread for each source.

    environment:
      - {name: lab, file: /sys/class/thermal/thermal_zone0/temp, scale: 0.001, unit: C}
      - {name: lamp, command: "owread /28.FF/temperature", unit: C}
      - {name: humidity, serial: /dev/ttyACM0, ask: "RH?\\n", unit: "%"}

A source is read again and again; a source that fails or is late does not delay a frame.
"""

from __future__ import annotations

import math
import re
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from emmc_rig.drivers.errors import DriverError
from emmc_rig.drivers.program import run_program
from emmc_rig.drivers.transport import SerialTransport
from emmc_rig.model.json_text import one_line
from emmc_rig.model.settings import Settings

MOST_BYTES = 4096
"""Of an answer."""
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
CLOSING_S = 0.5
Positive = Annotated[float, Field(gt=0)]


class SourceConfig(Settings):
    """A source: the first number of a file, of a command's output, or of a serial port's line."""

    name: str = Field(min_length=1, pattern="^[^/]*$")
    file: str | None = None
    command: str | None = Field(default=None, description="run without a shell")
    serial: str | None = Field(default=None, description="a port, as the stage's")
    ask: str = Field(default="", description="sent to the port before its line is read")
    baud: int = Field(default=9600, gt=0)
    unit: str = ""
    scale: float = Field(default=1.0, description="what the number is multiplied by")
    limit_s: Positive = Field(default=2.0, description="an answer that takes longer is none")
    every_s: Positive = Field(default=5.0, description="from one answer to the next question")

    @model_validator(mode="after")
    def _one_origin(self) -> Self:
        if sum(origin is not None for origin in (self.file, self.command, self.serial)) != 1:
            raise ValueError("write one of file:, command: and serial:")
        return self


@dataclass(frozen=True)
class _Answer:
    """The last answer of a source; fault: why there is none."""

    at_s: float
    value: float = math.nan
    fault: str = ""


class Source:
    """A source and its thread, which ends with the `with` block."""

    def __init__(self, config: SourceConfig) -> None:
        self.config = config
        self._answer, self._begun_s = _Answer(-math.inf), math.inf
        self._answered, self._ended = threading.Event(), threading.Event()
        # A daemon: a file that never opens must not keep the program.
        self._thread = threading.Thread(target=self._ask, name=f"source {config.name}", daemon=True)

    def __enter__(self) -> Self:
        self._begun_s = time.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        self._thread.join(CLOSING_S)

    def read(self) -> tuple[float, str]:
        """Return the last value, and "" or the reason why there is none.

        Waits for the first answer only, until `limit_s` after the begin.
        """
        config = self.config
        self._answered.wait(max(0.0, self._begun_s + config.limit_s - time.monotonic()))
        answer = self._answer
        if time.monotonic() - answer.at_s > config.every_s + 2 * config.limit_s:
            return math.nan, f"gave no answer within {config.limit_s:g} s"
        return answer.value, answer.fault

    def _ask(self) -> None:
        with _asking(self.config) as ask:
            while not self._ended.is_set():
                try:
                    value = _number(ask(), self.config.scale)
                    self._answer = _Answer(time.monotonic(), value)
                except Exception as fault:
                    self._answer = _Answer(time.monotonic(), fault=one_line(fault))
                self._answered.set()
                self._ended.wait(self.config.every_s)


def read_all(sources: Iterable[Source]) -> tuple[dict[str, float], dict[str, str]]:
    """Return by name the values of sources, and why those have none that failed."""
    read = {source.config.name: source.read() for source in sources}
    values = {name: value for name, (value, fault) in read.items() if not fault}
    return values, {name: fault for name, (_, fault) in read.items() if fault}


def _number(text: str, scale: float) -> float:
    """Return the first number in a text, none that is part of a word, scaled."""
    found = NUMBER.search(text)
    if found is None or not math.isfinite(value := float(found[0]) * scale):
        raise ValueError(f"no number in {one_line(text)[:60]!r}")
    return value


@contextmanager
def _asking(config: SourceConfig) -> Iterator[Callable[[], str]]:
    """Yield what asks the source once and returns its text."""
    if config.file is not None:
        yield partial(_read_file, Path(config.file))
    elif config.command is not None:
        # On Windows a program is started by a line, in which a backslash divides folders.
        words = config.command if sys.platform == "win32" else shlex.split(config.command)
        yield partial(run_program, words, config.limit_s)
    else:
        port = _Port(config)
        with closing(port):
            yield port.ask


def _read_file(path: Path) -> str:
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.read(MOST_BYTES)


class _Port:
    """A serial port, opened when it is first asked, and anew after a fault."""

    def __init__(self, config: SourceConfig) -> None:
        self._config = config
        self._wire: SerialTransport | None = None

    def ask(self) -> str:
        """Return the line that the question brings."""
        config = self._config
        try:
            if self._wire is None:
                assert config.serial is not None
                self._wire = SerialTransport(
                    config.serial, config.limit_s, config.limit_s, baud=config.baud
                )
            if config.ask:
                self._wire.discard_input()
                self._wire.write(config.ask.encode())
            return self._wire.read_until(b"\n").decode(errors="replace")
        except DriverError:
            self.close()
            raise

    def close(self) -> None:
        """Close it; closing twice is allowed."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None
