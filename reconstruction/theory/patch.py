"""A patch of Psi under a Gaussian texture at a known disparity: what is known of it, exactly.

The rays r of a patch see a texture on a plane at disparity d: r ~ N(0, K_d), in opponent colours
(see `adaptive.evidence`), and its readings are y = Psi r + n, n ~ N(0, N). With the covariance
S = Psi K_d Psi^T + N of the readings, the posterior mean of rays t is G y, G = K_t Psi^T S^-1, and
errs by K_tt - G Psi K_t (Kay 1993, Estimation Theory, theorem 10.2). No estimator has less mean
square error: for this linear Gaussian model the Bayesian Cramer-Rao bound (Van Trees 1968, section
2.4) is met with equality. How much of the error is the readings' noise: |G n|^2, per unit of it the
mean square of G's rows, which is also the derivative of the error by the noise's variance, since G
is the best there is (envelope theorem).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]
SIDE = 8
TARGETS = 4
"""Samples a side, in the middle of a patch, whose error counts."""


@dataclass(frozen=True)
class Texture:
    """amplitude: variance of luminance. chroma: that of a chrominance over it.

    mean_known: the patch's mean colour is known; its deviation from it is modelled.
    """

    amplitude: float
    chroma: float
    mean_known: bool = False
    prior: TexturePrior = field(default_factory=TexturePrior)

    @property
    def variances(self) -> NDArray[np.float64]:
        """Of the opponent colours, (3,)."""
        return self.amplitude * np.array([1.0, self.chroma, self.chroma])


@dataclass(frozen=True)
class Expected:
    """What the posterior mean of a patch's middle does; all per value of the light field.

    error: its mean squared error. prior: that of knowing no reading. noise_gain: root mean square
    error per deviation of a reading's noise. degrees_of_freedom: those that the readings determine,
    trace(Psi K Psi^T S^-1), of as many as there are readings.
    """

    error: float
    prior: float
    noise_gain: float
    degrees_of_freedom: float


@lru_cache(maxsize=8)
def _separations(
    views: tuple[int, int], side: int
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Return rays (ray, 4), the number of each pair's separation, and the separations (n, 4).

    All as y, x, v, u.
    """
    v, u, y, x = (axis.ravel() for axis in np.indices((*views, side, side)))
    rays = np.stack([y, x, v - views[0] // 2, u - views[1] // 2], axis=1)
    reach = np.array([side, side, *views]) - 1
    spans = 2 * reach + 1
    number = np.zeros((len(rays), len(rays)), dtype=np.int32)
    for axis in range(4):
        apart = rays[:, None, axis] - rays[None, :, axis] + reach[axis]
        number = number * np.int32(spans[axis]) + apart.astype(np.int32)
    kinds = np.stack([axis.ravel() for axis in np.indices(tuple(spans))], axis=1) - reach
    return rays, number, kinds


def _about(texture: Texture, correlation: Array) -> NDArray[np.float64]:
    """Return a correlation of rays, or that of their departures from their mean, (ray, ray)."""
    if not texture.mean_known:
        return np.asarray(correlation, np.float64)
    rows = correlation.mean(axis=1)
    return np.asarray(correlation - rows[:, None] - rows + rows.mean(), np.float64)


@dataclass(frozen=True, eq=False)
class PatchModel:
    """opponent: (opponent colour, reading, ray), Psi of the patch. views: rows and columns.

    Readings are ordered as (shot, pixel_y, pixel_x), rays as (v, u, y, x).
    """

    opponent: NDArray[np.float64]
    views: tuple[int, int]
    side: int

    @classmethod
    def of(cls, psi: ImagingMatrix, corner: tuple[int, int], side: int = SIDE) -> PatchModel:
        """Return the patch of side x side samples at a corner (y, x).

        Raises SensingError when it cuts a pixel, ReconstructionError when it leaves the picture.
        """
        if any(at < 0 or at + side > size for at, size in zip(corner, psi.size, strict=True)):
            raise ReconstructionError(
                f"a patch of {side}x{side} samples at {corner} leaves a light field of "
                f"{psi.size[0]}x{psi.size[1]}"
            )
        rows, columns = (slice(at, at + side) for at in corner)
        part, k = psi.window(rows, columns), psi.binning
        views = part.light_field_shape[0], part.light_field_shape[1]
        v, u, y, x = (axis.ravel() for axis in np.indices((*views, side, side)))
        rays = np.zeros((psi.shots, side // k, side // k, 3, len(y)))
        for shot in range(psi.shots):
            for kind in range(part.weights.shape[4]):
                colour = kind if part.colour is None else part.colour[shot, y, x]
                seen = part.weights[shot, v, u, y, kind, x]
                rays[shot, y // k, x // k, colour, np.arange(len(y))] = seen
        opponent = np.einsum("oc,mcr->omr", OPPONENT, rays.reshape(-1, 3, len(y)), optimize=True)
        return cls(np.ascontiguousarray(opponent), views, side)

    @property
    def readings(self) -> int:
        """How many there are."""
        return self.opponent.shape[1]

    @property
    def rays(self) -> NDArray[np.int64]:
        """y, x, v and u of the rays, (ray, 4); views are counted from the centre view."""
        return _separations(self.views, self.side)[0]

    @cached_property
    def middle(self) -> NDArray[np.int64]:
        """The rays whose error counts: of all views, in the middle of the patch."""
        rays = self.rays
        first = (self.side - TARGETS) // 2
        inner = (rays[:, :2] >= first).all(axis=1) & (rays[:, :2] < first + TARGETS).all(axis=1)
        return np.flatnonzero(inner)

    def alike(self, disparity: float, texture: Texture) -> NDArray[np.float64]:
        """Return the correlation of the rays at a disparity, (ray, ray)."""
        _, number, kinds = _separations(self.views, self.side)
        apart = kinds[:, :2] - disparity * kinds[:, 2:]
        return _about(texture, texture.prior.covariance(np.square(apart).sum(axis=1))[number])

    def alike_slope(self, disparity: float, texture: Texture) -> NDArray[np.float64]:
        """Return the derivative of `alike` by the disparity, (ray, ray)."""
        _, number, kinds = _separations(self.views, self.side)
        apart = kinds[:, :2] - disparity * kinds[:, 2:]
        faster = -2 * (apart * kinds[:, 2:]).sum(axis=1)
        slope = texture.prior.slope(np.square(apart).sum(axis=1)) * faster
        return _about(texture, slope[number])

    def signal(self, alike: Array, texture: Texture) -> NDArray[np.float64]:
        """Return Psi K Psi^T of rays so correlated, (reading, reading)."""
        return self._through(self._seen(alike), texture)

    @cached_property
    def _sparse(self) -> list[sparse.csr_array]:
        """Psi in each opponent colour: a reading sums few of the rays."""
        return [sparse.csr_array(axis) for axis in self.opponent]

    def _seen(self, alike: Array) -> list[NDArray[np.float64]]:
        """Return Psi times the correlation of rays, (reading, ray) for each opponent colour."""
        return [np.asarray(axis @ alike) for axis in self._sparse]

    def _through(self, seen: list[NDArray[np.float64]], texture: Texture) -> NDArray[np.float64]:
        each = (
            size * (axis @ near.T)
            for size, near, axis in zip(texture.variances, seen, self._sparse, strict=True)
        )
        return np.sum(list(each), axis=0)

    def expected(self, disparity: float, texture: Texture, variance: Array | float) -> Expected:
        """Return what to expect of the middle. variance: of the readings, (reading,) or one."""
        alike = self.alike(disparity, texture)
        seen = self._seen(alike)
        signal = self._through(seen, texture)
        factor = cho_factor(signal + np.diag(np.broadcast_to(variance, self.readings)))
        explained = gain = 0.0
        for size, near in zip(texture.variances, seen, strict=True):
            cross = size * near[:, self.middle]
            weights = cho_solve(factor, cross)
            explained += float(np.mean(np.sum(cross * weights, axis=0)))
            gain += float(np.mean(np.sum(np.square(weights), axis=0)))
        prior = float(texture.variances.sum() * np.diag(alike)[self.middle].mean())
        degrees = float(np.trace(cho_solve(factor, signal)))
        return Expected((prior - explained) / 3, prior / 3, (gain / 3) ** 0.5, degrees)

    def estimate(
        self, disparity: float, texture: Texture, variance: Array | float, readings: Array
    ) -> NDArray[np.float64]:
        """Return the posterior mean of the middle's rays, (..., ray, c) in RGB.

        readings: (..., reading).
        """
        seen = self._seen(self.alike(disparity, texture))
        covariance = self._through(seen, texture)
        covariance += np.diag(np.broadcast_to(variance, self.readings))
        wanted = np.asarray(readings, dtype=np.float64)
        solved = cho_solve(cho_factor(covariance), wanted.reshape(-1, self.readings).T).T
        found = [
            size * solved @ near[:, self.middle]
            for size, near in zip(texture.variances, seen, strict=True)
        ]
        rays = np.stack(found, axis=-1) @ OPPONENT
        return rays.reshape(*wanted.shape[:-1], len(self.middle), 3)
