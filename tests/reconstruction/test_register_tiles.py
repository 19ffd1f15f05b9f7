"""Tiles kept in registers against NumPy: sums, products, factors of many matrices side by side."""

import numpy as np
import pytest
from numba import njit

from emmc_rig.reconstruction.adaptive.register_tiles import (
    LANES,
    SIDE,
    combined,
    divided,
    factored,
    less_products,
    load_tile,
    meet,
    meet_too,
    multiplied,
    plus_diagonal,
    plus_outer,
    scatter_tile,
    store_tile,
    substitute,
    take_applied,
    zero_tile,
)

SIZE = SIDE * SIDE * LANES


@njit
def _sum_of_products(table, rows, vectors, terms, out):
    tile = zero_tile()
    for term in range(terms):
        tile = plus_outer(tile, table, rows, 1, term, vectors, term * LANES, terms * LANES)
    store_tile(tile, out, 0)


@njit
def _second_row(tiles, values, least):
    """Factor the tiles 11, 21, 22 of a matrix in its place; divide values by the factor."""
    tile = factored(load_tile(tiles, 0), least)
    substitute(tile, values, 0)
    store_tile(tile, tiles, 0)
    tile = divided(load_tile(tiles, SIZE), tiles, 0)
    take_applied(tile, values, 0, SIDE * LANES)
    store_tile(tile, tiles, SIZE)
    tile = less_products(load_tile(tiles, 2 * SIZE), tiles, SIZE, SIZE)
    tile = factored(tile, least)
    substitute(tile, values, SIDE * LANES)
    store_tile(tile, tiles, 2 * SIZE)


@njit
def _entries(tiles, mix, spots, out):
    """Combine a tile and its product with another; add to its diagonal; scatter its vectors."""
    loaded = load_tile(tiles, 0)
    tile = combined(loaded, multiplied(loaded, load_tile(tiles, SIZE)), mix)
    scatter_tile(plus_diagonal(tile, mix, 0), out, LANES, SIDE * LANES, spots, 1)


@njit
def _products(flat, out):
    meet(flat, 0, 2 * LANES, out, LANES)
    meet_too(flat, 4 * LANES, 0, out, LANES)


def test_entries_of_a_tile_are_scaled_and_scattered():
    rng = np.random.default_rng(2)
    tiles = rng.normal(size=(2, SIDE, SIDE, LANES)).astype(np.float32)
    mix = rng.normal(size=(SIDE, LANES)).astype(np.float32)
    columns = np.array([3, 0, 2, 1])
    out = np.zeros((1 + SIDE * SIDE, LANES), np.float32)
    _entries(tiles.reshape(-1), mix.reshape(-1), np.append(0, columns * LANES), out.reshape(-1))
    expected = tiles[0] * mix[0] + tiles[0] * tiles[1] * mix[1]
    expected[np.arange(SIDE), np.arange(SIDE)] += mix
    found = out[1:].reshape(SIDE, SIDE, LANES)[:, columns]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    assert not out[0].any()


def test_products_of_complex_numbers_are_added():
    rng = np.random.default_rng(3)
    parts = rng.normal(size=(3, 2, LANES)).astype(np.float32)
    out = np.full((3, LANES), np.nan, np.float32)
    _products(parts.reshape(-1), out.reshape(-1))
    a, b, c = parts[:, 0] + 1j * parts[:, 1]
    expected = a * b.conj() + c * a.conj()
    np.testing.assert_allclose(out[1] + 1j * out[2], expected, rtol=1e-5, atol=1e-5)


def test_a_tile_of_sums_is_a_matrix_product():
    rng = np.random.default_rng(0)
    table = rng.normal(size=(7, 5)).astype(np.float32)
    vectors = rng.normal(size=(SIDE, 5, LANES)).astype(np.float32)
    chosen = np.array([6, 2, 0, 5, 2])
    out = np.empty((SIDE, SIDE, LANES), np.float32)
    _sum_of_products(table.ravel(), chosen * 5, vectors.ravel(), 5, out.ravel())
    np.testing.assert_allclose(
        out, np.einsum("rt,ctl->rcl", table[chosen[1:]], vectors), rtol=1e-5, atol=1e-5
    )


def test_tiles_of_a_matrix_make_its_cholesky_factor_and_solve_with_it():
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(LANES, 2 * SIDE, 3 * SIDE))
    matrices = roots @ roots.transpose(0, 2, 1)
    given = rng.normal(size=(2 * SIDE, LANES)).astype(np.float32)
    first, two = slice(0, SIDE), slice(SIDE, 2 * SIDE)
    parts = [(first, first), (two, first), (two, two)]
    tiles = np.empty((3, SIDE, SIDE, LANES), np.float32)
    for tile, part in zip(tiles, parts, strict=True):
        tile[:] = matrices[:, *part].transpose(1, 2, 0)
    values = given.copy()
    _second_row(tiles.reshape(-1), values.reshape(-1), np.float32(1e-12))
    factors = np.linalg.cholesky(matrices)
    found = np.zeros_like(factors)
    for tile, part in zip(tiles, parts, strict=True):
        found[:, *part] = tile.transpose(2, 0, 1)
    diagonal = np.arange(2 * SIDE)
    found[:, diagonal, diagonal] **= -1
    np.testing.assert_allclose(np.tril(found), factors, rtol=1e-3, atol=1e-4)
    solved = np.linalg.solve(factors, given.T[..., None])[..., 0].T
    np.testing.assert_allclose(values, solved, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("square", [-1.0, 0.0])
def test_a_pivot_is_at_least_what_is_asked(square):
    tiles = np.zeros((3, SIDE, SIDE, LANES), np.float32)
    tiles[::2, np.arange(SIDE), np.arange(SIDE)] = square
    _second_row(tiles.reshape(-1), np.zeros(2 * SIDE * LANES, np.float32), np.float32(0.25))
    np.testing.assert_allclose(tiles[::2, np.arange(SIDE), np.arange(SIDE)], 2.0)
