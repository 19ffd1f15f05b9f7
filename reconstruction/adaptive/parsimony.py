"""Model no more than the whole scene needs: one plane for all views, or no colour, where they do.

One plane has three numbers where a disparity for each patch has thousands; it is taken when next to
no patch speaks against it, and disparity 0, one picture for all views, before any other. A scene is
taken to be grey when a grey texture predicts held-out readings as well as a coloured one. What is
left out is reported, with the PSNR that leaving it out allows at best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.search import DECISIVE, Volume

Array = NDArray[np.floating]
UNLIKELY = 20.0
"""Log-likelihood, below its patch's best, of disparities not evaluated, or that are no better. 2x
0.00, 0.5x 0.00 dB."""
UNSERVED = 0.01
"""Share of the deciding patches that may prefer a disparity of their own decisively, one at least:
by chance (chi squared, one degree of freedom) it is 0.16 % of them, one of 64 in a tenth of scenes.
2x 0.00, 0.5x 0.00 dB."""
GREY_RMS = 0.02
"""Chrominance of the smooth picture, over its brightness, above which colour is not in question. 2x
0.00, 0.5x 0.00 dB."""
PROOF = 3.0
"""Standard errors by which colour must explain held-out readings better to be needed. 2x 0.00, 0.5x
0.00 dB."""


@dataclass(frozen=True)
class Plane:
    """The whole scene's disparity: `middle` + `down` y + `right` x, of pixels from the centre."""

    middle: float
    down: float
    right: float

    @property
    def is_static(self) -> bool:
        """Whether all views are one picture."""
        return self.middle == self.down == self.right == 0

    def over(self, size: tuple[int, int], binning: int) -> NDArray[np.float32]:
        """Return the disparity of every sample (y, x)."""
        y, x = (
            ((np.arange(n, dtype=np.float32) + 0.5) / binning - 0.5 - (n / binning - 1) / 2)
            for n in size
        )
        return (self.middle + self.down * y[:, None] + self.right * x).astype(np.float32)


def one_plane(volume: Volume, pixels: tuple[int, int]) -> Plane | None:
    """Return the plane that serves all patches, if there is one.

    It does when next to no patch prefers a disparity of its own. pixels: rows and columns of the
    frames.
    """
    labels = volume.disparities
    decisive = volume.decisive
    if len(labels) < 2 or not decisive.any():
        return None
    best = volume.evidence.max(axis=-1, keepdims=True)
    lost = np.minimum(best - volume.evidence, UNLIKELY)[decisive].astype(np.float64)
    # Labels that no patch looked at are missing: between, and beyond, all are unlikely.
    step = np.diff(labels).min()
    place = np.rint((labels - labels[0]) / step).astype(np.int64) + 1
    unlikely = np.full((len(lost), place[-1] + 2), UNLIKELY)
    unlikely[:, place] = lost
    y, x = (at - (length - 1) / 2 for at, length in zip(volume.centres, pixels, strict=True))
    rows, columns = (axis[decisive] for axis in np.meshgrid(y, x, indexing="ij"))

    def losses(plane: Array) -> Array:
        wanted = plane[0] + plane[1] * rows + plane[2] * columns
        at = np.clip((wanted - labels[0]) / step + 1, 0, unlikely.shape[1] - 1)
        # A parabola through the three labels nearest: a straight line is least at a label.
        middle = np.clip(np.rint(at).astype(np.int64), 1, unlikely.shape[1] - 2)
        each, off = np.arange(len(rows)), at - middle
        below, here, above = (unlikely[each, middle + way] for way in (-1, 0, 1))
        return here + off / 2 * (above - below) + off**2 / 2 * (above - 2 * here + below)

    chosen = labels[lost.argmin(axis=-1)]
    begin = _fitted(chosen, rows, columns)
    steps = np.diag([0.1, 0.1 / max(y[-1] - y[0], 1), 0.1 / max(x[-1] - x[0], 1)])
    found = minimize(
        lambda plane: losses(plane).sum(),
        begin,
        method="Nelder-Mead",
        options={"initial_simplex": np.vstack([begin, begin + steps]), "maxiter": 200},
    ).x
    for plane in (np.zeros(3), found):
        if np.sum(losses(plane) > DECISIVE) <= max(1, UNSERVED * len(rows)):
            return Plane(*map(float, plane))
    return None


def _fitted(disparity: Array, rows: Array, columns: Array) -> Array:
    """Return middle, down and right of the plane of least absolute deviations (reweighted)."""
    system = np.stack([np.ones_like(rows), rows, columns], axis=-1)
    weight = np.ones(len(disparity))
    plane = np.zeros(3)
    for _ in range(12):
        root = np.sqrt(weight)
        plane = np.linalg.lstsq(system * root[:, None], disparity * root, rcond=None)[0]
        weight = 1 / np.maximum(np.abs(disparity - system @ plane), 0.02)
    return plane


def plane_bound_db(plane: Plane, volume: Volume, pixels: tuple[int, int], picture: Array) -> float:
    """Return the PSNR that the relief left out allows: what the patches' own disparities say.

    picture: (y, x, c), its slopes show what a wrong disparity costs.
    """
    mean = volume.probability @ volume.disparities
    rows, columns = (np.rint(at).astype(int) for at in volume.centres)
    flat = plane.over(pixels, 1)[np.ix_(rows, columns)]
    decided = np.square(mean - flat)[volume.decisive]
    relief = float(decided.mean()) if decided.size else 0.0
    steep = sum(float(np.square(np.gradient(picture, axis=axis)).mean()) for axis in (0, 1))
    return _decibels(relief * steep)


def _decibels(mean_square: float) -> float:
    return float(-10 * np.log10(max(mean_square, 1e-12)))


def _chroma_square(picture: Array) -> float:
    """Return the mean square of both chrominances over the three colours, of (y, x, c)."""
    return float(np.square(picture @ OPPONENT[1:].T.astype(picture.dtype)).sum(axis=-1).mean() / 3)


def may_be_grey(picture: Array) -> bool:
    """Return whether a smooth picture (y, x, c) has so little colour that it may have none."""
    return _chroma_square(picture) ** 0.5 < GREY_RMS * float(picture.mean())


def grey_bound_db(picture: Array) -> float:
    """Return the PSNR that leaving out the colours of a smooth picture (y, x, c) allows."""
    return _decibels(_chroma_square(picture))


def grey_psi(psi: ImagingMatrix) -> ImagingMatrix:
    """Return Psi of light fields of one colour: every pixel sees the first of the three."""
    shots, _, _, rows, _, columns = psi.weights.shape
    weights = np.ascontiguousarray(psi.weights.sum(axis=4, keepdims=True))
    return ImagingMatrix(weights, np.zeros((shots, rows, columns), np.uint8), psi.binning)


def colour_is_needed(coloured: Array, grey: Array) -> bool:
    """Return whether colour predicts the readings kept from both fits better, beyond chance.

    coloured, grey: what each misses of them, (reading,).
    """
    more = np.square(grey, dtype=np.float64) - np.square(coloured, dtype=np.float64)
    error = float(more.std()) / max(len(more), 1) ** 0.5
    return float(more.mean()) > PROOF * error
