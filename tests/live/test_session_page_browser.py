"""The page of a running capture in a browser: it follows, steers, and looks right at every size."""

import threading
from contextlib import contextmanager
from queue import Queue

import pytest
import yaml
from asked_person import manned
from browsers import MARKS, complaints, fits, on_screen, wait

import emmc_rig as emmc
from emmc_rig.captures.control import Control
from emmc_rig.captures.run import FrontEnd, capture_session
from emmc_rig.live.server import application, served
from emmc_rig.live.session_page import SessionPage
from emmc_rig.progress import Event
from emmc_rig.session.session import Session

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = MARKS
PLAN = {
    "title": "one shot at the bench",
    "camera": "rgbw-bayer-1shot",
    "shots": [{"exposure_s": "auto"}],
    "whiteboards": {"repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}
PATIENCE_S = 60


@contextmanager
def shown(browser, page):
    """Show a page in the browser; yield a function from a CSS selector to the element."""
    with served(application(page, "secret")) as port:
        browser.get(f"http://127.0.0.1:{port}/secret/")
        yield lambda css: browser.find_element(By.CSS_SELECTOR, css)
        assert complaints(browser) == []


@pytest.mark.slow
def test_a_capture_is_followed_paused_repeated_and_finished_in_the_browser(browser, tmp_path):
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
    with shown(browser, page) as element:
        page.start()
        run.start()
        wait(browser, lambda: "all frames are taken" in element("#waiting").text)
        assert element("#title").text == PLAN["title"]
        tiles = browser.find_elements(By.CSS_SELECTOR, ".tile")
        assert len(tiles) == len(Session(folder).stored)
        assert "% of white" in tiles[0].text
        assert not element("#field-stage").is_displayed()  # over a raw frame it would be misread
        wait(browser, lambda: element("[data-show=views]").is_displayed())
        element("[data-show=views]").click()
        wait(browser, lambda: "adaptive-fast: " in element("#field-stage").text)
        wait(browser, lambda: element("#viewer").get_attribute("data-complete"))
        assert element("#viewer-overlays").text.split("\n")[1:3] == ["nothing", "disparity"]
        tiles[0].click()
        assert element("#chosen").text == "1 chosen"
        element("#retake").click()
        wait(browser, lambda: "taken once more: shot-0-e0-r0" in element("#messages").text)
        wait(browser, lambda: "all frames are taken" in element("#waiting").text)
        for width in (1600, 800, 390):
            with on_screen(browser, width):
                assert fits(browser), width
        element("#finish").click()
        run.join(PATIENCE_S)
        page.close()
        wait(browser, lambda: "Complete: every frame verified" in element("#end").text)
        assert not element("#finish").is_displayed()


PHONE = 390, 844


class Asking(SessionPage):
    """A page whose wishes wait in a queue; None where all frames are taken."""

    def __init__(self, folder):
        self.control, self.wishes = Control(stays=True), Queue()
        super().__init__(folder, self.control, computes=False)

    def ask(self, what):
        asks = {"asked": what}
        self.event(Event("pause", {"reason": what}, asks))
        self.wishes.put(self.state.snapshot()["asked"])
        self.control.until_answered()
        self.event(Event("resume", {"seconds": 0.0}, asks))

    def event(self, event):
        super().event(event)
        if event.name == "pause" and not event.objects:
            self.wishes.put(None)


@pytest.mark.slow
def test_a_person_with_a_phone_sees_the_hole_and_answers_with_finger_or_foot(
    browser, tmp_path, monkeypatch
):
    plan, rig = manned(tmp_path, monkeypatch, {(1, 1): (1, 2)})
    page = Asking(tmp_path / "plan-session")
    front = FrontEnd(page, page.ask, control=page.control)
    run = threading.Thread(target=lambda: capture_session(plan, rig, None, None, front))
    with on_screen(browser, *PHONE), shown(browser, page) as element:
        page.start()
        run.start()

        def answer(asked):
            wait(browser, lambda: element("#ask-text").text.lower() == asked["text"].lower())
            wait(browser, lambda: element("#done").is_enabled())
            top, bottom, height = browser.execute_script(
                "const box = document.getElementById('done').getBoundingClientRect();"
                "return [box.top, box.bottom, innerHeight]"
            )
            assert 0 < top < bottom < height
            assert element("#ask-refusal").text == asked["refusal"]
            if asked["hole"]:
                holes.append(
                    (
                        element("#plate text.wanted").text,
                        element("#plate").get_attribute("aria-label"),
                    )
                )
            if asked["number"] % 3 == 0:
                element("#done").click()
            else:
                element("body").send_keys(Keys.SPACE if asked["number"] % 3 == 1 else Keys.ENTER)

        holes = []
        while asked := page.wishes.get(timeout=PATIENCE_S):
            answer(asked)
        plate = "plate of 5 by 5 holes: "
        assert holes == [
            ("1", plate + "1 is wanted"),
            ("7", plate + "7 is wanted, 1 was the last"),
            ("7", plate + "7 is wanted, 8 was the last"),
        ]
        wait(browser, lambda: not element("#done").is_displayed())
        element("#finish").click()
        run.join(PATIENCE_S)
        page.close()
        wait(browser, lambda: "Complete: every frame verified" in element("#end").text)


def test_a_hundred_and_fifty_frames_are_a_short_page_on_a_phone(browser, tmp_path):
    page = SessionPage(tmp_path / "session", Control(), computes=False)
    kinds = {"dark": 20, "reference": 4, "whiteboard": 110, "open": 13, "shot": 3}
    names = [(kind, n) for kind, count in kinds.items() for n in range(count)]
    page._frames = {
        f"{kind}-{n}": {
            "id": f"{kind}-{n}", "kind": kind, "shot": 0, "exposure_s": 0.1, "level": 0.7,
            "saturated": 0.2 if (kind, n) == ("open", 3) else 0.0, "number": 0, "stored": True,
        }
        for kind, n in names
    }  # fmt: skip
    page._small = dict.fromkeys(page._frames, b"")
    page._publish_frames(planned=len(names))
    with on_screen(browser, *PHONE), shown(browser, page):
        tiles = "return document.querySelectorAll('.tile').length"
        wait(browser, lambda: browser.execute_script(tiles) == 150)
        groups = browser.find_elements(By.CSS_SELECTOR, "#frames details")
        assert [group.get_attribute("open") is not None for group in groups] == [True] + 4 * [False]
        assert groups[0].text.startswith("Shots: the scene")
        assert "13, 70 % of white, 1 saturated" in groups[1].text
        tall = "return document.documentElement.scrollHeight"
        assert browser.execute_script(tall) <= 2000
        groups[2].find_element(By.TAG_NAME, "summary").click()
        assert browser.execute_script(tall) <= 3000
        more = groups[2].find_element(By.XPATH, "./button")
        assert more.text == "all 110"
        tile = "[...document.querySelectorAll('.tile')]"
        seen = f"return {tile}.filter((tile) => tile.checkVisibility()).length"
        assert browser.execute_script(seen) == 3 + 24
        more.click()
        assert browser.execute_script(seen) == 3 + 110
