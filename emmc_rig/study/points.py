"""The engine of every study: points are measured one by one, kept, and drawn on a page.

A study is a subclass of `Study`, with points, their measurement, columns of CSV files and sections
of a page. A point is identified by a digest of everything that it depends on, so
that changed settings never reuse old results. The journal has one JSON line for each point; a line
torn by a crash is ignored, and a stopped study resumes.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from emmc_rig.errors import AppError
from emmc_rig.model.files import write_text
from emmc_rig.model.json_text import parse_json
from emmc_rig.progress import Watcher
from emmc_rig.report.page import Head, Section, framed, number, provenance_section
from emmc_rig.store.folders import Listing, refuse_edited, refuse_inside_session, result_folder
from emmc_rig.store.jobs import Store, kept_words, run_job
from emmc_rig.store.journal import Lines
from emmc_rig.store.pool import Pool, opened_pool
from emmc_rig.store.products import digest_of
from emmc_rig.store.results import write_metrics
from emmc_rig.study.rows import csv_text, plain, provenance
from emmc_rig.version import __version__

P = TypeVar("P", bound=Hashable)
Results = Generator[dict, None, None]
LEFT_OUT = "excluded"
"""Key of why a point has no result."""


class NotApplicableError(AppError):
    """A point cannot be measured with this camera or scene; the message says why."""


@contextmanager
def study_folder(out: Path, journal: str, command: str) -> Iterator[Path]:
    """Yield the folder of a study, created where missing; it outlives interruptions of the block.

    command: as typed, such as "chart". Charts and tables of the points are replaced later by
    `result_folder`; files that it would refuse are refused before the first point is measured.

    Raises AppError when the folder holds something else, or results that were edited, where a
    session is, and where nothing can be written; StoppedError at Ctrl-C.
    """
    refuse_inside_session(out)
    folder = Path(os.path.abspath(out))
    if folder.is_file():
        raise AppError(f"{out}: a file of that name exists; choose another folder")
    known = (folder / journal).is_file() or Listing.read(folder) is not None
    if folder.is_dir() and any(folder.iterdir()) and not known:
        raise AppError(
            f"{out}: the folder holds something other than an earlier {command}; "
            "choose another folder or empty it"
        )
    with kept_words(out, lambda: "what was measured is"):
        refuse_edited(folder, command)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / journal).touch()
        yield folder


class Journal(Store[dict, dict]):
    """Results by digest, a JSON line each.

    inputs: returns what a new result depends on, by its digest. A result is not kept where its
    `keep` is False, or where it says why a point is left out.
    """

    def __init__(self, path: Path, inputs: Callable[[str], Mapping[str, object]]) -> None:
        self._results: dict[str, dict] = {}
        self._inputs = inputs
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

    def get(self, name: str) -> dict | None:
        """Return the result of a digest, None where the point is not measured."""
        return self._results.get(name)

    def add(self, name: str, result: dict) -> dict:
        """Keep a result: it is on the disk when this returns. Raises OSError when it cannot be."""
        if result.get("keep", True) and LEFT_OUT not in result:
            entry = {"digest": name, "inputs": self._inputs(name), "result": result}
            self._lines.append(f"{json.dumps(entry, allow_nan=False)}\n".encode())
            self._results[name] = result
        return result


class Table(NamedTuple):
    """A table of a terminal and a page. heads: of the columns. rows: cells in words."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Report:
    """Content of a study's files.

    about: sentences under the title of the page. rows: of each CSV file, by the file's name.
    metrics: of metrics.json. sources: where figures came from, beside settings and versions.
    """

    head: Head
    about: Sequence[str]
    sections: Sequence[Section]
    rows: Mapping[str, Sequence[Mapping[str, object]]]
    metrics: Mapping[str, object]
    sources: Mapping[str, str]


@dataclass
class Study(Generic[P]):
    """Points measured into a folder, and their page. A study is a subclass.

    results: by point, plain data; one with `failed` says why there are no figures, and is measured
    again the next time if its `keep` is False. left_out: points that cannot be measured, and why.
    started: time of the study's making, perf_counter. seconds: from then until the page is written.
    """

    settings: Any
    folder: Path
    results: dict[P, dict] = field(default_factory=dict, init=False)
    left_out: dict[P, str] = field(default_factory=dict, init=False)
    started: float = field(default_factory=time.perf_counter, init=False)
    seconds: float = field(default=0.0, init=False)

    command: ClassVar[str] = "study"
    """As typed."""
    title: ClassVar[str] = ""
    page: ClassVar[str] = "study.html"
    style_sheets: ClassVar[Sequence[str]] = ()
    caveats: ClassVar[Sequence[str]] = ()
    columns: ClassVar[Mapping[str, Sequence[str]]] = {}
    """Of each CSV file, by its name; empty fields are infinite, unknown or not applicable."""
    journal: ClassVar[str] = "points.jsonl"
    noun: ClassVar[str] = "points"
    stage: ClassVar[str] = "measure the points"
    revision: ClassVar[int] = 0
    """Of what a point's figures are: raised with them, so that older points are measured again."""

    def planned(self) -> Sequence[P]:
        """Return the points. Raises AppError for wrong input, before the folder is made."""
        raise NotImplementedError

    def inputs(self, point: P) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data.

        Raises NotApplicableError for a point that cannot be measured.
        """
        raise NotImplementedError

    def measured(self, points: Sequence[P]) -> Results:
        """Yield the result of each point of a group, in order.

        Raises NotApplicableError where the rest of the group cannot be measured.
        """
        raise NotImplementedError

    def report(self, new: Path) -> Report:
        """Return the content of the files, with drawings written into a folder.

        Raises AppError where no point has figures.
        """
        raise NotImplementedError

    def shown(self) -> Iterable[Table | str]:
        """Return tables and sentences for a terminal, in their order."""
        return ()

    def group(self, point: P) -> Hashable:
        """Return what points that are measured together have in common."""
        return point

    def label(self, point: P) -> str:
        """Return a point in words."""
        return getattr(point, "label", str(point))

    def words(self, point: P, result: dict) -> str:
        """Return a measured point in words."""
        if LEFT_OUT in result:
            return f"excluded: {self.label(point)}"
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

    def excluded(self) -> list[str]:
        """Return a line for what could not be measured, and for each point that failed."""
        return [*self.unmeasured(), *self.failures()]

    def unmeasured(self) -> list[str]:
        """Return a line for each reason why points were not measured."""
        return list(dict.fromkeys(self.left_out.values()))

    def failures(self) -> list[str]:
        """Return a line for each point that has no figures."""
        return [
            f"{self.label(point)}: {result['failed']}"
            for point, result in self.results.items()
            if "failed" in result
        ]

    def carry_out(
        self, watcher: Watcher, workers: int | None = None, cluster: str | None = None
    ) -> None:
        """Measure into a folder that outlives interruptions, and write everything.

        workers: processes that share the points; None: this process. cluster: address of a Dask
        scheduler whose workers share them, on a disk shared with them.

        Raises StoppedError at Ctrl-C, AppError for wrong input and a folder that cannot be written,
        and the errors of the layers below; measured points are kept in each case.
        """
        points = self.planned()
        with study_folder(self.folder, self.journal, self.command) as self.folder:
            shared = workers is not None or cluster is not None
            with opened_pool(workers or 1, cluster) if shared else nullcontext() as pool:
                self.run(points, watcher, pool)
            watcher.begin("draw", None)
            self.seconds = time.perf_counter() - self.started
            with result_folder(self.folder, self.command, adds=True) as new:
                self.write(new)

    def write(self, new: Path) -> None:
        """Write CSV files, page and metrics.json into a folder."""
        report, excluded = self.report(new), self.excluded()
        for name, rows in report.rows.items():
            write_text(new / name, csv_text(rows, self.columns[name]))
        sources = provenance(self.settings, self.seconds, **report.sources)
        sections = [*report.sections, provenance_section(sources)]
        about = [*report.about, *([f"Excluded: {'; '.join(excluded)}."] if excluded else [])]
        text = framed(
            self.title, about, self.caveats, sections, self.style_sheets, head=report.head
        )
        write_text(new / self.page, text)
        write_metrics(new, report.metrics)

    def run(self, points: Iterable[P], watcher: Watcher, pool: Pool | None = None) -> dict[P, dict]:
        """Measure the points that the folder does not hold; return the results in their order.

        Points of one digest are measured once. pool: workers that share the groups of points, where
        figures do not depend on how busy the machine is.

        Raises StoppedError at Ctrl-C, AppError when the folder cannot be written, and what the
        study does for wrong input; what is measured is kept in each case.
        """
        digests: dict[P, str] = {}
        unfit: dict[P, str] = {}
        for point in dict.fromkeys(points):
            try:
                digests[point] = self.digest(point)
            except NotApplicableError as why:
                unfit[point] = str(why)
        first: dict[str, P] = {}
        for point, digest in digests.items():
            first.setdefault(digest, point)

        def groups(missing: Sequence[str]) -> list[list[tuple[str, P]]]:
            found: dict[Hashable, list[tuple[str, P]]] = {}
            for digest in missing:
                found.setdefault(self.group(first[digest]), []).append((digest, first[digest]))
            return list(found.values())

        self.results, self.left_out = {}, {}
        with kept_words(self.folder, lambda: "what was measured is"):
            path = self.folder / self.journal
            journal = Journal(path, lambda digest: self.all_inputs(first[digest]))
        known = run_job(
            list(first),
            groups,
            self.measured_group,
            journal,
            watcher,
            self.folder,
            self.noun,
            pool,
            self.stage,
            lambda digest, result: self.words(first[digest], result),
        )
        for point, digest in digests.items():
            if LEFT_OUT in known[digest]:
                self.left_out[point] = known[digest][LEFT_OUT]
            else:
                self.results[point] = known[digest]
        self.left_out |= unfit
        return self.results

    def measured_group(
        self, group: Sequence[tuple[str, P]]
    ) -> Generator[tuple[str, dict], None, None]:
        """Yield digest and result of the points of a group, or why they are left out."""
        left = iter(group)
        with closing(self.measured([point for _, point in group])) as results:
            try:
                for result in results:
                    yield next(left)[0], plain(result)
            except NotApplicableError as why:
                for digest, _ in left:
                    yield digest, {LEFT_OUT: str(why)}
