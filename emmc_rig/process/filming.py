"""Films to light fields, frame after frame; of a session, each on the disk once it is done.

Segments of a film do not depend on each other: each is a task for a worker, which goes on after the
last frame that was done.

KEPT/                         see `emmc_rig.store.folders.kept_folder`
    psi.h5, calibration.h5    the scale that makes readings, of all frames
    job.json                  see `emmc_rig.store.jobs`
    next-001.npz              the state from which segment 1 goes on
    frames/000007/            the result of frame 7, whole
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.errors import AppError
from emmc_rig.formats.exports import FRAMES
from emmc_rig.model.arguments import refusal, required
from emmc_rig.model.camera import psi_of_shot
from emmc_rig.model.files import PART, whole_file, whole_folder
from emmc_rig.model.frames import Frames
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.sensing import Psi
from emmc_rig.process.cost import (
    BASE_BYTES,
    assumed_grid,
    own_bytes,
    peak_memory_mib,
    task_bytes,
)
from emmc_rig.process.reconstructing import (
    PSI_TAKES,
    OnStep,
    as_frames,
    is_one_block,
    settings_of,
)
from emmc_rig.process.result import Result
from emmc_rig.process.session_capture import SessionCapture
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.methods import (
    DEFAULT_METHOD,
    MethodSettings,
    film_methods,
    find_method,
)
from emmc_rig.reconstruction.verdict.rules import LEVELS
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.session.brightness import exposure_reasons, shot_exposures
from emmc_rig.session.journal import FilmEntry, of_kind
from emmc_rig.session.measured_psi import CALIBRATION_FILE, open_scale, write_scale
from emmc_rig.session.readings import FilmPlace, film_frames, film_places
from emmc_rig.session.session import Session
from emmc_rig.store.folders import (
    kept_folder,
    result_folder,
)
from emmc_rig.store.jobs import Store, kept_words, run_job, settled
from emmc_rig.store.pool import Ceiling, Pool, opened_pool
from emmc_rig.store.products import digest_of
from emmc_rig.store.psi import PSI, StoredPsi
from emmc_rig.store.result_files import read_metrics
from emmc_rig.store.results import PSI_ASSUMED, write_metrics
from emmc_rig.version import __version__

ABOUT = "plain"
DONE = "[0-9]*"
"""Names of frames that are done; partial folders have other names."""
DAMAGED = (
    OSError, ValueError, LookupError, TypeError, EOFError, MemoryError, zlib.error, BadZipFile,
)  # fmt: skip
"""Errors of reading a damaged or missing file of an earlier run."""
STILL = "still_share"
FOLLOWS = {STILL, "moved_px"}
"""Parameters of frames that follow an earlier frame, with masks at rest and stepping masks."""
FILM_TAKES = "an array (t, pixel_y, pixel_x), or an iterable of Frames of one shot each"


@dataclass(frozen=True, eq=False)
class Latest:
    """What the next frame goes on from.

    film: what is known after the latest frame. shots: of Psi, of the frames that it carries.
    place: in time, of the latest frame of a session. failed: why frames could not be reconstructed,
    by place.
    """

    film: Film = field(default_factory=Film)
    shots: tuple[int, ...] = ()
    place: int = -1
    failed: Mapping[int, str] = field(default_factory=dict)

    def next(
        self,
        psi: Psi,
        shot: int,
        frames: Frames,
        method: str,
        settings: MethodSettings,
        on_step: OnStep | None = None,
    ) -> tuple[Result, Latest]:
        """Return the result of the next frame, taken as a shot of Psi, and what follows from it."""
        of_shot = psi_of_shot(psi, shot)
        solved, verdict = reconstruct_judged(
            method, of_shot, frames, None, settings, on_step, self.film
        )
        shots = (*self.shots, shot)[-len(solved.film.known.earlier) :]
        result = Result(replace(solved, film=None), verdict, of_shot, frames, settings=settings)
        return result, replace(self, film=solved.film, shots=shots)

    def saved(self, path: Path, psi: Psi) -> Latest:
        """Write it, whole and on the disk; return it as `opened` would."""
        arrays = self.film.arrays()
        _save(path, {"shots": self.shots, "place": self.place, "failed": self.failed}, arrays)
        # As after a kill: what follows must not depend on how arrays lie in memory.
        return replace(self, film=Film.restored(arrays, [psi_of_shot(psi, s) for s in self.shots]))

    @classmethod
    def opened(cls, path: Path, psi: Psi) -> Latest:
        """Return what was written there; raises one of DAMAGED."""
        about, arrays = _open(path)
        film = Film.restored(arrays, [psi_of_shot(psi, shot) for shot in about["shots"]])
        failed = {int(place): why for place, why in about["failed"].items()}
        return cls(film, tuple(about["shots"]), about["place"], failed)


def _save(path: Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> None:
    """Write plain data and arrays, whole and on the disk."""
    named = {ABOUT: np.array(json.dumps(about)), **arrays}
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez(file, **named)  # pyright: ignore[reportArgumentType]


def _open(path: Path) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Return plain data and arrays; raises one of DAMAGED, also for a missing file."""
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return parse_json(str(arrays[ABOUT]), str(path), ValueError), arrays


def reconstruct_film(
    psi: Psi,
    frames: ArrayLike | Iterable[Frames],
    method: str = DEFAULT_METHOD,
    *,
    noise_sigma: float | None = None,
    settings: MethodSettings | Mapping[str, Any] | None = None,
    on_step: OnStep | None = None,
) -> Iterator[Result]:
    """Yield the light field of each frame of a film, computed when the caller asks for it.

    Each estimate also uses the frames before it. After a cut or a pause call the function again.

    Args:
        psi: the imaging matrix. With several shots, frame t is shot t modulo their number.
        frames: an array (t, pixel_y, pixel_x) of readings in the order of time, or an iterable of
            `Frames` of one shot each, (1, pixel_y, pixel_x).
        method: "adaptive" or "adaptive-fast".
        noise_sigma: standard deviation of the readings, as for `reconstruct`.
        settings: settings of the methods, or a dict with the keys of a settings file; with {"film":
            {"segment": 50}} every 50th frame starts anew, like the first. None: the defaults.
        on_step: is called with the `Progress` after each step of a frame.

    Yields:
        A `Result` for each frame, in their order.

    Raises:
        AppError: a method that takes no films, wrong settings; of a frame, when its turn comes,
            what `reconstruct` raises.
        ReconstructionError: an unknown method; a frame that does not fit Psi, when its turn comes.
        ArgumentError: an argument of another type.

    >>> import emmc_rig as emmc
    >>> scene = emmc.scene("near-planar", size=(24, 32))
    >>> psi = emmc.camera("rgbw-bayer-1shot").psi(scene.size)
    >>> film = [(psi @ scene)[0], (psi @ scene)[0]]
    >>> [result.light_field.shape for result in emmc.reconstruct_film(psi, film, "adaptive-fast")]
    [(5, 5, 24, 32, 3), (5, 5, 24, 32, 3)]
    """
    required(psi, Psi, "psi", PSI_TAKES)
    _refuse_without_films(method)
    chosen = settings_of(settings)
    if isinstance(frames, Frames) or not isinstance(frames, Iterable):
        raise refusal(frames, "frames", FILM_TAKES)

    def results() -> Iterator[Result]:
        latest = first = Latest(Film(chosen.film))
        for place, frame in enumerate(frames):
            if chosen.film.segment and place % chosen.film.segment == 0:
                latest = first
            shot = place % psi.shots
            single = frame if isinstance(frame, Frames) else np.asarray(frame)[np.newaxis]
            taken = as_frames(psi_of_shot(psi, shot), single, noise_sigma, None)
            result, latest = latest.next(psi, shot, taken, method, chosen, on_step)
            yield result

    return results()


def _refuse_without_films(method: str) -> None:
    if not find_method(method).films:
        able = " or ".join(film_methods())
        line = f"'{method}' takes no films: choose {able}, or a single frame"
        raise AppError(line, "name-frame")


@dataclass(frozen=True)
class FilmJob:
    """What the frames of a session's film are computed from; picklable, so that workers get it.

    session, kept: absolute, on a disk that all workers share.
    """

    session: Path
    kept: Path
    method: str
    settings: MethodSettings

    def settle(self, capture: SessionCapture, psi_path: Path | None, watcher: Watcher) -> None:
        """Write what all frames have alike, unless an earlier run of the same film did.

        Raises AppError, CalibrationError.
        """
        given = None if psi_path is None else StoredPsi(psi_path).load()
        session = capture.session
        inputs = {
            "stored": [entry.model_dump(mode="json") for entry in session.stored.values()],
            "session": session.digests,
            "psi": None if given is None else given.checksum(),
            "method": self.method,
            "settings": self.settings.model_dump(mode="json"),
            "version": __version__,
        }

        def settle() -> None:
            scale = capture.scale(psi_path, watcher)
            psi = scale.psi if given is None else given
            if psi.frames_shape != scale.psi.frames_shape:
                raise AppError(f"{psi_path}: not of this session's shots and frames; name its own")
            if not is_one_block(psi.size, self.settings):
                raise AppError(
                    f"frames of {'x'.join(map(str, psi.size))} are more than one block, and films "
                    "are reconstructed as a whole: raise the setting blocks: {whole: SAMPLES}"
                )
            psi.save(self.kept / PSI)
            with h5py.File(self.kept / CALIBRATION_FILE, "w") as file:
                write_scale(file, scale)
            (self.kept / FRAMES).mkdir()

        def done() -> str:
            return f"frames done: {len(self.done())}"

        settled(self.kept, digest_of(inputs), settle, watcher, done)

    def done(self) -> list[Path]:
        """Return the folders of the frames that are done, in order."""
        return sorted((self.kept / FRAMES).glob(DONE))


@dataclass(frozen=True)
class SegmentTask:
    """A segment of a film. places: in time, of dropped frames too."""

    job: FilmJob
    number: int
    places: range

    @property
    def path(self) -> Path:
        """The file of what the next frame goes on from."""
        return self.job.kept / f"next-{self.number:03d}.npz"


@dataclass(frozen=True)
class FrameFolders(Store[str, str]):
    """The folders of a film's frames, which tasks write; results are why a frame failed, or ""."""

    job: FilmJob

    def get(self, name: str) -> str | None:
        """Return "" for a frame that is done."""
        return "" if (self.job.kept / FRAMES / name).is_dir() else None

    def add(self, name: str, result: str) -> str:
        """Return why a frame failed."""
        return result

    def count(self) -> int:
        """Return how many frames are done."""
        return len(self.job.done())


def segment_task(task: SegmentTask) -> Generator[tuple[str, str], None, None]:
    """Reconstruct the frames of a segment that are not done, each to the disk.

    Yields the name of each frame, and why it could not be reconstructed or "". Raises AppError.
    """
    job, session, scale = task.job, Session(task.job.session), open_scale(task.job.kept)
    reasons = exposure_reasons(shot_exposures(session))
    latest = Latest(Film(job.settings.film), place=task.places.start - 1)
    with suppress(*DAMAGED):
        latest = Latest.opened(task.path, scale.psi)
    for place, why in latest.failed.items():
        yield name_of(place), why
    for at, frames in film_frames(session, scale, range(latest.place + 1, task.places.stop)):
        latest, shot = replace(latest, place=at.place), scale.shots.index(at.shot)
        why = ""
        try:
            result, latest = latest.next(scale.psi, shot, frames, job.method, job.settings)
        except ReconstructionError as fault:
            why = str(fault)
            latest = replace(latest, failed={**latest.failed, at.place: why})
        else:
            _write(replace(result, verdict=result.verdict.with_reasons(reasons)), at, task)
        latest = latest.saved(task.path, scale.psi)
        yield name_of(at.place), why


def name_of(place: int) -> str:
    """Return the name of a frame's folder."""
    return f"{place:06d}"


def _write(result: Result, frame: FilmPlace, task: SegmentTask) -> None:
    """Write the result of a frame, whole and on the disk."""
    of_film = {
        "frame": frame.place,
        "time_s": frame.time_s,
        "segment": task.number,
        "shot": frame.shot + 1,
        "peak_gib": peak_memory_mib() / 2**10,
    }
    with whole_folder(task.job.kept / FRAMES / name_of(frame.place)) as partial:
        result.write(partial, {**result.metrics(), **of_film})


def reconstruct_film_session(
    capture: SessionCapture,
    out: Path,
    method: str = DEFAULT_METHOD,
    psi_path: Path | None = None,
    settings: MethodSettings | None = None,
    memory: int | None = None,
    watcher: Watcher | None = None,
    workers: int | None = None,
    cluster: str | None = None,
) -> dict[str, Any]:
    """Reconstruct the film of a session into the folder `out`; return its metrics.

    Goes on after the frames that an earlier run finished, if it was of the same film, method,
    settings and version. psi_path: of another Psi than that of the session's whiteboards. memory:
    bytes that must be enough. watcher: gets the frames done, from any thread, and as a note what
    becomes of an earlier run. workers, cluster: see `opened_pool`, for segments
    beside each other; None of both: this process and its threads.
    Raises AppError, CalibrationError; StoppedError by Ctrl-C.
    """
    _refuse_without_films(method)
    watcher = watcher or Watcher()
    with (
        result_folder(out, "reconstruct", belongs_to=capture.own_place, resumes=True) as new,
        kept_words(out, lambda: "frames that are done are"),
    ):
        kept, session = kept_folder(new).absolute(), capture.session
        job = FilmJob(session.folder, kept, method, settings or MethodSettings())
        count, places = capture.planned_frames, film_places(session)
        job.settle(capture, psi_path, watcher)
        tasks = _segments(job, places)
        names = [name_of(at.place) for at in places]
        with _workers(job, len(tasks), workers, cluster, memory, watcher) as pool:
            reasons = run_job(
                names,
                lambda missing: [
                    task for task in tasks if not {*map(name_of, task.places)}.isdisjoint(missing)
                ],
                segment_task,
                FrameFolders(job),
                watcher,
                out,
                "frames",
                pool,
            )
        failed = {int(name): why for name, why in sorted(reasons.items()) if why}
        metrics = _metrics(job, session, count, places, failed)
        whole = shutil.ignore_patterns(f".*{PART}")
        shutil.copytree(kept / FRAMES, new / FRAMES, ignore=whole, copy_function=_linked)
        if psi_path is None:
            _linked(kept / PSI, new / PSI)
            metrics |= {"assumed": PSI_ASSUMED} if capture.assumed else {}
        write_metrics(new, metrics)
    return metrics


def _segments(job: FilmJob, places: Sequence[FilmPlace]) -> list[SegmentTask]:
    """Return the capture's segments, cut after every so many frames as the settings say."""
    found: list[range] = []
    for _, within in groupby(places, key=lambda at: at.segment):
        inside = [at.place for at in within]
        whole = range(inside[0], inside[-1] + 1)
        length = job.settings.film.segment or len(whole)
        found += (whole[at : at + length] for at in range(0, len(whole), length))
    return [SegmentTask(job, number, among) for number, among in enumerate(found)]


@contextmanager
def _workers(
    job: FilmJob,
    segments: int,
    workers: int | None,
    cluster: str | None,
    memory: int | None,
    watcher: Watcher,
) -> Iterator[Pool | None]:
    """Yield the workers that share segments; None: this process computes every segment."""
    if segments == 1 and (cluster is not None or (workers or 1) > 1):
        watcher.tell(
            "one segment, which workers cannot share: the setting film: {segment: 50} makes "
            "segments of 50 frames, the first of each without those before it"
        )
    shared = cluster is not None or (workers is not None and segments > 1)
    count, ceiling = workers or 1, None
    if memory is not None:
        saved, settings = StoredPsi(job.kept / PSI), job.settings
        own = own_bytes(saved, settings, False, False)
        ceiling = Ceiling(memory, BASE_BYTES + own if shared else own)
        count = min(count, ceiling.workers(task_bytes(saved, assumed_grid(saved, settings))))
    with opened_pool(count, cluster, ceiling) if shared else nullcontext() as pool:
        yield pool


def _linked(path: str | Path, place: str | Path) -> None:
    """Link a file to a second name; move the file where the disk has no links."""
    try:
        os.link(path, place)
    except OSError:  # a file system without links, as on a memory stick
        os.replace(path, place)


def _metrics(
    job: FilmJob,
    session: Session,
    count: int,
    places: Sequence[FilmPlace],
    failed: Mapping[int, str],
) -> dict[str, Any]:
    """Return the metrics of a film of which all frames are done."""
    times_s = {at.place: at.time_s for at in places}
    clocks = {f"{at.entry.film_clock} clock" if at.entry.film_clock else "" for at in places}
    done = [read_metrics(path) for path in job.done()]
    if not done:
        raise AppError(f"{session.folder}: {next(iter(failed.values()), 'no frame')}")
    rate = of_kind(session.journal.entries, FilmEntry)[0].rate_hz
    anew = [
        frame["frame"]
        for before, frame in pairwise(done)
        if frame["segment"] == before["segment"] and not FOLLOWS & frame["parameters"].keys()
    ]
    took_s = sum(frame["seconds"] for frame in done)
    levels = Counter(frame["verdict"]["level"] for frame in done)
    worst = max(done, key=_doubt)
    shown = ("frame", "time_s", "stated_db", "stated_interval_db")
    return {
        "method": job.method,
        "film": {
            "frames": count,
            "rate": rate,
            "times_s": _all_times(times_s, count, rate),
            "times_by": " and ".join(sorted(clocks)),
            "missing": sorted(set(range(count)) - {frame["frame"] for frame in done}),
            "failed": {str(place): why for place, why in failed.items()},
            "begun_anew": anew,
            "still_share": float(np.mean([frame["parameters"].get(STILL, 0.0) for frame in done])),
            "verdicts": {level: levels[level] for level in LEVELS},
            "trusted_share": levels["trust"] / len(done),
            "seconds_per_frame": took_s / len(done),
            "worst": {name: worst[name] for name in shown},
        },
        "seconds": took_s,
        "verdict": worst["verdict"],
        "psi_sha256": StoredPsi(job.kept / PSI).checksum,
        "peak_gib": max(frame["peak_gib"] for frame in done),
        "program_peak_gib": peak_memory_mib() / 2**10,
    }


def _doubt(figures: Mapping[str, Any]) -> tuple[int, float]:
    """Return what is larger the worse the frame of these metrics is."""
    return LEVELS.index(figures["verdict"]["level"]), -(figures["stated_db"] or 0.0)


def _all_times(times_s: Mapping[int, float], count: int, rate: float) -> list[float]:
    """Return the times of all places, those of missing frames a period after the one before."""
    every = []
    for place in range(count):
        before = every[-1] + 1 / rate if every else 0.0
        every.append(times_s.get(place, before))
    return every
