"""Films to light fields, frame after frame; of a session, each on the disk once it is done.

KEPT/                see `emmc_rig.files.folders.kept_folder`
    next.npz         what the next frame goes on from, and what all are of
    frames/000007/   the result of frame 7, whole
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike

from emmc_rig.errors import AppError, StoppedError
from emmc_rig.files.films import FRAMES
from emmc_rig.files.folders import (
    SESSION_RECONSTRUCTION,
    emptied,
    kept_folder,
    placed,
    result_folder,
)
from emmc_rig.files.psi import PSI, open_psi
from emmc_rig.files.results import METRICS, PSI_ASSUMED, write_metrics
from emmc_rig.model.arguments import refusal, required
from emmc_rig.model.camera import camera_of, json_of_shots
from emmc_rig.model.frames import Frames
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.processing.memory import (
    Ceiling,
    assumed_grid,
    own_bytes,
    peak_memory_mib,
    task_bytes,
)
from emmc_rig.processing.reconstructing import (
    PSI_TAKES,
    OnStep,
    as_frames,
    is_one_block,
    settings_of,
)
from emmc_rig.processing.result import Result
from emmc_rig.session.exposure import exposure_reasons, shot_exposures
from emmc_rig.session.journal import FilmEntry, of_kind
from emmc_rig.session.measured_psi import Scale, psi_is_assumed, session_scale
from emmc_rig.session.readings import FilmFrame, film_frames
from emmc_rig.session.session import Session
from emmc_rig.version import __version__
from reconstruction.adaptive.film import Film
from reconstruction.errors import ReconstructionError
from reconstruction.methods import DEFAULT_METHOD, MethodSettings, film_methods, find_method
from reconstruction.result import Progress
from reconstruction.verdict.rules import LEVELS
from reconstruction.verdict.run import reconstruct_judged

NEXT = "next.npz"
DAMAGED = (
    OSError, ValueError, LookupError, TypeError, EOFError, MemoryError, zlib.error, BadZipFile,
)  # fmt: skip
"""What reading a damaged file of arrays raises."""
FILM_TAKES = "an array (t, pixel_y, pixel_x), or an iterable of Frames of one shot each"


@dataclass(frozen=True, eq=False)
class Latest:
    """What the next frame goes on from.

    film: what is known after the latest frame. shots: of Psi, of the frames that it carries.
    place, segment: of the latest frame of a session, see `FilmFrame`. failed: why frames could not
    be reconstructed, by place.
    """

    film: Film = field(default_factory=Film)
    shots: tuple[int, ...] = ()
    place: int = -1
    segment: int = -1
    failed: Mapping[int, str] = field(default_factory=dict)

    def next(
        self,
        psi: ImagingMatrix,
        shot: int,
        frames: Frames,
        method: str,
        settings: MethodSettings,
        on_step: OnStep | None = None,
    ) -> tuple[Result, Latest]:
        """Return the result of the next frame, taken as a shot of Psi, and what follows from it."""
        one = _one_shot(psi, shot)
        solved, verdict = reconstruct_judged(
            method, one, frames.readings, frames.noise_sigma, None, settings, frames.usable,
            on_step, self.film,
        )  # fmt: skip
        shots = (*self.shots, shot)[-len(solved.film.known.earlier) :]
        result = Result(replace(solved, film=None), verdict, one, frames)
        return result, replace(self, film=solved.film, shots=shots)

    def saved(self, path: Path, fingerprint: str, psi: ImagingMatrix) -> Latest:
        """Write it, whole and on the disk; return it as `opened` would."""
        of_session = {"place": self.place, "segment": self.segment, "failed": self.failed}
        about = json.dumps({"fingerprint": fingerprint, "shots": self.shots, **of_session})
        arrays = {"latest": np.array(about), **self.film.arrays()}
        partial = path.with_name("part.npz")
        np.savez(partial, **arrays)  # pyright: ignore[reportArgumentType]
        placed(partial, path)
        # As after a kill: what follows must not depend on how arrays lie in memory.
        return replace(self, film=Film.restored(arrays, [_one_shot(psi, s) for s in self.shots]))

    @classmethod
    def opened(cls, path: Path, fingerprint: str, psi: ImagingMatrix) -> Latest | None:
        """Return what was written there; None where that is damaged, or of another film."""
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            about = parse_json(str(arrays["latest"]), str(path), ValueError)
            if about.pop("fingerprint") != fingerprint:
                return None
            shots, failed = tuple(about.pop("shots")), about.pop("failed")
            film = Film.restored(arrays, [_one_shot(psi, shot) for shot in shots])
        except (*DAMAGED, ReconstructionError):
            return None
        return cls(film, shots, failed={int(place): why for place, why in failed.items()}, **about)


def _one_shot(psi: ImagingMatrix, shot: int) -> ImagingMatrix:
    if psi.shots == 1:
        return psi
    camera = json_of_shots(camera_of(psi), [shot]) if psi.camera_json else ""
    return psi.of_shots([shot], camera)


def reconstruct_film(
    psi: ImagingMatrix,
    frames: ArrayLike | Iterable[Frames],
    method: str = DEFAULT_METHOD,
    *,
    noise_sigma: float | None = None,
    settings: MethodSettings | Mapping[str, Any] | None = None,
    on_step: OnStep | None = None,
) -> Iterator[Result]:
    """Return the light fields of a film's frames, one by one as they are asked for.

    Each goes on from what the frames before it showed. After a cut or a pause call it again.

    Args:
        psi: the imaging matrix. Of several shots, frame t is taken as shot t modulo their number.
        frames: an array (t, pixel_y, pixel_x) of readings in the order of time, or an iterable of
            `Frames` of one shot each, (1, pixel_y, pixel_x).
        method: "adaptive" or "adaptive-fast".
        noise_sigma: standard deviation of the readings, as for `reconstruct`.
        settings: of the methods, or a dict with the keys of a settings file.
        on_step: is called with the progress after each step of a frame.

    Raises:
        AppError: a method that takes no films, and what `reconstruct` raises.

    >>> import emmc_rig as emmc
    >>> scene = emmc.scene("near-planar", size=(24, 32))
    >>> psi = emmc.camera("rgbw-bayer-1shot").psi(scene.size)
    >>> film = [(psi @ scene)[0], (psi @ scene)[0]]
    >>> [result.light_field.shape for result in emmc.reconstruct_film(psi, film, "adaptive-fast")]
    [(5, 5, 24, 32, 3), (5, 5, 24, 32, 3)]
    """
    required(psi, ImagingMatrix, "psi", PSI_TAKES)
    _refuse_without_films(method)
    chosen = settings_of(settings)
    if isinstance(frames, Frames) or not isinstance(frames, Iterable):
        raise refusal(frames, "frames", FILM_TAKES)

    def results() -> Iterator[Result]:
        latest = Latest()
        for place, frame in enumerate(frames):
            shot = place % psi.shots
            one = frame if isinstance(frame, Frames) else np.asarray(frame)[np.newaxis]
            taken = as_frames(_one_shot(psi, shot), one, noise_sigma, None)
            result, latest = latest.next(psi, shot, taken, method, chosen, on_step)
            yield result

    return results()


def _refuse_without_films(method: str) -> None:
    if not find_method(method).films:
        able = " or ".join(film_methods())
        raise AppError(f"'{method}' takes no films: choose {able}, or a single frame by --frame")


def holds_film(folder: Path) -> bool:
    """Return whether a session's plan is one of a film."""
    return any(frame.film is not None for frame in Session(folder).frames)


def reconstruct_film_session(
    folder: Path,
    out: Path,
    method: str = DEFAULT_METHOD,
    psi_path: Path | None = None,
    settings: MethodSettings | None = None,
    memory: int | None = None,
    on_step: Callable[[Progress], None] = lambda progress: None,
    on_note: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Reconstruct the film of a session into the folder `out`; return its metrics.

    Goes on after the last frame that an earlier run finished, if it was of the same film, method,
    settings and version. psi_path: of another Psi than that of the session's whiteboards. memory:
    bytes that must be enough. on_step: called with the frames done. on_note: called with what
    becomes of an earlier run. Raises AppError, CalibrationError; StoppedError by Ctrl-C.
    """
    _refuse_without_films(method)
    belongs = folder / SESSION_RECONSTRUCTION
    with result_folder(out, "reconstruct", belongs_to=belongs, resumes=True) as new:
        kept = kept_folder(new)
        film = _opened(Session(folder), kept, method, psi_path, settings or MethodSettings())
        if memory is not None:
            saved = open_psi(psi_path or kept / PSI)
            ceiling = Ceiling(memory, own_bytes(saved, film.settings, False, False))
            ceiling.workers(task_bytes(saved, assumed_grid(saved, film.settings)))
        try:
            metrics = film.reconstructed(on_step, on_note)
        except KeyboardInterrupt as stop:
            raise StoppedError(
                f"stopped by Ctrl-C; frames that are done are kept in {out}, and the same command "
                "goes on"
            ) from stop
        shutil.copytree(kept / FRAMES, new / FRAMES, copy_function=_linked)
        if psi_path is None:
            _linked(kept / PSI, new / PSI)
            metrics |= {"assumed": PSI_ASSUMED} if psi_is_assumed(film.session) else {}
        write_metrics(new, metrics)
    return metrics


def _linked(path: str | Path, place: str | Path) -> None:
    """Give a file another name, which stays when the first goes; it moves where it can have one."""
    try:
        os.link(path, place)
    except OSError:  # a file system without links, as on a memory stick
        os.replace(path, place)


def _opened(
    session: Session, kept: Path, method: str, psi_path: Path | None, settings: MethodSettings
) -> _SessionFilm:
    scale = session_scale(session)
    if psi_path is None:
        psi = scale.psi
        psi.save(kept / PSI)
    else:
        psi = open_psi(psi_path).load()
    if psi.frames_shape != scale.psi.frames_shape:
        raise AppError(f"{psi_path}: is not of this session's shots and frames")
    if not is_one_block(psi.size, settings):
        raise AppError(
            f"frames of {'x'.join(map(str, psi.size))} are more than one block, and films are "
            "reconstructed as a whole: raise blocks: {whole: SAMPLES} by --settings"
        )
    return _SessionFilm(session, kept, method, settings, scale, psi)


@dataclass(frozen=True, eq=False)
class _SessionFilm:
    """A film on its way from a session to results in the folder `kept`."""

    session: Session
    kept: Path
    method: str
    settings: MethodSettings
    scale: Scale
    psi: ImagingMatrix

    def fingerprint(self) -> str:
        """Return a SHA-256 of all that the light fields follow from."""
        stored = [entry.model_dump(mode="json") for entry in self.session.stored.values()]
        settings = self.settings.model_dump(mode="json")
        what = stored, self.psi.checksum(), self.method, settings, __version__
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def reconstructed(
        self, on_step: Callable[[Progress], None], on_note: Callable[[str], None]
    ) -> dict[str, Any]:
        """Reconstruct all frames that are not done; return the metrics of the film."""
        fingerprint, path = self.fingerprint(), self.kept / NEXT
        latest = Latest.opened(path, fingerprint, self.psi)
        if latest is not None:
            on_note(f"goes on after frame {latest.place} of an earlier run")
        elif path.exists():
            on_note("starts anew: an earlier run was of other frames, settings or version")
        (self.kept / FRAMES).mkdir(exist_ok=True)
        if latest is None:
            emptied(self.kept / FRAMES)
        latest = latest or Latest()
        planned = [frame for frame in self.session.frames if frame.film is not None]
        reasons = exposure_reasons(shot_exposures(self.session))
        times_s: dict[int, float] = {}
        for frame in film_frames(self.session, self.scale):
            times_s[frame.place] = frame.time_s
            if frame.place > latest.place:
                if frame.segment != latest.segment:
                    latest = Latest(failed=latest.failed)
                latest = self._after(latest, frame, reasons).saved(path, fingerprint, self.psi)
            on_step(Progress(frame.place + 1, None, None, len(planned)))
        return self._metrics(len(planned), times_s, latest.failed)

    def _after(self, latest: Latest, frame: FilmFrame, reasons: Sequence) -> Latest:
        """Write the result of a frame, if it can be reconstructed; return what follows from it."""
        latest = replace(latest, place=frame.place, segment=frame.segment)
        frames = Frames(frame.readings, frame.deviation, frame.usable)
        try:
            result, latest = latest.next(self.psi, frame.shot, frames, self.method, self.settings)
        except ReconstructionError as fault:
            return replace(latest, failed={**latest.failed, frame.place: str(fault)})
        result = replace(result, verdict=result.verdict.with_reasons(reasons))
        of_film = {"frame": frame.place, "time_s": frame.time_s, "segment": frame.segment}
        partial = self.kept / "part"
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir()
        result.write(partial, {**result.metrics(), **of_film, "shot": frame.shot + 1})
        placed(partial, self.kept / FRAMES / f"{frame.place:06d}")
        return latest

    def _metrics(
        self, count: int, times_s: Mapping[int, float], failed: Mapping[int, str]
    ) -> dict[str, Any]:
        done = [_figures(path / METRICS) for path in sorted((self.kept / FRAMES).iterdir())]
        if not done:
            raise AppError(f"{self.session.folder}: {next(iter(failed.values()), 'no frame')}")
        rate = of_kind(self.session.journal.entries, FilmEntry)[0].rate_hz
        places = {one["frame"] for one in done}
        anew = [
            one["frame"]
            for before, one in pairwise(done)
            if one["segment"] == before["segment"] and "new_share" not in one["parameters"]
        ]
        took_s = sum(one["seconds"] for one in done)
        levels = Counter(one["verdict"]["level"] for one in done)
        worst = max(done, key=_doubt)
        shown = ("frame", "time_s", "stated_db", "stated_interval_db")
        return {
            "method": self.method,
            "film": {
                "frames": count,
                "rate": rate,
                "times_s": _all_times(times_s, count, rate),
                "missing": sorted(set(range(count)) - places),
                "failed": {str(place): why for place, why in failed.items()},
                "begun_anew": anew,
                "verdicts": {level: levels[level] for level in LEVELS},
                "trusted_share": levels["trust"] / len(done),
                "seconds_per_frame": took_s / len(done),
                "worst": {name: worst[name] for name in shown},
            },
            "seconds": took_s,
            "verdict": worst["verdict"],
            "psi_sha256": self.psi.checksum(),
            "program_peak_gib": peak_memory_mib() / 2**10,
        }


def _figures(path: Path) -> dict[str, Any]:
    return parse_json(path.read_bytes(), str(path), AppError)


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
