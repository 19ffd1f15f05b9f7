"""`emmc-rig chart` end to end."""

import csv
import json
import os
import re
from contextlib import contextmanager
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from pages import Page

from emmc_rig.errors import AppError
from emmc_rig.files.results import METRICS
from emmc_rig.model.lightfield import save_views
from emmc_rig.progress import Silent
from emmc_rig.study.chart import chart_sweep, measure, points
from emmc_rig.study.chart.captures import kept_capture
from emmc_rig.study.chart.chart_sweep import ChartSweep, timing_lock, working
from emmc_rig.study.chart.charting import COLUMNS, run_chart
from emmc_rig.study.chart.measure import Reference, measured
from emmc_rig.study.chart.peers import Peer
from emmc_rig.study.chart.points import chart_settings
from emmc_rig.study.sweep import SweepStopped, digest_of
from emmc_rig.study.trial import Capture
from simulators.scenes import render

SIZE = (24, 32)
LEVELS = {"tv": {"2 steps": {"tv": {"max_steps": 2}}, "default": {"tv": {"max_steps": 9}}}}


def at_once(measure):
    """Return a worker that measures in this process: all but the memory is the same."""

    @contextmanager
    def working(*_):
        yield SimpleNamespace(measure=measure)

    return working


@pytest.fixture(autouse=True)
def lock_of_its_own(monkeypatch, tmp_path):
    """Nothing is timed here, so that a chart on this machine need not be waited for."""
    monkeypatch.setattr(chart_sweep, "lock_path", lambda: tmp_path / "lock")


@pytest.fixture
def quick(monkeypatch):
    """Few settings of total variation alone, measured in this process, by a known yardstick."""
    monkeypatch.setattr(measure, "reference", lambda: Reference(0.01, 0.01))
    monkeypatch.setattr(points, "VARIATIONS", LEVELS)
    monkeypatch.setattr(chart_sweep, "working", at_once(measured))


def settings(**more):
    chosen = {"methods": ("tv",), "scaling": False, **more}
    scenes, cameras = chosen.pop("scenes", ["dark"]), ["rgbw-bayer-1shot"]
    return chart_settings(True, scenes, cameras, SIZE, 1, **chosen)


@pytest.fixture
def command(run):
    """Run the program: exit code, standard output, and standard error on one line."""

    def call(*arguments):
        code, out, err = run(*arguments)
        return code, out, " ".join(err.split())

    return call


def test_a_chart_holds_every_point_with_its_picture(quick, tmp_path):
    measured_scene = tmp_path / "shed"
    save_views(measured_scene, render("near-planar", size=(30, 36)).light_field)
    chosen = settings(scenes=["dark", str(measured_scene)])
    outcome = run_chart(chosen, tmp_path / "out", Silent())
    folder = tmp_path / "out"
    assert [chart.scene for chart in outcome.charts] == ["all scenes", "dark", "shed"]
    with open(folder / "chart.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [(r["scene"], r["level"]) for r in rows] == [
        ("dark", "2 steps"), ("dark", "default"), ("shed", "2 steps"), ("shed", "default"),
    ]  # fmt: skip
    assert rows[0]["disparity_mae_px"]
    assert not rows[2]["disparity_mae_px"]
    text = (folder / "chart.html").read_text()
    page = Page(text)
    assert not page.foreign
    assert len(page.ids) == len(set(page.ids))
    marks = [name for name in page.ids if name.startswith("mark-")]
    assert len(marks) == 6
    marked, pictures = (
        json.loads(*re.findall(rf'id="{name}">(.*?)</script>', text))
        for name in ("points", "pictures")
    )
    assert set(marked) == set(marks)
    shown = {pair[key] for one in marked.values() for pair in one["pictures"]
             for key in ("estimate", "truth")}  # fmt: skip
    assert shown == set(pictures)
    for name in shown:
        picture = cv2.imread(str(folder / "pictures" / name))
        assert picture is not None
        assert picture.std() > 1
    for chart in outcome.charts:
        for ending in ("svg", "png"):
            assert (folder / "charts" / f"chart-{chart.key}.{ending}").stat().st_size > 5000
    front = json.loads((folder / METRICS).read_text())["fronts"]["rgbw-bayer-1shot, all scenes"]
    assert front


def test_an_interrupted_chart_goes_on(quick, monkeypatch, tmp_path):
    calls = []

    def stopping(job):
        calls.append(job)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return measured(job)

    monkeypatch.setattr(chart_sweep, "working", at_once(stopping))
    with pytest.raises(SweepStopped, match="1 of 2 points are kept"):
        run_chart(settings(), tmp_path / "out", Silent())
    run_chart(settings(), tmp_path / "out", Silent())
    assert len(calls) == 3
    kept = (tmp_path / "out" / ChartSweep.journal).read_text()
    run_chart(settings(), tmp_path / "out", Silent())
    assert len(calls) == 3
    assert (tmp_path / "out" / ChartSweep.journal).read_text() == kept


def test_growth_is_charted(quick, monkeypatch, tmp_path):
    capture = Capture("dark", "rgbw-bayer-1shot", SIZE)
    first = []

    def as_quick_as_small(run, point, path, picture, watcher):
        if not first:
            job = {
                "capture": path, "settings": {"tv": {"max_steps": 2}}, "method": "tv",
                "needs_dictionary": False, "repeats": 1, "enough_s": 1, "picture": picture,
            }  # fmt: skip
            first.append((measured(job), picture))
        figures, shown = first[0]
        picture.write_bytes(shown.read_bytes())
        size = point.capture.size
        seconds = 1e-4 * size[0] * size[1]
        return {**figures, "cpu_seconds": seconds, "size": list(size)}

    monkeypatch.setattr(ChartSweep, "_measured", as_quick_as_small)

    def always_the_same(asked, folder):
        path, _ = kept_capture(capture, folder)
        return path, digest_of({"asked": repr(asked)})

    monkeypatch.setattr(chart_sweep, "kept_capture", always_the_same)
    outcome = run_chart(settings(scaling=True), tmp_path / "out", Silent())
    pixels = next(growth for growth in outcome.growths if growth.axis == "pixels")
    assert pixels.exponent == pytest.approx(1)
    assert pixels.expected == pytest.approx(1)
    assert (tmp_path / "out/charts/growth-disparity-range.svg").is_file()
    assert "Growth with the size" in outcome.page.read_text()


@pytest.fixture
def job(tmp_path):
    """Three steps of total variation on a small capture."""
    path, digest = kept_capture(Capture("dark", "rgbw-bayer-1shot", SIZE), tmp_path)
    return {
        "capture": str(path), "settings": {"tv": {"max_steps": 3}}, "method": "tv",
        "needs_dictionary": False, "dictionary": None, "repeats": 2, "enough_s": 60,
        "picture": str(tmp_path / f"{digest}-x.webp"),
    }  # fmt: skip


def test_a_worker_outlives_what_fails_and_tells_each_jobs_peak(job, tmp_path):
    large, digest = kept_capture(Capture("dark", "rgbw-bayer-1shot", (96, 160)), tmp_path)
    later = {**job, "capture": str(large), "picture": str(tmp_path / f"{digest}-x.webp")}
    wrong = {**job, "needs_dictionary": True, "dictionary": str(tmp_path / "none.h5")}
    with (
        timing_lock("a test") as held,
        working({"NUMBA_NUM_THREADS": "1"}, 300, held) as worker,
    ):
        first = worker.measure(job)
        process = worker._process
        reported = worker.measure(wrong)
        assert "none.h5" in reported["failed"]
        assert not reported["keep"]
        wide, again = worker.measure(later), worker.measure(job)
        assert (worker._process is process) == worker.lasting
    assert first["cores"] == 1
    assert first["repeats"] == 2
    assert first["steps"] == 3
    assert 0 < first["fastest_s"] <= first["seconds"] <= first["slowest_s"]
    assert 50 < first["base_mib"] <= first["peak_mib"]
    assert list(tmp_path.glob("*-truth.webp"))
    # Psi alone takes 5 x 5 x 96 x 160 numbers more.
    assert again["peak_mib"] < wide["peak_mib"] - 1
    assert again["peak_mib"] == pytest.approx(first["peak_mib"], rel=0.1)
    assert again["psnr_db"] == first["psnr_db"]


def test_a_job_that_takes_too_long_is_given_up_and_the_next_is_done(job):
    with timing_lock("a test") as held, working({}, 0.01, held) as worker:
        assert worker.measure(job) == {"failed": "not done after 0 s"}
        worker.limit_s = 300
        assert worker.measure(job)["steps"] == 3


def test_a_worker_that_fails_by_itself_says_why(job):
    with timing_lock("a test") as held, working({}, 300, held) as worker:
        with pytest.raises(AppError, match="tv: the measuring process failed: KeyError: 'repeats'"):
            worker.measure({key: job[key] for key in job if key != "repeats"})
        assert worker.measure(job)["steps"] == 3


def test_a_missing_rival_is_one_line(quick, monkeypatch, tmp_path):
    absent = Peer("nobody's", ("no_such_library",), points.PEERS["sklearn-omp"].solve)
    monkeypatch.setitem(points.PEERS, "absent", absent)
    outcome = run_chart(settings(methods=("tv", "absent")), tmp_path / "out", Silent())
    (line,) = outcome.left_out
    assert "pip install" in line
    assert {mark.configuration.method for c in outcome.charts for mark in c.marks} == {"tv"}
    with pytest.raises(AppError, match="nothing to chart: absent: no_such_library"):
        run_chart(settings(methods=("absent",)), tmp_path / "out", Silent())


def test_when_every_point_fails_the_chart_says_why(quick, monkeypatch, tmp_path):
    full = at_once(lambda _: {"failed": "no room", "keep": False})
    monkeypatch.setattr(chart_sweep, "working", full)
    with pytest.raises(AppError, match=r"nothing could be measured: .*no room"):
        run_chart(settings(), tmp_path / "out", Silent())
    assert not (tmp_path / "out" / ChartSweep.journal).read_text()


@pytest.mark.parametrize(
    ("arguments", "reported", "expected"),
    [
        (["--method", "tv-dic"], "did you mean 'tv-dict'", 1),
        (["--scene", "nowhere"], "no scene 'nowhere'", 1),
        (["--scene", "dark", "--scene", "./dark"], "two are called 'dark'", 1),
        (["--camera", "no-camera"], "no-camera", 1),
        (["--size", "big"], "write ROWSxCOLUMNS", 2),
        (["--size", "8x8"], "needs 16x16", 1),
        (["--out", "mine"], "something else than an earlier `emmc-rig chart`", 1),
    ],
)
def test_what_cannot_be_charted_is_one_line(command, tmp_path, arguments, reported, expected):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    code, _, err = command("chart", "--fast", "--method", "tv", *arguments)
    assert code == expected
    assert reported in err
    assert "Traceback" not in err


@pytest.mark.real_data
def test_a_real_light_field_is_charted(quick, tmp_path):
    folder = os.environ["EMMC_LIGHTFIELDS"]
    scene = next(path for path in sorted(os.scandir(folder), key=str) if path.is_dir()).path
    outcome = run_chart(settings(scenes=[scene]), tmp_path / "out", Silent())
    assert np.isfinite([mark.psnr_db for mark in outcome.charts[0].marks]).all()
