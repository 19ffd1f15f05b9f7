"""The page of a film: all light fields on one scale, size of the page, head."""

import json
import re

import pytest
from filmed import SIZE, write_film
from pages import Page

from emmc_rig.formats.exports import open_film
from emmc_rig.report import viewer
from emmc_rig.report.viewer import render_film


def page_data(text) -> dict:
    found = re.search(r'id="film-data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film") / "slide"
    return open_film(write_film(folder, levels=["doubt", "trust", "doubt"]))


@pytest.fixture(scope="module")
def page(film):
    return render_film(film)


def test_the_page_has_all_frames_and_loads_nothing(page):
    assert Page(page).foreign == []
    data = page_data(page)
    assert [frame is not None for frame in data["frames"]] == [True] * 3 + [False] + [True] * 2
    assert data["levels"] == ["doubt", "trust", "doubt", "", "trust", "trust"]
    assert data["rate"] == 8.0
    assert len(data["times_s"]) == 6
    assert "5 of 6 frames at 8 Hz, 3x3 views of 36x48." in page


def test_brightness_focus_and_colours_mean_the_same_in_all_frames(page):
    frames = [frame for frame in page_data(page)["frames"] if frame]
    for key in ("gamma", "scale", "views", "tile"):
        assert all(frame[key] == frames[0][key] for frame in frames)
    assert len({(frame["focus"]["low"], frame["focus"]["high"]) for frame in frames}) == 1
    for overlays in zip(*(frame["overlays"] for frame in frames), strict=True):
        assert len({(o["key"], o.get("low"), o.get("high")) for o in overlays}) == 1


def picture_bytes(text):
    return sum(len(frame["estimate"]) * 3 / 4 for frame in page_data(text)["frames"] if frame)


def test_a_long_film_has_smaller_pictures_of_fewer_bytes(film, page, monkeypatch):
    monkeypatch.setattr(viewer, "FILM_BYTES", 6_000)
    text = render_film(film)
    (height, width), views = SIZE, page_data(text)["frames"][0]["views"]
    assert views["height"] < 0.8 * height
    assert views["height"] / views["width"] == pytest.approx(height / width, rel=0.1)
    assert f"shown as {views['height']}x{views['width']}" in text
    assert picture_bytes(text) < 0.5 * picture_bytes(page)


def test_the_head_is_that_of_the_worst_frames_and_says_how_many(page, tmp_path):
    assert "There is reason to doubt this light field" in page
    assert "2 of 5 frames, the first at 0.00 s: a reason" in page
    good = render_film(open_film(write_film(tmp_path / "good", frames=2)))
    assert "You can trust this light field" in good
    assert "frames, the first at" not in good


def test_a_film_whose_frames_have_no_disparity_gets_one(tmp_path, film):
    folder = write_film(tmp_path / "film", frames=2)
    for path in folder.rglob("maps.h5"):
        path.unlink()
    data = page_data(render_film(open_film(folder)))
    assert [overlay["key"] for overlay in data["frames"][0]["overlays"]] == ["sharp"]
    assert data["frames"][0]["disparity"]["low"] < data["frames"][0]["disparity"]["high"]
