"""Taps of single rays against NumPy."""

import numpy as np
import pytest
from numba import njit

from emmc_rig.reconstruction.adaptive.lanes import TAPS, add_taps, read_taps

WIDE, AT = 40, 87


@njit
def reads_taps(texture, fraction_y, fraction_x):
    return read_taps(texture, AT, WIDE, fraction_y, fraction_x)


@njit
def adds_taps(texture, fraction_y, fraction_x, value):
    add_taps(texture, AT, WIDE, fraction_y, fraction_x, value)


@pytest.mark.parametrize("fractions", [(0.0, 0.0), (0.3, 0.9), (1.0, 0.5)])
def test_taps_are_those_of_catmull_and_rom_and_their_adjoint(fractions):
    def weights(t):
        """The cubic through four values that has their central differences as slopes."""
        at = np.array([1, t, t**2, t**3])
        hermite = np.array([[1, 0, -3, 2], [0, 0, 3, -2], [0, 1, -2, 1], [0, 0, -1, 1]])
        ends_and_slopes = np.array(
            [[0, 1, 0, 0], [0, 0, 1, 0], [-0.5, 0, 0.5, 0], [0, -0.5, 0, 0.5]]
        )
        return (hermite @ at) @ ends_and_slopes

    both = np.outer(weights(fractions[0]), weights(fractions[1]))
    texture = np.random.default_rng(0).normal(size=12 * WIDE).astype(np.float32)
    top, left = divmod(AT, WIDE)
    part = np.s_[top : top + TAPS, left : left + TAPS]
    seen = (both * texture.reshape(-1, WIDE)[part]).sum()
    down, right = np.float32(fractions[0]), np.float32(fractions[1])
    assert reads_taps(texture, down, right) == pytest.approx(seen, rel=1e-4, abs=1e-5)
    expected = texture.copy()
    expected.reshape(-1, WIDE)[part] += 0.7 * both
    adds_taps(texture, down, right, np.float32(0.7))
    np.testing.assert_allclose(texture, expected, rtol=1e-5, atol=1e-5)
