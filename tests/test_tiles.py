"""Tiles: they cover the light field once, and the result does not depend on how it is tiled."""

import h5py
import numpy as np
import pytest

from emmc_rig.model.errors import SensingError
from reconstruction.dictionary import dct_dictionary
from reconstruction.errors import ReconstructionError
from reconstruction.methods import MethodSettings
from reconstruction.sparse import SparseSettings
from reconstruction.tiles import SavedPsi, reconstruct_in_tiles, tiles
from reconstruction.tv import TVSettings

VIEWS = (2, 2)


@pytest.mark.parametrize(
    ("tile", "overlap", "multiple"), [(7, 3, 1), (10, 4, 5), (16, 5, 4), (99, 8, 2)]
)
def test_inner_parts_cover_every_sample_once_and_lie_in_their_tiles(tile, overlap, multiple):
    size = (40, 60)
    seen = np.zeros(size, dtype=int)
    for place in tiles(size, tile, overlap, multiple):
        seen[place.inner] += 1
        for inner, outer, whole in zip(place.inner, place.outer, size, strict=True):
            assert outer.start % multiple == 0
            assert outer.start == 0 or inner.start - outer.start >= overlap
            assert outer.stop == whole or outer.stop - inner.stop >= overlap
    np.testing.assert_array_equal(seen, 1)


def scene(random_psi, binning=1):
    size = (36, 160)
    psi = random_psi(2, VIEWS, size, binning=binning)
    y, x = np.mgrid[: size[0], : size[1]] / 12
    picture = 0.5 + 0.3 * np.sin(x + np.sin(y))[..., None] * np.array([1, 0.5, -0.5])
    truth = np.broadcast_to(picture.astype(np.float32), psi.light_field_shape)
    noise = np.random.default_rng(0).normal(0, 0.01, psi.frames_shape)
    return psi, (psi.forward(truth) + noise).astype(np.float32)


@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize("method", ["tv", "dict-omp", "tv-dict"])
def test_the_tiling_changes_the_result_by_less_than_a_ten_thousandth(random_psi, method, binning):
    psi, frames = scene(random_psi, binning)
    dictionary = dct_dictionary(VIEWS, (4, 4))
    settings = MethodSettings(tv=TVSettings(max_steps=60), sparse=SparseSettings(stride=2))
    found = []
    for tile in (1000, 40):
        out = np.full(psi.light_field_shape, np.nan, dtype=np.float32)
        reconstruct_in_tiles(method, psi, frames, 0.01, out, dictionary, settings, tile=tile)
        found.append(out)
    assert np.isfinite(found[1]).all()
    assert np.abs(found[0] - found[1]).max() < 1e-4


def test_seams_show_without_overlap(random_psi):
    psi, frames = scene(random_psi)
    settings = MethodSettings(tv=TVSettings(max_steps=60))
    whole, cut = np.empty((2, *psi.light_field_shape), dtype=np.float32)
    reconstruct_in_tiles("tv", psi, frames, 0.01, whole, None, settings, tile=1000)
    reconstruct_in_tiles("tv", psi, frames, 0.01, cut, None, settings, tile=40, overlap=0)
    assert np.abs(whole - cut).max() > 1e-3


def test_psi_is_read_from_its_file_window_by_window(random_psi, tmp_path):
    psi, frames = scene(random_psi, binning=2)
    psi.save(tmp_path / "psi.h5")
    saved = SavedPsi(tmp_path / "psi.h5")
    assert (saved.size, saved.binning) == (psi.size, 2)
    part, expected = (source.window(slice(4, 20), slice(10, 30)) for source in (saved, psi))
    np.testing.assert_array_equal(part.weights, expected.weights)
    np.testing.assert_array_equal(part.colour, expected.colour)
    outs = np.empty((2, *psi.light_field_shape), dtype=np.float32)
    for out, source in zip(outs, (psi, saved), strict=True):
        reconstruct_in_tiles("tv", source, frames, 0.01, out, tile=40)
    np.testing.assert_array_equal(outs[0], outs[1])


def test_results_go_straight_into_a_file_and_progress_is_told(random_psi, tmp_path):
    psi, frames = scene(random_psi)
    told = []
    with h5py.File(tmp_path / "out.h5", "w") as file:
        out = file.create_dataset("light_field", psi.light_field_shape, "f4")
        results = reconstruct_in_tiles(
            "tv", psi, frames, 0.01, out, tile=60, on_tile=lambda done, of: told.append((done, of))
        )
        assert np.isfinite(out[()]).all()
        assert out[()].std() > 0.01
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert [r.light_field.size for r in results] == [0, 0, 0]


def test_a_tile_without_usable_pixels_is_left_dark(random_psi):
    psi, frames = scene(random_psi)
    usable = np.ones(psi.frames_shape, dtype=bool)
    usable[:, :, :100] = False
    out = np.empty(psi.light_field_shape, dtype=np.float32)
    reconstruct_in_tiles("tv", psi, frames, 0.01, out, usable=usable, tile=40, overlap=10)
    assert not out[:, :, :, :40].any()
    assert out[:, :, :, 120:].any()


def test_tiles_and_windows_that_cannot_be_are_refused(random_psi, tmp_path):
    psi, frames = scene(random_psi, binning=2)
    out = np.empty(psi.light_field_shape, dtype=np.float32)
    with pytest.raises(ReconstructionError, match="tiles of 0"):
        reconstruct_in_tiles("tv", psi, frames, 0.01, out, tile=0)
    with pytest.raises(ReconstructionError, match="no usable pixel"):
        reconstruct_in_tiles("tv", psi, frames, 0.01, out, usable=np.zeros(frames.shape, bool))
    with pytest.raises(SensingError, match="cuts pixels"):
        psi.window(slice(1, 5), slice(0, 4))
    (tmp_path / "psi.h5").write_bytes(b"no")
    with pytest.raises(SensingError, match="cannot be read"):
        SavedPsi(tmp_path / "psi.h5")
