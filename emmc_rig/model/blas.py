"""One thread for NumPy's and SciPy's linear algebra, so that its rounding is the same everywhere.

OpenBLAS splits sums by its number of threads, which is that of the machine's cores.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

_lock = threading.Lock()
_inside: list[threadpool_limits] = []
"""A limit for each call that is at work; the first one's is lifted when the last call ends."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Compute with one thread of BLAS in this process, until all calls that ask for it have ended.

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
