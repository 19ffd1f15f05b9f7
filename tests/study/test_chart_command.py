"""`emmc-rig chart` end to end."""

import csv
import json
import os

import numpy as np
import pytest
from pages import Page
from view_files import save_views

from emmc_rig.errors import AppError
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.simulators.scenes import render
from emmc_rig.store.results import METRICS
from emmc_rig.study.chart import chart_points, charting
from emmc_rig.study.chart.chart_points import Configuration, Point, chart_settings, measured
from emmc_rig.study.chart.charting import CSV, ChartStudy
from emmc_rig.study.trial import Capture

SIZE = (24, 32)
LEVELS = {"tv": {"2 steps": {"tv": {"max_steps": 2}}, "default": {"tv": {"max_steps": 9}}}}


@pytest.fixture
def quick(monkeypatch):
    """Few settings of total variation alone."""
    monkeypatch.setattr(chart_points, "VARIATIONS", LEVELS)


def settings(**more):
    chosen = {"methods": ("tv",), **more}
    scenes, cameras = chosen.pop("scenes", ["dark"]), ["rgbw-bayer-1shot"]
    return chart_settings(True, scenes, cameras, SIZE, 1, **chosen)


def charted(out, **more):
    study = ChartStudy(settings(**more), out)
    study.carry_out(Watcher())
    return study


@pytest.mark.slow
def test_a_chart_holds_every_point(quick, tmp_path):
    measured_scene = tmp_path / "shed"
    save_views(measured_scene, render("near-planar", size=(30, 36)).light_field)
    folder = tmp_path / "out"
    outcome = charted(folder, scenes=["dark", str(measured_scene)])
    assert [chart.scene for chart in outcome.charts] == ["all scenes", "dark", "shed"]
    with open(folder / "chart.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == ChartStudy.columns[CSV]
    assert [(r["scene"], r["level"]) for r in rows] == [
        ("dark", "2 steps"), ("dark", "default"), ("shed", "2 steps"), ("shed", "default"),
    ]  # fmt: skip
    assert rows[0]["disparity_mae_px"]
    assert not rows[2]["disparity_mae_px"]
    text = (folder / "chart.html").read_text()
    page = Page(text)
    assert not page.foreign
    assert len(page.ids) == len(set(page.ids))
    assert text.count('<th scope="row">tv') == 6
    assert text.count("data:image/svg+xml") == 3
    for chart in outcome.charts:
        assert (folder / "charts" / f"chart-{chart.key}.svg").stat().st_size > 5000
    front = json.loads((folder / METRICS).read_text())["fronts"]["rgbw-bayer-1shot, all scenes"]
    assert front


@pytest.mark.slow
def test_a_point_has_its_seconds_and_its_own_peak_of_memory():
    three = MethodSettings.model_validate({"tv": {"max_steps": 3}})
    chart = settings()
    chart = chart.model_copy(update={"repeats": 2})
    small, wide = (
        measured(
            Point(Capture("dark", "rgbw-bayer-1shot", size), Configuration("tv", "3", three)), chart
        )
        for size in (SIZE, (96, 160))
    )
    assert (small["repeats"], small["steps"]) == (2, 3)
    assert 0 < small["fastest_s"] <= small["seconds"] <= small["slowest_s"]
    # The light field and its dual variables take 5 x 5 x 96 x 160 x 3 x 6 numbers more.
    assert small["peak_mib"] < wide["peak_mib"] - 10


def test_when_every_point_fails_the_chart_says_why(quick, monkeypatch, tmp_path):
    def full(*_):
        raise MemoryError

    monkeypatch.setattr(charting, "measured", full)
    with pytest.raises(AppError, match=r"nothing could be measured: .*not enough memory"):
        charted(tmp_path / "out")
    assert not (tmp_path / "out" / ChartStudy.journal).read_text()


@pytest.mark.slow
@pytest.mark.real_data
def test_a_real_light_field_is_charted(quick, tmp_path):
    folder = os.environ["EMMC_LIGHTFIELDS"]
    scene = next(path for path in sorted(os.scandir(folder), key=str) if path.is_dir()).path
    outcome = charted(tmp_path / "out", scenes=[scene])
    assert np.isfinite([mark.psnr_db for mark in outcome.charts[0].marks]).all()
