"""A calibration against the truth of the simulated bench: error of Psi, coverage, geometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.whiteboard import Calibration
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.processing.bench import BenchTruth

Array = NDArray[np.floating]


def in_three_colours(values: Array, psi: ImagingMatrix) -> NDArray[np.float32]:
    """Return values shaped as Psi's weights for all three colours: 0 where it stores none."""
    if psi.colour is None:
        return np.asarray(values, dtype=np.float32)
    own = np.arange(3)[:, None] == psi.colour[:, None, None, :, None, :]
    return np.where(own, values, 0).astype(np.float32)


def _of_good(psi: ImagingMatrix, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return good.repeat(psi.binning, axis=0).repeat(psi.binning, axis=1)[:, None, :]


def true_error(psi: ImagingMatrix, true: Array, good: NDArray[np.bool_]) -> float:
    """Return |Psi - true| / |true| in three colours over the good pixels, Frobenius.

    true: (shot, v, u, y, colour, x). A colour that Psi does not store counts as 0.
    """
    chosen = _of_good(psi, good)
    off = np.where(chosen, in_three_colours(psi.weights, psi) - true, 0)
    return float(np.linalg.norm(off) / np.linalg.norm(np.where(chosen, true, 0)))


def stated_error(known: Calibration, good: NDArray[np.bool_]) -> float:
    """Return the relative error of Psi that a calibration states, as `true_error`."""
    chosen = _of_good(known.psi, good)
    off = np.where(chosen, known.deviation, 0)
    return float(np.linalg.norm(off) / np.linalg.norm(np.where(chosen, known.psi.weights, 0)))


def coverage(known: Calibration, true: Array, good: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the share of true coefficients within one and two stated deviations.

    Coefficients that are 0 in truth and in Psi do not count.
    """
    psi = known.psi
    chosen = np.broadcast_to(_of_good(psi, good), true.shape)
    off = np.abs(in_three_colours(psi.weights, psi) - true)
    stated = in_three_colours(known.deviation, psi)
    counted = chosen & ((true != 0) | (stated != 0))
    within = [float((off <= k * stated)[counted].mean()) for k in (1, 2)]
    return within[0], within[1]


def true_parameters(truth: BenchTruth) -> dict[str, float]:
    """Return the scalars of the placement that the simulated bench really has, where comparable.

    Its vignetting and falloff follow another law.
    """
    mounting, optics = truth.mounting, truth.optics
    return {
        "offset_x_um": mounting.offset_um[0],
        "offset_y_um": mounting.offset_um[1],
        "rotation_rad": float(np.deg2rad(mounting.rotation_deg)),
        "scale": mounting.stretch,
        "skew": mounting.skew,
        "distance_share": mounting.distance_share,
        "distortion_um": mounting.distortion_um,
        "blur_um": mounting.edge_blur_um,
        "clear": optics.clear,
        "leak": optics.leak,
    }
