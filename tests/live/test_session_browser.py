"""The report of a session in a real browser: complete, silent, readable on a narrow screen."""

import pytest
from capture_rigs import begun, still_rig

from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.model.files import SYSTEM_DISK
from emmc_rig.report.session_sheet import write_sheet
from emmc_rig.session.session import REPORT

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from browsers import MARKS, complaints
from selenium.webdriver.common.by import By

pytestmark = MARKS


def test_the_report_of_a_session_shows_everything_and_asks_for_nothing(browser, tmp_path):
    rig = still_rig()
    session, plan = begun(tmp_path, SYSTEM_DISK, rig)
    Sequencer(session, plan, rig).run()
    write_sheet(session, session.folder)
    browser.get((session.folder / REPORT).as_uri())
    pictures = browser.find_elements(By.CSS_SELECTOR, ".sheet img")
    assert len(pictures) == len(session.frames)
    assert all(int(picture.get_property("naturalWidth")) > 0 for picture in pictures)
    stored = browser.find_element(By.CSS_SELECTOR, ".card .value").text
    assert stored == f"{len(session.frames)} of {len(session.frames)}"
    assert complaints(browser) == []
    for width in (1280, 420):
        browser.set_window_size(width, 900)
        wide = browser.execute_script("return document.documentElement.scrollWidth")
        seen = browser.execute_script("return document.documentElement.clientWidth")
        assert wide <= seen
