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

A round pupil covers the corners of the views: w_j then has the open share of view j as a factor,
and u and the aperture cell's box are those of the view's open part (`emmc_rig.model.pupil`). The
pupil's centre and diameter differ from its description by pupil_x_um, pupil_y_um, pupil_share; the
diameter of the rim that moves over it, and its move, by rim_share and rim_shift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import Camera
from emmc_rig.model.pupil import Pupil, Rim

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
    "pupil_x_um",
    "pupil_y_um",
    "pupil_share",
    "rim_share",
    "rim_shift",
)
(
    OFFSET_X, OFFSET_Y, ROTATION, SCALE, SKEW, DISTANCE, DISTORTION, BLUR,
    CLEAR, LEAK, VIGNETTING, FALLOFF, TILT_X, TILT_Y, BOW, GLASS,
    PUPIL_X, PUPIL_Y, PUPIL_SHARE, RIM_SHARE, RIM_SHIFT,
) = range(len(SCALARS))  # fmt: skip
"""Where the scalars lie in the parameter vector."""
LEAST_BLUR_UM = 0.3
"""Far below a cell; keeps the shadow differentiable where the mask's edges are sharp."""
LIMITS = {
    "blur_um": (LEAST_BLUR_UM, np.inf),
    "distance_share": (-0.9, 3.0),
    "falloff": (-0.9, 3.0),
    "scale": (0.5, 2.0),
    "pupil_share": (-0.5, 1.0),
    "rim_share": (-0.5, 1.0),
}
"""Of the scalars: beyond them there is no shadow to compute."""


@dataclass(frozen=True)
class Placement:
    """The parameters, in the order of SCALARS and then the aperture's weights.

    distance_share: relative error of d. scale: of the mask's cells. skew: tangent of the angle by
    which its columns lean. aperture: (v, u), mean 1, relative to the views' open shares.
    pupil_x_um, pupil_y_um, pupil_share: the pupil's centre from that of `pupil`, and the relative
    error of its diameter. rim_share, rim_shift: the relative error of the rim's diameter, and what
    it moves more for each mm of the pixel. pupil: as described, or of the shape that the
    whiteboards show; None: the views are open to their edges, and the pupil's parameters mean
    nothing, as those of the rim do without a rim.
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
    pupil_x_um: float = 0.0
    pupil_y_um: float = 0.0
    pupil_share: float = 0.0
    rim_share: float = 0.0
    rim_shift: float = 0.0
    aperture: tuple[tuple[float, ...], ...] = ()
    pupil: Pupil | None = None

    def vector(self) -> NDArray[np.float64]:
        """Return the parameters as one vector."""
        return np.array([*(getattr(self, name) for name in SCALARS), *np.ravel(self.aperture)])

    def moved(self, step: NDArray[np.floating]) -> Placement:
        """Return the placement after a step, within what is possible."""
        vector = self.vector() + step
        scalars = dict(zip(SCALARS, map(float, vector), strict=False))
        for name, (least, most) in LIMITS.items():
            scalars[name] = min(max(scalars[name], least), most)
        weights = np.maximum(vector[len(SCALARS) :], 1e-3).reshape(np.shape(self.aperture))
        return Placement(**scalars, aperture=as_weights(weights), pupil=self.pupil)

    def fitted_pupil(self) -> Pupil | None:
        """Return the pupil with centre, diameter and rim of these parameters."""
        if self.pupil is None:
            return None
        x_mm, y_mm = self.pupil.centre_mm
        rim = self.pupil.rim
        if rim is not None:
            diameter_mm = rim.diameter_mm * (1 + self.rim_share)
            rim = Rim(diameter_mm=diameter_mm, shift=rim.shift + self.rim_shift)
        return self.pupil.model_copy(
            update={
                "rim": rim,
                "centre_mm": (x_mm + self.pupil_x_um / 1e3, y_mm + self.pupil_y_um / 1e3),
                "diameter_mm": self.pupil.diameter_mm * (1 + self.pupil_share),
            }
        )


def designed_placement(camera: Camera) -> Placement:
    """Return the placement of a camera built as described."""
    rows, columns = camera.views
    return Placement(aperture=((1.0,) * columns,) * rows, pupil=described_pupil(camera))


def described_pupil(camera: Camera) -> Pupil | None:
    """Return the pupil of the camera's lens; None for a lens that is described without a pupil."""
    return getattr(camera.lens, "pupil", None)


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
    pupil_x_um: float = 500.0
    pupil_y_um: float = 500.0
    pupil_share: float = 0.05
    rim_share: float = 0.05
    rim_shift: float = 0.5
    aperture: float = 0.05

    def deviations(self, views: tuple[int, int]) -> NDArray[np.float64]:
        """Return the deviations in the order of the parameter vector."""
        scalars = [self.offset_um, self.offset_um]
        scalars += [getattr(self, name) for name in SCALARS[2:]]
        return np.array([*scalars, *[self.aperture] * (views[0] * views[1])])


def as_weights(values: NDArray[np.floating]) -> tuple[tuple[float, ...], ...]:
    """Return an array (v, u) as the aperture's weights of a placement."""
    return tuple(tuple(map(float, row)) for row in values)


def with_aperture_mean_one(placement: Placement) -> Placement:
    """Return the same Psi with aperture weights of mean 1: only their ratios count."""
    weights = np.array(placement.aperture)
    return replace(placement, aperture=as_weights(weights / weights.mean()))
