"""A thread that does jobs in order, so that a frame is written while the stage moves on.

The first job that fails ends the writing: later ones are dropped, and the fault is raised to
whoever hands over the next job, or closes. At most `room` jobs wait: memory stays flat.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

Job = Callable[[], None]
ROOM = 3


class Writer:
    """The thread; use it in a `with` block, which ends when every job is done."""

    def __init__(self, room: int = ROOM) -> None:
        self._jobs: queue.Queue[Job | threading.Event | None] = queue.Queue(room)
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="session-writer")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._jobs.put(None)
        self._thread.join()
        if error is None:
            self.check()

    def put(self, job: Job) -> None:
        """Hand a job over, waiting for room; raises what an earlier job raised."""
        self.check()
        self._jobs.put(job)

    def flush(self) -> None:
        """Return when every job handed over so far is done; raises the first fault of a job."""
        done = threading.Event()
        self._jobs.put(done)
        done.wait()
        self.check()

    def check(self) -> None:
        """Raise what a job raised."""
        if self._fault is not None:
            raise self._fault

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if isinstance(job, threading.Event):
                job.set()
            elif self._fault is None:
                try:
                    job()
                except BaseException as fault:
                    self._fault = fault
