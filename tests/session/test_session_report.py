"""What a session shows of itself: times, contact sheet, terminal, and what it costs."""

import io
import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import SIZE, begun, still_rig
from rich.console import Console
from simulated_disk import SimulatedDisk

from emmc_rig.captures.control import Control
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.commands.capture_display import CaptureDisplay
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.raw import RawFrame, decode_raw
from emmc_rig.model.files import SYSTEM_DISK
from emmc_rig.report.session_sheet import run_times, sheet
from emmc_rig.session.brightness import ShotExposure, exposure_reasons, figures, thinned
from emmc_rig.session.frame_file import NO_FIGURES, frame_entry
from emmc_rig.session.journal import RetryEntry
from emmc_rig.session.session import Session

ROOT = Path("/disk")


def entry(name, run=1, **spans_s):
    frame = RawFrame(np.zeros(SIZE, np.uint16), np.zeros((2, 2)), 255, "rggb", 0.01, b"", "")
    taken = frame_entry(frame, 0.01, 1.0, figures=NO_FIGURES, run=run, spans_s=spans_s)
    return taken.model_copy(update={"id": name})


def test_the_times_of_runs_are_kept_apart(tmp_path):
    session, _ = begun(tmp_path, SYSTEM_DISK, still_rig())
    for item in (
        entry("a", 1, move=(0, 1), expose=(1, 2), write=(2, 5)),
        entry("b", 1, move=(2.5, 4), expose=(4, 4.5), write=(5, 6)),
        entry("c", 2, write=(0, 1)),
    ):
        session.note(item)
    first, second = run_times(session)
    assert first == {
        "frames": 2, "seconds": 6, "moving_s": 2.5, "exposing_s": 1.5, "writing_s": 4,
    }  # fmt: skip
    assert second["seconds"] == second["writing_s"] == 1


@pytest.fixture
def captured(tmp_path):
    rig = still_rig()
    session, plan = begun(tmp_path, SYSTEM_DISK, rig)
    Sequencer(session, plan, rig).run()
    return session


def test_the_contact_sheet_shows_what_is_missing_and_what_is_damaged(captured):
    captured.discard("shot-0-e0-r0", "for the test")
    path = captured.path_of(captured.stored["shot-1-e0-r0"])
    path.write_bytes(path.read_bytes()[:-9])
    page = sheet(Session(captured.folder))
    assert "not captured" in page
    assert "is damaged" in page
    assert "not complete" in page
    assert page.count("<img ") == len(captured.frames) - 2


def test_a_contact_sheet_of_few_pictures_says_so(captured):
    page = sheet(captured, pictures=4)
    assert page.count("<img ") == 4
    assert "of 4 are shown" in page


def test_the_shots_come_first_and_every_other_kind_of_frame_is_folded(captured, monkeypatch):
    monkeypatch.setattr("emmc_rig.report.session_sheet.FIRST_PICTURES", 1)
    page = sheet(captured)
    kinds = Counter(frame.kind for frame in captured.needed)
    assert [int(count) for count in re.findall(r"<summary>(\d+) more<", page)] == [
        kinds["shot"] - 1
    ]
    folded = re.findall(r'<details class="folded">.*?<span>(\d+) frames?,', page)
    assert sorted(map(int, folded)) == sorted(n for kind, n in kinds.items() if kind != "shot")
    assert (
        page.index('id="shot"') < page.index('<details class="folded">') < page.index('id="events"')
    )
    assert page.count("<img ") == len(captured.needed)


def test_the_report_of_a_reconstructed_session_has_its_verdict(captured):
    assert "Light field" not in sheet(captured)
    (captured.folder / "reconstruction").mkdir()
    reported = {"verdict": {"level": "doubt"}, "stated_db": 27.5}
    (captured.folder / "reconstruction/metrics.json").write_text(json.dumps(reported))
    page = sheet(captured)
    assert page.index("doubt") < page.index("estimated accuracy 27.5 dB") < page.index("<img ")


def test_a_page_shows_names_as_text(captured):
    captured.note(RetryEntry(id="<b>", fault="<script>alert(1)</script>", attempt=1))
    page = sheet(captured)
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


def test_a_terminal_shows_the_bar_and_the_saturation():
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120, height=30)
    display = CaptureDisplay(console, Control())
    rig = still_rig()
    session, plan = begun(ROOT, SimulatedDisk(), rig)
    with display.shown():
        Sequencer(session, plan, rig, display).run()
    text = out.getvalue()
    assert f"{len(session.frames)}/{len(session.frames)}" in text
    assert "saturated 0.00%" in text


def test_thinning_keeps_the_places_of_the_colours_and_the_figures():
    rows, columns = np.indices((400, 600))
    mosaic = (1000 * (rows % 2) + 100 * (columns % 2) + 5).astype(np.uint16)
    few = thinned(mosaic, 10_000)
    assert 5_000 < few.size < 40_000
    for i in (0, 1):
        for j in (0, 1):
            assert (few[i::2, j::2] == mosaic[i, j]).all()


def test_the_figures_of_a_frame_are_its_saturation_mean_and_brightest():
    drawn = np.random.default_rng(0).integers(256, 3800, (100, 120), dtype=np.uint16)
    frame = decode_raw(encode_dng(drawn, "rggb", 256, 4000, 0.01))
    dn = frame.mosaic.astype(float)
    found = figures(frame)
    assert found.mean_dn == pytest.approx(dn.mean() - 256)
    assert found.bright_dn == pytest.approx(np.percentile(dn, 99.9) - 256, abs=2)
    assert found.saturated == 0


def test_hot_pixels_are_no_light_that_a_frame_is_metered_by():
    rng = np.random.default_rng(0)
    drawn = rng.integers(300, 1400, (400, 600), dtype=np.uint16)
    hot = rng.random(drawn.shape) < 0.002
    plain, spotted = (
        figures(decode_raw(encode_dng(dn, "rggb", 256, 4000, 0.01)))
        for dn in (drawn, np.where(hot, np.uint16(4000), drawn))
    )
    assert spotted.bright_dn == pytest.approx(plain.bright_dn, rel=0.01)
    # What is left are hot pixels beside others: one in sixty of them.
    assert plain.saturated == 0
    assert spotted.saturated < 1e-4


@pytest.mark.parametrize(
    ("shots", "said"),
    [
        ([ShotExposure(0, 0.05, 0.0)], "shot 1 is 5.0% of white: 11.5 dB or more"),
        ([ShotExposure(0, 0.7, 0.0), ShotExposure(1, 0.01, 0.0)], "shot 2 is 1.0% of white"),
        ([ShotExposure(0, 1.0, 0.03)], "3.0% of the readings of shot 1 are saturated"),
        ([ShotExposure(0, 0.3, 0.0005)], ""),
    ],
)
def test_badly_exposed_shots_are_a_doubt(shots, said):
    reasons = exposure_reasons(shots)
    assert [reason.level for reason in reasons] == ["doubt"] * bool(said)
    assert all(said in reason.what for reason in reasons)
