"""A headless Chromium for tests of pages: extra `browser`, and chromium with its driver on PATH."""

import shutil
from contextlib import contextmanager

import pytest

webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium: extra `browser`")
exceptions = pytest.importorskip("selenium.common.exceptions")
waiting = pytest.importorskip("selenium.webdriver.support.ui")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
CHROMEDRIVER = shutil.which("chromedriver")
MARKS = [
    pytest.mark.browser,
    pytest.mark.timing("Chromium draws and answers late beside other work; the tests wait for it"),
    pytest.mark.skipif(
        CHROMIUM is None or CHROMEDRIVER is None, reason="needs chromium and chromedriver on PATH"
    ),
]
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,900",
)


HARMLESS = ("software WebGL", "GPU stall due to ReadPixels", "WebGL contexts")
"""What Chromium says of drawing without a graphics card, and of a test reading pictures back."""


def complaints(driver):
    """Return what the browser's console complained of since it was last asked."""
    reported = [entry["message"] for entry in driver.get_log("browser")]
    return [message for message in reported if not any(words in message for words in HARMLESS)]


def wait(driver, holds, patience_s=60):
    """Wait until that holds; what is drawn anew in between is looked up again."""
    ignored = [exceptions.StaleElementReferenceException]
    patient = waiting.WebDriverWait(driver, patience_s, 0.1, ignored)
    patient.until(lambda _: holds())


def drawn(driver):
    """Wait for two frames of the browser: the page is laid out and painted anew."""
    driver.execute_async_script(
        "const end = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(end))"
    )


@contextmanager
def on_screen(driver, width, height=900, scheme="light"):
    """Show the page on a screen of so many pixels, below 500 px a phone's."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    seen = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", seen)
    drawn(driver)
    try:
        yield
    finally:
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def fits(driver):
    """Return whether the page is no wider than its screen."""
    return driver.execute_script("return document.documentElement.scrollWidth <= innerWidth")


def nameless(driver):
    """Return the controls of the viewer that have no name for screen readers."""
    return driver.execute_script(
        "return [...document.querySelectorAll('#viewer input, #viewer button, #viewer canvas')]"
        ".filter((e) => !(e.ariaLabel || e.textContent.trim() || e.labels?.length))"
        ".map((e) => e.id)"
    )


@contextmanager
def open_browser(profile):
    """Yield a driver of a browser whose profile lies in that folder."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM or ""
    for option in (*OPTIONS, f"--user-data-dir={profile}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(CHROMEDRIVER))
    try:
        yield driver
    finally:
        driver.quit()
