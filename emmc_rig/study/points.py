"""The engine of every study: points are measured one by one, stored, and resumed after a stop.

A point is identified by a digest of everything that it depends on, so that changed settings never
reuse old results. The journal has one JSON line for each point; a line torn by a crash is ignored.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from emmc_rig.errors import AppError
from emmc_rig.model.json_text import parse_json
from emmc_rig.pages.page import number
from emmc_rig.processing.pool import Pool
from emmc_rig.progress import Watcher
from emmc_rig.store.folders import Listing, refuse_edited, refuse_inside_session
from emmc_rig.store.journal import Lines
from emmc_rig.study.rows import described, digest_of, plain
from emmc_rig.version import __version__

P = TypeVar("P", bound=Hashable)
Results = Generator[dict, None, None]


class StudyStopped(KeyboardInterrupt):
    """Ctrl-C; the points measured so far are kept."""


class NotApplicableError(AppError):
    """A point cannot be measured with this camera or scene; the message says why."""


@contextmanager
def study_folder(out: Path, journal: str, command: str) -> Iterator[Path]:
    """Yield the folder of a study, created where missing; it outlives interruptions of the block.

    command: as typed, such as "chart". What is drawn and written of the points is replaced later by
    `result_folder`; what that would refuse is refused here, before anything is measured.

    Raises AppError when the folder holds something else, or results that were edited, where a
    session is, and where nothing can be written; StudyStopped at Ctrl-C.
    """
    refuse_inside_session(out)
    folder = Path(os.path.abspath(out))
    if folder.is_file():
        raise AppError(f"{out}: a file of that name exists; choose another folder")
    known = (folder / journal).is_file() or Listing.read(folder) is not None
    if folder.is_dir() and any(folder.iterdir()) and not known:
        raise AppError(
            f"{out}: the folder holds something else than an earlier {command}; "
            "choose another folder or empty it"
        )
    with _stopped_with_words(out):
        refuse_edited(folder, command)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / journal).touch()
        yield folder


@contextmanager
def _stopped_with_words(out: Path, what: Callable[[], str] = lambda: "what was measured is"):
    """Say at Ctrl-C and at a full disk what is kept: raise StudyStopped and AppError."""
    try:
        yield
    except StudyStopped:
        raise
    except KeyboardInterrupt as stop:
        raise StudyStopped(
            f"stopped by Ctrl-C; {what()} kept in {out}: run the same command again to go on"
        ) from stop
    except OSError as fault:
        raise AppError(
            f"{out}: cannot be written ({fault.strerror or fault}); {what()} kept: "
            "make room and run the same command again to go on"
        ) from fault


class Journal:
    """The results so far, by digest."""

    def __init__(self, path: Path) -> None:
        self._results: dict[str, dict] = {}
        path.touch()
        self._lines = Lines(path)
        for line in self._lines.lines:
            try:
                entry = parse_json(line, path.name, ValueError)
                self._results[entry["digest"]] = entry["result"]
            except (ValueError, KeyError, TypeError):
                continue

    def __len__(self) -> int:
        return len(self._results)

    def get(self, digest: str) -> dict | None:
        """Return a point's result, None when it is not measured."""
        return self._results.get(digest)

    def add(self, digest: str, inputs: Mapping[str, object], result: dict) -> None:
        """Keep a result: it is on the disk when this returns. Raises OSError when it cannot be."""
        entry = {"digest": digest, "inputs": inputs, "result": result}
        self._lines.append(f"{json.dumps(entry, allow_nan=False)}\n".encode())
        self._results[digest] = result


@dataclass
class Study(Generic[P]):
    """Points measured into a folder. A study is a subclass that says what a point is.

    results: by point, plain data; one with `failed` says why there are no figures, and is measured
    again the next time if its `keep` is False. left_out: points that cannot be, and why.
    """

    settings: Any
    folder: Path
    results: dict[P, dict] = field(default_factory=dict, init=False)
    left_out: dict[P, str] = field(default_factory=dict, init=False)

    journal: ClassVar[str] = "points.jsonl"
    noun: ClassVar[str] = "points"
    stage: ClassVar[str] = "measure the points"
    revision: ClassVar[int] = 0
    """Of what a point's figures are: raised with them, so that older points are measured again."""

    def inputs(self, point: P) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data: by default its own.

        Raises NotApplicableError for a point that cannot be measured.
        """
        return described(point)

    def measured(self, points: Sequence[P], watcher: Watcher) -> Results:
        """Yield the result of each point of a group, in order.

        Raises NotApplicableError where the rest of the group cannot be measured.
        """
        raise NotImplementedError

    def group(self, point: P) -> Hashable:
        """Return what points that are measured together have in common."""
        return point

    def label(self, point: P) -> str:
        """Return a point in words."""
        return getattr(point, "label", str(point))

    def words(self, point: P, result: dict) -> str:
        """Return a measured point in words."""
        if "failed" in result:
            return f"{self.label(point)}: {result['failed']}"
        if "psnr_db" not in result:
            return self.label(point)
        return f"{number(result['psnr_db'], '.2f')} dB, {self.label(point)}"

    def all_inputs(self, point: P) -> dict[str, object]:
        """Return the inputs with the versions of the program and of the figures."""
        return {"version": __version__, "revision": self.revision, **self.inputs(point)}

    def digest(self, point: P) -> str:
        """Return the digest that identifies a point."""
        return digest_of(self.all_inputs(point))

    def failures(self) -> list[str]:
        """Return a line for each point that has no figures."""
        return [
            f"{self.label(point)}: {result['failed']}"
            for point, result in self.results.items()
            if "failed" in result
        ]

    def run(self, points: Iterable[P], watcher: Watcher, pool: Pool | None = None) -> dict[P, dict]:
        """Measure the points that the folder does not hold; return the results in their order.

        Points of one digest are measured once. pool: workers that share the groups of points, where
        figures do not depend on how busy the machine is.

        Raises StudyStopped at Ctrl-C, AppError when the folder cannot be written, and what the
        study does for wrong input; what is measured is kept in each case.
        """
        points = list(dict.fromkeys(points))
        self.results, self.left_out = {}, {}
        digests, unfit = self._digests(points)
        known: dict[str, dict] = {}
        with _stopped_with_words(
            self.folder, lambda: f"{len(known)} of {len(set(digests.values()))} {self.noun} are"
        ):
            journal = Journal(self.folder / self.journal)
            missing: dict[str, P] = {}
            for point, digest in digests.items():
                result = journal.get(digest)
                if result is not None:
                    known[digest] = result
                else:
                    missing.setdefault(digest, point)
            before = f", {len(known)} kept from before" if known else ""
            watcher.begin(self.stage + before, len(missing))
            groups: dict[Hashable, list[P]] = {}
            for point in missing.values():
                groups.setdefault(self.group(point), []).append(point)
            for point, result in self._all_measured(list(groups.values()), watcher, pool):
                if result.get("keep", True):
                    journal.add(digests[point], self.all_inputs(point), result)
                known[digests[point]] = result
                watcher.step(self.words(point, result))
        self.results = {p: known[d] for p, d in digests.items() if d in known}
        why = {digests[point]: reason for point, reason in self.left_out.items()}
        self.left_out = {p: why[d] for p, d in digests.items() if d in why} | unfit
        return self.results

    def _digests(self, points: Iterable[P]) -> tuple[dict[P, str], dict[P, str]]:
        """Return the digests of the points that can be measured, and why the others cannot be."""
        digests: dict[P, str] = {}
        unfit: dict[P, str] = {}
        for point in points:
            try:
                digests[point] = self.digest(point)
            except NotApplicableError as why:
                unfit[point] = str(why)
        return digests, unfit

    def _all_measured(
        self, groups: list[list[P]], watcher: Watcher, pool: Pool | None
    ) -> Iterator[tuple[P, dict]]:
        """Yield points as they are measured; leave out those that cannot be."""
        if pool is not None:
            for (_, group), (results, why) in pool.run(
                _group_measured, [(self, g) for g in groups]
            ):
                yield from zip(group, results, strict=False)
                if why is not None:
                    self._leave_out(group[len(results) :], why, watcher)
            return
        for group in groups:
            done = 0
            with closing(self.measured(group, watcher)) as results:
                try:
                    for point, result in zip(group, results, strict=True):
                        done += 1
                        yield point, plain(result)
                except NotApplicableError as why:
                    self._leave_out(group[done:], str(why), watcher)

    def _leave_out(self, points: Iterable[P], why: str, watcher: Watcher) -> None:
        for point in points:
            self.left_out[point] = why
            watcher.step(f"excluded: {self.label(point)}")


def _group_measured(task: tuple[Study, Sequence]) -> tuple[list[dict], str | None]:
    """Measure a group in a worker; return its results, and why the rest of it cannot be."""
    study, group = task
    results: list[dict] = []
    try:
        with closing(study.measured(group, Watcher())) as measured:
            results.extend(map(plain, measured))
    except NotApplicableError as why:
        return results, str(why)
    return results, None
