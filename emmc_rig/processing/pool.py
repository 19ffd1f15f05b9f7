"""Workers for independent tasks: processes of this machine, or those of a Dask cluster.

A task is a function of one value, both picklable, that writes its result to a disk all workers
share; what it returns is small. Every process computes with one thread, so that nothing
oversubscribes and a result does not depend on how many there are.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import resource
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from emmc_rig.errors import AppError
from emmc_rig.model.reading import one_line
from emmc_rig.processing.memory import Ceiling
from emmc_rig.version import __version__

Item = TypeVar("Item")
Result = TypeVar("Result")
THREADS = "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
MOST_LOSSES = 5
"""Times in a row that workers may be lost before another task is done."""
CONNECT_S = 10.0


class WorkersError(AppError):
    """Workers that are not there, do not fit this program, or were lost."""


class Pool(Protocol):
    """Workers that share tasks."""

    @property
    def size(self) -> int:
        """How many tasks are computed at a time."""
        ...

    def run(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, in the order they are done.

        Tasks whose worker was lost are done again. Raises WorkersError, and what a task raises.
        """
        ...

    def fit(self, task_bytes: int) -> None:
        """Compute from here on only as many tasks at a time as a ceiling of memory allows.

        task_bytes: what a worker needs for one. Raises AppError where none fits.
        """
        ...

    def end(self) -> None:
        """Stop what is computed; later tasks are refused."""
        ...


def _begin(most_bytes: int | None) -> None:
    """Prepare a process of the pool: it ends with the program, which alone hears Ctrl-C.

    most_bytes: of data it may map, so that allocating more raises MemoryError. What is mapped but
    never touched (220 MiB) outweighs the pages of libraries (150 MiB) that do not count.
    """
    import cv2

    cv2.setNumThreads(1)
    if most_bytes is not None:
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, hard))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


class Processes:
    """A pool of processes of this machine; safe to use from several threads.

    size: at most so many. ceiling: of their memory and this program's, kept by fewer processes.
    """

    def __init__(self, size: int, ceiling: Ceiling | None = None) -> None:
        self.size, self.ceiling = size, ceiling
        self._lock = threading.Lock()
        self._executor: ProcessPoolExecutor | None = None
        self._mine: set[BaseProcess] = set()
        self._losses = 0
        self._ended = False

    def _submitted(
        self, task: Callable[[Item], Result], items: Iterable[Item]
    ) -> tuple[ProcessPoolExecutor, dict[Future[Result], Item]]:
        with self._lock:
            if self._ended:
                raise WorkersError("the workers were stopped")
            if self._executor is None:
                share = None if self.ceiling is None else self.ceiling.share(self.size)
                self._executor = ProcessPoolExecutor(
                    self.size, multiprocessing.get_context("spawn"), _begin, (share,)
                )
            before = set(multiprocessing.active_children())
            futures = {self._executor.submit(task, item): item for item in items}
            self._mine |= set(multiprocessing.active_children()) - before
            return self._executor, futures

    def run(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, see `Pool.run`."""
        left = list(items)
        while left:
            try:
                executor, futures = self._submitted(task, left)
            except BrokenProcessPool as fault:
                self._replace(self._executor, fault)
                continue
            try:
                for future in as_completed(futures):
                    result, item = future.result(), futures[future]
                    left.remove(item)
                    self._losses = 0
                    yield item, result
            except BrokenProcessPool as fault:
                self._replace(executor, fault)
            except MemoryError as fault:
                self._fewer(executor, fault)
            except CancelledError:
                continue  # another thread made the workers fewer
            finally:
                for future in futures:
                    future.cancel()

    def fit(self, task_bytes: int) -> None:
        """Let fewer processes share the ceiling where a task needs more, see `Pool.fit`."""
        if self.ceiling is None:
            return
        count = self.ceiling.workers(task_bytes)
        with self._lock:
            if count < self.size:
                self.size = count
                self._restart()

    def _restart(self) -> None:
        """End the processes once their tasks are done; the next task starts others."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None

    def _fewer(self, executor: ProcessPoolExecutor, fault: MemoryError) -> None:
        """Give the workers more memory each, after a task needed more than its share."""
        with self._lock:
            if self._executor is not executor:
                return
            if self.size == 1 or self.ceiling is None:
                limit = "" if self.ceiling is None else f" {self.ceiling.share(1) / 2**20:.0f} MiB"
                raise WorkersError(
                    f"one worker alone needs more memory than the{limit} there is: give more by "
                    "--memory, or smaller blocks by --settings (blocks: side, whole); the same "
                    "command goes on"
                ) from fault
            self.size -= 1
            self._restart()

    def _replace(self, broken: ProcessPoolExecutor | None, fault: BrokenProcessPool) -> None:
        """Give up an executor that lost a process; all threads that used it come here."""
        with self._lock:
            if self._executor is broken and broken is not None:
                self._restart()
                self._losses += 1
        if self._losses >= MOST_LOSSES:
            raise WorkersError(
                f"workers were killed {self._losses} times in a row, as when memory runs out: "
                "give fewer --workers, or --memory; the same command goes on"
            ) from fault

    def end(self) -> None:
        """Stop the processes, whatever they do."""
        self._ended = True
        # Before the lock, too: its holder may wait for a task.
        for process in list(self._mine):
            process.terminate()
        with self._lock:
            for process in self._mine:
                process.terminate()
            self._restart()


def fingerprint() -> dict[str, str]:
    """Return what workers and the program must have alike."""
    return {"emmc-rig": __version__, "python": ".".join(platform.python_version_tuple()[:2])}


def _on_one_thread(task: Callable[[Item], Result], item: Item) -> Result:
    """Return the result of a task in a thread of a worker, which may have others beside it."""
    import numba

    numba.set_num_threads(1)
    return task(item)


class Cluster:
    """A pool of the workers of a Dask cluster."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address

    @property
    def size(self) -> int:
        """Threads of all workers."""
        return max(sum(self._client.nthreads().values()), 1)

    def check(self) -> None:
        """Raise WorkersError where there are no workers, or some with other versions."""
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
            found: Mapping[str, dict[str, str]] = self._client.run(fingerprint)
        except Exception as fault:  # whatever a worker without this program raises
            kind = type(fault).__name__
            raise WorkersError(
                f"--cluster {self._address}: no worker there runs emmc-rig "
                f"({kind}: {one_line(fault)}); install emmc-rig {__version__} where the workers run"
            ) from fault
        own = fingerprint()
        for worker, theirs in found.items():
            if theirs != own:
                what = ", ".join(f"{key} {value}" for key, value in theirs.items())
                mine = ", ".join(f"{key} {value}" for key, value in own.items())
                raise WorkersError(
                    f"--cluster {self._address}: the worker {worker} has {what}, this program "
                    f"{mine}: install the same there"
                )

    def run(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, see `Pool.run`."""
        from distributed import CancelledError, KilledWorker
        from distributed import as_completed as completed
        from distributed.comm.core import CommClosedError

        futures = self._client.map(partial(_on_one_thread, task), list(items), pure=False)
        of = dict(zip((future.key for future in futures), items, strict=True))
        try:
            for future in completed(futures, loop=self._client.loop):
                yield of[future.key], future.result()
                future.release()
        except (KilledWorker, CancelledError, CommClosedError) as fault:
            raise WorkersError(
                f"--cluster {self._address}: lost ({one_line(fault)}); the same command goes on"
            ) from fault
        finally:
            with suppress(Exception):
                self._client.cancel(futures)

    def fit(self, task_bytes: int) -> None:
        """Leave memory to the cluster, which sets that of its workers."""

    def end(self) -> None:
        """Leave the cluster, which goes on."""
        with suppress(Exception):
            self._client.close()


def _connected(address: str) -> Cluster:
    try:
        from distributed import Client
    except ImportError as fault:
        raise WorkersError(
            "--cluster needs Dask: pip install 'emmc-rig[cluster]'; --workers needs nothing more"
        ) from fault
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError, RuntimeError) as fault:
        raise WorkersError(
            f"--cluster {address}: no Dask scheduler answers there; start one by `dask scheduler`, "
            "or see docs/scale.md"
        ) from fault
    return Cluster(client, address)


@contextmanager
def opened_pool(
    workers: int, cluster: str | None = None, ceiling: Ceiling | None = None
) -> Iterator[Pool]:
    """Yield so many processes of this machine, or a cluster's workers; they end with the block.

    Processes start with the first task. ceiling: of memory, see `Processes`. Raises WorkersError.
    """
    if cluster is not None:
        pool = _connected(cluster)
        try:
            pool.check()
            yield pool
        finally:
            pool.end()
        return
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    processes = Processes(workers, ceiling)
    try:
        yield processes
    finally:
        processes.end()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
