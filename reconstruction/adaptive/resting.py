"""What rests before a camera at rest keeps its light field; only what changed is fitted anew.

A reading is the sum over its pixel's rays, I = sum_r w_r L_r. As long as it differs from the mean
of the readings before by no more than noise (`changed`), its rays are what they were, whichever
surfaces they see: rest is decided pixel by pixel, without flow or disparity. Before a mask at rest
n frames of such a pixel are n times the same equation: their mean has the n-th part of the noise.

Windows around what changed are fitted as captures of their own (`windows`): the present readings
where they changed, means elsewhere. Each also sees resting pixels anew, beside other neighbours and
other patches: the fits of a resting pixel are averaged. After REFITTED, REFITTED^2 ... frames the
means of all readings are fitted as one more capture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.reconstruction.adaptive import mixture
from emmc_rig.reconstruction.adaptive.times import at_places, flow_between, of_samples, sampled
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.result import Reconstruction

Array = NDArray[np.floating]
Window = tuple[slice, slice]
MOST, CHANGED = 8.0, {1.2: 3.2, 3.0: 1.5, 6.0: 1.25}
"""Squared changes over their variance, each MOST at most, are averaged in windows of these
deviations, pixels; and the means from which on a pixel changed. Wider windows leave out what
changed by narrower ones."""
CLOSED_PX = 9
"""Gaps in what changed that are filled."""
WHOLE = 0.8
"""Share of the picture that windows cover from which on nothing rests. Films of group A (96x128,
`benchmarks/films.py`): 0.4 to 0.6 while a disc passes before a scene at rest, 0.7 of `moving-toys`,
1 while the camera moves by a pixel a frame."""
AROUND_PX, LEAST_PX, BORDER_PX = 5, 36, 3
"""Pixels around what changed that are fitted with it; least side of a window; pixels at a window's
border whose fit is not used."""
REFITTED = 4
LONGEST = 8
"""Fits that are averaged, about."""


@dataclass(frozen=True, eq=False)
class Rest:
    """What is known of each pixel since it changed last.

    Attributes:
        light_field: mean of the fits, as `mixture.stored`.
        disparity, disparity_sigma, texture, sigma: maps of the latest fit.
        readings: mean of the readings, (1, pixel_y, pixel_x).
        count: of readings in the mean, (pixel_y, pixel_x).
        fits: number in the mean of light fields, (pixel_y, pixel_x).
        whole: number of fits of the whole picture.
        figures: parameters of the latest one.
    """

    light_field: NDArray[np.uint16]
    disparity: Array
    disparity_sigma: Array
    texture: NDArray[np.uint8]
    sigma: NDArray[np.float16]
    picture: Array
    readings: Array
    count: Array
    fits: Array
    whole: int
    figures: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, result: Reconstruction, readings: Array, picture) -> Rest:
        """Return what a frame leaves that was fitted as a whole."""
        once = np.ones(readings.shape[1:], dtype=np.float32)
        sigma = result.maps.get("sigma", np.empty((0, 0, 0, 0)))
        return cls(
            light_field=mixture.stored(result.light_field),
            disparity=result.maps["disparity"],
            disparity_sigma=result.maps["disparity_sigma"],
            texture=result.maps["texture"],
            sigma=sigma.astype(np.float16),
            picture=picture,
            readings=readings,
            count=once,
            fits=once,
            whole=1,
            figures=tuple((name, float(value)) for name, value in result.parameters.items()),
        )

    def changed(self, given: Readings) -> NDArray[np.bool_]:
        """Return where readings differ from the mean by more than noise, (pixel_y, pixel_x).

        The noise of bright readings is that of photons at most, whatever their mean deviation.
        """
        weight = given.usable[0].astype(np.float32)
        mean = max(float(self.readings[given.usable].mean()), 1e-20)
        variance = given.noise[0] * (1 + 1 / self.count) * np.maximum(self.readings[0] / mean, 1)
        square = np.minimum(np.square(given.frames - self.readings)[0] / variance, MOST)
        changed = np.zeros(weight.shape, np.uint8)
        closing = np.ones((CLOSED_PX, CLOSED_PX), np.uint8)
        for window_px, limit in CHANGED.items():
            left = weight * (cv2.dilate(changed, closing) == 0)
            mean, of = (
                cv2.GaussianBlur(part.astype(np.float32), (0, 0), window_px)
                for part in (square * left, left)
            )
            more = (mean > limit * np.maximum(of, 0.1)).astype(np.uint8)
            changed = cv2.morphologyEx(changed | more, cv2.MORPH_CLOSE, closing)
        outlines, _ = cv2.findContours(changed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        return cv2.drawContours(changed, outlines, -1, 1, cv2.FILLED) > 0

    def after(self, given: Readings, changed: NDArray[np.bool_]) -> Rest:
        """Return it with the readings of one more frame; where they changed a mean begins."""
        count = np.where(changed, np.float32(1), self.count + 1)
        readings = self.readings + (given.frames - self.readings) / count
        return replace(self, readings=readings, count=count, fits=np.where(changed, 0, self.fits))

    def mean(self, given: Readings) -> Readings:
        """Return the mean readings with their noise; given: of the present frame."""
        noise = (given.noise / self.count).astype(np.float32)
        typical = float(np.sqrt(noise.mean()))
        return replace(given, frames=self.readings, noise=noise, typical=typical)

    def due(self) -> bool:
        """Return whether the whole picture is to be fitted again."""
        return float(np.median(self.count)) >= REFITTED**self.whole

    def with_fit(self, found: Reconstruction, window: Window, binning: int) -> Rest:
        """Return it with one more fit of a window of pixels, averaged where it rests."""
        new, rows, columns = np.zeros(self.fits.shape, bool), *window
        ends = [
            slice(
                at.start + BORDER_PX * (at.start > 0),
                at.stop - BORDER_PX * (at.stop < length),
            )
            for at, length in zip(window, self.fits.shape, strict=True)
        ]
        new[tuple(ends)] = True
        new[window] |= self.fits[window] == 0
        part = new[window]
        samples = tuple(slice(at.start * binning, at.stop * binning) for at in window)
        share = part / (np.minimum(self.fits[window], LONGEST - 1) + 1)
        at = np.s_[:, :, samples[0], samples[1]]
        share = of_samples(share.astype(np.float32), found.light_field[0, 0])
        light_field, sigma = self.light_field.copy(), self.sigma.copy()
        before = mixture.values(light_field[at])
        light_field[at] = mixture.stored(before + share[..., None] * (found.light_field - before))
        chosen = share > 0
        maps = {}
        for name in ("disparity", "disparity_sigma", "texture"):
            maps[name] = getattr(self, name).copy()
            maps[name][samples][chosen] = found.maps[name][chosen]
        if sigma.size and "sigma" in found.maps:
            sigma[at][..., chosen] = found.maps["sigma"][..., chosen]
        if "picture" in found.maps:
            maps["picture"] = self.picture.copy()
            maps["picture"][samples] = found.maps["picture"]
        fits = self.fits.copy()
        fits[window] += part
        return replace(self, light_field=light_field, sigma=sigma, fits=fits, **maps)

    @property
    def maps(self) -> dict[str, NDArray]:
        """Maps of a result."""
        found = {
            "disparity": self.disparity,
            "disparity_sigma": self.disparity_sigma,
            "texture": self.texture,
        }
        return found | ({"sigma": self.sigma.astype(np.float32)} if self.sigma.size else {})


class Before(NamedTuple):
    picture: Array
    disparity: Array
    changed: NDArray[np.bool_]

    def carried(self, picture) -> Array:
        """Return the disparity of the frame before, carried to the present picture."""
        there, back = flow_between(self.picture, picture)
        back = back * self.changed[..., None]
        return sampled(self.disparity, at_places(back.shape[:2]) + back)


def windows(changed: NDArray[np.bool_]) -> list[Window]:
    """Return disjoint windows of pixels (row, column) around all that changed."""
    side = 2 * AROUND_PX + 1
    around = cv2.dilate(changed.astype(np.uint8), np.ones((side, side), np.uint8))
    while True:
        found, before = [], around.copy()
        for left, top, wide, high, _ in cv2.connectedComponentsWithStats(around)[2][1:]:
            window = tuple(
                _least(at, length, whole)
                for at, length, whole in zip((top, left), (high, wide), changed.shape, strict=True)
            )
            around[window] = 1
            found.append(window)
        if np.array_equal(around, before):
            return found


def covered(places: Sequence[Window]) -> int:
    """Return how many pixels lie in windows."""
    return sum(
        (rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in places
    )


def _least(first: int, length: int, whole: int) -> slice:
    """Return a side of a window, of LEAST_PX at least where the picture has so many."""
    side = min(max(length, LEAST_PX), whole)
    first = min(max(first - (side - length) // 2, 0), whole - side)
    return slice(int(first), int(first + side))
