"""A person who knows nothing but the README: `emmc-rig live --rig simulated`, click by click.

With EMMC_PICTURES=FOLDER the pages are written there as pictures: docs/ shows them.
"""

import os
import re
import signal
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from browsers import MARKS, complaints, drawn, on_screen, wait
from programs import PROGRAM

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.by import By

pytestmark = MARKS
PATIENCE_S = 60
WIDTHS = {"desktop": 1600, "phone": 390}


def pictured(driver, name):
    """Write pictures of a page where the documentation wants them."""
    folder = os.environ.get("EMMC_PICTURES")
    for size, width in WIDTHS.items() if folder else ():
        driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": size == "phone"})
        with on_screen(driver, width):
            driver.execute_script("scrollTo(0, 0)")
            drawn(driver)
            seen = cv2.imdecode(np.frombuffer(driver.get_screenshot_as_png(), np.uint8), 1)
        assert seen is not None
        file = Path(str(folder)) / f"{name}-{size}.webp"
        assert cv2.imwrite(str(file), seen, [cv2.IMWRITE_WEBP_QUALITY, 60])
    driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


@pytest.mark.slow
def test_from_the_readmes_command_to_a_saved_plan_and_a_light_field(browser, tmp_path):
    plan = tmp_path / "plan.yaml"
    made = subprocess.run(
        [*PROGRAM, "capture", "--new", "rgbw-bayer-1shot"], cwd=tmp_path, check=True
    )
    assert made.returncode == 0
    before = plan.read_text()
    command = [*PROGRAM, "live", "--rig", "simulated", "--plan", "plan.yaml"]
    environment = {**os.environ, "EMMC_SIZE": "48x64"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
    ) as running:
        try:
            assert running.stdout is not None
            browser.get(running.stdout.readline().strip())

            def text(css):
                return browser.find_element(By.CSS_SELECTOR, css).text

            def click(css):
                def clicked():
                    element = browser.find_element(By.CSS_SELECTOR, css)
                    able = element.is_enabled()
                    if able:
                        element.click()
                    return able

                wait(browser, clicked)

            def done(step):
                found = browser.find_element(By.CSS_SELECTOR, f"#steps li:nth-child({step})")
                return "done" in (found.get_attribute("class") or "")

            # The page is dark, and says what to do about it; so do its steps.
            wait(browser, lambda: "away from the centre" in text("#hint"))
            assert "centre the mask first" in text("#steps li:nth-child(2)")
            click("#steps li:nth-child(1) button")
            wait(browser, lambda: done(1))
            click("#steps li:nth-child(3) button")
            click("#steps li:nth-child(2) button")
            wait(browser, lambda: done(2))
            wait(browser, lambda: done(3))
            assert re.search(r"rotation -?\d\.\d\d . \d\.\d\d", text("#steps li:nth-child(3)"))
            pictured(browser, "live")
            click("#targets button:nth-child(1)")
            assert "by hand" in text("#steps li:nth-child(4)")
            click("#steps li:nth-child(2) button") if not done(2) else None
            wait(browser, lambda: done(2))
            click("#steps li:nth-child(5) button")
            wait(browser, lambda: "+  - exposure_s: " in text("#diff"))
            click("#save")
            wait(browser, lambda: "wrote plan.yaml" in text("#saved"))
            assert text("#saved").endswith("next: emmc-rig capture plan.yaml --rig simulated")
            assert not browser.find_element(By.ID, "diff").is_displayed()
            click("[data-show=views]")

            def has_verdict():
                now = text("#field-stage")  # once: the next frame clears it
                return "as by reconstruct" in now and re.search("trust|doubt|do not use", now)

            wait(browser, has_verdict)
            wait(
                browser,
                lambda: browser.find_element(By.ID, "viewer").get_attribute("data-complete"),
            )
            pictured(browser, "light-field")
            assert complaints(browser) == []
        finally:
            running.send_signal(signal.SIGINT)
            # Before its output is closed, to which it writes a last line.
            ended = running.wait(PATIENCE_S)
    assert ended == 0
    found = yaml.safe_load(plan.read_text())["shots"][0]["exposure_s"]
    assert 1e-4 < found < 10
    assert plan.read_text() == before.replace("  - exposure_s: auto", f"  - exposure_s: {found}")
