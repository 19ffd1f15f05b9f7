"""Time of capturing and storing beside the devices: overhead, overlap, verifying, listing.

Devices that take no time of their own stand in for real ones; the disk is the real one.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.clock import SYSTEM_CLOCK
from drivers.dng import encode_dng
from drivers.raw import RawFrame, decode_raw
from emmc_rig.acquisition.expand import expand
from emmc_rig.acquisition.plan import Plan, planned_camera
from emmc_rig.acquisition.sequencer import Sequencer
from emmc_rig.acquisition.watcher import CaptureWatcher
from emmc_rig.bench.hardware import STAGE_AXES, Rig
from emmc_rig.errors import AppError
from emmc_rig.files.folders import refuse_inside_session
from emmc_rig.files.results import shown_bytes
from emmc_rig.pages.timeline import overlap, run_entries
from emmc_rig.session.journal import encode_line
from emmc_rig.session.listing import summary
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import JOURNAL, Frozen, Session
from emmc_rig.session.storage import SYSTEM_DISK, Disk
from emmc_rig.session.verify import PIECE_BYTES, THREADS, verify
from emmc_rig.study.benchmarks.timing import Figures
from simulators.still import PreparedCamera, StillStage

LARGE_SHAPE = (4000, 6000)
SMALL_SHAPE = (24, 32)
BLACK_DN, WHITE_DN = 256, 4095
ZERO_UM, WINDOW_UM = 30_000.0, 60_000.0
PLACES = 7
MOVE_S = 0.3


@dataclass(frozen=True)
class Overhead(Figures):
    """Milliseconds of the program for each shot, the time in the devices not counted.

    sequencing_ms: all but handing_over_ms, which includes waiting for a disk that is behind.
    hidden_share: of hashing and writing, how much went on while the bench worked.
    """

    megapixels: float
    shots: int
    move_s: float
    sequencing_ms: float
    handing_over_ms: float
    hidden_share: float


@dataclass(frozen=True)
class Verification(Figures):
    """Rates in MB/s of SHA-256 alone, of reading alone and of both, with as many threads."""

    shots: int
    megabytes: float
    threads: int
    sha256_mb_s: float
    disk_mb_s: float
    verify_mb_s: float

    @property
    def share(self) -> float:
        """Of the slower of the two alone."""
        return self.verify_mb_s / min(self.sha256_mb_s, self.disk_mb_s)


class _Idle:
    """An attendant with nothing to do."""

    def set_lamp(self, colour: str) -> None:
        pass

    def place(self, target: str, turn_deg: float = 0.0) -> None:
        pass

    def fit_masks(self, shot: int, fitted: bool = True) -> None:
        pass


class _Timed:
    """Adds up the time spent in a function."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            began_s = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - began_s

        return timed


def overheads(folder: Path, shots: int) -> Iterator[Overhead]:
    """Yield what sequencing costs: of small frames, and of 24 MP frames."""
    with _scratch(folder) as scratch:
        yield _overhead(SMALL_SHAPE, shots, SYSTEM_DISK, scratch / "small", 0.0)
        yield _overhead(LARGE_SHAPE, min(shots, 24), SYSTEM_DISK, scratch / "session", MOVE_S)


def _overhead(
    shape: tuple[int, int], shots: int, disk: Disk, folder: Path, move_s: float
) -> Overhead:
    rig, device = _rig(shape, move_s)
    session, plan = _begun(shots, disk, folder)
    steps = _Steps(device)
    Sequencer(session, plan, rig, steps).run()
    overlapping = overlap(run_entries(session.journal.entries)[-1])
    program_s = steps.looped_s - steps.device_s - steps.handing_over_s
    return Overhead(
        shape[0] * shape[1] / 1e6,
        shots,
        move_s,
        1e3 * program_s / (shots - 1),
        1e3 * steps.handing_over_s / (shots - 1),
        overlapping.hidden_share,
    )


class _Steps(CaptureWatcher):
    """Clocks the loop from the first frame to the last, and the handing over in it."""

    def __init__(self, device: _Timed) -> None:
        self.handing_over_s = 0.0
        self._device = device
        self._first: tuple[float, float] | None = None
        self._last = (0.0, 0.0)
        self._handed_s: float | None = None

    @property
    def looped_s(self) -> float:
        """From the first frame to the last."""
        assert self._first is not None
        return self._last[0] - self._first[0]

    @property
    def device_s(self) -> float:
        """Of that, in the devices."""
        assert self._first is not None
        return self._last[1] - self._first[1]

    def step(self, name: str, frame: PlannedFrame) -> None:
        """Note the time."""
        now_s = time.perf_counter()
        if name == "hand over":
            self._handed_s = now_s
        elif name == "attend":
            self._last = (now_s, self._device.seconds)
            self._first = self._first or self._last
            if self._handed_s is not None:
                self.handing_over_s += now_s - self._handed_s


def _rig(shape: tuple[int, int], move_s: float) -> tuple[Rig, _Timed]:
    device = _Timed()
    frames = [_frame(shape, seed) for seed in (0, 1)]
    count = 0

    def give(exposure_s: float) -> RawFrame:
        nonlocal count
        count += 1
        return frames[count % 2]

    stage = StillStage(STAGE_AXES, SYSTEM_CLOCK, move_s)
    camera = PreparedCamera(give, shape, "rggb")
    for thing, names in ((stage, ("move_to_um", "position_um")), (camera, ("snap",))):
        for name in names:
            setattr(thing, name, device(getattr(thing, name)))
    zero_um = dict.fromkeys(STAGE_AXES, ZERO_UM)
    return Rig(stage, camera, _Idle(), zero_um, WINDOW_UM), device


def _frame(shape: tuple[int, int], seed: int) -> RawFrame:
    rng = np.random.default_rng(seed)
    dn = rng.integers(BLACK_DN, WHITE_DN - 200, shape, dtype=np.uint16)
    return decode_raw(encode_dng(dn, "rggb", BLACK_DN, WHITE_DN, 0.01))


def _plan(shots: int) -> Plan:
    """Return a plan of a number of shots, each at another place than the one before."""
    places = [{"mask_um": [24.0 * (i % PLACES), 0.0], "exposure_s": 0.01} for i in range(shots)]
    return Plan.model_validate(
        {
            "camera": "rgbw-bayer-3shots",
            "shots": [{**place, "camera_shot": 0} for place in places],
            "whiteboards": None,
            "darks": None,
            "order": "as-planned",
        }
    )


def _begun(shots: int, disk: Disk, folder: Path) -> tuple[Session, Plan]:
    plan = _plan(shots)
    frames = expand(plan, planned_camera(plan), WINDOW_UM)
    about = {"title": "benchmark", "created": "", "command": "", "versions": {"emmc-rig": ""}}
    return Session.create(folder, Frozen("", {}, {}, frames), about, disk), plan


def verification(folder: Path, shots: int) -> Verification:
    """Return how fast a session of 24 MP frames is verified; the page cache is emptied before."""
    with _scratch(folder) as scratch:
        frame = _frame(LARGE_SHAPE, 0)
        free = shutil.disk_usage(scratch).free
        needed = 1.05 * shots * len(frame.original)
        if needed > free:
            raise AppError(
                f"{folder}: {shots} frames of 24 MP need {shown_bytes(needed)}, "
                f"{shown_bytes(free)} are free; use fewer --shots"
            )
        session = _begun(shots, SYSTEM_DISK, scratch / "session")[0]
        data = bytearray(frame.original)
        for place, planned in enumerate(session.frames):
            data[-8:] = place.to_bytes(8, "big")
            digest = hashlib.sha256(data).hexdigest()
            session.store(planned, ".dng", bytes(data), digest, dict)
        paths = [session.path_of(entry) for entry in session.stored.values()]
        total_mb = shots * len(data) / 1e6
        sha_s = _timed(lambda: _hash_alone(len(data), shots))
        _forget(paths)
        disk_s = _timed(lambda: _read_alone(paths))
        _forget(paths)
        verify_s = _timed(lambda: verify(session))
    return Verification(
        shots, total_mb, THREADS, total_mb / sha_s, total_mb / disk_s, total_mb / verify_s
    )


def listing_seconds(folder: Path, shots: int) -> float:
    """Return the seconds to open and summarise a session of a number of shots."""
    with _scratch(folder) as scratch:
        session = _begun(shots, SYSTEM_DISK, scratch / "session")[0]
        facts = {
            "bytes": 48_000_000,
            "sha256": "0" * 64,
            "run": 1,
            "shape": list(LARGE_SHAPE),
            "black_level_dn": [[256.0, 256.0], [256.0, 256.0]],
            "commanded_um": dict.fromkeys(STAGE_AXES, 123.456),
            "read_um": dict.fromkeys(STAGE_AXES, 123.456),
            "spans_s": {name: [1.0, 2.0] for name in ("move", "expose", "check", "write")},
            "figures": {"saturated": 0.001, "mean_dn": 1234.5, "bright_dn": 3456.7},
        }
        with open(session.folder / JOURNAL, "ab") as file:
            for frame in session.frames:
                entry = {"kind": "frame", "id": frame.id, "file": f"{frame.id}.dng", **facts}
                file.write(encode_line(entry))
        return _timed(lambda: summary(session.folder))


def _timed(work: Callable[[], object]) -> float:
    began_s = time.perf_counter()
    work()
    return time.perf_counter() - began_s


def _hash_alone(size: int, count: int) -> None:
    """Hash as many bytes as the frames have, from memory that is in no cache to begin with."""
    block = os.urandom(PIECE_BYTES)

    def one(_: int) -> str:
        digest = hashlib.sha256()
        for _ in range(size // len(block)):
            digest.update(block)
        digest.update(block[: size % len(block)])
        return digest.hexdigest()

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(one, range(count)))


def _read_alone(paths: list[Path]) -> None:
    def one(part: list[Path]) -> None:
        buffer = bytearray(PIECE_BYTES)
        for path in part:
            with open(path, "rb", buffering=0) as file:
                while file.readinto(buffer):
                    pass

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(one, [paths[i::THREADS] for i in range(THREADS)]))


def _forget(paths: list[Path]) -> None:
    """Drop the files from the page cache, where the system offers it."""
    if not hasattr(os, "posix_fadvise"):
        return
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    refuse_inside_session(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix="emmc-bench-") as scratch:
            yield Path(scratch)
    except OSError as fault:
        raise AppError(f"{folder}: cannot be written ({fault.strerror})") from fault
