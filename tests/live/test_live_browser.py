"""The set-up page in a browser: it follows the camera, jogs the stage, and says what goes wrong."""

import re
from contextlib import contextmanager

import pytest
from browsers import MARKS, complaints, fits, on_screen, wait
from test_live import FakeCamera, PatientCamera

from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.calibration.scale import designed_scale
from emmc_rig.captures.control import Control
from emmc_rig.drivers.errors import DriverError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.live.light_field import LiveLightField
from emmc_rig.live.server import application, served
from emmc_rig.live.session_page import SessionPage
from emmc_rig.live.watch import Watch
from emmc_rig.simulators.bench import MountingErrors

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = MARKS

TOKEN = "a-secret"
WANTS = "Saving needs `--plan PLAN` (exposure)."
WIDTH = "return document.getElementById('viewer-picture').width"


@pytest.fixture(scope="module")
def rig():
    camera, size = find_camera("rgbw-bayer-1shot"), (48, 64)
    fine = fine_scene("near-planar", 2, 2, size=size, views=camera.views)
    made, bench = simulated_rig(camera, fine.samples, size, 0)
    bench._errors = MountingErrors(rotation_deg=0.5, stretch=1.002)
    made.attendant.set_lamp("white")
    return made


@pytest.fixture(scope="module")
def address(rig):
    centre_um = {**rig.zero_um, "aperture_x": rig.zero_um["aperture_x"] + rig.window_um}
    design = find_camera("rgbw-bayer-1shot")
    field = LiveLightField(designed_scale(design.psi((48, 64))), "tv")
    targets = ("scene", "whiteboard")
    watch = Watch(
        rig.camera, rig.stage, rig.attendant.place, targets, centre_um, design, field, wants=WANTS
    )
    watch.start()
    with served(application(watch, TOKEN)) as port:
        yield f"http://127.0.0.1:{port}/{TOKEN}/"
    watch.close()


@pytest.fixture
def page(browser, address):
    browser.get_log("browser")
    browser.get(address)
    wait(browser, lambda: frame_number(browser) > 0)
    return browser


def text(driver, name):
    return driver.find_element(By.ID, name).text


def frame_number(driver):
    found = re.search(r"\d+", text(driver, "frame"))
    return int(found.group()) if found else 0


def click(driver, css):
    def clicked():
        driver.find_element(By.CSS_SELECTOR, css).click()
        return True

    wait(driver, clicked)


def place_um(driver, axis):
    found = re.search(
        r"-?[\d.]+(?= \u00b5m)", driver.find_element(By.CSS_SELECTOR, f"tr[data-axis={axis}]").text
    )
    return float(found.group()) if found else float("nan")


def test_the_page_opens_and_its_frame_updates_without_a_complaint(page):
    before = frame_number(page)
    wait(page, lambda: frame_number(page) > before)
    picture = page.find_element(By.ID, "picture")
    wait(page, lambda: int(picture.get_attribute("naturalWidth")) > 0)
    shown = int(picture.get_attribute("data-frame"))
    wait(page, lambda: int(picture.get_attribute("data-frame")) > shown)
    assert "48x64 rggb" in text(page, "camera")
    assert page.get_log("browser") == []


@pytest.mark.slow
def test_from_a_dark_page_to_a_light_field_by_what_the_page_offers(page, rig):
    """Click by click: centre, expose, read the mask off a board, look at the scene's views."""
    wait(page, lambda: "away from the centre" in text(page, "hint"))
    assert text(page, "hint-do") == "centre the mask"
    click(page, "#hint-do")
    wait(page, lambda: place_um(page, "mask_x") == pytest.approx(rig.zero_um["mask_x"], abs=0.5))
    click(page, "#targets button:nth-child(2)")
    wait(page, lambda: text(page, "hint-do") == "expose automatically")
    click(page, "#hint-do")
    wait(page, lambda: text(page, "hint") == "")
    wait(page, lambda: "\u00b0" in text(page, "rotation"))
    shown = [float(figure) for figure in re.findall(r"-?[\d.]+", text(page, "rotation"))]
    assert shown[0] == pytest.approx(-0.5, abs=0.1)
    stretched = float(re.findall(r"-?[\d.]+", text(page, "scale"))[0])
    assert stretched == pytest.approx(0.2, abs=0.1)
    click(page, "#targets button:nth-child(1)")
    click(page, "[data-show=views]")
    field = page.find_element(By.ID, "viewer")
    wait(page, lambda: int(field.get_attribute("data-number") or 0) > 0)
    turned = page.find_element(By.ID, "viewer-picture")
    ActionChains(page).drag_and_drop_by_offset(turned, -60, 0).perform()
    turned.send_keys("+", "+")
    looked = text(page, "viewer-status").split(";")[0]
    assert looked != "View v 2.00, u 2.00"
    wait(page, lambda: "as by reconstruct" in text(page, "field-stage"))
    assert re.search("trust|cannot tell|doubt|do not use", text(page, "field-stage"))
    # The reconstruction takes the preview's place, seen from where the hand had turned it.
    wait(page, lambda: page.execute_script(WIDTH) == 64)
    assert text(page, "viewer-status").split(";")[0] == looked
    assert text(page, "viewer-aperture-value") == "0.50"
    assert field.get_attribute("data-renderer") == "WebGL2"
    click(page, "#viewer-overlays label:nth-of-type(2) input")
    assert "unexplained residual" in text(page, "viewer-overlays")
    wait(page, lambda: page.find_element(By.ID, "viewer-legend").is_displayed())
    assert complaints(page) == []


def test_keys_stop_jog_and_expose_and_a_button_keeps_the_focus(page, rig):
    click(page, "#centre")
    wait(page, lambda: text(page, "busy") == "")
    wait(page, lambda: place_um(page, "mask_x") > 0)
    start = place_um(page, "mask_x")
    page.find_element(By.ID, "home").send_keys(Keys.ARROW_RIGHT)
    wait(page, lambda: place_um(page, "mask_x") == pytest.approx(start + 10, abs=0.5))
    wait(page, lambda: text(page, "busy") == "")
    assert page.switch_to.active_element.get_attribute("id") == "home"
    body = page.find_element(By.TAG_NAME, "body")
    page.execute_script("document.activeElement.blur()")
    body.send_keys(Keys.ARROW_RIGHT)
    exposure_s = rig.camera.exposure_s
    body.send_keys("]")
    wait(page, lambda: rig.camera.exposure_s == pytest.approx(exposure_s * 2 ** (1 / 3), rel=0.01))
    assert place_um(page, "mask_x") == pytest.approx(start + 10, abs=0.5)
    stops = []
    original, rig.stage.stop = rig.stage.stop, lambda *_: stops.append(1)
    try:
        body.send_keys(Keys.ESCAPE)
        wait(page, lambda: stops)
    finally:
        rig.stage.stop = original


NAMELESS = """
return [...document.querySelectorAll("button, input, canvas, [tabindex]")].filter((control) =>
  control.offsetParent && !(control.textContent.trim() || control.getAttribute("aria-label") ||
    control.labels?.length)).map((control) => control.outerHTML)
"""
TOO_LOW_FOR_A_FINGER = """
return [...document.querySelectorAll("button, summary")].filter((control) =>
  control.offsetParent && control.getBoundingClientRect().height < 36)
  .map((control) => control.outerHTML)
"""


def test_nothing_is_cut_off_at_any_width_and_every_control_has_a_name(page):
    for width in (1600, 800, 390):
        with on_screen(page, width):
            assert fits(page), width
            assert page.execute_script(NAMELESS) == []
            assert width > 500 or page.execute_script(TOO_LOW_FOR_A_FINGER) == []


def test_zoom_view_and_exposure_answer(page, rig):
    click(page, "#closer")
    assert text(page, "zoom") == "2x"
    click(page, "#whole")
    assert text(page, "zoom") == "1x"
    click(page, "[data-show=mosaic]")
    assert (
        page.find_element(By.CSS_SELECTOR, "[data-show=mosaic]").get_attribute("aria-pressed")
        == "true"
    )
    exposure = page.find_element(By.ID, "exposure")
    exposure.clear()
    exposure.send_keys("40")
    click(page, "#exposure-form button")
    wait(page, lambda: rig.camera.exposure_s == pytest.approx(0.04))


def test_a_refusal_is_reported_floats_over_the_page_and_can_be_hidden(page):
    click(page, "#centre")
    wait(page, lambda: text(page, "busy") == "")
    step = page.find_element(By.ID, "step")
    step.clear()
    step.send_keys("ten")
    click(page, "button[aria-label='mask_y up']")
    said = "jog: distance_um: input should be a number"
    wait(page, lambda: text(page, "trouble-text") == said)
    page.execute_script("act('jog', { axis: 'mask_x', distance_um: 1e9 })")
    wait(page, lambda: "mask_x cannot go to" in text(page, "trouble"))
    # At one moment: figures that come meanwhile may move the button.
    shown, hidden = page.execute_script("""
        const trouble = document.getElementById("trouble");
        const button = document.getElementById("home");
        const shown = button.getBoundingClientRect().top;
        trouble.style.display = "none";
        const hidden = button.getBoundingClientRect().top;
        trouble.style.display = "";
        return [shown, hidden];
    """)
    assert shown == hidden
    click(page, "#trouble-close")
    assert not page.find_element(By.ID, "trouble").is_displayed()
    page.execute_script("act('jog', { axis: 'mask_x', distance_um: 1e9 })")
    wait(page, lambda: "mask_x cannot go to" in text(page, "trouble"))


def test_a_lost_connection_says_so_and_what_to_do(browser, tmp_path):
    shown = SessionPage(tmp_path / "session", Control(), computes=False)
    with served(application(shown, TOKEN)) as port:
        browser.get(f"http://127.0.0.1:{port}/{TOKEN}/")
        wait(browser, lambda: text(browser, "count") == "no frame yet")
        assert "waiting for the first frame" in text(browser, "stage")
    wait(browser, lambda: "No connection since" in text(browser, "trouble"))
    assert "start it again" in text(browser, "trouble")
    browser.execute_script("act('pause')")
    wait(browser, lambda: "pause: the program does not answer" in text(browser, "trouble"))
    browser.get_log("browser")


@contextmanager
def page_of(browser, camera):
    """Show the page of a camera without a stage."""
    watch = Watch(camera)
    watch.start()
    try:
        with served(application(watch, TOKEN)) as port:
            browser.get(f"http://127.0.0.1:{port}/{TOKEN}/")
            yield
            assert complaints(browser) == []
    finally:
        watch.close()


def test_a_long_exposure_is_counted_down_where_the_picture_is_and_cancelled(browser):
    with page_of(browser, PatientCamera()):
        wait(browser, lambda: frame_number(browser) > 0)
        before = frame_number(browser)
        field = browser.find_element(By.ID, "exposure")
        field.clear()
        field.send_keys("35000", Keys.ENTER)
        shown = re.compile(r"exposing, 3[2-5] s left of 35")
        wait(browser, lambda: shown.fullmatch(text(browser, "exposing-text")))
        click(browser, "#cancel")
        wait(browser, lambda: frame_number(browser) > before + 1)
        wait(browser, lambda: not browser.find_element(By.ID, "exposing").is_displayed())


SHOWN = """
const box = (id) => document.getElementById(id).getBoundingClientRect();
const stop = box("stop"), below = stop.top > innerHeight / 2 ? stop.top : innerHeight;
return ["picture", "histogram", "levels", "exposure", "gain", "focus", "rotation", "offset", "stop"]
  .filter((id) => !box(id).height || box(id).top < 0 || box(id).left < 0 ||
    box(id).right > innerWidth || box(id).bottom > (id === "stop" ? innerHeight : below));
"""


@pytest.mark.parametrize("size", [(1600, 900), (390, 844)])
def test_picture_levels_exposure_focus_mask_and_stop_are_in_view_without_scrolling(page, size):
    page.execute_script("scrollTo(0, 0)")
    page.execute_script("act('centre')")
    wait(page, lambda: page.execute_script("return state.figures && !state.busy"))
    wait(page, lambda: page.execute_script("return !picture.hidden"))
    for scheme in ("light", "dark"):
        with on_screen(page, size[0], size[1], scheme):
            wait(page, lambda: page.execute_script(SHOWN) == [])
            back = page.execute_script("return getComputedStyle(document.body).backgroundColor")
            assert (int(back.split("(")[1].split(",")[0]) < 128) == (scheme == "dark")


NEXT_BOTTOM = """
return ["hint", "next"].map((id) => document.getElementById(id).getBoundingClientRect())
  .filter((box) => box.height).map((box) => box.bottom)
"""


@pytest.mark.parametrize("kind", ["colour", "views"])
def test_a_phone_shows_the_next_step_and_what_saving_wants_without_scrolling(page, kind):
    with on_screen(page, 390, 844):
        page.execute_script("scrollTo(0, 0); act('centre')")
        press = f"[data-show={kind}]"
        wait(page, lambda: page.find_element(By.CSS_SELECTOR, press).is_displayed())
        click(page, press)
        wait(page, lambda: page.execute_script("return state.figures && !state.busy"))
        wait(page, lambda: len(page.execute_script(NEXT_BOTTOM)) == 1)
        assert page.execute_script(NEXT_BOTTOM)[0] < 500
        shown = text(page, "wants-text")
        assert shown == WANTS.replace("`", "")
        assert page.find_element(By.CSS_SELECTOR, "#steps li:last-child").text.endswith(shown)
        click(page, "#wants-close")
        wait(page, lambda: not page.find_element(By.ID, "wants").is_displayed())
        click(page, "[data-show=colour]")


def test_a_black_picture_says_why_and_the_next_step_stands_below_it(page, rig):
    click(page, "#centre")
    wait(page, lambda: text(page, "busy") == "")
    click(page, "#targets button:nth-child(1)")
    click(page, "#autoexpose")
    wait(page, lambda: text(page, "why") == "")
    wait(page, lambda: text(page, "next").startswith("Step "))
    rig.attendant.set_lamp("off")
    try:
        wait(page, lambda: text(page, "why") == text(page, "hint-text") != "")
        assert "switch the lamp on" in text(page, "why")
        assert not page.find_element(By.ID, "next").is_displayed()
    finally:
        rig.attendant.set_lamp("white")
    wait(page, lambda: text(page, "why") == "")


def test_no_camera_and_no_stage_are_explained_where_the_picture_would_be(browser):
    camera, gone = FakeCamera(), DriverError("no camera answers", "switch it on")
    camera.fault = gone
    with page_of(browser, camera):
        said = "No picture: no camera answers: switch it on. Trying again every second."
        wait(browser, lambda: text(browser, "why") == said)
        assert not browser.find_element(By.ID, "picture").is_displayed()
        assert not browser.find_element(By.ID, "stop").is_displayed()
        assert "by hand" in browser.find_element(By.CSS_SELECTOR, "#steps li").text
        camera.fault = None
        wait(browser, lambda: frame_number(browser) > 0)
        camera.fault = gone
        wait(browser, lambda: text(browser, "why").startswith("Not live, this is the last"))
