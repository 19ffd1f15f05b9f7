"""Glare in readings and coefficients: put in by its definition, and taken out again."""

from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.glare import Glare

SHAPE = (12, 16)
FILTERS = np.add.outer(np.arange(12) % 2, np.arange(16) % 2).astype(np.uint8)
RNG = np.random.default_rng(0)
ELECTRONS = np.array([0.7, 1.0, 0.6])[FILTERS] * RNG.uniform(0.98, 1.02, SHAPE)
PASSED = RNG.uniform(0, 1, SHAPE)


def glare_of(in_front, behind):
    white = (1 - behind) * ELECTRONS + behind * ELECTRONS.mean()
    return Glare(in_front, behind, np.zeros((2, 2)), np.zeros((1, 2)), white, FILTERS)


def reading(in_front, behind):
    """Return what pixels read with glare, (y, x), as electrons scatter."""
    lit = PASSED.copy()
    for colour in range(3):
        same = colour == FILTERS
        lit[same] = (1 - in_front) * PASSED[same] + in_front * PASSED[same].mean()
    electrons = (1 - behind) * ELECTRONS * lit + behind * (ELECTRONS * lit).mean()
    return electrons / ((1 - behind) * ELECTRONS + behind * ELECTRONS.mean())


@pytest.mark.parametrize(("in_front", "behind"), [(0.02, 0.0), (0.0, 0.03), (0.02, 0.03)])
def test_glare_is_put_into_coefficients_and_taken_out_of_readings(in_front, behind):
    glare = glare_of(in_front, behind)
    weights = PASSED[None, None, None, :, None, :]
    assert glare.put_in(weights)[0, 0, 0, :, 0] == pytest.approx(reading(in_front, behind))
    seen = reading(in_front, behind).astype(np.float32)
    variance = np.full(SHAPE, 1e-6, np.float32)
    board = Board("", seen, variance, FILTERS, np.ones((1, 1), bool), (0.0, 0.0), 0)
    found = glare.taken_out(board)
    assert found.reading == pytest.approx(PASSED, abs=1e-6)
    assert (found.variance >= board.variance).all()


def test_pixels_that_do_not_count_have_no_part_in_the_mean():
    glare = glare_of(0.02, 0.03)
    seen, variance = reading(0.02, 0.03).astype(np.float32), np.full(SHAPE, 1e-6, np.float32)
    board = Board("", seen, variance, FILTERS, np.ones((1, 1), bool), (0.0, 0.0), 0)
    hot = np.zeros(SHAPE, bool)
    hot[3, 4] = True
    bright = replace(board.without(hot), reading=np.where(hot, np.float32(50), seen))
    off = np.abs(glare.taken_out(bright).reading - PASSED)[~hot]
    assert off.max() < 0.001
