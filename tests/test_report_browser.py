import cv2
import numpy as np
import pytest
from browsers import MARKS, complaints, open_browser

from emmc_rig.pages.display import DisplayCurve
from emmc_rig.pages.report import ReportContent, write_report

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
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
        scene="plane",
        camera="bayer",
        camera_line="a plane of known disparity",
        camera_reference="",
        estimate=np.clip(truth + rng.normal(0, 0.03, truth.shape), 0, 1).astype(np.float32),
        truth=truth,
        frames=rng.random((2, HEIGHT, WIDTH)).astype(np.float32),
        cfa="rggb",
        cfa_tile=np.eye(3, dtype=np.float32)[[[0, 1], [1, 2]]],
        whiteboards=[("View v 0, u 0", psi[0, 0])],
        psi=psi,
        metrics={"psnr_db": 30.0},
        objective=[3.0, 2.0, 1.0],
        stage_s={"reconstruction": 1.0},
        disparity_range_px=(-2.0, 2.0),
    )


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with open_browser(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, content())
    return path


@pytest.fixture
def page(browser, report):
    browser.get(report.as_uri())
    WebDriverWait(browser, 15).until(
        lambda driver: driver.execute_script("return document.documentElement.dataset.ready")
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


def pixels(page, canvas: str) -> np.ndarray:
    values = page.execute_script(
        "const c = document.getElementById(arguments[0]), copy = document.createElement('canvas');"
        "copy.width = c.width; copy.height = c.height;"
        "const context = copy.getContext('2d', {willReadFrequently: true});"
        "context.drawImage(c, 0, 0);"
        "return Array.from(context.getImageData(0, 0, c.width, c.height).data)",
        canvas,
    )
    return np.array(values, dtype=float).reshape(-1, 4)[:, :3]


def move_over(page, canvas: str, across: float, down: float) -> None:
    element = page.find_element(By.ID, canvas)
    page.execute_script(
        "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", element
    )
    offset = (round((across - 0.5) * element.size["width"]), round((down - 0.5) * 400))
    ActionChains(page).move_to_element_with_offset(element, *offset).perform()
    settled(page)


def set_slider(page, slider: str, value: float) -> None:
    page.execute_script(
        "const s = document.getElementById(arguments[0]); s.value = arguments[1];"
        "s.dispatchEvent(new Event('input'))",
        slider,
        value,
    )
    settled(page)


def test_the_page_asks_the_network_for_nothing(page, report):
    asked = page.execute_script(
        "return performance.getEntriesByType('resource').map(entry => entry.name)"
    )
    assert [name for name in asked if not name.startswith("data:")] == []
    assert page.current_url == report.as_uri()


def test_moving_the_mouse_changes_the_view_on_both_sides(page):
    truth, estimate = pixels(page, "view-truth"), pixels(page, "view-estimate")
    assert page.find_element(By.ID, "view-index").text == "view v 2, u 2"
    move_over(page, "view-estimate", 0.05, 0.5)
    assert page.find_element(By.ID, "view-index").text == "view v 2, u 0"
    assert np.abs(pixels(page, "view-estimate") - estimate).mean() > 5
    assert np.abs(pixels(page, "view-truth") - truth).mean() > 5
    move_over(page, "view-truth", 0.95, 0.5)
    assert page.find_element(By.ID, "view-index").text == "view v 2, u 4"


def test_arrow_keys_change_the_view(page):
    page.find_element(By.ID, "view-estimate").send_keys(Keys.ARROW_UP, Keys.ARROW_RIGHT)
    settled(page)
    assert page.find_element(By.ID, "view-index").text == "view v 1, u 3"


@pytest.mark.parametrize("canvas", ["refocus-truth", "refocus-estimate"])
def test_a_plane_is_sharpest_at_its_own_disparity(page, canvas):
    contrast = {}
    for disparity in (-1, 0, DISPARITY_PX, 2):
        set_slider(page, "refocus-slider", disparity)
        contrast[disparity] = pixels(page, canvas).std()
    assert max(contrast, key=lambda disparity: contrast[disparity]) == DISPARITY_PX
    assert contrast[DISPARITY_PX] > 1.5 * contrast[0]


def test_a_refocused_plane_is_the_centre_view(page):
    set_slider(page, "refocus-slider", DISPARITY_PX)
    refocused = pixels(page, "refocus-truth").reshape(HEIGHT, WIDTH, 3)
    truth = content().truth
    assert truth is not None
    centre = DisplayCurve.fitted_to(truth).encode(truth[2, 2]).astype(float)
    inside = np.s_[3:-3, 3:-3]  # views are rolled round at the borders
    assert np.abs(refocused - centre)[inside].mean() < 3


def test_the_epipolar_lines_follow_their_sliders(page):
    before = pixels(page, "epi-h-truth"), pixels(page, "epi-v-estimate")
    set_slider(page, "line-y", 5)
    set_slider(page, "line-x", 60)
    assert not np.array_equal(pixels(page, "epi-h-truth"), before[0])
    assert not np.array_equal(pixels(page, "epi-v-estimate"), before[1])
    assert "at y 5" in page.find_element(By.ID, "epi-horizontal-name").text


def test_the_error_map_follows_the_selected_view(page):
    mean = pixels(page, "error-map")
    page.execute_script("document.querySelector('input[value=view]').click()")
    page.execute_script('document.querySelector(\'button[data-v="0"][data-u="4"]\').click()')
    settled(page)
    assert page.find_element(By.ID, "error-caption").text == "View v 0, u 4"
    assert not np.array_equal(pixels(page, "error-map"), mean)


def test_shots_can_be_switched_and_tinted(page):
    def frame() -> str:
        return page.execute_script("return document.querySelector('#shots canvas').toDataURL()")

    first = frame()
    page.execute_script("document.querySelectorAll('#shots button')[1].click()")
    second = frame()
    page.execute_script("document.querySelector('#shots input').click()")
    assert len({first, second, frame()}) == 3


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


@pytest.mark.parametrize("width", [900, 1600])
def test_nothing_sticks_out_sideways(page, width):
    page.set_window_size(width, 900)
    settled(page)
    assert page.execute_script(
        "return document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    )
