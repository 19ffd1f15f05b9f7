"""The pages of one result: their size, how soon a headless Chromium shows them, frames of a turn.

The result is the scene with noise, and maps of noise: no method runs. Chromium draws WebGL by the
processor (SwiftShader) unless the machine gives it a graphics card.
"""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.files.formats import Export
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import Camera
from emmc_rig.model.files import write_text
from emmc_rig.pages.report import ReportContent, render
from emmc_rig.pages.viewer import render_viewer
from emmc_rig.study.benchmarks.running import Asked, Show

SIZES = ((376, 541), (593, 840))
NOISE = 0.01
FRAMES, PATIENCE_S = 12, 120
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")
OPTIONS = ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--window-size=1600,1000")
EMPTY = "<!doctype html><title>empty</title><p>empty</p>"
WATCH = """new PerformanceObserver((list) => {
  for (const one of list.getEntries()) window.seen = one.startTime;
}).observe({ type: "largest-contentful-paint", buffered: true });
addEventListener("DOMContentLoaded", () => {
  const viewer = document.getElementById("viewer");
  const look = () => { if (!viewer || viewer.dataset.ready) window.turns = performance.now(); };
  look();
  if (viewer) new MutationObserver(look).observe(viewer, { attributeFilter: ["data-ready"] });
});"""
"""Notes by the page's own clock when its largest picture is seen, and when it can be turned."""
TIMES = """const viewer = document.getElementById("viewer");
return window.seen && (!viewer || viewer.dataset.complete) ? [window.seen, window.turns] : null"""
TURN = """const show = document.getElementById('viewer').show, times = [];
for (let k = 0; k <= arguments[0]; k++) {
  const begun = performance.now();
  show({ v: 1.1 + 0.05 * k, u: 2.3, aperture: 0 }, arguments[1]);
  times.push(performance.now() - begun);
}
return times.slice(1);"""
DETAILS = (1, 2, 4)
"""Every which pixel is drawn: all at rest, fewer while a slow machine turns."""


@dataclass(frozen=True)
class PageTiming:
    """One page of one size. seen_s, turns_s: from the address to the centre view's picture, and
    until the light field can be turned, medians of three.

    frame_ms: of a view between views, by every which pixel.
    """

    page: str
    size: tuple[int, int]
    megabytes: float
    seen_s: float
    turns_s: float
    frame_ms: dict[int, float]


@contextmanager
def _browser() -> Iterator[Any]:
    """Yield a headless Chromium; raises AppError where selenium or Chromium is missing."""
    try:
        from selenium import webdriver
    except ImportError as fault:
        raise AppError("selenium is not installed: pip install 'emmc-rig[browser]'") from fault
    chromium = next(filter(None, map(shutil.which, CHROMIUM)), None)
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        raise AppError(f"no chromedriver and one of {', '.join(CHROMIUM)} on PATH: install them")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    with tempfile.TemporaryDirectory() as profile:
        for option in (*OPTIONS, f"--user-data-dir={profile}"):
            options.add_argument(option)
        browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
        try:
            browser.set_script_timeout(PATIENCE_S)
            browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH})
            yield browser
        finally:
            browser.quit()


def pages_of(camera: Camera, size: tuple[int, int], scene: str, seed: int) -> dict[str, str]:
    """Return report and viewer of a noisy copy of a scene with all maps, as text by name."""
    opened = open_scene(scene, size=size, views=camera.views)
    truth, rng = opened.light_field, np.random.default_rng(seed)
    estimate = np.clip(truth + rng.normal(0, NOISE, truth.shape).astype(np.float32), 0, 1)
    disparity = opened.disparity_px
    maps = {
        "sigma": np.full(truth.shape[:4], NOISE, np.float32),
        "model": rng.integers(0, 5, truth.shape[2:4]),
        "misfit": np.abs(rng.normal(0, 1, truth.shape[2:4])).astype(np.float32),
        **({} if disparity is None else {"disparity": disparity}),
    }
    psi = rng.random(truth.shape[:4], dtype=np.float32)
    report = ReportContent(
        title=scene, scene=scene, camera="", camera_line=camera.title, camera_reference="",
        estimate=estimate, frames=truth.mean(axis=(0, 1))[None, ..., 1], cfa="rggb", metrics={},
        truth=truth, psi=psi, psi_std=psi, maps=maps,
    )  # fmt: skip
    export = Export(scene, "", estimate, truth, disparity, maps["sigma"], maps["model"])
    return {"report": render(report), "viewer": render_viewer(export)}


def _opened_s(browser: Any, path: Path) -> list[float]:
    """Open a page three times; return when it was seen, and when it could be turned."""
    from selenium.webdriver.support.ui import WebDriverWait

    times = []
    for _ in range(3):
        browser.get(path.as_uri())
        waiting = WebDriverWait(browser, PATIENCE_S, 0.2)
        times.append(waiting.until(lambda it: it.execute_script(TIMES)))
    return [statistics.median(one) / 1000 for one in zip(*times, strict=True)]


def page_timing(browser: Any, page: str, size: tuple[int, int], path: Path) -> PageTiming:
    """Open a page, and turn its light field."""
    seen_s, turns_s = _opened_s(browser, path)
    frame_ms = {
        every: statistics.median(browser.execute_script(TURN, FRAMES, every)) for every in DETAILS
    }
    return PageTiming(page, size, path.stat().st_size / 1e6, seen_s, turns_s, frame_ms)


def timings(
    camera: Camera, sizes: Sequence[tuple[int, int]], scene: str, seed: int, folder: Path
) -> Iterator[PageTiming]:
    """Write the pages into a folder, and measure an empty one and each."""
    with _browser() as browser:
        empty = folder / "empty.html"
        write_text(empty, EMPTY)
        seen_s, turns_s = _opened_s(browser, empty)
        yield PageTiming("empty page", (0, 0), len(EMPTY) / 1e6, seen_s, turns_s, {})
        for size in sizes:
            for name, text in pages_of(camera, size, scene, seed).items():
                path = folder / f"{name}-{size[0]}x{size[1]}.html"
                write_text(path, text)
                yield page_timing(browser, name, size, path)


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure report and viewer of both sizes (`chart --pages`)."""
    scene, found = (*asked.scenes, "deep-occlusions")[0], []
    sizes = (asked.size,) if asked.size else SIZES
    for one in timings(asked.described, sizes, scene, asked.seed, folder.absolute()):
        found.append(asdict(one))
        frames = ", ".join(f"{ms:.0f} ms at 1/{every}" for every, ms in one.frame_ms.items())
        times = f"seen after {one.seen_s:.2f} s"
        if frames:
            times += f", turns after {one.turns_s:.2f} s; a view between views {frames}"
        show.line(f"{one.page}, {one.size[0]}x{one.size[1]}: {one.megabytes:.2f} MB, {times}")
    return {"scene": scene, "pages": found, "load": os.getloadavg()[0], "cores": os.cpu_count()}
