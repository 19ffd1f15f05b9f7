"""The page of a film in a browser: time by hand, by keys and by itself, and a row over time."""

import base64
import re

import cv2
import numpy as np
import pytest
from browsers import MARKS, complaints, drawn, fits, nameless, on_screen, wait
from filmed import SIZE, light_field_at, write_film

from emmc_rig.formats.exports import open_film
from emmc_rig.model.lightfield import centre_view
from emmc_rig.report.viewer import curve_of, render_film

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = MARKS


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return open_film(write_film(tmp_path_factory.mktemp("film") / "slide"))


@pytest.fixture(scope="module")
def written(film):
    path = film.folder.parent / "viewer.html"
    path.write_text(render_film(film), encoding="utf-8")
    return path


@pytest.fixture
def page(browser, written):
    browser.get(written.as_uri())
    shown(browser, 0)
    rows = "return document.getElementById('viewer').dataset.rows"
    wait(browser, lambda: browser.execute_script(rows))
    yield browser
    assert complaints(browser) == []


def shown(page, place):
    """Wait until the frame of a place in time is shown."""
    viewer = page.find_element(By.ID, "viewer")
    wait(page, lambda: viewer.get_attribute("data-place") == str(place))


def picture(page, name) -> np.ndarray:
    """Return a canvas as codes (y, x, rgba)."""
    address = page.execute_script(
        "return document.getElementById(arguments[0]).toDataURL('image/png')", name
    )
    codes = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    found = cv2.imdecode(codes, cv2.IMREAD_UNCHANGED)
    assert found is not None
    return cv2.cvtColor(found, cv2.COLOR_BGRA2RGBA).astype(float)


def expected(film, place) -> np.ndarray:
    """Return the centre view of a place as the page shows it, codes (y, x, rgb)."""
    places = list(film.frames)
    curve = curve_of(film.opened(places[len(places) // 2]))
    return curve.encode(centre_view(light_field_at(place))).astype(float)


def place_in(page, film) -> int:
    """Return the place whose centre view the picture is."""
    seen = picture(page, "viewer-picture")[..., :3]
    missed = {place: np.abs(seen - expected(film, place)).mean() for place in film.frames}
    assert min(missed.values()) < 6  # of WebP, whose colours are of half the resolution
    return min(missed, key=lambda place: missed[place])


def time_text(page) -> str:
    return page.find_element(By.ID, "film-time-value").text


def test_the_slider_and_the_keys_choose_the_frame(page, film):
    page.find_element(By.ID, "film-time").send_keys(Keys.END)
    shown(page, 5)
    assert time_text(page) == "0.63 s, frame 5 / 5: trust"
    assert place_in(page, film) == 5
    page.find_element(By.ID, "viewer-picture").send_keys(",")
    shown(page, 4)
    assert place_in(page, film) == 4
    page.find_element(By.ID, "viewer-picture").send_keys("..")
    shown(page, 0)  # behind the last frame is the first


def test_a_missing_frame_is_said_to_be_missing(page, film):
    missing = page.find_element(By.ID, "film-missing")
    assert not missing.is_displayed()
    page.find_element(By.ID, "viewer-picture").send_keys("...")
    shown(page, 3)
    assert missing.is_displayed()
    assert time_text(page) == "0.38 s, frame 3 / 5"
    assert place_in(page, film) == 2


def test_the_viewpoint_stays_from_frame_to_frame(page):
    looked = page.find_element(By.ID, "viewer-picture")
    looked.send_keys(Keys.ARROW_LEFT, Keys.ARROW_UP, ".")
    shown(page, 1)
    status = page.find_element(By.ID, "viewer-status")
    wait(page, lambda: status.text.startswith("View v 0.90, u 0.90"))


def test_it_plays_by_itself_until_it_is_stopped(page):
    looked = page.find_element(By.ID, "viewer-picture")
    looked.send_keys(" ")
    button = page.find_element(By.ID, "film-play")
    assert button.text == "Pause"
    seen = set()
    wait(page, lambda: seen.add(time_text(page)) or len(seen) >= 4)
    looked.send_keys(" ")
    assert (button.text, button.get_attribute("aria-pressed")) == ("Play", "false")
    stopped = time_text(page)
    page.execute_async_script("setTimeout(arguments[0], 400)")
    assert time_text(page) == stopped


def test_a_row_of_pixels_is_drawn_over_time_and_a_click_on_it_goes_there(page, film):
    looked = page.find_element(By.ID, "viewer-picture")
    ActionChains(page).move_to_element_with_offset(looked, 0, -100).perform()
    drawn(page)
    found = re.search(r"y (\d+)", page.find_element(By.ID, "viewer-status").text)
    assert found is not None
    y = int(found[1])
    assert y != SIZE[0] // 2  # where it was before the pointer came
    rows = picture(page, "film-rows")
    assert rows.shape == (6, SIZE[1], 4)
    assert rows[3, 1:20, 3].max() == 0  # nothing at a time without a frame
    for place in (1, 2, 4, 5):  # row 0 is marked as the time that is shown
        views = expected(film, place)[:, 1:20]
        missed = np.abs(rows[place, 1:20, :3] - views).mean(axis=(1, 2))
        assert int(np.argmin(missed)) == y
    over_time = page.find_element(By.ID, "film-rows")
    ActionChains(page).move_to_element_with_offset(
        over_time, 0, round(over_time.size["height"] * (2.5 / 6 - 0.5))
    ).click().perform()
    shown(page, 2)


def test_it_fits_every_screen_and_every_control_has_a_name(page):
    for width in (1600, 390):
        with on_screen(page, width):
            assert fits(page), width
            assert nameless(page) == []
