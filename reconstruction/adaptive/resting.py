"""What rests before a camera at rest keeps its light field; only what changed is fitted anew.

A reading is the sum over its pixel's rays, I = sum_r w_r L_r. A pixel rests while its reading
differs from the mean of earlier readings by no more than noise (`changed`). Its rays have then not
changed; flow and disparity play no part in that decision. Behind a mask at rest n frames of
such a pixel are n times the same equation: their mean has the n-th part of the noise's variance.

Windows around what changed are fitted as captures of their own (`windows`): the present readings
where they changed, means elsewhere. The resting pixels of a window are fitted again, too, and the
fits of a resting pixel are averaged. When pixels have rested for REFITTED, REFITTED^2 ... frames,
the means of all readings are fitted as one more capture.
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
from emmc_rig.reconstruction.result import SCALE, TAILS, WITHIN, Reconstruction

Array = NDArray[np.floating]
Window = tuple[slice, slice]
MOST, CHANGED = 8.0, {1.2: 3.2, 3.0: 1.5, 6.0: 1.25}
"""Squared changes over their variance, each MOST at most, are averaged in windows of these
deviations, pixels; and the means from which on a pixel changed. Wider windows leave out what
changed by narrower ones."""
CLOSED_PX = 9
"""Width of gaps between changed pixels that count as changed."""
WHOLE = 0.8
"""Share of the picture that windows cover from which on nothing rests. Films of group A (96x128,
`benchmarks/films.py`): 0.4 to 0.6 while a disc passes before a scene at rest, 0.7 of `moving-toys`,
1 while the camera moves by a pixel a frame."""
AROUND_PX, LEAST_PX, BORDER_PX = 5, 36, 3
"""Resting pixels around changed ones that a window includes. A window's least side. Pixels at a
window's border whose fit is not used."""
REFITTED = 4
"""Frames of rest after which the means of all readings are fitted; each time so many times more."""
LONGEST = 8
"""Fits that are averaged, about."""
BY_AREA = WITHIN, SCALE, "decided", "over_plain"
"""Figures of a frame that are means over its fits, weighted by the area where each is used."""


@dataclass(frozen=True, eq=False)
class Rest:
    """What is known of each pixel since it changed last.

    Attributes:
        light_field: mean of the fits, as `mixture.stored`.
        disparity, disparity_sigma, texture, sigma: maps of the latest fit.
        picture: centre view of the latest light field without surfaces, (y, x, c).
        readings: mean of the usable readings, (1, pixel_y, pixel_x).
        count: number of readings in the mean, (pixel_y, pixel_x).
        fits: number of fits in the mean of light fields, (pixel_y, pixel_x).
        whole: number of fits of the whole picture.
        figures: parameters of the latest fit of the whole picture, those of `BY_AREA` averaged.
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
    def of(cls, result: Reconstruction, given: Readings, picture: Array) -> Rest:
        """Return what a frame leaves that was fitted as a whole."""
        sigma = result.maps.get("sigma", np.empty((0, 0, 0, 0)))
        return cls(
            light_field=mixture.stored(result.light_field),
            disparity=result.maps["disparity"],
            disparity_sigma=result.maps["disparity_sigma"],
            texture=result.maps["texture"],
            sigma=sigma.astype(np.float16),
            picture=picture,
            readings=given.frames,
            count=given.usable[0].astype(np.float32),
            fits=np.ones(given.frames.shape[1:], dtype=np.float32),
            whole=1,
            figures=tuple((name, float(value)) for name, value in result.parameters.items()),
        )

    def changed(self, given: Readings) -> NDArray[np.bool_]:
        """Return where readings differ from the mean by more than noise, (pixel_y, pixel_x).

        The noise of bright readings is that of photons at most, whatever their mean deviation.
        """
        known = given.usable[0] & (self.count > 0)
        if not known.any():
            return np.ones_like(known)
        weight = known.astype(np.float32)
        relative = self.readings[0] / max(float(self.readings[0][known].mean()), 1e-20)
        variance = given.noise[0] * (1 + 1 / np.maximum(self.count, 1)) * np.maximum(relative, 1)
        square = np.square(given.frames - self.readings)[0] / np.maximum(variance, 1e-20)
        square = np.minimum(square, MOST)
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
        """Return the state with one more frame's readings; a mean begins where they changed."""
        used = given.usable[0].astype(np.float32)
        count = np.where(changed, 0, self.count) + used
        readings = self.readings + used * (given.frames - self.readings) / np.maximum(count, 1)
        return replace(self, readings=readings, count=count, fits=np.where(changed, 0, self.fits))

    def mean(self, given: Readings) -> Readings:
        """Return the mean readings with their noise; given: of the present frame."""
        noise = (given.noise / np.maximum(self.count, 1)).astype(np.float32)
        typical, usable = float(np.sqrt(noise.mean())), (self.count > 0)[None]
        return Readings(given.psi, self.readings, typical, noise, usable)

    def due(self) -> bool:
        """Return whether the whole picture is to be fitted again."""
        return float(np.median(self.count)) >= REFITTED**self.whole

    def with_fit(self, found: Reconstruction, window: Window, binning: int) -> Rest:
        """Return the state with one more fit of a window of pixels, averaged where they rest."""
        new = np.zeros(self.fits.shape, bool)
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
        figures = dict(self.figures)
        if sigma.size and "sigma" in found.maps:
            # The PSNR stated is then that of the mean square error of all parts.
            more_db = found.parameters.get(TAILS, 0.0) - figures.get(TAILS, 0.0)
            own = np.square(found.maps["sigma"]) * np.float32(10 ** (more_db / 10))
            variance = np.square(sigma[at], dtype=np.float32)
            sigma[at] = np.sqrt(variance + share * (own - variance))
        if "picture" in found.maps:
            maps["picture"] = self.picture.copy()
            maps["picture"][samples] = found.maps["picture"]
        fits = self.fits.copy()
        fits[window] += part
        area = float(new.mean())
        for name in BY_AREA:
            if name in figures and name in found.parameters:
                figures[name] += area * (float(found.parameters[name]) - figures[name])
        return replace(
            self,
            light_field=light_field,
            sigma=sigma,
            fits=fits,
            figures=tuple(figures.items()),
            **maps,
        )

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
    """What a window showed in the frame before.

    Attributes:
        picture: centre view of the light field without surfaces, (y, x, c).
        disparity: of the centre view, (y, x).
        changed: where readings changed since, (y, x).
    """

    picture: Array
    disparity: Array
    changed: NDArray[np.bool_]

    def carried(self, picture: Array) -> Array:
        """Return the disparity of the frame before, carried to the present picture."""
        back = flow_between(self.picture, picture)[1] * self.changed[..., None]
        return sampled(self.disparity, at_places(back.shape[:2]) + back)


def windows(changed: NDArray[np.bool_]) -> list[Window]:
    """Return disjoint windows of pixels (row, column) around all that changed."""
    side = 2 * AROUND_PX + 1
    around = cv2.dilate(changed.astype(np.uint8), np.ones((side, side), np.uint8))
    while True:
        found, before = [], around.copy()
        for left, top, wide, high, _ in cv2.connectedComponentsWithStats(around)[2][1:]:
            rows, columns = changed.shape
            window = _least(top, high, rows), _least(left, wide, columns)
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
