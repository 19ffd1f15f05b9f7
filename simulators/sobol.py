"""Scrambled Sobol points: the first of SciPy's `qmc.Sobol`, without the second its import takes.

The direction numbers are those of Joe and Kuo, "Constructing Sobol sequences with better
two-dimensional projections", SIAM J. Sci. Comput. 30 (2008), 2635-2654; the scrambling, a random
linear one of the digits and a shift, that of Matousek, "On the L2-discrepancy for anchored boxes",
J. Complexity 14 (1998), 527-556.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 30
_POLYNOMIALS = (
    (1, ()),
    (3, (1,)),
    (7, (1, 3)),
    (11, (1, 3, 1)),
    (13, (1, 1, 1)),
    (19, (1, 1, 3, 3)),
)
"""Of each axis: the polynomial over GF(2), a bit a coefficient, and the first direction numbers."""
AXES = len(_POLYNOMIALS)


def sobol_points(count: int, axes: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the first points of a sequence scrambled by rng: (count, axes), in [0, 1).

    count: best a power of two, for balance. axes: at most AXES.
    """
    own = rng.spawn(1)[0]
    powers = 1 << np.arange(_BITS, dtype=np.int64)
    shift = own.integers(2, size=(axes, _BITS), dtype=np.uint32) @ powers
    scrambling = np.tril(own.integers(2, size=(axes, _BITS, _BITS), dtype=np.uint32), -1)
    scrambling = scrambling.astype(np.int64) + np.eye(_BITS, dtype=np.int64)
    points = np.empty((count, axes), dtype=np.int64)
    order = np.arange(count - 1)
    lowest_zero = np.log2(~order & (order + 1)).astype(int)
    for axis in range(axes):
        digits = (_directions(axis)[:, np.newaxis] >> np.arange(_BITS)[::-1]) & 1
        scrambled = ((digits @ scrambling[axis].T) % 2) @ powers[::-1]
        # In the order of the Gray code: each point differs from the one before by one direction.
        points[0, axis] = shift[axis]
        points[1:, axis] = scrambled[lowest_zero]
    return np.bitwise_xor.accumulate(points, axis=0) / (1 << _BITS)


def _directions(axis: int) -> NDArray[np.int64]:
    """Return the direction numbers (_BITS,) of an axis, as integers below 2^_BITS."""
    polynomial, first = _POLYNOMIALS[axis]
    degree = len(first)
    if not degree:
        numbers = [1] * _BITS
    else:
        numbers = list(first)
        for n in range(degree, _BITS):
            number = numbers[n - degree]
            for k in range(1, degree + 1):
                if polynomial >> (degree - k) & 1:
                    number ^= numbers[n - k] << k
            numbers.append(number)
    return np.array([number << (_BITS - 1 - n) for n, number in enumerate(numbers)])
