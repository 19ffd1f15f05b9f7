"""Sobol points: those of SciPy, bit by bit."""

import numpy as np
import pytest
from scipy.stats.qmc import Sobol

from emmc_rig.simulators.sobol import AXES, sobol_points


@pytest.mark.parametrize("axes", range(1, AXES + 1))
@pytest.mark.parametrize("count", [1, 2, 8, 128])
def test_they_are_those_of_scipy(count, axes):
    theirs = Sobol(axes, rng=np.random.default_rng(5)).random(count)
    ours = sobol_points(count, axes, np.random.default_rng(5))
    np.testing.assert_array_equal(ours, theirs)


def test_every_axis_has_one_point_in_each_of_as_many_intervals():
    points = sobol_points(64, AXES, np.random.default_rng(1))
    for axis in range(AXES):
        assert sorted((64 * points[:, axis]).astype(int)) == list(range(64))
