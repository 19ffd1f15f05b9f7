"""Resumable jobs: tasks are done once, in this process or by workers, and kept by name.

A job may be stopped at any time. The next run of the same job does only what is not kept.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any, Generic, TypeVar

from emmc_rig.errors import ERRORS, AppError, StoppedError
from emmc_rig.model.files import write_text
from emmc_rig.model.json_text import parse_json
from emmc_rig.progress import Watcher
from emmc_rig.store.folders import emptied
from emmc_rig.store.pool import Pool

Part = TypeVar("Part")
Result = TypeVar("Result")
Kept = TypeVar("Kept")
Work = Callable[[Part], Generator[tuple[str, Result], None, None]]
"""Computes a part of a job, and yields its results with their names."""
JOB = "job.json"
COUNTING_S = 1.0
"""Between two looks at how much workers have done."""


class Store(Generic[Result, Kept]):
    """What is kept of a job, by name."""

    def get(self, name: str) -> Kept | None:
        """Return the kept result of a name; None for a missing or damaged result."""
        raise NotImplementedError

    def add(self, name: str, result: Result) -> Kept:
        """Keep a result that the work yielded, and return what `get` returns from then on."""
        raise NotImplementedError

    def count(self) -> int | None:
        """Return how many names workers have kept by now; None where only `add` keeps."""
        return None


def run_job(
    names: Sequence[str],
    parts: Callable[[Sequence[str]], Sequence[Part]],
    work: Work[Part, Result],
    store: Store[Result, Kept],
    watcher: Watcher,
    out: Path,
    noun: str,
    pool: Pool | None = None,
    stage: str = "",
    words: Callable[[str, Kept], str] = lambda name, kept: "",
) -> dict[str, Kept]:
    """Compute the results that the store lacks; return all results as the store keeps them.

    Args:
        names: of all results, each once.
        parts: returns what to compute for the names that are missing.
        work: computes a part; a function or method that workers can import.
        store: keeps each result as soon as the work yields it.
        watcher: gets the number of results done, and each new result in words.
        out: the folder that messages name.
        noun: plural of what results are, for messages.
        pool: workers that share the parts; None: this process does.
        stage: name of the stage to begin; "": a stage of the watcher has begun.
        words: returns a result in words.

    Raises:
        StoppedError: by Ctrl-C. AppError: the disk is full. Both say how much is kept. And what
            the work raises.
    """
    done: dict[str, Kept] = {}
    with kept_words(out, lambda: f"{len(done)} of {len(names)} {noun} are"):
        for name in names:
            if (kept := store.get(name)) is not None:
                done[name] = kept
        if stage:
            before = f", {len(done)} kept from before" if done else ""
            watcher.begin(stage + before, len(names))
        if done:
            watcher.at(len(done), len(names))
        missing = [name for name in names if name not in done]

        def count() -> None:
            watcher.at(store.count() or 0, len(names))

        counts = pool is not None and store.count() is not None
        with _repeated(count) if counts else nullcontext():
            for name, result in _results(parts(missing), work, pool):
                done[name] = store.add(name, result)
                watcher.at(len(done), len(names), words(name, done[name]))
    return done


def _results(
    parts: Sequence[Part], work: Work[Part, Result], pool: Pool | None
) -> Iterator[tuple[str, Result]]:
    """Yield the results of all parts with their names, as they are computed."""
    if pool is not None:
        for _, results in pool.run(partial(_listed, work), parts):
            yield from results
        return
    for part in parts:
        with closing(work(part)) as results:
            yield from results


def _listed(work: Work[Part, Result], part: Part) -> list[tuple[str, Result]]:
    """Return all results of a part: in a worker."""
    return list(work(part))


@contextmanager
def _repeated(call: Callable[[], None]) -> Iterator[None]:
    """Call a function again and again in a thread, until the block ends."""
    ended = Event()

    def repeat() -> None:
        while not ended.wait(COUNTING_S):
            call()

    thread = Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def kept_words(out: Path, what: Callable[[], str]) -> Iterator[None]:
    """Word Ctrl-C and a full disk within the block: raise StoppedError or AppError.

    out: the folder to name. what: returns the kept results and a verb; "": nothing is kept yet,
    and Ctrl-C stays a KeyboardInterrupt.
    """
    try:
        yield
    except KeyboardInterrupt as stop:
        if not what():
            raise
        raise StoppedError(
            f"stopped by Ctrl-C; {what()} kept in {out}: run the same command again to go on"
        ) from stop
    except ERRORS:
        raise
    except OSError as fault:
        kept = f"; {what()} kept" if what() else ""
        raise AppError(
            f"{out}: cannot be written ({fault.strerror or fault}){kept}: make room and run the "
            "same command again to go on"
        ) from fault


def settled(
    folder: Path,
    digest: str,
    settle: Callable[[], Any],
    watcher: Watcher,
    kept: Callable[[], str],
) -> Any:
    """Return what holds for all tasks of a job, from an earlier run where it was of the same job.

    Else the folder is emptied first. The file job.json states the digest, what was settled, and the
    SHA-256 of the files that `settle` wrote; where one differs the job starts anew.

    Args:
        folder: what is kept of the job.
        digest: of everything that the results follow from.
        settle: returns plain data, and writes files into the folder.
        watcher: gets a note about an earlier run.
        kept: returns in words how much an earlier run has kept.

    Raises OSError, and what `settle` does.
    """
    path = folder / JOB
    with suppress(OSError, ValueError, LookupError, TypeError):
        job = parse_json(path.read_bytes(), path.name, ValueError)
        if job["digest"] == digest and job["files"] == _checksums(folder, job["files"]):
            watcher.tell(f"goes on with an earlier run; {kept()}")
            return job["settled"]
    if path.exists():
        watcher.tell("starts anew: an earlier run was of other frames, settings or version")
        path.unlink()  # before all else: without it nothing is gone on from
    emptied(folder)
    plain = settle()
    names = [file.name for file in folder.iterdir() if file.is_file()]
    job = {"digest": digest, "settled": plain, "files": _checksums(folder, names)}
    write_text(path, json.dumps(job))
    return plain


def _checksums(folder: Path, names: Sequence[str] | Mapping[str, str]) -> dict[str, str]:
    """Return the SHA-256 of files by name; raises OSError."""
    found = {}
    for name in names:
        with open(folder / name, "rb") as file:
            found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
