"""Maps as SVG files: labelled, pixel for pixel, in colours that stand for their values."""

import base64
import re
from xml.etree import ElementTree

import cv2
import numpy as np

from emmc_rig.report.maps import Map, colour_table, maps_svg, pixel_ticks

VALUES = np.array([[-1.0, 0.0, 1.0], [np.nan, 9.0, -9.0]], np.float32)
MAP = Map("a <title>", VALUES, (-1, 1), "bar,\nunit", "blue-red", "x", "y", {0.5: "0"}, {})


def test_a_map_shows_every_value_in_its_colour_and_what_is_unknown_in_white():
    (picture, _) = re.findall(r'href="data:image/png;base64,([^"]+)"', maps_svg([MAP]).decode())
    colours = np.asarray(
        cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
    )
    blue, white, red = (5, 48, 97), (247, 247, 247), (103, 0, 31)
    expected = np.array([[blue, white, red], [(255, 255, 255), red, blue]])
    assert np.abs(colours[..., ::-1].astype(int) - expected).max() <= 1


def test_maps_stand_side_by_side_with_their_words_and_are_equal_for_equal_maps():
    drawn = maps_svg([MAP, MAP])
    assert drawn == maps_svg([MAP, MAP])
    words = [text.text for text in ElementTree.fromstring(drawn).iter() if text.text]
    assert words[: len(words) // 2] == words[len(words) // 2 :]
    assert {"a <title>", "x", "y", "0", "bar,", "unit", "-1", "-0.5", "0.5", "1"} <= set(words)


def test_colour_tables_go_from_least_to_most():
    for name in ("gray", "magma"):
        light = colour_table(name).astype(float).mean(axis=1)
        assert light[0] < 5
        assert light[-1] > 200
        assert (np.diff(light) > -1).all()


def test_ticks_are_round_numbers_of_pixels_however_large_the_map_is_drawn():
    assert list(pixel_ticks(128, 128).values()) == ["0", "50", "100"]
    assert pixel_ticks(4000, 640) == {
        (n + 0.5) * 0.16: str(n) for n in (0, 1000, 2000, 3000)
    }  # fmt: skip
    assert list(pixel_ticks(3, 3).values()) == ["0", "1", "2"]
