"""Linear algebra of NumPy and SciPy in one thread, for equal rounding on all computers.

OpenBLAS splits sums among its threads, of which there are as many as processor cores.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

_lock = threading.Lock()
_inside: list[threadpool_limits] = []
"""A limit for each call at work, all the same; it is lifted when the last call ends."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS in this process to one thread, until the last of overlapping calls ends.

    Also a decorator.
    """
    import scipy.linalg  # noqa: F401 - a library that is loaded later would not be limited

    with _lock:
        _inside.append(threadpool_limits(1, "blas") if not _inside else _inside[0])
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()
