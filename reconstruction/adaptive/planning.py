"""Which further shot would help most: the error to be expected with each, before it is taken.

A patch of known disparity and kind of texture is Gaussian (see `evidence`), so that its expected
error given any shots follows from their Psi alone (see `theory.patch`). It is averaged over patches
spread over the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.errors import ReconstructionError
from reconstruction.theory.patch import SIDE, PatchModel, Texture

Array = NDArray[np.floating]
PATCHES = 24


def patch_error(
    psi: ImagingMatrix,
    corner: tuple[int, int],
    disparity: float,
    amplitude: float,
    chroma: float,
    variance: float,
    prior: TexturePrior,
) -> float:
    """Return the expected squared error of a value in the middle of a patch.

    corner: (y, x), in samples, of SIDE x SIDE samples in pixels of k x k. amplitude: variance of
    luminance; chroma: that of a chrominance over it. variance: of a reading.
    """
    patch = PatchModel.of(psi, corner)
    return patch.expected(disparity, Texture(amplitude, chroma, prior), variance).error


def expected_errors(
    candidates: Sequence[ImagingMatrix],
    disparity: Array,
    kinds: Array,
    brightness: Array,
    variance: float,
    patches: int = PATCHES,
) -> NDArray[np.float64]:
    """Return the mean squared error to be expected with each candidate's shots, (candidate,).

    candidates: Psi of all shots taken and one more, each. disparity, brightness: (y, x) of the
    centre view. kinds: (y, x) indices of the textures in TexturePrior.kinds. Raises
    ReconstructionError for light fields smaller than a patch.
    """
    prior = TexturePrior()
    rows, columns = disparity.shape
    if min(rows, columns) < SIDE or SIDE % candidates[0].binning:
        raise ReconstructionError(
            f"a light field of {rows}x{columns} in pixels of {candidates[0].binning} samples "
            f"holds no patch of {SIDE}x{SIDE}"
        )
    across = max(1, round((patches * columns / rows) ** 0.5))
    down = max(1, patches // across)
    k = candidates[0].binning
    corners = [
        (int(y) // k * k, int(x) // k * k)
        for y in np.linspace(0, rows - SIDE, down)
        for x in np.linspace(0, columns - SIDE, across)
    ]
    errors = np.zeros(len(candidates))
    for corner in corners:
        middle = corner[0] + SIDE // 2, corner[1] + SIDE // 2
        amplitude, chroma = prior.kinds[int(kinds[middle])]
        for number, psi in enumerate(candidates):
            errors[number] += patch_error(
                psi,
                corner,
                float(disparity[middle]),
                amplitude * float(brightness[middle]) ** 2,
                chroma,
                variance,
                prior,
            )
    return errors / len(corners)
