"""Light fields: reading, writing, shearing, refocusing and comparing, against theory."""

import re
import shutil
from functools import partial
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from scipy.signal import correlate2d
from view_files import save_views

from emmc_rig.model.errors import SceneError
from emmc_rig.model.lightfield import (
    centre_view,
    check_light_field,
    epi_horizontal,
    focus_disparities,
    load_hdf5,
    load_views,
    psnr_db,
    save_hdf5,
    shear,
    ssim,
)

RNG_SEED = 7


def random_light_field(*shape: int) -> np.ndarray:
    return np.random.default_rng(RNG_SEED).random((*shape, 3), dtype=np.float32)


def texture(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A smooth colour picture, known at every real coordinate."""
    waves = (
        np.sin(0.31 * x + 0.17 * y) + np.sin(0.23 * y - 0.4 * x),
        np.sin(0.52 * y) + np.sin(0.45 * x),
        np.sin(0.37 * (x + y)) + np.cos(0.2 * x),
    )
    return np.stack([0.5 + 0.2 * w for w in waves], axis=-1).astype(np.float32)


def plane_light_field(
    disparity_px: float, views: tuple[int, int] = (5, 5), size: tuple[int, int] = (48, 64)
) -> np.ndarray:
    """A plane: a point at x in the centre view is at x + disparity (u - U // 2) in view u."""
    y, x = np.indices(size)
    return np.stack(
        [
            np.stack(
                [
                    texture(
                        y - disparity_px * (v - views[0] // 2),
                        x - disparity_px * (u - views[1] // 2),
                    )
                    for u in range(views[1])
                ]
            )
            for v in range(views[0])
        ]
    )


def write_png(path: Path, codes: np.ndarray) -> None:
    assert cv2.imwrite(str(path), codes)


def message_of(error: pytest.ExceptionInfo[SceneError]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


def test_psnr_counts_every_sample_once():
    truth = np.zeros((2, 2, 8, 8, 3), np.float32)
    estimate = truth.copy()
    assert psnr_db(estimate, truth) == float("inf")
    estimate[1, 0, 3, 4, 2] = 1
    assert psnr_db(estimate, truth) == pytest.approx(10 * np.log10(truth.size), abs=1e-9)


def test_ssim_agrees_with_the_definition_written_out():
    truth = random_light_field(2, 2, 17, 20)
    estimate = np.clip(truth + 0.2 * random_light_field(2, 2, 17, 20)[..., ::-1], 0, 1)
    offset = np.arange(11) - 5
    window = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(picture: np.ndarray) -> np.ndarray:
        return correlate2d(picture.astype(np.float64), window, mode="valid")

    values = []
    for v, u, c in np.ndindex(2, 2, 3):
        a, b = (lf[v, u, ..., c].astype(np.float64) for lf in (estimate, truth))
        ma, mb = mean(a), mean(b)
        va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
        values.append(
            (2 * ma * mb + 0.01**2)
            * (2 * cov + 0.03**2)
            / ((ma**2 + mb**2 + 0.01**2) * (va + vb + 0.03**2))
        )
    assert ssim(estimate, truth) == pytest.approx(float(np.mean(values)), abs=1e-9)


@pytest.mark.parametrize("compare", [psnr_db, ssim])
def test_light_fields_of_different_shapes_are_not_compared(compare):
    with pytest.raises(SceneError) as error:
        compare(random_light_field(2, 2, 12, 12), random_light_field(2, 2, 12, 13))
    assert "(2, 2, 12, 12, 3)" in message_of(error)
    assert "(2, 2, 12, 13, 3)" in message_of(error)


def test_ssim_refuses_views_smaller_than_its_window():
    small = random_light_field(2, 2, 10, 40)
    with pytest.raises(SceneError, match="11x11 pixels or more, these have 10x40"):
        ssim(small, small)


@pytest.mark.parametrize("views", [(3, 3), (4, 5), (2, 2)])
def test_the_centre_view_is_the_one_that_shearing_leaves_alone(views):
    lf = random_light_field(*views, 12, 14)
    np.testing.assert_allclose(centre_view(shear(lf, 1.37)), centre_view(lf), atol=1e-7)


def test_a_point_draws_a_line_of_slope_disparity_through_the_epi():
    lf = np.zeros((5, 5, 31, 33, 3), np.float32)
    y, x, disparity_px = 15, 16, -3
    for v, u in np.ndindex(5, 5):
        lf[v, u, y + disparity_px * (v - 2), x + disparity_px * (u - 2)] = 1
    across = epi_horizontal(lf, 2, y)
    assert across.shape == (5, 33, 3)
    np.testing.assert_array_equal(np.diff(across[..., 0].argmax(axis=1)), disparity_px)


def test_shearing_interpolates_a_parabola_exactly():
    """Catmull-Rom reproduces polynomials up to the second degree."""
    y, x = np.indices((20, 24)).astype(np.float64)

    def parabola(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        return 0.2 + 0.01 * x + 0.0008 * x * x + 0.0005 * y * y - 0.0004 * x * y

    lf = np.broadcast_to(parabola(y, x)[..., None], (3, 3, 20, 24, 3)).astype(np.float32)
    sheared = shear(lf, 1.3)[2, 0, 3:-3, 3:-3, 1]
    expected = parabola(y + 1.3, x - 1.3)[3:-3, 3:-3]
    np.testing.assert_allclose(sheared, expected, atol=3e-6)


def test_beyond_its_edge_a_view_continues_with_its_last_pixel():
    lf = random_light_field(3, 3, 8, 9)
    far = shear(lf, 1e6)
    assert np.all(far[1, 2] == lf[1, 2, :, -1:])
    assert np.all(far[0, 1] == lf[0, 1, :1])


def test_the_focus_of_two_planes_is_found_at_both():
    front, back = plane_light_field(1.5, size=(80, 100)), plane_light_field(-1.0, size=(80, 100))
    both = np.concatenate([back[:, :, :, :50], front[:, :, :, 50:]], axis=3)
    low, middle, high = focus_disparities(both)
    assert low == pytest.approx(-1.0, abs=0.15)
    assert high == pytest.approx(1.5, abs=0.15)
    assert low <= middle <= high


@pytest.mark.parametrize(
    ("array", "complaint"),
    [
        (np.zeros((2, 2, 8, 8, 3), np.int64), "values are int64"),
        (np.zeros((5, 5, 8, 8)), "shape (5, 5, 8, 8) is not (v, u, y, x, c)"),
        (np.zeros((1, 1, 8, 8, 3)), "1x1 views, needs two"),
        (np.zeros((2, 2, 8, 8, 4)), "4 colours, needs 3"),
        (np.zeros((2, 2, 0, 8, 3)), "0x8 pixels"),
    ],
)
def test_an_array_of_another_shape_or_type_is_no_light_field(array, complaint):
    with pytest.raises(SceneError) as error:
        check_light_field(array, "a.h5")
    assert message_of(error).startswith("a.h5: ")
    assert complaint in message_of(error)


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.25, 1.5])
def test_a_sample_outside_zero_to_one_is_named_with_its_place(value):
    lf = random_light_field(2, 3, 8, 9)
    lf[1, 2, 3, 4, 0] = value
    with pytest.raises(SceneError) as error:
        check_light_field(lf, "somewhere")
    assert "1 samples" in message_of(error)
    assert f"{value:.4g} at view (1, 2), y 3, x 4, colour 0" in message_of(error)


def test_views_come_back_from_a_folder_within_half_a_code(tmp_path):
    lf = random_light_field(3, 4, 10, 12)
    save_views(tmp_path / "new" / "views", lf)
    loaded = load_views(tmp_path / "new" / "views")
    assert loaded.shape == lf.shape
    assert loaded.dtype == np.float32
    assert np.abs(loaded - lf).max() <= 0.5 / 255 + 1e-6


def test_grey_pictures_become_three_equal_colours(tmp_path):
    codes = np.random.default_rng(RNG_SEED).integers(0, 256, (2, 2, 6, 7)).astype(np.uint8)
    for v, u in np.ndindex(2, 2):
        write_png(tmp_path / f"view_{v}_{u}.png", codes[v, u])
    loaded = load_views(tmp_path)
    for c in range(3):
        np.testing.assert_allclose(loaded[..., c], codes / 255, atol=1e-7)


def test_view_numbers_may_start_anywhere_and_have_leading_zeros(tmp_path):
    lf = random_light_field(2, 2, 6, 7)
    save_views(tmp_path, lf)
    expected = load_views(tmp_path)
    for v, u in np.ndindex(2, 2):
        (tmp_path / f"view_{v}_{u}.png").rename(tmp_path / f"view_{v + 9:02d}_{u + 9:02d}.png")
    np.testing.assert_array_equal(load_views(tmp_path), expected)


def test_an_opaque_alpha_channel_is_dropped(tmp_path):
    save_views(tmp_path, np.full((2, 2, 6, 7, 3), 0.5, np.float32))
    codes = np.full((6, 7, 4), 128, np.uint8)
    codes[..., 3] = 255
    write_png(tmp_path / "view_0_0.png", codes)
    np.testing.assert_allclose(load_views(tmp_path), 128 / 255, atol=1e-6)


def shortened(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


@pytest.mark.parametrize(
    ("views", "spoil", "complaint"),
    [
        (0, lambda folder: folder.rmdir(), r"views: no such folder"),
        (0, lambda folder: (folder / "IMG_0001.png").touch(), r"named view_ROW_COL\.png"),
        (
            3,
            lambda folder: [(folder / f"view_{place}.png").unlink() for place in ("0_2", "2_1")],
            r"2 of 3x3 views missing: view_0_2\.png, view_2_1\.png",
        ),
        (
            2,
            lambda folder: (folder / "view_1_1.png").rename(folder / "view_8_8.png"),
            r"77 of 9x9 views missing.* and 71 more",
        ),
        (
            2,
            lambda folder: shutil.copy(folder / "view_0_1.png", folder / "view_00_1.png"),
            r"are the same view",
        ),
        (
            2,
            lambda folder: (folder / "view_1_0.png").write_text("a letter"),
            r"view_1_0\.png: of an unknown format; formats read here are PNG",
        ),
        (2, lambda folder: shortened(folder / "view_0_1.png"), r"view_0_1\.png: a PNG picture cut"),
        (
            2,
            lambda folder: write_png(folder / "view_1_1.png", np.zeros((30, 41, 3), np.uint8)),
            r"view_1_1\.png: 30x41 pixels, but .* has 30x40",
        ),
    ],
)
def test_what_is_wrong_with_a_folder_of_views_is_named(tmp_path, views, spoil, complaint):
    folder = tmp_path / "views"
    folder.mkdir()
    if views:
        save_views(folder, random_light_field(views, views, 30, 40))
    spoil(folder)
    with pytest.raises(SceneError, match=complaint) as error:
        load_views(folder)
    assert message_of(error)


def test_a_light_field_comes_back_from_hdf5_exactly_with_its_attributes(tmp_path):
    lf = random_light_field(2, 3, 8, 9)
    path = tmp_path / "new" / "lf.h5"
    save_hdf5(path, lf, {"scene": "dragon", "seed": 4, "gain": 1.5})
    np.testing.assert_array_equal(load_hdf5(path), lf)
    with h5py.File(path) as file:
        assert dict(file["light_field"].attrs) == {"scene": "dragon", "seed": 4, "gain": 1.5}
    assert [p.name for p in path.parent.iterdir()] == ["lf.h5"]


def test_a_reconstruction_outside_zero_to_one_is_saved_clipped(tmp_path):
    lf = random_light_field(2, 2, 8, 9) * 1.2 - 0.1
    save_hdf5(tmp_path / "lf.h5", lf, {})
    np.testing.assert_array_equal(load_hdf5(tmp_path / "lf.h5"), np.clip(lf, 0, 1))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integer_codes_in_hdf5_are_divided_by_their_full_scale(tmp_path, dtype):
    top = np.iinfo(dtype).max
    codes = np.random.default_rng(RNG_SEED).integers(0, top, (2, 2, 6, 7, 3), endpoint=True)
    with h5py.File(tmp_path / "lf.h5", "w") as file:
        file["light_field"] = codes.astype(dtype)
    np.testing.assert_allclose(load_hdf5(tmp_path / "lf.h5"), codes / top, atol=1e-7)


def test_a_save_that_breaks_off_half_way_leaves_nothing_behind(tmp_path, monkeypatch):
    def disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", disk_full)
    with pytest.raises(SceneError, match=r"cannot be written.*No space left"):
        save_hdf5(tmp_path / "lf.h5", random_light_field(2, 2, 8, 9), {})
    assert list(tmp_path.iterdir()) == []


def write_nothing(path):
    pass


def write_other_datasets(path):
    with h5py.File(path, "w") as file:
        file["psi"] = np.zeros(3)
        file["a"] = 1


def write_text_as_light_field(path):
    with h5py.File(path, "w") as file:
        file["light_field"] = "hello"


def write_cut_short(path, kept):
    save_hdf5(path, random_light_field(2, 2, 20, 30), {})
    path.write_bytes(path.read_bytes()[:kept])


@pytest.mark.parametrize(
    ("write", "complaint"),
    [
        (write_nothing, "no such file"),
        (write_other_datasets, "no dataset 'light_field'; it holds a, psi"),
        (write_text_as_light_field, "no numbers"),
        (partial(write_cut_short, kept=0), "empty"),
        (partial(write_cut_short, kept=100), "cannot be read"),
        (partial(write_cut_short, kept=3000), "cannot be read"),
    ],
)
def test_an_hdf5_file_that_holds_no_light_field_is_one_clear_line(tmp_path, write, complaint):
    write(tmp_path / "lf.h5")
    with pytest.raises(SceneError) as error:
        load_hdf5(tmp_path / "lf.h5")
    assert re.search(rf"lf\.h5: .*{complaint}", message_of(error))
