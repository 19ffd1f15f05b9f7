"""Masks from photographs that rays render: tilted, bowed, vignetted, blurred, noisy, uneven.

The renderer follows every pixel's rays back to the mask's plane; the code under test maps the mask
onto the photograph by a homography. They share nothing.
"""

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.mask_photo import find_corners, read_mask
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.model.camera import Camera
from emmc_rig.model.masks import fiducial_marks
from emmc_rig.model.srgb import codes_of, srgb_of

CELLS = (40, 52)
ACCURACY = 0.02
FILTERS = np.array([(0.9, 0.05, 0.02), (0.04, 0.85, 0.05), (0.02, 0.06, 0.8), (1, 1, 1)])
RAYS = 2


def photograph(
    cells, px=10.0, tilt=(10, 0, 0), bow=0.02, vignetting=0.3, noise=0.01, blur_px=1.0,
    surround=0.0, uneven=0.1, exposure=0.8, margin=1.3, speck=None,
):  # fmt: skip
    """Return the linear light of a photograph (y, x[, colour]) of cells (row, column[, colour]).

    tilt: degrees about x, y and the axis. bow: moves the photograph's corners outward by this part.
    vignetting: what its corners lose. speck: row and column, in cells, of dust 0.3 cells wide.
    """
    plate = np.atleast_3d(np.asarray(cells, float))
    rows, columns = plate.shape[:2]
    high, wide = int(rows * px * margin), int(columns * px * margin)
    radius = np.hypot(high, wide) / 2
    y, x = (
        ((np.arange(n * RAYS) + 0.5) / RAYS - n / 2).reshape(shape)
        for n, shape in ((high, (-1, 1)), (wide, (1, -1)))
    )
    seen = np.hypot(x, y) / radius
    straight = seen.copy()
    for _ in range(20):  # Newton, of straight + bow straight^3 = seen
        straight -= (straight + bow * straight**3 - seen) / (1 + 3 * bow * straight**2)
    shrunk = straight / np.maximum(seen, 1e-9)
    away = 3.0 * max(rows, columns) * px
    rays = np.stack([x * shrunk, y * shrunk, np.full(seen.shape, away)], axis=-1)
    turned = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
    along = away * turned[2, 2] / (rays @ turned[:, 2])
    on_plane = rays * along[..., None] - (0, 0, away)
    column = on_plane @ turned[:, 0] / px + columns / 2
    row = on_plane @ turned[:, 1] / px + rows / 2
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    light = np.full((*row.shape, plate.shape[2]), float(surround))
    light[inside] = plate[row[inside].astype(int), column[inside].astype(int)]
    if speck is not None:
        light[np.hypot(row - speck[0], column - speck[1]) < 0.3] = 0
    light = light.reshape(high, RAYS, wide, RAYS, -1).mean(axis=(1, 3))
    light = gaussian_filter(light, (blur_px, blur_px, 0))
    y, x = np.mgrid[-1 : 1 : high * 1j, -1 : 1 : wide * 1j]
    lamp = exposure * (1 - vignetting * (x**2 + y**2) / 2) * (1 + uneven * x - uneven / 2 * y)
    light = light * lamp[..., None]
    light += noise * np.random.default_rng(5).standard_normal(light.shape)
    light = np.clip(light, 0, 1)
    return light[..., 0] if np.ndim(cells) == 2 else light


def binary(cells=CELLS, seed=1, shut=0.02):
    return np.where(np.random.default_rng(seed).random(cells) < 0.5, 1.0, shut)


@cache
def plain():
    """A photograph that other tests look at too."""
    return photograph(binary())


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"surround": 1.0},
        {"tilt": (-7, 7, -9), "bow": -0.02, "surround": 1.0},
        {"tilt": (0, -10, 14), "uneven": 0.2, "margin": 1.5},
        {"px": 6.0},
        {"px": 12.0, "blur_px": 2.5},
    ],
    ids=["dark", "clear", "pincushion", "turned", "small", "blurred"],
)
def test_cells_are_right_under_tilt_bow_vignetting_blur_and_noise(how):
    truth = binary()
    found = read_mask(photograph(truth, **how), CELLS)
    error = found.cells[..., 0] - truth
    assert rms(error) < ACCURACY
    assert abs(error).max() < 0.1
    assert 0.3 < rms(error / found.sigma[..., 0]) < 1.6
    assert found.grid.bow == pytest.approx(how.get("bow", 0.02), abs=0.004)
    assert not found.defects


@pytest.mark.parametrize(
    ("kinds", "surround"), [(4, 0.0), (4, 1.0), (3, 1.0)], ids=["dark", "clear", "equal means"]
)
def test_a_colour_mask_is_read_in_every_colour_against_its_clear_cells(kinds, surround):
    truth = FILTERS[np.random.default_rng(2).integers(kinds, size=CELLS)]
    found = read_mask(photograph(truth, surround=surround), CELLS)
    assert found.cells.shape == truth.shape
    assert rms(found.cells - truth) < ACCURACY
    assert found.clear == pytest.approx((truth.min(axis=-1) == 1).mean(), abs=0.01)


def test_a_grey_mask_in_colour_is_one_of_greys():
    found = read_mask(np.repeat(plain()[..., None], 3, axis=-1) * (1, 0.8, 0.6), CELLS)
    assert found.cells.shape == (*CELLS, 1)
    assert rms(found.cells[..., 0] - binary()) < ACCURACY


def test_greys_need_clear_glass_around_them():
    truth = np.clip(np.random.default_rng(3).normal(0.5, 0.2, CELLS), 0, 1)
    found = read_mask(photograph(truth, surround=1.0), CELLS)
    assert rms(found.cells[..., 0] - truth) < ACCURACY
    assert not found.defects
    with pytest.raises(CalibrationError, match=r"no clear parts.*clear glass around"):
        read_mask(photograph(truth), CELLS)


def test_given_corners_serve_where_no_outline_is_seen():
    whole = plain()
    found = find_corners(whole[..., None].astype(np.float32), CELLS)
    edge = int(np.floor(found.min(axis=0)[0])) + 8
    # A bright object covers the left edge of the mask.
    disturbed = whole.copy()
    disturbed[:, : edge - 20] = 0.7 * np.random.default_rng(0).random((len(whole), edge - 20))
    with pytest.raises(CalibrationError, match="corners"):
        read_mask(disturbed, CELLS)
    by_hand = found + np.array([(2, -2), (-2, 1), (1, 2), (-2, -2)])
    assert rms(read_mask(disturbed, CELLS, by_hand).cells[..., 0] - binary()) < ACCURACY


def test_corners_from_the_masks_own_top_left_turn_the_mask_upright():
    corners = find_corners(plain()[..., None].astype(np.float32), CELLS)
    # Turned by 90 degrees against the clock, (x, y) comes to lie at (y, width - 1 - x).
    width = plain().shape[1]
    there = np.stack([corners[:, 1], width - 1 - corners[:, 0]], axis=1)
    found = read_mask(np.rot90(plain()).copy(), CELLS, there)
    assert rms(found.cells[..., 0] - binary()) < ACCURACY


def test_defects_are_listed_where_they_are():
    truth = binary()
    truth[5, 7] = 0.5
    truth[20, 30] = 1
    photo = photograph(truth, speck=(20.5, 30.5))
    found = {(cell.row, cell.column): cell.what for cell in read_mask(photo, CELLS).defects}
    assert set(found) == {(5, 7), (20, 30)}
    assert "partly open" in found[5, 7]
    assert "uneven within" in found[20, 30]


def test_cells_that_are_not_as_ordered_are_defects():
    ordered = binary()
    made = ordered.copy()
    made[11, 13] = 1.02 - made[11, 13]
    found = read_mask(photograph(made), CELLS, ordered=ordered).defects
    assert [(cell.row, cell.column) for cell in found] == [(11, 13)]
    assert "not as ordered" in found[0].what


@pytest.mark.parametrize(
    "asked",
    [
        (40, 51),
        (52, 40),
        *(
            pytest.param(asked, marks=pytest.mark.slow)
            for asked in ((39, 52), (40, 53), (41, 52), (20, 52), (44, 48), (20, 26))
        ),
    ],
)
def test_another_number_of_cells_is_refused_with_the_one_seen(asked):
    with pytest.raises(
        CalibrationError, match=r"about (39|40|41)x(51|52|53) cells.*(turned|number)"
    ):
        read_mask(plain(), asked)


def test_twice_the_number_of_cells_is_refused_too():
    with pytest.raises(CalibrationError, match=r"about 40x52 cells are seen.*not 80x104"):
        read_mask(photograph(binary(), px=12), (80, 104))


@pytest.mark.parametrize(
    ("change", "face"),
    [
        (lambda seen: np.rot90(seen, 2), "bottom right"),
        (lambda seen: seen[:, ::-1], "top right"),
        (lambda seen: seen[::-1], "bottom left"),
    ],
)
def test_the_ring_of_a_designed_mask_shows_a_turned_photograph(change, face):
    truth = binary()
    ring, cross = fiducial_marks()
    for row, column in ((3, 3), (3, 40), (28, 3), (28, 40)):
        truth[row : row + 9, column : column + 9] = ring if (row, column) == (3, 3) else cross
    photo = photograph(truth)
    assert rms(read_mask(photo, CELLS).cells[..., 0] - truth) < ACCURACY
    with pytest.raises(CalibrationError, match=f"ring .* is at the {face}, not at the top left"):
        read_mask(np.ascontiguousarray(change(photo)), CELLS)


def cornered(*corners):
    return lambda: (plain(), {"corners_px": corners})


def as_ordered(ordered, change=lambda seen: seen):
    return lambda: (np.ascontiguousarray(change(plain())), {"ordered": ordered})


REFUSED = {
    "few pixels": (lambda: (photograph(binary(), px=4), {}), r"3\.\d pixels a cell of 40x52, at l"),
    "overexposed": (lambda: (np.clip(1.6 * plain(), 0, 1), {}), "saturated: .* less exposure"),
    "blank": (lambda: (np.full((300, 300), 0.5), {}), "no mask"),
    "noise": (lambda: (np.random.default_rng(0).random((300, 300)), {}), "no mask"),
    "cut": (lambda: (plain()[70:], {}), "corners"),
    "blurred": (lambda: (photograph(binary(), blur_px=6), {}), "sharp"),
    "NaN": (lambda: (np.where(plain() > 0.5, np.nan, plain()), {}), "1 where saturated"),
    "codes": (lambda: (255 * plain(), {}), "1 where saturated"),
    "corners against the clock": (
        cornered((0, 0), (0, 400), (400, 400), (400, 0)),
        "against the clock: .* mirrored",
    ),
    "corners crossed": (cornered((0, 0), (400, 400), (400, 0), (0, 400)), "no quadrilateral"),
    "corners outside": (
        cornered((0, 0), (4000, 0), (400, 400), (0, 400)),
        "outside the photograph of 676 x 520 pixels",
    ),
    "three corners": (cornered((0, 0), (400, 0), (400, 400)), "four corners"),
    "corners elsewhere": (cornered((9, 9), (600, 9), (600, 500), (9, 500)), "cells"),
    "ordered smaller": (as_ordered(binary((40, 51))), "as ordered has 40x51 cells, not 40x52"),
    "another ordered": (as_ordered(binary(seed=9)), "resembles the mask as ordered in no orient"),
    "turned": (
        as_ordered(binary(), lambda seen: np.rot90(seen, 2)),
        "only when it is turned by 180 degrees:",
    ),
    "mirrored": (as_ordered(binary(), lambda seen: seen[:, ::-1]), "only when it is mirrored:"),
    "mirrored and turned": (
        as_ordered(binary(), lambda seen: seen[::-1]),
        "only when it is mirrored and turned by 180 degrees:",
    ),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_photograph_that_shows_no_such_mask_is_refused(fault):
    given, complaint = REFUSED[fault]
    photo, how = given()
    with pytest.raises(CalibrationError, match=complaint):
        read_mask(photo, CELLS, **how)


def save(path, light, bits=16):
    """Write linear light as a picture: linear of 16 bits, sRGB of 8."""
    codes = codes_of(light if bits == 16 else srgb_of(light), bits)
    codes = codes[..., ::-1] if codes.ndim == 3 else codes
    Path(path).write_bytes(cv2.imencode(Path(path).suffix, codes)[1].tobytes())


MASK = ("--cells", "40x52", "--cell-um", "100", "--out", "mine.png")


def test_the_command_writes_a_mask_that_a_camera_takes(tmp_path, run):
    save("photo.tif", plain())
    code, out, err = run("mask", "photo.tif", *MASK)
    assert code == 0, err
    assert "4 x 5.2 mm" in out
    assert "pattern: {kind: picture, path: mine.png}, cell_um: 100" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "mine-check.png", "mine.json", "mine.png", "photo.tif",
    ]  # fmt: skip
    facts = json.loads(Path("mine.json").read_text())
    assert np.shape(facts["sigma"]) == (*CELLS, 1)
    assert (facts["cells"], facts["cell_um"], facts["defects"]) == ([40, 52], 100, [])

    def psi(pattern):
        mask = {"distance_mm": 1, "cell_um": 100, "pattern": pattern}
        described = {"title": "mine", "masks": {"mask": mask}, "views": (1, 3)}
        return Camera.model_validate(described).psi((16, 24))

    scene = np.random.default_rng(0).random((1, 3, 16, 24, 3), dtype=np.float32)
    read = psi({"kind": "picture", "path": str(tmp_path / "mine.png")}).forward(scene)
    true = psi({"kind": "parameters", "cells": binary().tolist()}).forward(scene)
    assert rms(read - true) < ACCURACY
    assert rms(true - true.mean()) > 5 * ACCURACY


def test_the_command_reads_srgb_pictures_and_colours(run):
    truth = FILTERS[np.random.default_rng(2).integers(4, size=CELLS)]
    save("photo.jpg", photograph(truth), bits=8)
    code, _, err = run("mask", "photo.jpg", *MASK)
    assert code == 0, err
    found = np.asarray(cv2.imread("mine.png", cv2.IMREAD_UNCHANGED))[..., ::-1] / 65535
    assert rms(found - truth) < 0.03  # JPEG halves the colours' resolution


@pytest.mark.parametrize("cfa", ["mono", "rggb"])
def test_the_command_reads_raw_files(run, cfa):
    codes = np.rint(64 + 900 * plain()).astype(np.uint16)
    Path("photo.dng").write_bytes(encode_dng(codes, cfa, 64, 964, None))
    code, _, err = run("mask", "photo.dng", *MASK)
    assert code == 0, err
    found = np.asarray(cv2.imread("mine.png", cv2.IMREAD_UNCHANGED)) / 65535
    assert rms(found - binary()) < ACCURACY


def test_nothing_is_written_over(tmp_path, run):
    save("photo.tif", plain())
    Path("mine.json").write_text("kept")
    code, _, err = run("mask", "photo.tif", *MASK)
    assert code == 1
    assert "mine.json: exists already" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.json", "photo.tif"]
    assert Path("mine.json").read_text() == "kept"


@pytest.mark.parametrize(
    ("words", "code", "complaint"),
    [
        (("no.tif", *MASK), 1, "no.tif: no such file"),
        (("text.png", *MASK), 1, "text.png: of an unknown format"),
        (("photo.tif", "--cells", "40", *MASK[2:]), 2, "write ROWSxCOLUMNS"),
        (("photo.tif", "--cells", "40x60", *MASK[2:]), 1, "about 40x52 cells"),
        (("photo.tif", *MASK, "--corners", "1,2 3,4"), 2, "write four points"),
        (("photo.tif", *MASK[:5], "mine.jpg"), 2, "name a file that ends in .png"),
        (("photo.tif", *MASK, "--ordered", "photo.tif"), 1, "as ordered has 520x676 cells"),
        (("photo.tif", *MASK[:5], "none/mine.png"), 1, "none"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(tmp_path, run, words, code, complaint):
    save("photo.tif", plain())
    Path("text.png").write_text("no picture")
    got, _, err = run("mask", *words)
    assert got == code
    assert complaint in " ".join(err.split())
    assert "Traceback" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photo.tif", "text.png"]
