"""What the parametric Psi is made of: where the mask really sits, and what lens and mask let pass.

A ray through sensor point x and lens point u meets the mask at xi = (1 - rho) x + rho u, rho =
d / D (paper, eq. 2), bent by distortion_um x |x|^2 / corner^3. Column and row of the mask there,
in cells from its middle: B (xi - offset - stage) / cell, with B = [1 skew; 0 1] R(-rotation) /
scale. A tilted or bowed mask is farther by tilt . x + bow_um |x|^2 / corner^2: xi grows by so much
of the ray's slope t = (u - x) / D. Glass of glass_um between mask and sensor moves the ray by
glass_um (t / sqrt(n^2 (1 + |t|^2) - |t|^2) - t / n), n = 1.52 (Snell's law); what is linear in t is
part of the distance. The mask is seen through the convolution of three kernels: the pixel's box,
the aperture cell's box, and a Gaussian of deviation blur_um (rounded cells, diffraction).

The coefficient of view j at pixel p is w_j(p) (leak + (clear - leak) T_j(p)), T the design's
transmittance so averaged, and w_j(p) = a_j (1 + vignetting x.u_j) (1 + falloff |u_j|^2) / sum over
the views, x and u as shares of the picture's corner and of the aperture's: what falls off evenly
over the views cancels against the white board seen without masks. The falloff could be part of the
a_j; known apart, what is left of those is small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import Camera

SCALARS = (
    "offset_x_um",
    "offset_y_um",
    "rotation_rad",
    "scale",
    "skew",
    "distance_share",
    "distortion_um",
    "blur_um",
    "clear",
    "leak",
    "vignetting",
    "falloff",
    "tilt_x_rad",
    "tilt_y_rad",
    "bow_um",
    "glass_um",
)
(
    OFFSET_X, OFFSET_Y, ROTATION, SCALE, SKEW, DISTANCE, DISTORTION, BLUR,
    CLEAR, LEAK, VIGNETTING, FALLOFF, TILT_X, TILT_Y, BOW, GLASS,
) = range(len(SCALARS))  # fmt: skip
"""Where the scalars lie in the parameter vector."""
LEAST_BLUR_UM = 0.3
"""Far below a cell; keeps the shadow differentiable where the mask's edges are sharp."""


@dataclass(frozen=True)
class Placement:
    """The parameters, in the order of SCALARS and then the aperture's weights.

    distance_share: relative error of d. scale: of the mask's cells. skew: tangent of the angle by
    which its columns lean. aperture: (v, u), mean 1.
    """

    offset_x_um: float = 0.0
    offset_y_um: float = 0.0
    rotation_rad: float = 0.0
    scale: float = 1.0
    skew: float = 0.0
    distance_share: float = 0.0
    distortion_um: float = 0.0
    blur_um: float = LEAST_BLUR_UM
    clear: float = 1.0
    leak: float = 0.0
    vignetting: float = 0.0
    falloff: float = 0.0
    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    bow_um: float = 0.0
    glass_um: float = 0.0
    aperture: tuple[tuple[float, ...], ...] = ()

    def vector(self) -> NDArray[np.float64]:
        """Return the parameters as one vector."""
        return np.array([*(getattr(self, name) for name in SCALARS), *np.ravel(self.aperture)])

    def moved(self, step: NDArray[np.floating]) -> Placement:
        """Return the placement after a step, within what is possible."""
        return placement_of(self.vector() + step, np.shape(self.aperture))


def placement_of(vector: NDArray[np.floating], views: tuple[int, ...]) -> Placement:
    """Return the placement of a parameter vector for a grid of `views`, within what is possible."""
    scalars = dict(zip(SCALARS, map(float, vector), strict=False))
    scalars["blur_um"] = max(scalars["blur_um"], LEAST_BLUR_UM)
    scalars["distance_share"] = min(max(scalars["distance_share"], -0.9), 3.0)
    scalars["falloff"] = min(max(scalars["falloff"], -0.9), 3.0)
    scalars["scale"] = min(max(scalars["scale"], 0.5), 2.0)
    weights = np.maximum(vector[len(SCALARS) :], 1e-3).reshape(views)
    return Placement(**scalars, aperture=tuple(tuple(map(float, row)) for row in weights))


def designed_placement(camera: Camera) -> Placement:
    """Return the placement of a camera built as described."""
    rows, columns = camera.views
    return Placement(aperture=((1.0,) * columns,) * rows)


def labels(views: tuple[int, int]) -> tuple[str, ...]:
    """Return the names of the parameters in the order of their vector."""
    return (*SCALARS, *(f"aperture_{v}_{u}" for v, u in np.ndindex(views)))


@dataclass(frozen=True)
class Tolerances:
    """How far a bench may be from its design: standard deviations of the parameters' prior.

    They hold what the whiteboards do not determine at the design; a frame shows the rest far
    better.
    """

    offset_um: float = 200.0
    rotation_rad: float = 0.02
    scale: float = 0.01
    skew: float = 0.01
    distance_share: float = 0.3
    distortion_um: float = 20.0
    blur_um: float = 10.0
    clear: float = 0.2
    leak: float = 0.1
    vignetting: float = 0.2
    falloff: float = 0.5
    tilt_x_rad: float = 0.01
    tilt_y_rad: float = 0.01
    bow_um: float = 10.0
    glass_um: float = 100.0
    aperture: float = 0.05

    def deviations(self, views: tuple[int, int]) -> NDArray[np.float64]:
        """Return the deviations in the order of the parameter vector."""
        scalars = [self.offset_um, self.offset_um]
        scalars += [getattr(self, name) for name in SCALARS[2:]]
        return np.array([*scalars, *[self.aperture] * (views[0] * views[1])])


def with_aperture_mean_one(placement: Placement) -> Placement:
    """Return the same Psi with aperture weights of mean 1: only their ratios count."""
    weights = np.array(placement.aperture)
    weights /= weights.mean()
    return replace(placement, aperture=tuple(tuple(map(float, row)) for row in weights))
