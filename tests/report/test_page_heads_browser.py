"""Pages fit their screens, from a desktop to a phone."""

import numpy as np
import pytest
from browsers import MARKS
from capture_rigs import begun, still_rig

from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.formats.format import Export
from emmc_rig.model.files import SYSTEM_DISK
from emmc_rig.report.page import Head, Section, framed
from emmc_rig.report.session_sheet import sheet
from emmc_rig.report.viewer import render_viewer

pytestmark = MARKS
WIDTHS_PX = 1600, 800, 390


@pytest.fixture(scope="module")
def light_field():
    return np.random.default_rng(0).random((3, 3, 24, 32, 3), dtype=np.float32)


def of_width(browser, path, width):
    """Open a page as on a screen of this width."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(path.as_uri())


@pytest.mark.parametrize("width", WIDTHS_PX)
def test_no_page_is_wider_than_its_screen(browser, tmp_path, light_field, width):
    commands = [f"`emmc-rig {'long/' * 30}`"]
    table = "<table><tr>" + "<td>a long word</td>" * 30 + "</tr></table>"
    pages = {
        "sections": framed(
            "A title", [], [], [Section("one", "One", table)], head=Head("trust", "", commands)
        ),
        "viewer": render_viewer(Export("a", "", light_field)),
    }
    for name, text in pages.items():
        (tmp_path / f"{name}.html").write_text(text, encoding="utf-8")
        of_width(browser, tmp_path / f"{name}.html", width)
        assert browser.execute_script("return document.body.scrollWidth") <= width, name


@pytest.mark.parametrize("aspect", [0.6, 1.3, 2.0])
def test_a_wide_screen_leaves_no_gap_beside_the_viewers_picture(
    browser, tmp_path, light_field, aspect
):
    shaped = light_field[:, :, :, : max(int(24 * aspect), 8)]
    path = tmp_path / "viewer.html"
    path.write_text(render_viewer(Export("a", "", shaped)), encoding="utf-8")
    of_width(browser, path, 1600)
    gap = browser.execute_script(
        "const side = (id) => document.querySelector(id).getBoundingClientRect();"
        "return side('.viewer-panel').left - side('.viewer-stage').right"
    )
    assert 0 <= gap <= 20


MANY_FRAMES = """
title: many frames
camera: rgbw-bayer-1shot
shots:
{shots}
whiteboards: {{repeats: 4, references: 4}}
darks: {{repeats: 8}}
"""


def test_the_sheet_of_a_session_of_150_frames_is_short_on_a_phone(browser, tmp_path):
    rig = still_rig()
    text = MANY_FRAMES.format(shots="  - {exposure_s: 0.01, repeats: 40}")
    session, plan = begun(tmp_path, SYSTEM_DISK, rig, text)
    Sequencer(session, plan, rig).run()
    assert len(session.stored) >= 150
    path = tmp_path / "sheet.html"
    path.write_text(sheet(session), encoding="utf-8")
    of_width(browser, path, 390)
    assert browser.execute_script("return document.documentElement.scrollHeight") <= 3000
