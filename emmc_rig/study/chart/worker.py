"""A process that measures the points of one configuration, one after another.

Starting one costs more than most points. Where the peak of memory is not known for each point,
and after a point that its process did not outlive, the next gets a new one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from tempfile import TemporaryFile
from typing import IO

from emmc_rig.errors import AppError
from emmc_rig.files.memory import forget_peak

MODULE = "emmc_rig.study.chart.measure"


@contextmanager
def working(environment: Mapping[str, str], limit_s: float, lock: int) -> Iterator[Worker]:
    """Yield a worker, which ends with the block."""
    with TemporaryFile("w+") as errors:
        worker = Worker(environment, limit_s, lock, errors, forget_peak())
        try:
            yield worker
        finally:
            worker.end()


@dataclass
class Worker:
    """Measures jobs.

    environment: added to this process's. limit_s: after which a job is given up. lock: a
    descriptor that the process holds as well, should this one be killed. errors: gets its messages.
    lasting: whether it measures more than one.
    """

    environment: Mapping[str, str]
    limit_s: float
    lock: int
    errors: IO[str]
    lasting: bool
    _process: subprocess.Popen[str] | None = None

    def measure(self, job: dict) -> dict:
        """Return the figures of a job; `failed` says why there are none.

        A result that may differ the next time has `keep` False. Raises AppError for a process
        that failed by itself.
        """
        process = self._process = self._process or self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        late = threading.Event()

        def give_up() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self.limit_s, give_up)
        timer.start()
        try:
            print(json.dumps(job), file=process.stdin, flush=True)
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            timer.cancel()
        if line:
            if not self.lasting:
                self.end()
            return json.loads(line)
        code = process.wait()
        self.end()
        if late.is_set():
            return {"failed": f"not done after {self.limit_s:.0f} s"}
        if code < 0:
            return {"failed": f"killed by signal {-code}: memory?", "keep": False}
        self.errors.seek(0)
        lines = self.errors.read().strip().splitlines() or ["no message"]
        raise AppError(f"{job['method']}: the measuring process failed: {lines[-1]}")

    def _started(self) -> subprocess.Popen[str]:
        """Return a new process, which Ctrl-C reaches through us only."""
        return subprocess.Popen(
            [sys.executable, "-m", MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            text=True,
            env={**os.environ, **self.environment},
            pass_fds=(self.lock,),
            start_new_session=True,
        )

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
