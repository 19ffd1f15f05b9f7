"""Whether the readings show Psi's masks mirrored, turned, as a negative, or far from their place.

Masks that show weakly may stand otherwise in their holder than the camera's file says. The design's
masks are drawn in their eight orientations, at other distances and blurred, and each shadow m is
correlated with what is seen at every displacement d that keeps the colour filters,

    cross = sum w seen m(d),    square = sum w m(d)^2,    gain = cross^2 / square

with w the texture's inverse variance. A negative has cross < 0. The likeliest is that of the
largest gain. What is seen are the readings over their local means: a smooth picture found with
wrong masks follows these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from emmc_rig.model.camera import Camera, Plate, draw_plates, seen_of_white
from emmc_rig.model.errors import ModelError
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.verdict.displaced import known_camera, moved_masks, near_masks
from emmc_rig.reconstruction.verdict.shadow import (
    SMOOTH_PX,
    Relief,
    averaged,
    channels,
    predicted_relief,
    texture_weight,
)

Array = NDArray[np.floating]
ORIENTATIONS = {
    "": (0, False),
    "turned by 90 degrees to the left": (1, False),
    "turned by 180 degrees": (2, False),
    "turned by 90 degrees to the right": (3, False),
    "mirrored left to right": (0, True),
    "mirrored top to bottom": (2, True),
    "transposed": (1, True),
    "transposed about the other diagonal": (3, True),
}
"""Quarter turns to the left, of the mask mirrored left to right or not."""
SIZES = {
    "distance": tuple((1.25 ** np.arange(-4, 7)).tolist()),
    "blurred": (1.0, 1.5, 2.0, 2.5, 3.0, 4.0),
    "turned": (*range(-10, 0, 2), *range(2, 12, 2)),
    "scaled": tuple((1 + 0.025 * np.arange(-5, 6)).tolist()),
}
"""Changes of the masks, in the sizes tried: distance from the sensor, and scale, over those in Psi;
deviation of the shadow's blur, pixels; turn from x to y, degrees. The outermost are not named."""
WORDS = {
    "distance": "the masks are about {far:.0%} {way} the sensor",
    "blurred": "the masks' shadow is blurred by about {size:g} pixels",
    "turned": "the masks are turned by about {size:+.0f} degrees from x to y",
    "scaled": "the masks' cells are about {far:.1%} {larger}",
}
FURTHEST_PX = 24
"""Displacements that are tried."""
NEAR_PX = 4
"""Gains so near count as one peak."""
IN_PLACE_PX = 1
"""Masks that are displaced by no more count as in their place."""
CLEARLY = 1.7
"""Least ratio of the largest gain to the next largest: below it nothing is named."""
WEAK = 0.85
"""Of the strength that Psi predicts: below it the masks are compared with `SIZES`, ORIENTATIONS."""
LEAST_STRENGTH = 0.3
"""Of the masks as found: 1 where every cell is where it is drawn."""


class Seen(NamedTuple):
    """The masks as the readings show them; orientation: of ORIENTATIONS, "" as in Psi.

    negative: whether clear cells are dark. by_px: their displacement from there, (y, x). strength:
    of their shadow, 1 in Psi. change, size: of SIZES; "": none.
    """

    orientation: str
    negative: bool
    by_px: tuple[int, int]
    strength: float
    change: str = ""
    size: float = 0.0

    def __str__(self) -> str:
        """The masks in words."""
        more = self.size > 1
        far, way, larger = abs(self.size - 1), "further from", "larger"
        if not more:
            way, larger = "nearer to", "smaller"
        if self.change:
            words = WORDS[self.change].format(size=self.size, far=far, way=way, larger=larger)
            return f"against Psi {words}"
        y, x = self.by_px
        turned = ["a negative" * self.negative, self.orientation]
        # Masks that are turned stand elsewhere than drawn, too.
        far_off = "" if any(turned) else f"({x:+d}, {y:+d}) pixels off in x and y"
        return "against Psi the masks are " + ", ".join(filter(None, [*turned, far_off]))

    @property
    def as_in_psi(self) -> bool:
        """Whether the masks are as in Psi."""
        near = max(map(abs, self.by_px)) <= IN_PLACE_PX
        return near and not (self.change or self.orientation or self.negative)

    @property
    def outermost(self) -> bool:
        """Whether a change is as large as any that was tried."""
        return bool(self.change) and self.size in (SIZES[self.change][0], SIZES[self.change][-1])


def seen_masks(psi: Psi, relief: Relief) -> Seen | None:
    """Return how the masks stand, where they stand clearly otherwise than in Psi; else None.

    None as well for a Psi without a design, and for masks at the lens.
    """
    camera = known_camera(psi)
    if camera is None:
        return None
    period, detail = camera.seen_tile().shape[:2], _detail(psi, relief)
    found = list[tuple[float, Seen]]()
    try:
        for masks, how in _hypotheses(psi, camera, relief.picture):
            tried = _correlated(detail, masks, period)
            for peak in _two_peaks(tried):
                strength = float(tried.strength[peak])
                by_px = tried.by_px[0][peak[0]], tried.by_px[1][peak[1]]
                seen = how._replace(negative=strength < 0, by_px=by_px, strength=abs(strength))
                if not (seen.change and seen.negative):
                    found.append((float(tried.gain[peak]), seen))
    except ModelError:
        return None
    gain, seen = max(found, key=lambda tried: tried[0])
    # Changes of nearly the same size explain what is seen nearly as well.
    next_gain = max(tried for tried, other in found if not other.change and other != seen)
    clearly = gain > CLEARLY * next_gain and seen.strength > LEAST_STRENGTH
    return seen if clearly and not (seen.as_in_psi or seen.outermost) else None


class _Detail(NamedTuple):
    """Readings over their local means less 1, the inverse variance of their texture, and where both
    are known, (shot, pixel_y, pixel_x) each."""

    seen: Array
    weight: Array
    good: NDArray[np.bool_]


def _detail(psi: Psi, relief: Relief) -> _Detail:
    good, filters = relief.good, channels(psi)
    read = relief.level * (1 + relief.read)
    around = averaged(read, good, filters, SMOOTH_PX)
    seen = np.where(good & (around > 0), read / np.where(around > 0, around, 1) - 1, 0)
    return _Detail(seen, texture_weight(seen, good, filters), good)


def _two_peaks(tried: _Correlated) -> Iterator[tuple[int, int]]:
    """Yield where the gain is largest, and where it is largest further than NEAR_PX from there."""
    y, x = np.unravel_index(int(tried.gain.argmax()), tried.gain.shape)
    yield int(y), int(x)
    down, right = (
        np.abs(np.array(by_px) - by_px[at]) > NEAR_PX
        for by_px, at in zip(tried.by_px, (y, x), strict=True)
    )
    rest = np.where(down[:, None] | right, tried.gain, 0.0)
    y, x = np.unravel_index(int(rest.argmax()), rest.shape)
    yield int(y), int(x)


def _hypotheses(
    psi: Psi, camera: Camera, picture: Array
) -> Iterator[tuple[NDArray[np.float32], Seen]]:
    """Yield what the masks near the sensor add to the readings, as they may stand in the bench."""
    plates, near = draw_plates(camera, psi.size), near_masks(camera)
    as_drawn = Seen("", False, (0, 0), 1.0)

    def shadow_of(seen_by: Camera, plates: Mapping[str, Plate]) -> NDArray[np.float32]:
        white = seen_of_white(seen_by, psi.size, dict(plates))
        return predicted_relief(psi, white, picture)[1]

    def blurred_by(px: float) -> Callable[[str, Plate], NDArray[np.float32]]:
        blur_um = px * camera.sensor.sample_pitch_um * psi.binning

        def blur(name: str, plate: Plate) -> NDArray[np.float32]:
            cells = blur_um / camera.masks[name].cell_um
            return np.asarray(gaussian_filter(plate.cells, cells, axes=(1, 2)), np.float32)

        return blur

    def warped_by(degrees: float, scale: float) -> Callable[[str, Plate], NDArray[np.float32]]:
        def warp(_: str, plate: Plate) -> NDArray[np.float32]:
            rows, columns = plate.cells.shape[1:3]
            # OpenCV turns from x to -y.
            how = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), -degrees, scale)
            frames = [
                cv2.warpAffine(cells, how, (columns, rows), borderMode=cv2.BORDER_REPLICATE)
                for cells in plate.cells
            ]
            return np.asarray(frames, np.float32)

        return warp

    def changed(change: Callable[[str, Plate], NDArray[np.float32]]) -> dict[str, Plate]:
        return {
            name: replace(plate, cells=change(name, plate)) if name in near else plate
            for name, plate in plates.items()
        }

    for name, (turns, mirrored) in ORIENTATIONS.items():
        turned = changed(lambda _, plate, t=turns, m=mirrored: _turned(plate, t, m))
        yield shadow_of(camera, turned), as_drawn._replace(orientation=name)
    for change, sizes in SIZES.items():
        for size in sizes:
            how = as_drawn._replace(change=change, size=float(size))
            if change == "distance":
                moved = moved_masks(camera, 0, 0, size)
                beyond = [moved.masks[name].distance_mm >= camera.lens.distance_mm for name in near]
                if size != 1 and not any(beyond):
                    yield shadow_of(moved, draw_plates(moved, psi.size)), how
            elif change == "blurred":
                yield shadow_of(camera, changed(blurred_by(size))), how
            elif size != 1:
                degrees, scale = (size, 1.0) if change == "turned" else (0.0, size)
                yield shadow_of(camera, changed(warped_by(degrees, scale))), how


def _turned(plate: Plate, turns: int, mirrored: bool) -> NDArray[np.float32]:
    """Return the cells of a plate turned about its middle; beyond its edges they are grey."""
    cells = plate.cells[:, :, ::-1] if mirrored else plate.cells
    turned = np.rot90(cells, turns, axes=(1, 2))
    found = np.empty_like(plate.cells)
    found[:] = plate.cells.mean(axis=(1, 2), keepdims=True)
    cuts = [
        (max(0, (have - want) // 2), max(0, (want - have) // 2), min(have, want))
        for have, want in zip(turned.shape[1:3], found.shape[1:3], strict=True)
    ]
    (top, down, rows), (left, right, columns) = cuts
    found[:, down : down + rows, right : right + columns] = turned[
        :, top : top + rows, left : left + columns
    ]
    return found


class _Correlated(NamedTuple):
    """gain, strength: (y, x) by displacement; by_px: the displacements along y and x."""

    gain: NDArray[np.float64]
    strength: NDArray[np.float64]
    by_px: tuple[list[int], list[int]]


def _correlated(detail: _Detail, masks: Array, period: tuple[int, ...]) -> _Correlated:
    """Return how a shadow of masks correlates with the readings, by displacement."""
    rows, columns = masks.shape[1:]
    size = tuple(next_fast_len(n + FURTHEST_PX) for n in (rows, columns))

    def summed(fixed: Array, moved: Array) -> NDArray[np.float64]:
        product = (rfft2(fixed, size) * np.conj(rfft2(moved, size))).sum(axis=0)
        return np.asarray(irfft2(product, size), np.float64)

    weight = detail.weight.astype(np.float64)
    known = np.where(detail.good, masks, 0).astype(np.float64)
    by_px = tuple(
        [by for by in range(-FURTHEST_PX, FURTHEST_PX + 1) if by % step == 0] for step in period
    )
    chosen = np.ix_(*by_px)
    cross = summed(weight * detail.seen, known)[chosen]
    square = np.maximum(summed(weight, np.square(known))[chosen], 1e-12)
    return _Correlated(cross**2 / square, cross / square, (by_px[0], by_px[1]))
