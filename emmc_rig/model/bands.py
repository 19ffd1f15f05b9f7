"""Share rows among threads: kernels that release the interpreter's lock, a band of rows each.

Numba's own parallel loops take two to four times as long to compile.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from typing import Any

import numpy as np
from numba import get_num_threads, njit


def in_bands(work: Callable[[int, int, int], None], rows: int, bands: int | None = None) -> None:
    """Call work(band, first, last + 1) for bands of about equally many rows, in threads."""
    threads = get_num_threads()
    count = min(rows, threads if bands is None else bands)
    edges = np.linspace(0, rows, count + 1).round().astype(int)
    spans = [(band, int(edges[band]), int(edges[band + 1])) for band in range(count)]
    if threads == 1:
        for span in spans:
            work(*span)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda span: work(*span), spans))


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
