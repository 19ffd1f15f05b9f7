"""Theory beside measurement: what Psi and a scene's statistics predict as a camera gets worse.

Theory covers the faults that leave Psi true. It takes from the scene, patch by patch, its
disparity and the variance of its texture, and from the camera Psi and the noise (see
`reconstruction.theory`); it never sees the frames. Measured on the same samples: the posterior
mean that theory describes, given disparity, mean colour and variance of each patch and given the
noisy frames (the oracle), and the methods, which are given none of these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import camera_of, pixel_light
from emmc_rig.model.lightfield import OPPONENT, centre_view
from emmc_rig.progress import Watcher
from emmc_rig.study.scores import swept_disparity
from emmc_rig.study.stability.fault_sweep import StabilitySettings, strengths
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.sweep import Results, Sweep, described
from emmc_rig.study.trial import Trial
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.errors import ReconstructionError
from reconstruction.methods import reconstruct
from reconstruction.theory.bounds import disparity_information, distances, ziv_zakai
from reconstruction.theory.conditioning import (
    condition,
    ray_coherence,
    spot_coherence,
    subspace,
    unexplained,
    union,
)
from reconstruction.theory.patch import SIDE, PatchModel, Texture

Array = NDArray[np.floating]
METHODS_COMPARED = ("tv", "adaptive-fast")
PATCHES, QUICK_PATCHES = (24, 4), (8, 2)
"""That theory looks at, and those whose conditioning it looks at."""
SWEPT = (
    "exposure", "read-noise", "masked-pixels", "contrast", "disparity-range", "mask-distance",
    "mask-cell", "shots", "r",
)  # fmt: skip
"""Faults that leave Psi true."""
QUICK_SWEPT = tuple(name for name in SWEPT if name not in ("masked-pixels", "contrast"))
LAGS_PX = (1, 2, 3)
"""Of the variogram that sets a patch's texture."""
LEAST_AMPLITUDE, LEAST_CHROMA = 1e-7, 1e-3
"""Of a patch without texture."""
DISPARITIES = 9
"""Between which the Ziv-Zakai bound decides: it sees no finer than their steps."""
APART_PX = 1.0
"""Between the disparities whose patches are compared."""
WIDEST_PX = 10.0
"""Disparities swept to both sides where a scene has no known disparity."""
NOT_USED = 1e6
"""Variance of a reading that is not to be used."""


@dataclass(frozen=True, eq=False)
class Place:
    """A patch of a scene, as theory knows it. mean: its mean colour, (c,)."""

    corner: tuple[int, int]
    disparity: float
    texture: Texture
    mean: NDArray[np.float64]


def patch_texture(picture: Array, prior: TexturePrior) -> Texture:
    """Return the texture of a picture (y, x, c) whose variogram at LAGS_PX is the prior's.

    A variogram is half the mean squared difference at a distance; of a texture of variance a it is
    a (1 - k) (Matheron 1963). Differences do not know the mean, which no patch shows.
    """
    opponent = picture.astype(np.float64) @ OPPONENT.T
    seen, expected = np.zeros(3), 0.0
    for lag in LAGS_PX:
        for axis in (0, 1):
            apart = np.take(opponent, range(lag, opponent.shape[axis]), axis) - np.take(
                opponent, range(opponent.shape[axis] - lag), axis
            )
            seen += np.square(apart).mean(axis=(0, 1)) / 2
            expected += 1 - float(prior.covariance(np.array(float(lag**2))))
    luminance, *chrominance = np.maximum(seen / expected, 0)
    amplitude = max(float(luminance), LEAST_AMPLITUDE)
    return Texture(
        amplitude, max(float(np.mean(chrominance)) / amplitude, LEAST_CHROMA), True, prior
    )


def places_of(light_field: Array, disparity_px: Array, binning: int, count: int) -> list[Place]:
    """Return patches spread over a scene, in whole pixels of binning samples."""
    picture, prior = centre_view(light_field), TexturePrior()
    rows, columns = picture.shape[:2]
    across = max(1, round((count * columns / rows) ** 0.5))
    down = max(1, count // across)
    found = []
    for top in np.linspace(0, rows - SIDE, down):
        for left in np.linspace(0, columns - SIDE, across):
            y, x = int(top) // binning * binning, int(left) // binning * binning
            seen = np.s_[y : y + SIDE, x : x + SIDE]
            found.append(
                Place(
                    (y, x),
                    float(np.median(disparity_px[seen])),
                    patch_texture(picture[seen], prior),
                    light_field[(slice(None), slice(None), *seen)].mean(axis=(0, 1, 2, 3)),
                )
            )
    return found


def psnr_of(error: float, peak: float = 1.0) -> float:
    """Return the PSNR of a mean squared error."""
    return 10 * math.log10(peak**2 / max(error, 1e-12))


def misplaced(texture: Texture, deviation_px: float, views: tuple[int, int]) -> float:
    """Return the mean squared error of a texture seen at a disparity off by a deviation.

    By the structure function 2 a (1 - k) at the distance that each view then misses it by, averaged
    over views; it forgets that what was not resolved cannot be misplaced.
    """
    v, u = (np.arange(count) - count // 2 for count in views)
    far = np.add.outer(np.square(v), np.square(u)) * deviation_px**2
    parted = float(np.mean(1 - texture.prior.covariance(far)))
    return 2 * float(texture.variances.sum()) / 3 * parted


@dataclass(frozen=True, eq=False)
class Seen:
    """A trial as theory sees it. variance: of the readings, what it really is (shot, y, x), and
    NOT_USED where they are not usable. disparity_px: (y, x) of the centre view."""

    trial: Trial
    variance: Array
    disparity_px: Array

    @classmethod
    def of(cls, trial: Trial) -> Seen:
        """Return what theory needs of a trial; a measured scene's disparities are swept for."""
        camera = camera_of(trial.true_psi)
        noise, light = camera.sensor.noise, pixel_light(camera, trial.psi.size)
        exposures_s = camera.exposures_s()[:, None, None]
        variance = noise.variance(trial.true_psi.forward(trial.truth), exposures_s, light)
        disparity_px = trial.disparity_px
        if disparity_px is None:
            disparity_px = swept_disparity(trial.truth, -WIDEST_PX, WIDEST_PX)
        return cls(trial, np.where(trial.usable, variance, NOT_USED), disparity_px)

    def places(self, count: int) -> list[Place]:
        """Return a number of patches, spread over the scene."""
        return places_of(self.trial.truth, self.disparity_px, self.trial.psi.binning, count)

    def patch(self, place: Place) -> tuple[PatchModel, Array, Array]:
        """Return a patch with its readings and their variance, (reading,) each."""
        k = self.trial.psi.binning
        y, x = (at // k for at in place.corner)
        pixels = np.s_[:, y : y + SIDE // k, x : x + SIDE // k]
        model = PatchModel.of(self.trial.psi, place.corner)
        return model, self.trial.readings[pixels].ravel(), self.variance[pixels].ravel()


def predicted(seen: Seen, places: Sequence[Place]) -> dict[str, float]:
    """Return what theory expects of patches of a scene, and the oracle's error on its frames.

    bound_db: PSNR of the posterior mean, disparities known. found_db: with an error of disparity by
    the Cramer-Rao bound on top. oracle_db: the posterior mean's own, measured. crb_px: root mean
    of the Cramer-Rao bounds; gain, degrees: means, see `theory.patch.Expected`.
    """
    sums = dict.fromkeys(("bound", "found", "oracle", "crb", "gain", "degrees"), 0.0)
    truth = seen.trial.truth
    views = truth.shape[0], truth.shape[1]
    widest = max(float(np.ptp(seen.disparity_px)) / 12**0.5, 1e-3)
    for place in places:
        patch, readings, variance = seen.patch(place)
        expected = patch.expected(place.disparity, place.texture, variance)
        information = disparity_information(patch, place.disparity, place.texture, variance)
        crb = min(1 / max(information, 1e-12), widest**2)
        lost = misplaced(place.texture, crb**0.5, views)
        sums["bound"] += expected.error
        sums["found"] += min(expected.error + lost, 2 * expected.prior)
        sums["crb"] += crb
        sums["gain"] += expected.noise_gain
        sums["degrees"] += expected.degrees_of_freedom
        part = (slice(None), slice(None), *(slice(at, at + SIDE) for at in place.corner))
        flat = np.broadcast_to(place.mean, truth[part].shape).reshape(-1, 3) @ OPPONENT.T
        plain = np.einsum("omr,ro->m", patch.opponent, flat)
        estimate = patch.estimate(place.disparity, place.texture, variance, readings - plain)
        wanted = truth[part].reshape(-1, 3)[patch.middle] - place.mean
        sums["oracle"] += float(np.mean(np.square(estimate - wanted)))
    mean = {key: value / len(places) for key, value in sums.items()}
    peak = seen.trial.peak
    return {
        "bound_db": psnr_of(mean["bound"], peak),
        "found_db": psnr_of(mean["found"], peak),
        "oracle_db": psnr_of(mean["oracle"], peak),
        "crb_px": mean["crb"] ** 0.5,
        "gain": mean["gain"],
        "degrees": mean["degrees"],
    }


def conditioned(seen: Seen, places: Sequence[Place]) -> dict[str, float]:
    """Return how Psi is conditioned along the disparities of patches: medians over them.

    zzb_px: root of the Ziv-Zakai bound of a disparity anywhere in the scene's range.
    """
    low, high = float(seen.disparity_px.min()), float(seen.disparity_px.max())
    half = max((high - low) / 2, 0.5)
    grid = (low + high) / 2 + np.linspace(-half, half, DISPARITIES)
    rows = []
    for place in places:
        patch, _, variance = seen.patch(place)
        here = subspace(patch, place.disparity, place.texture)
        beside = subspace(patch, place.disparity + APART_PX, place.texture)
        alone, both = condition(patch, here), condition(patch, union([here, beside]))
        spots = spot_coherence(patch, np.array([place.disparity, place.disparity + APART_PX]))
        apart = distances(patch, grid, place.texture, variance)
        rows.append(
            {
                "condition": alone.number,
                "least_squares_gain": alone.gain,
                "condition_of_two": both.number,
                "unexplained": unexplained(patch, beside, here),
                "spot_coherence": float(spots[0, 1]),
                "zzb_px": ziv_zakai(grid, apart) ** 0.5,
            }
        )
    medians = {key: float(np.median([row[key] for row in rows])) for key in rows[0]}
    return {"ray_coherence": ray_coherence(seen.trial.psi), **medians}


def measured(seen: Seen, places: Sequence[Place], method: str) -> dict[str, float]:
    """Return a method's PSNR on the samples that theory covers, and its disparity's error.

    Raises ReconstructionError as the method does.
    """
    trial = seen.trial
    result = reconstruct(
        method, trial.psi, trial.readings, max(trial.noise_sigma, 1e-9), usable=trial.usable
    )
    error, off = 0.0, []
    own = result.maps.get("disparity")
    for place in places:
        inner = tuple(slice(at + SIDE // 4, at + 3 * SIDE // 4) for at in place.corner)
        part = (slice(None), slice(None), *inner)
        error += float(np.mean(np.square(result.light_field[part] - trial.truth[part])))
        if own is not None:
            off.append(float(np.median(np.abs(own[inner] - place.disparity))))
    found = {"db": psnr_of(error / len(places), trial.peak)}
    return found if not off else {**found, "disparity_px": float(np.median(off))}


@dataclass
class TheorySweep(Sweep[Point]):
    """The points of theory; settings: StabilitySettings."""

    methods: Sequence[str]
    journal = "theory.jsonl"
    stage = "theory beside the sweeps"
    revision = 3

    @property
    def patches(self) -> tuple[int, int]:
        """How many patches theory looks at, and at how many of these for conditioning."""
        return QUICK_PATCHES if self.settings.fast else PATCHES

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        return {**described(point), "methods": self.methods, "patches": self.patches}

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the figures of theory and of the methods."""
        for point in points:
            yield self._figures(Seen.of(point.trial()))

    def _figures(self, seen: Seen) -> dict[str, float]:
        count, conditioned_count = self.patches
        places = seen.places(count)
        figures = predicted(seen, places)
        step = max(1, len(places) // conditioned_count)
        figures |= conditioned(seen, places[step // 2 :: step])
        for method in self.methods:
            try:
                found = measured(seen, places, method)
            except ReconstructionError:
                found = {"db": math.nan}
            figures |= {f"{method}_{key}": value for key, value in found.items()}
        return figures


def measure_theory(
    settings: StabilitySettings,
    folder: Path,
    watcher: Watcher,
    methods: Sequence[str] = METHODS_COMPARED,
) -> dict[Point, dict[str, float | None]]:
    """Return the figures of every point by name, None where not finite; kept in the folder.

    Raises what scenes and cameras do for wrong input.
    """
    wanted = (
        Point(capture, name, strength)
        for capture in settings.captures
        for name in (QUICK_SWEPT if settings.fast else SWEPT)
        for strength in strengths(FAULTS[name], settings)
    )
    return TheorySweep(settings, folder, methods).run(wanted, watcher)
