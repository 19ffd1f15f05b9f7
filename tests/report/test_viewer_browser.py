"""The viewer in a browser: pictures as numpy computes them; hand, keys and screens."""

import base64
import json
import re

import cv2
import numpy as np
import pytest
from browsers import MARKS, complaints, drawn, fits, nameless, on_screen, wait

from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.format import Export
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import Lens
from emmc_rig.model.novel_view import between, sampled
from emmc_rig.model.optics import optics_of
from emmc_rig.report import viewer
from emmc_rig.report.display import TILE_MULTIPLE_PX, png_of, tiled
from emmc_rig.report.viewer import render_viewer

pytest.importorskip("selenium", reason="needs selenium: extra `browser`")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = MARKS
LENS = Lens(distance_mm=52.0, aperture_cell_mm=3.0, focus_mm=700.0)
CAMERA = find_camera("rgbw-bayer-1shot").model_copy(update={"lens": LENS})


def lossless(views, most_bytes, tile=TILE_MULTIPLE_PX):
    """Return an atlas that every decoder reads alike, to the last code."""
    return png_of(np.ascontiguousarray(tiled(views, tile)[..., ::-1]))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    scene = open_scene("deep-occlusions", size=(72, 96))
    rng = np.random.default_rng(2)
    noisy = np.clip(scene.light_field + rng.normal(0, 0.03, scene.light_field.shape), 0, 1)
    path = tmp_path_factory.mktemp("viewer") / "viewer.html"
    content = Export(
        title="Browser <test>",
        caption="",
        light_field=noisy.astype(np.float32),
        truth=scene.light_field,
        disparity=scene.disparity_px,
        sigma=np.full(scene.light_field.shape[:4], 0.03, np.float32),
        misfit=np.ones(scene.size, np.float32),
        camera=CAMERA,
        disparity_sigma=np.full(scene.size, 0.2, np.float32),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewer, "sprite", lossless)
        path.write_text(render_viewer(content), encoding="utf-8")
    return path


def page_data(path) -> dict:
    found = re.search(r'id="viewer-data">(.*?)</script>', path.read_text(), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def unpacked(data, atlas) -> np.ndarray:
    """Return the pictures of an atlas, (v, u, y, x, c), as codes in [0, 1]."""
    views, tile = data["views"], data["tile"]
    picture = cv2.imdecode(
        np.frombuffer(base64.b64decode(atlas.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR_RGB
    )
    assert picture is not None
    height, width = (-(-views[name] // tile) * tile for name in ("height", "width"))
    tiles = picture.reshape(views["rows"], height, views["columns"], width, 3)
    tiles = tiles.transpose(0, 2, 1, 3, 4)[:, :, : views["height"], : views["width"]]
    return tiles.astype(np.float32) / 255


@pytest.fixture(scope="module")
def twin(written):
    """What the page draws from, for numpy: estimate, truth, disparities, gamma."""
    data = page_data(written)
    low, high = data["disparity"]["low"], data["disparity"]["high"]
    disparities = low + (high - low) * unpacked(data, data["disparity"]["atlas"])[..., 0]
    light_fields = (unpacked(data, data[name]) for name in ("estimate", "truth"))
    return *light_fields, disparities, data["gamma"]


def opened(browser, address):
    browser.get(address)
    complete = "return document.getElementById('viewer').dataset.complete"
    wait(browser, lambda: browser.execute_script(complete))
    return browser


@pytest.fixture
def page(browser, written):
    yield opened(browser, written.as_uri())
    assert complaints(browser) == []


def shown(page, **state) -> np.ndarray:
    """Draw a state and return the picture, (y, x, c) in codes 0 to 255."""
    address = page.execute_script(
        "document.getElementById('viewer').show(arguments[0]);"
        "return document.getElementById('viewer-picture').toDataURL('image/png')",
        state,
    )
    codes = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    picture = cv2.imdecode(codes, cv2.IMREAD_COLOR_RGB)
    assert picture is not None
    return picture.astype(float)


def test_a_view_between_views_is_that_of_numpy(page, twin):
    estimate, _, disparities, _ = twin
    for v, u in ((2, 2), (0, 4), (1.5, 2), (2.3, 0.6), (3.9, 3.2)):
        expected = 255 * between(estimate, disparities, v, u)
        assert np.abs(shown(page, v=v, u=u, aperture=0) - expected).max() <= 1, (v, u)


def photograph(light_field, disparities, v, u, focus_px, aperture, gamma):
    """Return the picture (y, x, c) through an aperture around a position, focused on a disparity.

    Ng et al. 2005, eq. 5, over the views that the aperture lets through: those nearer than its
    radius, in view steps, and partly those less than a step further. Light is averaged, not codes.
    """
    y, x = np.mgrid[: light_field.shape[2], : light_field.shape[3]].astype(np.float32)
    total = np.zeros(light_field.shape[2:], np.float32)
    weights = max(0.0, 1.0 - aperture)
    if weights:
        pinhole = between(light_field, disparities, v, u)
        total += np.float32(weights) * np.maximum(pinhole, 0) ** np.float32(gamma)
    for j, i in np.ndindex(light_field.shape[:2]):
        weight = min(max(aperture - float(np.hypot(j - v, i - u)), 0.0), 1.0)
        if weight:
            shift = np.float32(focus_px)
            seen = sampled(
                light_field[j, i], y + shift * np.float32(j - v), x + shift * np.float32(i - u)
            )
            total += np.float32(weight) * np.maximum(seen, 0) ** np.float32(gamma)
            weights += weight
    return (total / np.float32(weights)) ** np.float32(1 / gamma)


def test_a_refocused_picture_is_that_of_numpy(page, twin):
    estimate, _, disparities, gamma = twin
    for focus, aperture in ((-1.0, 6.0), (0.7, 6.0), (0.25, 2.5), (0.0, 0.6)):
        expected = 255 * photograph(estimate, disparities, 1.8, 2.2, focus, aperture, gamma)
        seen = shown(page, v=1.8, u=2.2, focus=focus, aperture=aperture)
        assert np.abs(seen - expected).max() <= 1, (focus, aperture)


def test_the_wipe_shows_the_truth_on_its_left(page, twin):
    estimate, truth, *_ = twin
    seen = shown(page, v=2, u=2, aperture=0, wipe=0.5)
    half = seen.shape[1] // 2
    assert np.abs(seen[:, :half] - 255 * truth[2, 2, :, :half]).max() <= 1
    assert np.abs(seen[:, half:] - 255 * estimate[2, 2, :, half:]).max() <= 1


def test_the_sides_of_the_wipe_are_named_over_the_picture_wherever_it_stands(page):
    sides = {name: page.find_element(By.ID, f"viewer-side-{name}") for name in ("left", "right")}
    stage = page.find_element(By.ID, "viewer-stage").rect
    button = page.find_element(By.ID, "viewer-full").rect
    for wipe, named in ((0, ["right"]), (0.5, ["left", "right"]), (1, ["left"])):
        shown(page, wipe=wipe)
        assert [name for name, side in sides.items() if side.is_displayed()] == named
    shown(page, wipe=0.5)
    assert (sides["left"].text, sides["right"].text) == ("true", "reconstructed")
    for side in sides.values():
        assert stage["x"] <= side.rect["x"] < side.rect["x"] + side.rect["width"] < button["x"]
        assert side.rect["y"] < stage["y"] + 60
    away = sides["left"].rect["x"] - stage["x"]
    assert away < 20


def test_all_in_focus_replaces_the_estimate_and_leaves_the_truth(page, written, twin):
    _, truth, *_ = twin
    data = page_data(written)
    sharp = unpacked({**data, "tile": 1, "views": {**data["views"], "rows": 1, "columns": 1}},
                     data["overlays"][-1]["picture"])[0, 0]  # fmt: skip
    page.find_element(By.ID, "viewer-picture").send_keys("5")
    chosen = page.find_element(By.CSS_SELECTOR, "#viewer-overlays label:has(input:checked)")
    assert chosen.text == "all in focus"
    seen = shown(page, v=2, u=2, aperture=0, wipe=0.5)
    half = seen.shape[1] // 2
    assert np.abs(seen[:, half:] - 255 * sharp[:, half:]).max() <= 1
    assert np.abs(seen[:, :half] - 255 * truth[2, 2, :, :half]).max() <= 1
    assert not page.find_element(By.ID, "viewer-legend").is_displayed()


def test_depth_is_that_of_python_under_the_pointer_and_where_it_is_focused(page, twin):
    disparities, optics = twin[2], optics_of(CAMERA, None)
    height, width = disparities.shape[2:]
    shown(page, v=2, u=2)
    for x, y in ((width // 4, height // 3), (width // 2, height // 2), (width // 3, height - 9)):
        shown(page, x=x, y=y)
        expected = float(optics.depth_mm(disparities[2, 2, y, x]))
        said = re.search(r"depth (\d+) ± ([\d.]+) mm", state(page))
        assert said is not None
        assert float(said[1]) == pytest.approx(expected, abs=0.5 if expected < 1000 else 5)
        sigma = optics.sigma_mm(np.array(expected), np.array(0.2))
        assert float(said[2]) == pytest.approx(float(sigma), rel=0.06)
    shown(page, focus=0)
    said = page.find_element(By.ID, "viewer-focus-value").text
    assert said == "0.00 px, depth 700 mm"
    assert not page.find_element(By.ID, "viewer-no-depth").is_displayed()


def state(page) -> str:
    drawn(page)
    return page.find_element(By.ID, "viewer-status").text


def value(page, name) -> float:
    return float(page.find_element(By.ID, f"viewer-{name}").get_property("value"))


def test_dragging_changes_the_viewpoint_and_a_click_focuses_there(page):
    picture = page.find_element(By.ID, "viewer-picture")
    assert state(page).startswith("View v 2.00, u 2.00")
    ActionChains(page).click_and_hold(picture).move_by_offset(-60, 0).release().perform()
    assert not state(page).startswith("View v 2.00, u 2.00")
    before = value(page, "aperture")
    ActionChains(page).move_to_element_with_offset(picture, 40, 30).click().perform()
    wait(page, lambda: value(page, "aperture") > before)


def test_keys_reach_everything(page):
    picture = page.find_element(By.ID, "viewer-picture")
    picture.send_keys(Keys.ARROW_LEFT, Keys.ARROW_UP)
    assert state(page).startswith("View v 1.90, u 1.90")
    picture.send_keys("+", "w", Keys.PAGE_UP, "2")
    state(page)
    assert (value(page, "aperture"), value(page, "wipe")) == (0.25, 0.5)
    chosen = page.find_elements(By.CSS_SELECTOR, "#viewer-overlays input:checked")
    assert [choice.get_attribute("value") for choice in chosen] == ["1"]
    assert page.find_element(By.ID, "viewer-legend").is_displayed()
    picture.send_keys("r")
    assert state(page).startswith("View v 2.00, u 2.00")


def test_every_overlay_changes_the_picture_and_is_read_under_the_pointer(page):
    bare = shown(page, overlay=-1)
    for number in "123":
        page.find_element(By.ID, "viewer-picture").send_keys(number)
        assert np.abs(shown(page) - bare).mean() > 5
    for word in (
        "disparity",
        "standard deviation 0.03",
        "unexplained residual 1.0 x noise",
    ):
        assert word in state(page)


def test_without_webgl_views_and_refocus_are_drawn_by_canvas(browser, written, twin):
    estimate, *_ = twin
    page = opened(browser, f"{written.as_uri()}?renderer=plain")
    assert page.find_element(By.ID, "viewer").get_attribute("data-renderer") == "plain canvas"
    assert np.abs(shown(page, v=1.2, u=3.1) - 255 * estimate[1, 3]).max() <= 1
    opened_up = shown(page, v=2, u=2, focus=0, aperture=6)
    assert np.abs(opened_up - 255 * estimate.mean(axis=(0, 1))).max() < 20


def test_it_fits_every_screen_and_every_control_has_a_name(page):
    for width in (1600, 800, 390):
        with on_screen(page, width):
            assert fits(page), width
            assert nameless(page) == []


def test_bands_are_called_so_and_have_no_focus(browser, tmp_path):
    light_field = np.random.default_rng(1).random((1, 24, 32, 40, 3), dtype=np.float32)
    path = tmp_path / "bands.html"
    content = Export("bands", "", light_field, view_axes=("angle", "band"))
    path.write_text(render_viewer(content), encoding="utf-8")
    page = opened(browser, path.as_uri())
    status = page.find_element(By.ID, "viewer-status")
    assert status.text.startswith("Band 12; at x 20, y 16")
    page.find_element(By.ID, "viewer-picture").send_keys(Keys.ARROW_RIGHT)
    wait(page, lambda: status.text.startswith("Band 13;"))
    assert not page.find_element(By.ID, "viewer-focus").is_displayed()
    assert page.find_element(By.ID, "viewer-epi-h-name").text == "Row by band"
    words = page.find_element(By.TAG_NAME, "body").text.lower()
    assert not re.search(r"disparity|parallax|epipolar|view [vu] ", words)
    assert complaints(page) == []
