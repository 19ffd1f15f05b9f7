"""Share rows among threads: kernels that release the interpreter's lock, a band of rows each.

Numba's own parallel loops take two to four times as long to compile.
"""

from __future__ import annotations

import inspect
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, wraps
from math import ceil
from typing import Any

import numpy as np
from numba import get_num_threads

from emmc_rig.model.compiling import njit

_inside = threading.local()
"""Set in a thread that works on a band: calls within it use no further threads."""


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the threads of this process: to start them anew takes longer than a small kernel."""
    return ThreadPoolExecutor(threads, "band")


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_pool.cache_clear)


def in_bands(work: Callable[[int, int, int], None], rows: int, bands: int | None = None) -> None:
    """Call work(band, first, last + 1) for bands of about equally many rows, in threads."""
    threads = get_num_threads()
    count = min(rows, threads if bands is None else bands)
    edges = np.linspace(0, rows, count + 1).round().astype(int)

    def work_on(band: int) -> None:
        outer, _inside.band = getattr(_inside, "band", False), True
        try:
            work(band, int(edges[band]), int(edges[band + 1]))
        finally:
            _inside.band = outer

    if threads == 1 or count == 1 or getattr(_inside, "band", False):
        for band in range(count):
            work_on(band)
        return
    ahead = iter(range(count))

    def several() -> None:
        for band in ahead:  # threads share it: who is free takes the next
            work_on(band)

    # A task a thread, not a band: to hand one over takes as long as a short band.
    at_work = [_pool(threads).submit(several) for _ in range(min(threads, count))]
    wait(at_work)
    for thread in at_work:
        thread.result()


def in_views(work: Callable[[tuple[int, int]], None], views: tuple[int, ...]) -> None:
    """Call work((v, u)) for each of the rows and columns of views, in threads."""

    def band(_: int, first: int, last: int) -> None:
        for view in range(first, last):
            work(divmod(view, views[1]))

    in_bands(band, views[0] * views[1])


def summed_in_bands(work: Callable[[int, int, int], None], rows: int, reach_rows: float) -> None:
    """Call work(sums, first, last + 1) for bands of rows that add to one of two sums, 0 or 1.

    A row adds at most reach_rows away, so that bands of the same sum never meet. The terms and
    their order, and so the rounding, are the same for any number of threads.
    """
    apart = ceil(2 * reach_rows) + 1
    bands = max(2, rows // apart // 2 * 2)
    in_bands(lambda band, first, last: work(band % 2, first, last), rows, bands)


def row_kernel(
    array: str, axis: int, fastmath: bool = False
) -> Callable[[Callable], Callable[..., None]]:
    """Compile a kernel of (begin, end, *arguments) for calls with all its rows as (*arguments).

    array, axis: the argument whose axis the rows are, which are independent.
    """

    def compiled(kernel: Callable) -> Callable[..., None]:
        counted = list(inspect.signature(kernel).parameters)[2:].index(array)
        of_rows = njit(cache=True, nogil=True, fastmath=fastmath)(kernel)

        @wraps(kernel)
        def call(*arguments: Any) -> None:
            rows = arguments[counted].shape[axis]
            in_bands(lambda _, begin, end: of_rows(begin, end, *arguments), rows)

        return call

    return compiled
