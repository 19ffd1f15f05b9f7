"""The page of a running capture in a browser: it follows, steers, and looks right at every size."""

import threading

import pytest
import yaml
from browsers import MARKS, complaints, open_browser

import emmc_rig as emmc
from emmc_rig.acquisition.command import FrontEnd, capture_session
from emmc_rig.acquisition.control import Control
from emmc_rig.live.server import application, served
from emmc_rig.live.session_page import SessionPage
from emmc_rig.session.session import Session

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

pytestmark = MARKS
PLAN = {
    "title": "one shot at the bench",
    "camera": "rgbw-bayer-1shot",
    "shots": [{"exposure_s": "auto"}],
    "whiteboards": {"repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}
PATIENCE_S = 60


@pytest.mark.slow
def test_a_capture_is_followed_paused_repeated_and_finished_in_the_browser(tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_text(yaml.safe_dump(PLAN))
    rig = emmc.rig("simulated", scene="near-planar", size=(32, 40), rays=16)
    folder, control = tmp_path / "plan-session", Control(stays=True)
    page = SessionPage(folder, control)
    run = threading.Thread(
        target=lambda: capture_session(
            plan, rig.description, None, None, FrontEnd(page, print, control=control)
        ),
        daemon=True,
    )
    with (
        served(application(page, "secret")) as port,
        open_browser(tmp_path / "profile") as driver,
    ):
        driver.get(f"http://127.0.0.1:{port}/secret/")
        patient = WebDriverWait(
            driver, PATIENCE_S, ignored_exceptions=[StaleElementReferenceException]
        )

        def one(css):
            return driver.find_element(By.CSS_SELECTOR, css)

        def wait(holds):
            patient.until(lambda _: holds())

        page.start()
        run.start()
        wait(lambda: "all frames are taken" in one("#waiting").text)
        assert one("#title").text == PLAN["title"]
        tiles = driver.find_elements(By.CSS_SELECTOR, ".tile")
        assert len(tiles) == len(Session(folder).stored)
        assert "% of white" in tiles[0].text
        wait(lambda: "adaptive-fast: " in one("#field-stage").text)
        one("[data-show=views]").click()
        wait(lambda: one("#viewer").get_attribute("data-complete"))
        assert one("#viewer-overlays").text.split("\n")[1:3] == ["nothing", "disparity"]
        tiles[0].click()
        assert one("#chosen").text == "1 chosen"
        one("#retake").click()
        wait(lambda: "taken once more: shot-0-e0-r0" in one("#messages").text)
        wait(lambda: "all frames are taken" in one("#waiting").text)
        for width in (1600, 800, 390):
            driver.execute_cdp_cmd(
                "Emulation.setDeviceMetricsOverride",
                {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500},
            )
            needed, there = driver.execute_script(
                "return [document.documentElement.scrollWidth, window.innerWidth]"
            )
            assert needed <= there
        one("#finish").click()
        run.join(PATIENCE_S)
        page.close()
        wait(lambda: "Complete: every frame verified" in one("#end").text)
        assert not one("#finish").is_displayed()
        assert complaints(driver) == []
