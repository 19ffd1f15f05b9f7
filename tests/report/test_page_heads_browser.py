"""Pages fit their screens, from a desktop to a phone."""

import numpy as np
import pytest
from browsers import MARKS, complaints, fits, on_screen
from capture_rigs import begun, still_rig

from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.formats.format import Export
from emmc_rig.model.files import SYSTEM_DISK
from emmc_rig.report.page import Head, Section, framed
from emmc_rig.report.session_sheet import sheet
from emmc_rig.report.viewer import render_viewer

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.by import By

pytestmark = MARKS
WIDTHS_PX = 1600, 800, 390


@pytest.fixture(scope="module")
def light_field():
    return np.random.default_rng(0).random((3, 3, 24, 48, 3), dtype=np.float32)


def test_no_page_is_wider_than_its_screen_and_a_wide_one_has_no_gap_beside_the_viewer(
    browser, tmp_path, light_field
):
    commands = [f"`emmc-rig {'long/' * 30}`"]
    table = "<table><tr>" + "<td>a long word</td>" * 30 + "</tr></table>"
    pages = {
        "sections": framed(
            "A title", [], [], [Section("one", "One", table)], head=Head("trust", "", commands)
        ),
        **{
            f"viewer {width}": render_viewer(Export("a", "", light_field[:, :, :, :width]))
            for width in (14, 31, 48)
        },
    }
    for name, text in pages.items():
        path = tmp_path / f"{name}.html"
        path.write_text(text, encoding="utf-8")
        browser.get(path.as_uri())
        for width in WIDTHS_PX:
            with on_screen(browser, width):
                assert fits(browser), (name, width)
        if name != "sections":
            with on_screen(browser, 1600):
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


def test_the_sheet_of_a_session_of_150_frames_is_whole_silent_and_short_on_a_phone(
    browser, tmp_path
):
    rig = still_rig()
    text = MANY_FRAMES.format(shots="  - {exposure_s: 0.01, repeats: 40}")
    session, plan = begun(tmp_path, SYSTEM_DISK, rig, text)
    Sequencer(session, plan, rig).run()
    count = len(session.stored)
    assert count >= 150
    path = tmp_path / "sheet.html"
    path.write_text(sheet(session), encoding="utf-8")
    browser.get(path.as_uri())
    pictures = browser.find_elements(By.CSS_SELECTOR, ".sheet img")
    assert len(pictures) == count
    assert all(int(picture.get_property("naturalWidth")) > 0 for picture in pictures)
    stored = browser.find_element(By.CSS_SELECTOR, ".card .value").text
    assert stored == f"{count} of {count}"
    assert complaints(browser) == []
    for width in WIDTHS_PX:
        with on_screen(browser, width):
            assert fits(browser), width
            height = browser.execute_script("return document.documentElement.scrollHeight")
    assert height <= 3000
