import cv2
import numpy as np
import pytest
from browsers import MARKS, complaints

from emmc_rig.report.report import ReportContent, write_report

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

pytestmark = MARKS

VIEWS, HEIGHT, WIDTH, DISPARITY_PX = 5, 48, 64, 1


def content() -> ReportContent:
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH, 3)), (0, 0), 1)
    texture = np.clip(0.5 + 2 * (texture - 0.5), 0, 1)
    truth = np.empty((VIEWS, VIEWS, HEIGHT, WIDTH, 3), np.float32)
    for v, u in np.ndindex(VIEWS, VIEWS):
        truth[v, u] = np.roll(texture, np.subtract((v, u), 2) * DISPARITY_PX, axis=(0, 1))
    psi = rng.random((VIEWS, VIEWS, HEIGHT, WIDTH)).astype(np.float32) / 25
    return ReportContent(
        title="Browser test",
        estimate=np.clip(truth + rng.normal(0, 0.03, truth.shape), 0, 1).astype(np.float32),
        truth=truth,
        frames=rng.random((2, HEIGHT, WIDTH)).astype(np.float32),
        whiteboards=[("View v 0, u 0", psi[0, 0])],
        metrics={"psnr_db": 30.0},
        stage_s={"reconstruction": 1.0},
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, content())
    return path


@pytest.fixture
def page(browser, report):
    browser.get(report.as_uri())
    WebDriverWait(browser, 15).until(
        lambda driver: driver.execute_script(
            "return document.getElementById('viewer').dataset.complete"
        )
    )
    settled(browser)
    yield browser
    assert complaints(browser) == []


def settled(page) -> None:
    """Wait until the drawing that an event asked for has been done."""
    page.execute_async_script(
        "const done = arguments[0];"
        "requestAnimationFrame(() => requestAnimationFrame(() => done()));"
    )


def test_the_page_asks_the_network_for_nothing(page, report):
    asked = page.execute_script(
        "return performance.getEntriesByType('resource').map(entry => entry.name)"
    )
    assert [name for name in asked if not name.startswith("data:")] == []
    assert page.current_url == report.as_uri()


def test_the_true_light_field_can_be_wiped_against_the_estimate(page):
    def picture() -> str:
        return page.execute_script(
            "document.getElementById('viewer').show({});"
            "return document.getElementById('viewer-picture').toDataURL()"
        )

    before = picture()
    page.execute_script("document.getElementById('viewer').show({wipe: 1})")
    assert picture() != before
    assert page.find_element(By.ID, "viewer-side-left").is_displayed()


def test_every_picture_says_what_it_is_and_every_slider_has_a_label(page):
    unnamed = page.execute_script(
        "return [...document.querySelectorAll('img, canvas, svg')].filter("
        "e => !e.ariaHidden && !e.getAttribute('alt') && !e.getAttribute('aria-label'))"
        ".map(e => e.outerHTML)"
    )
    unlabelled = page.execute_script(
        "return [...document.querySelectorAll('input')].filter(e => !e.labels.length).length"
    )
    assert unnamed == []
    assert unlabelled == 0


@pytest.mark.parametrize("width", [400, 900, 1600])
def test_nothing_sticks_out_sideways(page, width):
    page.set_window_size(width, 900)
    settled(page)
    assert page.execute_script(
        "return document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    )


@pytest.mark.parametrize(("width", "most_px"), [(1600, 4000), (390, 4000)])
def test_the_folded_report_is_short_and_shows_the_picture_at_once(page, width, most_px):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    settled(page)
    height, top = page.execute_script(
        "return [document.documentElement.scrollHeight,"
        "document.getElementById('viewer-picture').getBoundingClientRect().top + scrollY]"
    )
    page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert height <= most_px
    assert top < 700


def test_a_link_to_a_folded_part_opens_it(page, report):
    page.get(report.as_uri() + "#figures")
    settled(page)
    assert page.find_element(By.ID, "figures").is_displayed()
