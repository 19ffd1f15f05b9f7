"""Workers for independent tasks: processes of this machine, or those of a Dask cluster.

A task is a function of one value, both picklable, that writes its result to a disk all workers
share; what it returns is small. Either kind of workers is a `concurrent.futures.Executor`. Every
worker computes with one thread, so that nothing oversubscribes and a result does not depend on how
many there are.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from emmc_rig.errors import AppError
from emmc_rig.model.memory_limit import limit_memory
from emmc_rig.model.reading import one_line
from emmc_rig.version import __version__

Item = TypeVar("Item")
Result = TypeVar("Result")
THREADS = "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
MOST_LOSSES = 5
"""Times in a row that workers may be lost before another task is done."""
CONNECT_S = 10.0


class WorkersError(AppError, ConnectionError):
    """No worker answers, workers run another version of the program, or all were lost."""


@dataclass(frozen=True)
class Ceiling:
    """Limit of the memory of all processes together, bytes. own: bytes of the program itself."""

    total: int
    own: int

    def workers(self, task_bytes: int) -> int:
        """Return how many workers fit; raises AppError with the smallest ceiling for one."""
        count = (self.total - self.own) // task_bytes
        if count < 1:
            # Rounded up: the ceiling that the message names suffices.
            least = -(-(self.own + task_bytes) // 2**20)
            raise AppError(
                f"memory of {self.total / 2**20:.0f} MiB: this program and one worker need "
                f"{least} MiB; allow {least}MiB, or set smaller blocks (blocks: side, whole)"
            )
        return count

    def share(self, workers: int) -> int:
        """Return what each of so many workers may hold."""
        return (self.total - self.own) // workers


class Pool:
    """Workers that share tasks; safe to use from several threads. size: tasks at a time."""

    losses: tuple[type[BaseException], ...] = ()
    """What tells that workers were lost, see `_mend`."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._lock = threading.Lock()
        self._executor: Executor | None = None
        self._losses_in_a_row = 0

    def _start(self) -> Executor:
        """Return what runs tasks; raises WorkersError."""
        raise NotImplementedError

    def _mend(self, executor: Executor, fault: BaseException) -> None:
        """Replace an executor that lost workers; raises WorkersError where it cannot."""
        raise NotImplementedError

    def run(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, in the order of completion.

        Tasks whose worker was lost are done again. Raises WorkersError, and what a task raises.
        """
        left = list(items)
        while left:
            futures = {}
            with self._lock:
                executor = self._executor = self._executor or self._start()
            try:
                with self._lock:
                    futures |= {executor.submit(task, item): item for item in left}
                for future in as_completed(futures):
                    result, item = future.result(), futures[future]
                    left.remove(item)
                    self._losses_in_a_row = 0
                    yield item, result
            except self.losses as fault:
                self._mend(executor, fault)
            finally:
                for future in futures:
                    future.cancel()

    def fit(self, task_bytes: int) -> None:
        """Compute from here on only as many tasks at a time as a ceiling of memory allows.

        task_bytes: what a worker needs for one. Raises AppError where none fits.
        """

    def end(self) -> None:
        """Stop what is computed; later tasks are refused."""


def _begin(program: Any, most_bytes: int | None) -> None:
    """Prepare a process of the pool: it ends with the program, which alone hears Ctrl-C.

    program: end of a pipe, read until it is closed. most_bytes: of data the process may map (on
    Linux), see `limit_memory`. What is mapped but never touched (220 MiB) outweighs the pages of
    libraries (150 MiB) that do not count.
    """
    import cv2

    cv2.setNumThreads(1)
    if most_bytes is not None:
        limit_memory(most_bytes, f"a worker needs more memory than {most_bytes / 2**20:.0f} MiB")
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow() -> None:
        with suppress(EOFError, OSError):
            program.recv_bytes()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


class Processes(Pool):
    """Processes of this machine, at most `size`.

    ceiling: of their memory and this program's, kept by fewer processes.
    """

    # CancelledError: another thread ended the executor, to start one of fewer processes.
    # RuntimeError: it did so before the tasks were submitted.
    losses = BrokenProcessPool, MemoryError, CancelledError, RuntimeError

    def __init__(self, size: int, ceiling: Ceiling | None = None) -> None:
        super().__init__(size)
        self.ceiling = ceiling
        # Workers read their end of a pipe without any data: they end when this process closes it.
        self._theirs, self._mine = multiprocessing.Pipe(duplex=False)

    def _start(self) -> Executor:
        if self._mine.closed:
            raise WorkersError("the workers were stopped")
        share = None if self.ceiling is None else self.ceiling.share(self.size)
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.size, context, _begin, (self._theirs, share))

    def fit(self, task_bytes: int) -> None:
        """Let fewer processes share the ceiling where a task needs more, see `Pool.fit`."""
        if self.ceiling is None:
            return
        count = self.ceiling.workers(task_bytes)
        with self._lock:
            if count < self.size:
                self.size = count
                self._shut_down()

    def _mend(self, executor: Executor, fault: BaseException) -> None:
        with self._lock:
            if self._executor is not executor:
                return  # another thread has mended it
            if isinstance(fault, MemoryError):
                if self.size == 1 or self.ceiling is None:
                    limit = (
                        "" if self.ceiling is None else f" {self.ceiling.share(1) / 2**20:.0f} MiB"
                    )
                    raise WorkersError(
                        f"one worker alone needs more memory than the{limit} there is: allow more, "
                        "or set smaller blocks (blocks: side, whole), and run the same "
                        "command again to go on"
                    ) from fault
                self.size -= 1
            elif isinstance(fault, BrokenProcessPool):
                self._losses_in_a_row += 1
                if self._losses_in_a_row >= MOST_LOSSES:
                    raise WorkersError(
                        f"workers were killed {self._losses_in_a_row} times in a row, as when "
                        "memory runs out: take fewer workers, or set a limit of memory, and run "
                        "the same command again to go on"
                    ) from fault
            else:
                raise fault
            self._shut_down()

    def _shut_down(self) -> None:
        """End the processes once their tasks are done; the next task starts others."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None

    def end(self) -> None:
        """Stop the processes, whatever they do."""
        # Before the lock, whose holder may wait for a task.
        self._mine.close()
        with self._lock:
            self._shut_down()
            self._theirs.close()


def fingerprint() -> dict[str, str]:
    """Return what workers and the program must have alike."""
    return {"emmc-rig": __version__, "python": ".".join(platform.python_version_tuple()[:2])}


def _on_one_thread(task: Callable[[Item], Result], item: Item) -> Result:
    """Return the result of a task, computed by one thread of a worker that may have several."""
    import numba

    numba.set_num_threads(1)
    return task(item)


class Cluster(Pool):
    """The workers of a Dask cluster, whose memory is the cluster's own concern.

    address: of its scheduler. Raises WorkersError where none answers or its workers do not fit.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import CancelledError as Cancelled
            from distributed import Client, KilledWorker
            from distributed.comm.core import CommClosedError
        except ImportError as fault:
            raise WorkersError(
                "a cluster needs Dask: pip install 'emmc-rig[cluster]'; workers of this computer "
                "need nothing more"
            ) from fault
        self.losses = KilledWorker, Cancelled, CancelledError, CommClosedError
        self._address = address
        try:
            self._client: Any = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError, RuntimeError) as fault:
            raise WorkersError(
                f"cluster {address}: no Dask scheduler answers there; start one by `dask "
                "scheduler`, or see docs/scale.md"
            ) from fault
        try:
            self._check_versions()
            super().__init__(sum(self._client.nthreads().values()))
        except BaseException:
            self.end()
            raise

    def _check_versions(self) -> None:
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
            by_worker: Mapping[str, dict[str, str]] = self._client.run(fingerprint)
        except Exception as fault:  # whatever a worker without this program raises
            kind = type(fault).__name__
            raise WorkersError(
                f"cluster {self._address}: no worker there runs emmc-rig "
                f"({kind}: {one_line(fault)}); install emmc-rig {__version__} where the workers run"
            ) from fault
        own = fingerprint()
        for worker, theirs in by_worker.items():
            if theirs != own:
                what, mine = (
                    ", ".join(f"{key} {value}" for key, value in versions.items())
                    for versions in (theirs, own)
                )
                raise WorkersError(
                    f"cluster {self._address}: the worker {worker} has {what}, this program "
                    f"{mine}: install the same there"
                )

    def _start(self) -> Executor:
        return self._client.get_executor(pure=False)

    def _mend(self, executor: Executor, fault: BaseException) -> None:
        raise WorkersError(
            f"cluster {self._address}: lost ({one_line(fault)}): run the same command "
            "again to go on"
        ) from fault

    def run(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, see `Pool.run`."""
        return super().run(partial(_on_one_thread, task), items)

    def end(self) -> None:
        """Leave the cluster, which goes on."""
        with suppress(Exception):
            self._client.close()


@contextmanager
def opened_pool(
    workers: int, cluster: str | None = None, ceiling: Ceiling | None = None
) -> Iterator[Pool]:
    """Yield so many processes of this machine, or a cluster's workers; they end with the block.

    Processes start with the first task. ceiling: of memory, see `Processes`. Raises WorkersError.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    pool = Processes(workers, ceiling) if cluster is None else Cluster(cluster)
    if cluster is None:
        os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield pool
    finally:
        pool.end()
        for name in THREADS:
            os.environ.pop(name, None)
        os.environ.update({name: value for name, value in before.items() if value is not None})
