"""What all tests share: which optional checks this machine can run."""

import os
from pathlib import Path

import numpy as np
import pytest

from emmc_rig.model.sensing import ImagingMatrix


def pytest_collection_modifyitems(items):
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    if folder and Path(folder).is_dir():
        return
    reason = "EMMC_LIGHTFIELDS does not name a folder of real light fields"
    for item in items:
        if "real_data" in item.keywords:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def random_psi():
    """Return a maker of imaging matrices with random weights and colours."""

    def make(shots=1, views=(2, 3), size=(12, 18), stored=1, binning=1, seed=0):
        rng = np.random.default_rng(seed)
        weights = rng.uniform(0, 1, (shots, *views, size[0], stored, size[1])).astype(np.float32)
        colour = None
        if stored == 1:
            colour = rng.integers(0, 3, (shots, *size), dtype=np.uint8)
            if binning > 1:
                colour = colour[:, ::binning, ::binning].repeat(binning, 1).repeat(binning, 2)
        return ImagingMatrix(weights, colour, binning)

    return make
