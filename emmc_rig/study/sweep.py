"""The engine of every study: points are measured one by one, stored, and resumed after a stop.

A point is identified by a digest of everything that it depends on, so that changed settings never
reuse old results. The journal has one JSON line for each point; a line torn by a crash is ignored.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import platform
import re
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from pydantic_core import to_jsonable_python

from emmc_rig.errors import AppError
from emmc_rig.files.folders import Listing, refuse_edited, refuse_inside_session
from emmc_rig.files.results import command_line, metrics_text, versions
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.settings import Settings
from emmc_rig.pages.page import number
from emmc_rig.processing.pool import Pool
from emmc_rig.progress import Silent, Watcher
from emmc_rig.version import __version__
from reconstruction.methods import METHODS

P = TypeVar("P", bound=Hashable)
Results = Generator[dict, None, None]


class SweepStopped(KeyboardInterrupt):
    """Ctrl-C; the points measured so far are kept."""


class NotApplicableError(AppError):
    """A point cannot be measured with this camera or scene; the message says why."""


@contextmanager
def sweep_folder(out: Path, journal: str, command: str) -> Iterator[Path]:
    """Yield the folder of a sweep, created where missing; it outlives interruptions of the block.

    Raises what `open_folder` and `kept_when_stopped` do.
    """
    folder = open_folder(out, journal, command)
    with kept_when_stopped(out, folder):
        yield folder


def open_folder(out: Path, journal: str, command: str) -> Path:
    """Return the folder of a journal of this name, created where missing.

    command: as typed, such as "chart". What is drawn and written of the points is replaced later by
    `result_folder`; what that would refuse is refused here, before anything is measured.

    Raises AppError when the folder holds something else, or results that were edited, and
    where a session is.
    """
    refuse_inside_session(out)
    out = Path(os.path.abspath(out))
    if out.is_file():
        raise AppError(f"--out {out}: a file of that name exists; choose another folder")
    known = (out / journal).is_file() or Listing.read(out) is not None
    if out.is_dir() and any(out.iterdir()) and not known:
        raise AppError(
            f"--out {out}: the folder holds something else than an earlier `emmc-rig {command}`; "
            "choose another folder or empty it"
        )
    try:
        refuse_edited(out, command)
        out.mkdir(parents=True, exist_ok=True)
        (out / journal).touch()
    except OSError as fault:
        raise AppError(f"--out {out}: cannot be written ({fault.strerror})") from fault
    return out


@contextmanager
def kept_when_stopped(
    out: Path, folder: Path, what: Callable[[], str] = lambda: "every point that was done is"
) -> Iterator[None]:
    """Add to the error what is kept when Ctrl-C or a full disk ends the block.

    out: the folder as asked for, folder: where it is. what: such as "3 of 10 points are". Raises
    SweepStopped and AppError.
    """
    try:
        yield
    except SweepStopped:
        raise
    except KeyboardInterrupt as stop:
        raise SweepStopped(
            f"stopped by Ctrl-C; {what()} kept in {folder}: run the same command again to go on"
        ) from stop
    except OSError as fault:
        raise AppError(
            f"--out {out}: cannot be written ({fault.strerror or fault}); {what()} kept: "
            "make room and run the same command again to go on"
        ) from fault


def digest_of(inputs: Mapping[str, object]) -> str:
    """Return a digest of plain data, the same for equal content in any order of keys."""
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return hashlib.blake2b(text.encode(), digest_size=12).hexdigest()


class Journal:
    """The results so far, by digest."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._results: dict[str, dict] = {}
        path.touch()
        text = path.read_bytes().decode("utf-8", errors="replace")
        self._torn = bool(text) and not text.endswith("\n")
        for line in text.splitlines():
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
        line = json.dumps(entry, allow_nan=False) + "\n"
        start, self._torn = (b"\n" if self._torn else b""), True
        with open(self._path, "ab") as file:
            file.write(start + line.encode())
            file.flush()
            os.fsync(file.fileno())
        self._torn = False
        self._results[digest] = result


@dataclass
class Sweep(Generic[P]):
    """Points measured into a folder. A study is a subclass that says what a point is.

    results: by point, plain data; one with `failed` says why there are no figures, and is measured
    again the next time if its `keep` is False. left_out: points that cannot be, and why.
    """

    settings: Any
    folder: Path
    results: dict[P, dict] = field(default_factory=dict, init=False)
    left_out: dict[P, str] = field(default_factory=dict, init=False)
    _digests: dict[P, str] = field(default_factory=dict, init=False)

    journal: ClassVar[str] = "points.jsonl"
    noun: ClassVar[str] = "points"
    stage: ClassVar[str] = "measure the points"
    revision: ClassVar[int | None] = None
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

    def is_whole(self, point: P, result: dict) -> bool:
        """Return whether all that belongs to a kept result, such as a picture, is there."""
        return True

    def prepare(self, points: Sequence[P], watcher: Watcher) -> None:
        """Make what several of the points need that will be measured."""

    def words(self, point: P, result: dict) -> str:
        """Return a measured point in words."""
        if "failed" in result:
            return f"{self.label(point)}: {result['failed']}"
        if "psnr_db" not in result:
            return self.label(point)
        return f"{number(result['psnr_db'], '.2f')} dB, {self.label(point)}"

    def label(self, point: P) -> str:
        """Return a point in words."""
        return getattr(point, "label", str(point))

    def all_inputs(self, point: P) -> dict[str, object]:
        """Return the inputs with the versions of the program and of the figures."""
        revision = {} if self.revision is None else {"revision": self.revision}
        return {"version": __version__, **revision, **self.inputs(point)}

    def digest(self, point: P) -> str:
        """Return the digest that identifies a point."""
        if point not in self._digests:
            self._digests[point] = digest_of(self.all_inputs(point))
        return self._digests[point]

    def failures(self) -> list[str]:
        """Return a line for each point that has no figures."""
        return [
            f"{self.label(point)}: {result['failed']}"
            for point, result in self.results.items()
            if "failed" in result
        ]

    def run(self, points: Iterable[P], watcher: Watcher, pool: Pool | None = None) -> dict[P, dict]:
        """Measure the points that the folder does not hold; return the results in their order.

        pool: workers that share the groups of points, where figures do not depend on how busy the
        machine is. Raises SweepStopped at Ctrl-C, AppError when the folder cannot be written, and
        what the study does for wrong input; what is measured is kept in each case.
        """
        points = list(dict.fromkeys(points))
        self.results, self.left_out = {}, {}

        def kept() -> str:
            return f"{len(self.results)} of {len(points)} {self.noun} are"

        with kept_when_stopped(self.folder, self.folder, kept):
            journal = Journal(self.folder / self.journal)
            missing = [point for point in points if not self._recalled(point, journal)]
            missing = [point for point in missing if point not in self.left_out]
            self.prepare(missing, watcher)
            before = f", {len(self.results)} kept from before" if self.results else ""
            watcher.begin(self.stage + before, len(missing))
            groups: dict[Hashable, list[P]] = {}
            for point in missing:
                groups.setdefault(self.group(point), []).append(point)
            left = list(groups.values())
            if pool is not None:
                left = self._measure_shared(left, journal, watcher, pool)
            for group in left:
                self._measure(group, journal, watcher)
        self.results = {point: self.results[point] for point in points if point in self.results}
        return self.results

    def _recalled(self, point: P, journal: Journal) -> bool:
        """Take a point's result from the journal; return whether there is a whole one."""
        try:
            result = journal.get(self.digest(point))
        except NotApplicableError as why:
            self.left_out[point] = str(why)
            return False
        if result is None or not self.is_whole(point, result):
            return False
        self.results[point] = result
        return True

    def _measure(self, group: Sequence[P], journal: Journal, watcher: Watcher) -> None:
        # Points of an earlier group may have had the same inputs.
        missing = [point for point in group if not self._recalled(point, journal)]
        for point in group:
            if point not in missing:
                watcher.step(self.words(point, self.results[point]))
        if not missing:
            return
        with closing(self.measured(missing, watcher)) as results:
            try:
                for point, result in zip(missing, results, strict=True):
                    self._keep(point, plain(result), journal, watcher)
            except NotApplicableError as why:
                self._leave_out(missing, str(why), watcher)

    def _measure_shared(
        self, groups: Iterable[Sequence[P]], journal: Journal, watcher: Watcher, pool: Pool
    ) -> list[list[P]]:
        """Measure groups by workers; return points that have the inputs of others, by group."""
        # A copy, since this one changes while it is sent.
        blank = replace(self)
        blank._digests = dict(self._digests)
        first: dict[str, P] = {}
        tasks, same = [], []
        for group in groups:
            own = [point for point in group if first.setdefault(self.digest(point), point) == point]
            tasks += [(blank, own)] if own else []
            same.append([point for point in group if point not in own])
        for (_, group), (results, why) in pool.run(_measured_group, tasks):
            for point, result in zip(group, results, strict=False):
                self._keep(point, result, journal, watcher)
            if why is not None:
                self._leave_out(group, why, watcher)
        return [group for group in same if group]

    def _keep(self, point: P, result: dict, journal: Journal, watcher: Watcher) -> None:
        if result.get("keep", True):
            journal.add(self.digest(point), self.all_inputs(point), result)
        self.results[point] = result
        watcher.step(self.words(point, result))

    def _leave_out(self, group: Sequence[P], why: str, watcher: Watcher) -> None:
        for point in group:
            if point not in self.results:
                self.left_out[point] = why
                watcher.step(f"left out: {self.label(point)}")


def _measured_group(task: tuple[Sweep, Sequence]) -> tuple[list[dict], str | None]:
    """Measure a group in a worker; return its results, and why the rest of it cannot be."""
    sweep, group = task
    results: list[dict] = []
    try:
        with closing(sweep.measured(group, Silent())) as found:
            results.extend(map(plain, found))
    except NotApplicableError as why:
        return results, str(why)
    return results, None


def plain(result: Mapping[str, object]) -> dict:
    """Return a result as read back from JSON: None for what is not finite, lists for tuples."""
    return parse_json(metrics_text(result), "a result", AppError)


def described(point: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as plain data; of its capture what identifies it.

    Raises NotApplicableError for a method that is not installed.
    """
    found = {one.name: getattr(point, one.name) for one in fields(point)}
    method = METHODS.get(found.get("method", ""))
    if method and not method.installed:
        raise NotApplicableError(f"{method.name} needs {method.package}, which is not installed")
    if "capture" in found:
        found["capture"] = found["capture"].identity()
    return to_jsonable_python(found)


def csv_text(
    rows: Sequence[Mapping[str, object]],
    columns: Sequence[str] = (),
    form: str = ".6g",
    forms: Mapping[str, str] | None = None,
) -> str:
    """Return rows as CSV: the columns named, or all that any row has; None is an empty field.

    form: of floats, but for the columns that `forms` has.
    """

    def written(name: str, value: object) -> object:
        return format(value, (forms or {}).get(name, form)) if isinstance(value, float) else value

    columns = columns or list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    writer.writerows({name: written(name, value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def provenance(settings: Settings, seconds: float, **more: str) -> dict[str, str]:
    """Return what a page says of where it came from; more: rows after the seconds."""
    return {
        "Command line": command_line(),
        "Seconds of this run": f"{seconds:.0f}",
        **more,
        "Settings": settings.model_dump_json(),
        **{f"Version of {name}": version for name, version in versions().items()},
    }


def check_scene_names(specs: Sequence[str], option: str = "--scene") -> None:
    """Raise AppError when two scenes (or cameras, by `option`) have one name."""
    names = [Path(spec).stem for spec in specs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise AppError(f"{option}: two are called '{twice}'; name each once, or rename one")


def check_size(size: tuple[int, int] | None, least_px: int) -> None:
    """Raise AppError for a picture of fewer than `least_px` rows or columns."""
    if size is not None and min(size) < least_px:
        raise AppError(f"--size {size[0]}x{size[1]}: needs {least_px}x{least_px} or more")


def available_cores() -> int:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """Return the processor's name and the number of cores."""
    name = platform.processor() or platform.machine()
    try:
        cpu = Path("/proc/cpuinfo").read_text("utf-8", errors="replace")
    except OSError:
        cpu = ""
    if found := re.search(r"^model name\s*:\s*(.+)$", cpu, re.MULTILINE):
        name = found[1].strip()
    return f"{name}, {available_cores()} cores"


def dictionary_identity(dictionary: str | None) -> str:
    """Return what identifies a dictionary: its name, and of a file its size and time."""
    if dictionary is None or not Path(dictionary).is_file():
        return dictionary or "lambertian"
    seen = Path(dictionary).stat()
    return f"{dictionary} {seen.st_size} {seen.st_mtime_ns}"
