"""Mask patterns and colour filter tiles: statistics, defining properties, bad input."""

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.signal import correlate

from emmc_rig.model.errors import CameraError
from emmc_rig.model.masks import AnyPattern, cfa_tile, mura_tile

CELL_UM = 24.0
PATTERN = TypeAdapter(AnyPattern)
RANDOM = [
    "random_rgbw",
    "random_binary",
    "uniform_colour",
    "gaussian_colour",
    "gaussian_monochrome",
]
SPECIFICATIONS = {
    "open": {},
    "pinhole": {"side_cells": 3},
    **{kind: {} for kind in RANDOM},
    "sinusoids": {"cycles_per_mm": [[2.0, 1.0], [0.0, 5.0]]},
    "mura": {"prime": 7},
    "tile": {"cells": [[0, 0.25], [0.5, 1]]},
}


def pattern(kind, **settings):
    return PATTERN.validate_python({"kind": kind, **settings})


def drawn(kind, frames=1, rows=200, columns=300, **settings):
    return pattern(kind, **settings).draw(frames, rows, columns, CELL_UM)


@pytest.mark.parametrize("kind", SPECIFICATIONS)
@pytest.mark.parametrize("frames", [1, 3])
def test_a_mask_is_drawn_as_large_as_asked_with_transmittance_between_0_and_1(kind, frames):
    cells = drawn(kind, frames, 13, 17, **SPECIFICATIONS[kind])
    assert cells.shape == (frames, 13, 17, 3)
    assert cells.dtype == np.float32
    assert cells.min() >= 0
    assert cells.max() <= 1


@pytest.mark.parametrize("kind", RANDOM)
def test_another_seed_draws_another_mask(kind):
    assert (drawn(kind, seed=1) != drawn(kind, seed=2)).mean() > 0.4


@pytest.mark.parametrize("kind", RANDOM)
def test_a_redrawn_mask_differs_in_every_shot_and_a_fixed_one_is_drawn_once(kind):
    assert pattern(kind).frame_count(3) == 1
    redrawn = pattern(kind, redraw=True)
    assert redrawn.frame_count(3) == 3
    cells = redrawn.draw(3, 50, 60, CELL_UM)
    for item, other in [(0, 1), (0, 2), (1, 2)]:
        assert (cells[item] != cells[other]).mean() > 0.4
    np.testing.assert_array_equal(cells[:2], redrawn.draw(2, 50, 60, CELL_UM))


@pytest.mark.parametrize("kind", RANDOM)
def test_a_larger_random_plate_is_the_same_plate_with_more_cells_around_it(kind):
    for rows, columns in [(12, 17), (13, 18)]:
        small = drawn(kind, 2, rows, columns, redraw=True)
        large = drawn(kind, 3, rows + 8, columns + 14, redraw=True)
        np.testing.assert_array_equal(large[:2, 4:-4, 7:-7], small)


def assert_mean(values, mean, deviation, sigmas=4.5):
    """Check a sample mean against theory, in standard errors."""
    assert abs(values.mean() - mean) < sigmas * deviation / np.sqrt(values.size)


def test_rgbw_filters_are_equally_likely_and_pass_half_of_the_light():
    cells = drawn("random_rgbw")[0]
    for letter in [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]:
        assert_mean((cells == letter).all(axis=-1), 0.25, np.sqrt(0.25 * 0.75))
    for colour in range(3):
        assert_mean(cells[..., colour], 0.5, 0.5)


@pytest.mark.parametrize("probability", [0.1, 0.5, 0.8, 1.0])
def test_a_binary_mask_is_open_with_its_probability_in_all_colours_alike(probability):
    cells = drawn("random_binary", open_probability=probability)[0]
    assert set(np.unique(cells)) <= {0.0, 1.0}
    assert (cells == cells[..., :1]).all()
    deviation = np.sqrt(probability * (1 - probability)) + 1e-9
    assert_mean(cells[..., 0], probability, deviation)


def test_uniform_colours_have_mean_a_half_variance_a_twelfth_and_are_independent():
    cells = drawn("uniform_colour")[0].astype(np.float64)
    assert_mean(cells, 0.5, np.sqrt(1 / 12))
    assert cells.var() == pytest.approx(1 / 12, rel=0.02)
    correlation = np.corrcoef(cells.reshape(-1, 3).T)
    assert np.abs(correlation - np.eye(3)).max() < 4.5 / np.sqrt(60_000)


@pytest.mark.parametrize("kind", ["gaussian_colour", "gaussian_monochrome"])
def test_gaussian_masks_have_their_mean_and_deviation(kind):
    cells = drawn(kind, mean=0.5, deviation=0.1)[0, ..., 0].astype(np.float64)
    assert_mean(cells, 0.5, 0.1)
    assert cells.std() == pytest.approx(0.1, rel=4.5 / np.sqrt(2 * cells.size))


def test_gaussian_colours_are_independent_and_gaussian_greys_equal():
    colour = drawn("gaussian_colour", deviation=0.1)[0].reshape(-1, 3)
    assert np.abs(np.corrcoef(colour.T) - np.eye(3)).max() < 4.5 / np.sqrt(60_000)
    grey = drawn("gaussian_monochrome")[0]
    assert (grey == grey[..., :1]).all()


def test_a_pinhole_moves_right_and_down_and_keeps_its_area_when_it_cuts_cells():
    cells = drawn("pinhole", 1, 9, 9, at_cells=(2, -1))[0, ..., 0]
    assert np.argwhere(cells).tolist() == [[3, 6]]
    cut = drawn("pinhole", 1, 9, 9, at_cells=(0.25, 0), side_cells=2)[0, ..., 0]
    assert cut.sum() == pytest.approx(4)
    np.testing.assert_allclose(cut[4], [0, 0, 0, 0.25, 1, 0.75, 0, 0, 0])
    np.testing.assert_allclose(cut[:, 4], [0, 0, 0, 0.5, 1, 0.5, 0, 0, 0])


def test_a_sum_of_sinusoids_holds_its_frequencies_and_no_others():
    rows, columns = 48, 60
    width_mm, height_mm = columns * CELL_UM * 1e-3, rows * CELL_UM * 1e-3
    waves = [(3, 0), (0, 5), (7, -4)]
    cells = drawn(
        "sinusoids",
        1,
        rows,
        columns,
        cycles_per_mm=[(m / width_mm, n / height_mm) for m, n in waves],
    )
    spectrum = np.abs(np.fft.fft2(cells[0, ..., 0].astype(np.float64))) / (rows * columns)
    expected = np.zeros((rows, columns))
    expected[0, 0] = 0.5
    for m, n in waves:
        expected[n % rows, m % columns] = expected[-n % rows, -m % columns] = 0.25 / len(waves)
    np.testing.assert_allclose(spectrum, expected, atol=1e-6)


@pytest.mark.parametrize("prime", [3, 5, 7, 11, 13, 31])
def test_the_periodic_correlation_of_a_mura_with_its_decoding_array_is_a_delta(prime):
    """Gottesman & Fenimore 1989: G is 1 where A is open, -1 elsewhere, but G(0, 0) = 1."""
    cells = drawn("mura", 1, 2 * prime, 2 * prime, prime=prime)[0, ..., 0].astype(np.float64)
    tile = cells[:prime, :prime]
    np.testing.assert_array_equal(tile, mura_tile(prime))
    decoding = 2 * tile - 1
    decoding[0, 0] = 1
    correlation = correlate(cells, decoding, mode="valid", method="direct")
    expected = np.zeros((prime + 1, prime + 1))
    expected[::prime, ::prime] = (prime**2 - 1) / 2
    np.testing.assert_allclose(correlation, expected, atol=1e-9)


def test_a_tile_repeats_from_the_corner():
    grey = [[0, 0.25, 1], [0.5, 0.75, 0]]
    cells = drawn("tile", 1, 5, 7, cells=grey)[0]
    expected = np.tile(np.array(grey), (3, 3))[:5, :7]
    np.testing.assert_array_equal(cells, np.repeat(expected[..., None], 3, axis=-1))


@pytest.mark.parametrize(
    ("cells", "complaint"),
    [
        ([[0, 1], [1]], "different lengths"),
        ([[0, 1.5]], r"\[0, 1\]"),
        ([[-0.1, 1]], r"\[0, 1\]"),
        ([[float("nan"), 1]], r"\[0, 1\]"),
        ([], "array of greys"),
        ([0, 1], "array of greys"),
        ([[[0, 1]]], "array of greys"),
        ([["clear", "dark"]], "numbers"),
        ([[{"grey": 1}]], "numbers"),
    ],
)
@pytest.mark.parametrize("kind", ["tile", "parameters"])
def test_cells_that_are_no_transmittance_are_refused(kind, cells, complaint):
    with pytest.raises(ValidationError, match=complaint):
        pattern(kind, cells=cells)


def test_parameters_are_drawn_as_given_whatever_is_asked():
    cells = np.random.default_rng(0).random((3, 4, 3))
    mask = drawn("parameters", 2, 50, 60, cells=cells.tolist())
    assert mask.shape == (2, 3, 4, 3)
    np.testing.assert_allclose(mask, np.stack([cells, cells]), rtol=1e-7)


def test_a_scan_opens_every_cell_once_row_by_row():
    scan = pattern("sequence", scan=(3, 2))
    assert scan.frame_count(1) == 6
    cells = scan.draw(6, 50, 60, CELL_UM)
    assert cells.shape == (6, 2, 3, 3)
    for frame in range(6):
        assert np.argwhere(cells[frame, ..., 1]).tolist() == [[frame // 3, frame % 3]]


def test_the_regions_of_a_sequence_are_its_frames():
    regions = [[[1, 0], [0, 0]], [[0, 1], [0.5, 0]], [[0, 0], [0, 1]]]
    sequence = pattern("sequence", regions=regions)
    assert sequence.frame_count(7) == 3
    np.testing.assert_array_equal(sequence.draw(7, 9, 9, CELL_UM)[..., 2], np.array(regions))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"scan": (2, 2), "regions": [[[1]]]},
        {"scan": (0, 2)},
        {"regions": [[0, 1]]},
        {"regions": [[[0, 2]]]},
    ],
)
def test_a_sequence_needs_either_a_scan_or_regions(settings):
    with pytest.raises(ValidationError):
        pattern("sequence", **settings)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_picture_comes_back_in_red_green_blue(tmp_path, dtype, channels):
    top = np.iinfo(dtype).max
    rng = np.random.default_rng(0)
    codes = rng.integers(0, top, (6, 9, channels), dtype=dtype, endpoint=True)
    path = tmp_path / "mask.png"
    red_first = codes[..., 0] if channels == 1 else codes[..., [2, 1, 0, 3][:channels]]
    assert cv2.imwrite(str(path), red_first)
    cells = drawn("picture", 2, 6, 9, path=str(path))
    assert cells.shape == (2, 6, 9, 3)
    expected = np.broadcast_to(codes[..., :3] / top, (2, 6, 9, 3))
    np.testing.assert_allclose(cells, expected, atol=1e-7)


def test_a_picture_is_repeated_only_when_asked(tmp_path):
    codes = np.arange(6, dtype=np.uint8).reshape(2, 3) * 50
    path = tmp_path / "mask.png"
    assert cv2.imwrite(str(path), codes)
    assert drawn("picture", 1, 5, 7, path=str(path)).shape == (1, 2, 3, 3)
    repeated = drawn("picture", 1, 5, 7, path=str(path), repeat=True)[0, ..., 0]
    np.testing.assert_allclose(repeated, np.tile(codes / 255, (3, 3))[:5, :7], atol=1e-7)


def test_a_file_that_is_no_picture_is_refused_in_one_line(tmp_path):
    text, empty = tmp_path / "mask.png", tmp_path / "empty.png"
    text.write_text("not a picture")
    empty.write_bytes(b"")
    for path, complaint in (
        (text, r"mask\.png: of an unknown format; formats read here are PNG"),
        (empty, r"empty\.png: empty; formats read here are PNG"),
        (tmp_path / "missing.png", r"missing\.png: no such file"),
        (tmp_path, "a folder, where a file is meant"),
    ):
        with pytest.raises(CameraError, match=complaint) as fault:
            drawn("picture", path=str(path))
        assert "\n" not in str(fault.value)


def test_a_picture_of_floats_holds_transmittances(tmp_path):
    path, cells = tmp_path / "mask.tiff", np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4)
    assert cv2.imwrite(str(path), cells)
    assert np.array_equal(drawn("picture", path=str(path))[0, ..., 0], cells)
    assert cv2.imwrite(str(path), cells - 0.5)
    with pytest.raises(CameraError, match="transmittances beyond 0 to 1"):
        drawn("picture", path=str(path))


PASSED = {"R": [1, 0, 0], "G": [0, 1, 0], "B": [0, 0, 1], "W": [1, 1, 1]}


def test_the_bayer_phases_read_as_their_names():
    for name in ("rggb", "grbg", "gbrg", "bggr"):
        expected = np.array([PASSED[letter.upper()] for letter in name]).reshape(2, 2, 3)
        np.testing.assert_array_equal(cfa_tile(name), expected)
        np.testing.assert_array_equal(cfa_tile(name.upper()), expected)


def test_every_row_and_column_of_x_trans_holds_all_colours():
    tile = cfa_tile("x-trans")
    assert (tile.sum(axis=0) > 0).all()
    assert (tile.sum(axis=1) > 0).all()
    assert (tile.sum(axis=-1) == 1).all()


def test_a_user_tile_is_read_row_by_row():
    expected = np.array([[PASSED[letter] for letter in row] for row in ("RWG", "BGW")])
    np.testing.assert_array_equal(cfa_tile(("RWG", "BGW")), expected)


@pytest.mark.parametrize(
    ("tile", "complaint"),
    [
        ("rgbb", "unknown CFA 'rgbb'.*rggb"),
        (("RG", "G"), "same number of filters"),
        ((), "same number of filters"),
        (("",), "same number of filters"),
        (("RX",), "'X' is not one of R G B W"),
        (("rg",), "is not one of R G B W"),
    ],
)
def test_a_bad_tile_is_refused(tile, complaint):
    with pytest.raises(CameraError, match=complaint):
        cfa_tile(tile)
