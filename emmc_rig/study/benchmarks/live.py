"""The live page under load: how soon it stops, how fast it shows, how soon a light field follows.

Clients run in processes of their own and speak HTTP as a browser does, each on one connection; the
camera is one that has its frame in memory, so that the page alone is measured.
"""

from __future__ import annotations

import http.client
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.clock import SYSTEM_CLOCK
from drivers.raw import RawFrame
from emmc_rig.files.scenes import open_scene
from emmc_rig.live.light_field import LiveLightField
from emmc_rig.live.scale import designed_scale
from emmc_rig.live.server import application, new_token, served
from emmc_rig.live.setup_page import SetupPage
from emmc_rig.live.watch import Watch
from emmc_rig.model.camera import Camera
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.lightfield import psnr_db, replicate_centre
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures
from simulators.still import PreparedCamera, StillStage

CLIENTS, STOPS = 100, 20
LARGE_PX = (4000, 6000)
SIZES = ((192, 256), (376, 541), (593, 840))
WATCHED_S = 10.0
WARM_UP_S = 3.0
PATIENCE_S = 60.0
FOLLOWED = 12
"""Frames of a scene that stands still, for a preview to settle."""


@dataclass(frozen=True)
class StopTiming(Figures):
    """From sending `stop` to the stage receiving it, of several, in ms."""

    clients: int
    median_ms: float
    worst_ms: float


@dataclass(frozen=True)
class ShownTiming(Figures):
    """Pictures of a large frame that one client got, each of a newer frame, and their size."""

    megapixels: float
    frames_per_s: float
    kilobytes: float
    cpu_s_per_frame: float


@dataclass(frozen=True)
class FieldTiming(Figures):
    """The preview of one size: seconds of a frame by the clock and of computing, and its PSNR.

    copied_db: of the true centre view in place of every view, at the same quarter size.
    """

    size: tuple[int, int]
    first_s: float
    frame_s: float
    cpu_s: float
    psnr_db: float
    copied_db: float

    @property
    def frames_per_s(self) -> float:
        """By the clock."""
        return 1 / self.frame_s


def raw_frame(
    mosaic: NDArray[np.uint16], cfa: str, black_dn: int, white_dn: int, exposure_s: float
) -> RawFrame:
    """Return a frame that no file holds."""
    return RawFrame(
        mosaic=mosaic,
        cfa=cfa,
        black_level_dn=np.full(4, float(black_dn)),
        white_level_dn=white_dn,
        exposure_s=exposure_s,
        original=b"",
        sha256="",
    )


def memory_camera(shape: tuple[int, int]) -> PreparedCamera:
    """Return a camera that has one frame in memory."""
    mosaic = np.random.default_rng(0).integers(256, 4000, shape).astype(np.uint16)
    frame = raw_frame(mosaic, "rggb", 256, 4095, 0.01)
    return PreparedCamera(lambda exposure_s: frame, shape, "rggb")


class StoppingStage(StillStage):
    """A stage of one axis that notes when it receives a stop."""

    def __init__(self) -> None:
        super().__init__(("mask_x",), SYSTEM_CLOCK)
        self.home()
        self.stopped_s: list[float] = []

    def stop(self, axes: object = None) -> None:
        """Note the time."""
        self.stopped_s.append(time.monotonic())


@contextmanager
def _served(watch: Watch) -> Iterator[tuple[int, str]]:
    """Serve a page; yield its port and the path that begins with its token."""
    token = new_token()
    watch.start()
    try:
        with served(application(SetupPage(watch), token)) as port:
            yield port, f"/{token}"
    finally:
        watch.close()


def _client(call: str) -> subprocess.Popen[str]:
    """Start a process that makes a call of this module; it must be ended."""
    code = f"from emmc_rig.study.benchmarks import live; live.{call}"
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def _look(port: int, path: str, clients: int) -> None:
    """Follow the state as so many pages do, until ended; say when all do."""
    begun = threading.Barrier(clients + 1)

    def one() -> None:
        link = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        link.request("GET", f"{path}/events")
        answer = link.getresponse()
        begun.wait()
        while answer.readline():
            pass

    threads = [threading.Thread(target=one, daemon=True) for _ in range(clients)]
    for thread in threads:
        thread.start()
    begun.wait()
    print("all look", flush=True)
    for thread in threads:
        thread.join()


def stop_timing(clients: int = CLIENTS, stops: int = STOPS) -> StopTiming:
    """Return how soon the stage receives a stop while so many pages follow a running camera."""
    stage = StoppingStage()
    watch = Watch(memory_camera((480, 640)), stage)
    with _served(watch) as (port, path), _client(f"_look({port}, {path!r}, {clients})") as crowd:
        assert crowd.stdout is not None
        crowd.stdout.readline()
        delays_s = []
        for _ in range(stops):
            link = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
            before, sent_s = len(stage.stopped_s), time.monotonic()
            link.request("POST", f"{path}/do/stop", "{}", {"Content-Type": "application/json"})
            link.getresponse().read()
            link.close()
            delays_s.append(stage.stopped_s[before] - sent_s)
            time.sleep(0.1)
        crowd.kill()
    ms = [1e3 * one for one in delays_s]
    return StopTiming(clients, statistics.median(ms), max(ms))


def _fetch(port: int, path: str, seconds: float) -> None:
    """Follow the page for some seconds as its script does; print pictures per second, bytes."""
    links = [http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S) for _ in range(2)]
    links[0].request("GET", f"{path}/events")
    events = links[0].getresponse()
    frame, pictures, size, started_s = 0, 0, 0, 0.0
    begin_s = time.monotonic() + WARM_UP_S
    while time.monotonic() < begin_s + seconds:
        line = events.readline()
        if not line.strip():
            continue
        state = parse_json(line.removeprefix(b"data: "), "events", ValueError)
        if state["frame"] == frame:
            continue
        frame = state["frame"]
        links[1].request("GET", f"{path}/picture.jpg?px=1600")
        data = links[1].getresponse().read()
        if time.monotonic() >= begin_s:
            started_s = started_s or time.monotonic()
            pictures, size = pictures + 1, len(data)
    print((pictures - 1) / (time.monotonic() - started_s), size)


def shown_timing(shape: tuple[int, int] = LARGE_PX, seconds: float = WATCHED_S) -> ShownTiming:
    """Return how many pictures a second of a large camera reach one page, with all its figures."""
    with _served(Watch(memory_camera(shape))) as (port, path):
        before_s, began_s = time.process_time(), time.monotonic()
        with _client(f"_fetch({port}, {path!r}, {seconds})") as client:
            answer, _ = client.communicate(timeout=PATIENCE_S + seconds)
        cpu_share = (time.process_time() - before_s) / (time.monotonic() - began_s)
        rate, size = (float(one) for one in answer.split())
    return ShownTiming(shape[0] * shape[1] / 1e6, rate, size / 1e3, cpu_share / rate)


def field_timing(camera: Camera, size: tuple[int, int], scene: str) -> FieldTiming:
    """Return how soon a light field follows a frame of a scene, and how good it is then.

    Measured from the frame in memory to the light field, less what a page that asks draws of it.
    """
    light_field = open_scene(scene, size=size, views=camera.views).light_field
    psi = camera.psi(size)
    noise = camera.sensor.noise
    frames = [camera.expose(light_field, seed, psi).frames_dn[0] for seed in range(2)]
    first = raw_frame(
        frames[0],
        camera.sensor.cfa_name,
        noise.black_level_dn,
        noise.white_level_dn,
        float(camera.exposures_s()[0]),
    )
    # A clock that stands still begins no reconstruction beside.
    live = LiveLightField(designed_scale(psi), clock=lambda: 0.0)
    live.update(replace(first))
    live = LiveLightField(designed_scale(psi), clock=lambda: 0.0)
    first_s = _seconds(lambda: live.update(first))
    seconds, cpu = [], []
    for number in range(FOLLOWED):
        frame = replace(first, mosaic=frames[number % 2])
        before_s = time.process_time()
        seconds.append(_seconds(lambda frame=frame: live.update(frame)))
        cpu.append(time.process_time() - before_s)
    assert live.preview is not None
    found = live.preview.light_field
    rows, columns = (4 * count for count in found.shape[2:4])
    cut = light_field[:, :, :rows, :columns]
    true = cut.reshape(*cut.shape[:2], rows // 4, 4, columns // 4, 4, 3).mean(axis=(3, 5))
    true = np.ascontiguousarray(true, dtype=np.float32)
    copied = np.ascontiguousarray(replicate_centre(true))
    return FieldTiming(
        size,
        first_s,
        statistics.median(seconds),
        statistics.median(cpu),
        psnr_db(found, true),
        psnr_db(copied, true),
    )


def _seconds(call: Callable[[], object]) -> float:
    started_s = time.perf_counter()
    call()
    return time.perf_counter() - started_s


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Time stopping among many pages, pictures of 24 MP, and live light fields (`chart --live`)."""
    scene, fields = (*asked.scenes, "deep-occlusions")[0], []
    stop = stop_timing()
    show.line(
        f"stop among {stop.clients} pages: {stop.median_ms:.0f} ms, at most {stop.worst_ms:.0f} ms"
    )
    shown = shown_timing()
    show.line(
        f"{shown.megapixels:.0f} MP: {shown.frames_per_s:.1f} frames/s to a page, "
        f"{shown.kilobytes:.0f} kB each, {shown.cpu_s_per_frame:.2f} s of computing"
    )
    for rows, columns in (asked.size,) if asked.size else SIZES:
        field = field_timing(asked.described, (rows, columns), scene)
        fields.append(field.as_dict())
        show.line(
            f"light field of {rows}x{columns}: {field.frame_s:.2f} s after its frame "
            f"({field.frames_per_s:.1f}/s, {field.cpu_s:.2f} s of computing, the first "
            f"{field.first_s:.2f} s), {field.psnr_db:.1f} dB, the copied centre view "
            f"{field.copied_db:.1f} dB"
        )
    return {
        "camera": asked.camera,
        "scene": scene,
        "stop": stop.as_dict(),
        "shown": shown.as_dict(),
        "light_fields": fields,
        "load": os.getloadavg()[0],
        "cores": os.cpu_count(),
    }
