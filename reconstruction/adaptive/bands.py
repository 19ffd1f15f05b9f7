"""Share rows among threads: kernels that release the interpreter's lock, a band of rows each."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import get_num_threads


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
