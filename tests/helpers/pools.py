"""A pool of workers in this process, to stop where a test wants it."""

import os
import pickle
from pathlib import Path

import numba

from emmc_rig.store.pool import Pool


class StoppedHereError(Exception):
    """Somebody stopped the tasks."""


class Here(Pool):
    """A pool that computes in this process, first things last if asked to, until it is stopped."""

    def __init__(self, backwards=False, stop_after=None):
        super().__init__(1)
        self.backwards, self.stop_after, self.done = backwards, stop_after, []

    def run(self, task, items):
        numba.set_num_threads(1)
        for item in reversed(items) if self.backwards else items:
            if len(self.done) == self.stop_after:
                raise StoppedHereError
            self.done.append(item)
            yield item, task(item)


class Posting(Here):
    """A pool that computes in this process and pickles tasks and results."""

    def run(self, task, items):
        def posted(item):
            return pickle.loads(pickle.dumps(task(pickle.loads(pickle.dumps(item)))))

        return super().run(posted, items)


def held_bytes(count):
    """Hold so many bytes for a moment; return them and the process."""
    return len(bytearray(count)), os.getpid()


def children(process):
    """Return the processes that a process of this machine started, the latest last."""
    try:
        text = Path(f"/proc/{process}/task/{process}/children").read_text()
    except OSError:  # it has ended
        return []
    return [int(child) for child in text.split()]
