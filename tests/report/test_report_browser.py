import cv2
import numpy as np
import pytest
from browsers import MARKS, complaints, drawn, fits, on_screen, wait

from emmc_rig.report.report import ReportContent, write_report

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.by import By

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
    complete = "return document.getElementById('viewer').dataset.complete"
    wait(browser, lambda: browser.execute_script(complete))
    yield browser
    assert complaints(browser) == []


def test_the_page_asks_the_network_for_nothing_and_names_every_picture_and_slider(page, report):
    asked = page.execute_script(
        "return performance.getEntriesByType('resource').map(entry => entry.name)"
    )
    assert [name for name in asked if not name.startswith("data:")] == []
    assert page.current_url == report.as_uri()
    unnamed = page.execute_script(
        "return [...document.querySelectorAll('img, canvas, svg, input')].filter("
        "e => !e.ariaHidden && !e.getAttribute('alt') && !e.getAttribute('aria-label')"
        "&& !e.labels?.length).map(e => e.outerHTML)"
    )
    assert unnamed == []


def test_the_folded_report_is_short_fits_and_shows_the_picture_at_once(page):
    for width in (1600, 900, 390):
        with on_screen(page, width):
            assert fits(page), width
            height, top = page.execute_script(
                "return [document.documentElement.scrollHeight,"
                "document.getElementById('viewer-picture').getBoundingClientRect().top + scrollY]"
            )
        assert height <= 4000
        assert top < 700


@pytest.mark.parametrize("size", [(1600, 900), (390, 844)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_first_screen_shows_the_coded_frame_beside_the_light_field(page, size, scheme):
    with on_screen(page, size[0], size[1], scheme):
        page.execute_script("scrollTo(0, 0)")
        frame, middle = page.find_elements(By.CSS_SELECTOR, ".viewer-coded img")
        picture = page.find_element(By.ID, "viewer-picture").rect
        for seen in (frame.rect, middle.rect):
            assert seen["height"] > 90
            assert seen["y"] + seen["height"] <= size[1]
        assert picture["y"] < size[1] - 100
        assert picture["width"] > frame.rect["width"]
    assert "2 coded frames in, 5x5 views out." in page.find_element(By.ID, "viewer-section").text


def test_a_link_to_a_folded_part_opens_it(page, report):
    page.get(report.as_uri() + "#figures")
    drawn(page)
    assert page.find_element(By.ID, "figures").is_displayed()
