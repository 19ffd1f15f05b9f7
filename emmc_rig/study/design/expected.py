"""What to expect of a camera before it is built: error and light, from Psi alone.

The error is that of textures on two surfaces half a sample of disparity apart, averaged over the
disparities to be seen, on periodic blocks: fast enough to search. It orders the default method's
PSNR: rank correlation 0.93 over 13 cameras with the mean of four scenes of group A, 96x96
(benchmarks/design_check.py).

A texture T on a plane at disparity d reaches the ray of view u through sample x as T(x - d u) (see
`adaptive.evidence`). On a torus of n x n samples T is a vector of n^2 values with a circulant prior
C, every view is T shifted, and readings are y = A_d T + noise with one small dense matrix

    A_d = sum over views of diag(Psi's weights) S,  S a shift by Fourier interpolation.

So 256 samples in each block know what lies 8 samples away, at a hundredth of the cost of the
covariance of their 6400 rays.

Where surfaces meet, or a disparity is not known, rays are the sum of two textures, each with half
the variance, at disparities d and e. The posterior mean of both, (T, T'), errs by
P = K - K A' S^-1 A K with K = diag(C, C) / 2, A = (A_d, A_e) and S = A K A' + N in each opponent
colour (Kay 1993, Estimation Theory, theorem 10.2), and the rays by trace(W P) / n^2, W the mean
over views of the shifts' products. At d = e this is the error of a single texture with a known
disparity. Errors of two textures separate cameras better, as benchmarks/design_check.py measures.

What rays hold that no texture on a plane explains (gloss, what is hidden) enters as a share `apart`
of the texture's variance, white over rays: it disturbs the readings and is not recovered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from emmc_rig.model.camera import Camera, pixel_light
from emmc_rig.model.geometry import fresnel_number
from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.evidence import TexturePrior
from emmc_rig.reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]
SIDE = 16
"""Samples of a block along each axis: even, as colour filters repeat every two."""
APART_PX = 0.5
"""Between the two surfaces, samples of disparity."""
PLACES = 3
"""Disparities of the nearer surface, evenly over what is to be seen."""
BRIGHTNESS = 0.35
"""Mean of the real scenes tuned on."""
SIZE = (2 * SIDE, 2 * SIDE)
CORNERS = ((0, 0), (SIDE, SIDE))
"""Of the blocks that stand for the picture: a random mask differs from place to place."""


@dataclass(frozen=True)
class SceneTexture:
    """variance: of luminance within a block. chroma: that of a chrominance over it.

    apart: share of a ray's variance that no texture on a plane explains.
    """

    variance: float = 0.02
    chroma: float = 0.06
    apart: float = 0.02
    prior: TexturePrior = field(default_factory=lambda: TexturePrior(length_px=6.0))

    @property
    def variances(self) -> NDArray[np.float64]:
        """Of the opponent colours, (3,)."""
        return self.variance * np.array([1.0, self.chroma, self.chroma])


TEXTURE = SceneTexture()


@lru_cache(maxsize=8)
def prior_covariance(prior: TexturePrior, side: int = SIDE) -> NDArray[np.float64]:
    """Return the covariance of a texture of variance 1 on the torus, (sample, sample).

    The prior's covariance at the distance around the torus, without what is negative in its
    spectrum; the mean of the block is taken as unknown but finite, with the variance that it has.
    """
    step = np.minimum(np.arange(side), side - np.arange(side))
    row = prior.covariance(np.add.outer(step**2, step**2).astype(float))
    spectrum = np.maximum(np.fft.fft2(row).real, 0)
    row = np.fft.ifft2(spectrum).real
    row /= row[0, 0]
    y, x = (axis.ravel() for axis in np.indices((side, side)))
    return row[(y[:, None] - y) % side, (x[:, None] - x) % side]


@lru_cache(maxsize=512)
def _shift(by: float, side: int) -> NDArray[np.float64]:
    """Return the matrix that carries T(x) to T(x - by) on a ring, (x, x)."""
    turned = np.exp(-2j * np.pi * np.fft.fftfreq(side) * by)
    # The highest frequency has no sign: its shifted value is real.
    turned[side // 2] = turned[side // 2].real
    column = np.fft.ifft(turned).real
    at = np.arange(side)
    return column[(at[:, None] - at) % side]


@dataclass(frozen=True, eq=False)
class Block:
    """A block of Psi: weights (opponent colour, v, u, shot, y, x), on a torus.

    noise: the variance of its readings, (reading,), ordered as (shot, y, x).
    """

    weights: NDArray[np.float64]
    noise: NDArray[np.float64]

    @classmethod
    def of(cls, psi: Psi, variance: Array, corner: tuple[int, int], side: int = SIDE) -> Block:
        """Return the block of side x side samples at a corner (y, x).

        variance: of the readings, (shot, y, x). Raises ReconstructionError for larger pixels.
        """
        if psi.binning != 1:
            raise ReconstructionError("theory on periodic blocks needs pixels of one sample")
        rows, columns = (slice(at, at + side) for at in corner)
        part = psi.window(rows, columns)
        weights = np.asarray(part.weights, np.float64)
        if part.colour is None:
            by_colour = np.einsum("oc,svuycx->ovusyx", OPPONENT, weights)
        else:
            by_colour = np.einsum(
                "osyx,svuyx->ovusyx", OPPONENT[:, part.colour], weights[:, :, :, :, 0, :]
            )
        return cls(by_colour, np.asarray(variance[:, rows, columns], np.float64).ravel())

    @property
    def side(self) -> int:
        """Samples along an axis."""
        return self.weights.shape[-1]

    def matrix(self, disparity: float) -> NDArray[np.float64]:
        """Return A_d, (opponent colour, reading, sample)."""
        colours, views_v, views_u, shots, side, _ = self.weights.shape
        made = np.zeros((colours, shots, side, side, side, side))
        for v in range(views_v):
            across = np.zeros((colours, shots, side, side, side))
            for u in range(views_u):
                shifted = _shift(round(disparity * (u - views_u // 2), 6), side)
                across += self.weights[:, v, u][..., None] * shifted
            down = _shift(round(disparity * (v - views_v // 2), 6), side)
            made += down[:, None, :, None] * across[:, :, :, :, None, :]
        return made.reshape(colours, shots * side * side, side * side)

    def apart(self, texture: SceneTexture) -> NDArray[np.float64]:
        """Return the variance of readings by what no texture on a plane explains, (reading,)."""
        per_ray = np.einsum("o,ovusyx->syx", texture.variances, np.square(self.weights))
        return texture.apart * per_ray.ravel()

    def error(self, disparity: float, other: float, texture: SceneTexture) -> float:
        """Return the mean squared error of a value of the light field of two textures' sum."""
        side, samples = self.side, self.side**2
        prior = prior_covariance(texture.prior, side) / 2
        near, far = self.matrix(disparity), self.matrix(other)
        covariance = np.diag(self.noise + self.apart(texture))
        crossed = []
        for size, item, two in zip(texture.variances, near, far, strict=True):
            first, second = size * (item @ prior), size * (two @ prior)
            covariance += first @ item.T + second @ two.T
            crossed.append((first, second))
        factor = cho_factor(covariance)
        both = self._turned_to(disparity - other)
        explained = 0.0
        for first, second in crossed:
            weights = cho_solve(factor, first), cho_solve(factor, second)
            explained += float(np.sum(first * weights[0]) + np.sum(second * weights[1]))
            explained += 2 * float(np.sum((second.T @ weights[0]) * both))
        whole = float(texture.variances.sum())
        return (whole * (1 + texture.apart) - explained / samples) / 3

    def _turned_to(self, apart: float) -> NDArray[np.float64]:
        """Return the mean over views of a shift by `apart` a view, (sample, sample)."""
        along = [
            np.mean(
                [_shift(round(apart * (view - count // 2), 6), self.side) for view in range(count)],
                axis=0,
            )
            for count in self.weights.shape[1:3]
        ]
        return np.kron(along[0], along[1])


@dataclass(frozen=True)
class Expected:
    """What theory says of a camera.

    psnr_db: expected, of two surfaces. light: what passes of the open camera's. fresnel: the least
    of its masks', infinite without one before the lens.
    """

    psnr_db: float
    light: float
    fresnel: float


def expected(camera: Camera, psi: Psi, disparities_px: tuple[float, float]) -> Expected:
    """Return what to expect of a camera with this Psi, of SIZE; see `printed.printed_psi`.

    Raises ReconstructionError for pixels of several samples.
    """
    low, high = disparities_px
    apart = min(APART_PX, high - low)
    near = np.linspace(low, high - apart, PLACES)
    errors = [block.error(d, d + apart, TEXTURE) for block in _blocks(camera, psi) for d in near]
    return Expected(_psnr_db(errors), psi.light_efficiency(), least_fresnel(camera))


def _blocks(camera: Camera, psi: Psi) -> list[Block]:
    light = pixel_light(camera, psi.size)
    grey = np.full(psi.light_field_shape, BRIGHTNESS, dtype=np.float32)
    exposures_s = camera.exposures_s()[:, None, None]
    variance = camera.sensor.noise.variance(psi.forward(grey), exposures_s, light)
    return [Block.of(psi, variance, corner) for corner in CORNERS]


def _psnr_db(errors: list[float]) -> float:
    return -10 * math.log10(float(np.mean(errors)))


def least_fresnel(camera: Camera) -> float:
    """Return the least Fresnel number of a camera's masks before the lens."""
    return min(
        (
            fresnel_number(mask.cell_um, mask.distance_mm)
            for mask in camera.masks.values()
            if mask.distance_mm < camera.lens.distance_mm
        ),
        default=math.inf,
    )
