"""Bands of rows in threads that are kept: of any call, of calls within calls, and after a fork."""

import os
import threading
from itertools import pairwise

import numpy as np
import pytest
from numba import get_num_threads

from emmc_rig.model.bands import in_bands, summed_in_bands

pytestmark = pytest.mark.skipif(get_num_threads() < 2, reason="needs two threads")


def rows_done(rows, bands=None):
    """Return how often in_bands works on each row, and the threads that did."""
    done, threads = np.zeros(rows, dtype=int), set()

    def work(_, first, last):
        done[first:last] += 1
        threads.add(threading.get_ident())

    in_bands(work, rows, bands)
    return done, threads


@pytest.mark.parametrize(("rows", "bands"), [(1, None), (2, None), (97, None), (97, 7), (3, 8)])
def test_every_row_is_worked_on_once(rows, bands):
    assert (rows_done(rows, bands)[0] == 1).all()


def test_a_call_within_a_band_runs_in_its_thread():
    inner = []
    in_bands(lambda *_: inner.append((threading.get_ident(), rows_done(5, 4)[1])), 6, 6)
    assert len(inner) == 6
    assert all(threads == {thread} for thread, threads in inner)


def test_what_fails_in_one_band_is_raised_after_all_have_ended():
    ended = []

    def work(band, *_):
        if band == 0:
            raise ValueError("band 0")
        ended.append(band)

    with pytest.raises(ValueError, match="band 0"):
        in_bands(work, 6, 6)
    assert sorted(ended) == [1, 2, 3, 4, 5]
    assert (rows_done(9)[0] == 1).all()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    rows_done(8)
    child = os.fork()
    if child == 0:
        os._exit(0 if (rows_done(8)[0] == 1).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("rows", [1, 2, 3, 48, 97])
@pytest.mark.parametrize("reach", [0.5, 3, 11])
def test_bands_that_add_to_the_same_sum_are_farther_apart_than_they_reach(rows, reach):
    calls = []
    summed_in_bands(lambda *call: calls.append(call), rows, reach)
    assert sorted(row for _, first, last in calls for row in range(first, last)) == [*range(rows)]
    for which in (0, 1):
        mine = sorted(call for call in calls if call[0] == which)
        assert all(after[1] - before[2] >= 2 * reach for before, after in pairwise(mine))
