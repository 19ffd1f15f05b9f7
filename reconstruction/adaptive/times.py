"""Frames of other times: each shows the scene's surfaces at its time, through its own masks.

By the flow between the times, a reading of another one saw the present texture elsewhere (`Seen`):
as far as that explains the readings around, the reading counts as a present reading. The disparity
is searched in all frames at once, as in shots of one capture, each moved by whole pixels
(`aligned`): there the fraction of a pixel is one of the errors that the search allows for.

A flow is (y, x, 2): the point at p of one time is at p + flow(p), along y and x, at the other. It
is computed by dense inverse search (Kroeger et al. 2016), as OpenCV has it, between the centre
views of light fields without surfaces: they blur as the scene does, whatever the mask. Of real
light fields that slide by 1 to 3 pixels it is off by 0.1 to 0.2 pixels, of the true pictures by as
much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.reconstruction.adaptive import mixture
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.refine import Seen
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import (
    Plain,
    Survey,
    plain_of,
    surveyed,
    unseen_by,
)
from emmc_rig.reconstruction.adaptive.sweep import mean_around
from emmc_rig.reconstruction.adaptive.visibility import carried
from emmc_rig.reconstruction.inputs import Readings

Array = NDArray[np.floating]
WHITE = 99.5
"""Percentile of the pictures' values that codes up to 255 are for."""
HELD_WINDOW_PX = 12.0
"""Deviation of the window that squared residuals of the few held-out readings are averaged in."""
ANOTHER = 4.0
"""Ratio of squared residuals of total variation, at another time over held-out readings, above
which the other frame shows another scene."""
LEAST_SEEN = 0.3
"""Least share of another frame's readings that must show this scene, for the frame to count at
all."""
REST, REST_PX = 1.12, 2.0
"""Squared residual of total variation without motion over that with it, up to which a place rests:
0.95 to 1.12 at rest, 1.2 to 2 with motion of 0.3 px. And the blur of the places."""
UP_TO = 0.99
"""Share of the places that moved by less than what a scene is said to have moved by."""
RESTING, ALL_MOVES = np.float32(0.1), np.float32(1)
"""Share of the residual added to the readings' variance, where the scene rests and elsewhere."""


def _codes(pictures: tuple[Array, Array]) -> list[NDArray[np.uint8]]:
    """Return the root of the brightness of pictures (y, x, c), as codes of one scale."""
    grey = [np.sqrt(np.maximum(picture.mean(axis=-1), 0)) for picture in pictures]
    white = max(float(np.percentile(np.stack(grey), WHITE)), 1e-6)
    return [(np.clip(picture / white, 0, 1) * 255).astype(np.uint8) for picture in grey]


def flow_between(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the flows from the first of two pictures (y, x, c) to the second, and back."""
    codes = _codes((first, second))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def flow(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> Array:
        across_first = search.calc(source, target, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        return np.ascontiguousarray(across_first[..., ::-1], dtype=np.float32)

    return flow(*codes), flow(*codes[::-1])


def at_places(shape: tuple[int, int]) -> Array:
    """Return the place of every sample, (y, x, 2)."""
    return np.moveaxis(np.indices(shape, dtype=np.float32), 0, -1)


def sampled(field: Array, places: Array, cubic: bool = False) -> Array:
    """Return a field (y, x) or (y, x, c) at places (y, x, 2); beyond its ends as there."""
    down, across = (np.ascontiguousarray(places[..., axis], dtype=np.float32) for axis in (0, 1))
    way = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    field = np.ascontiguousarray(field, dtype=np.float32)
    found = cv2.remap(field, across, down, way, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)


def joined(first: Array, second: Array) -> Array:
    """Return the flow of one time after the other."""
    return first + sampled(second, at_places(first.shape[:2]) + first)


@dataclass(frozen=True, eq=False)
class OtherTime:
    """A frame of another time, and the present positions of its points.

    Attributes:
        readings: over the scale.
        used: readings that count, (shot, pixel_y, pixel_x).
        picture: centre view of its light field without surfaces, (y, x, c).
        there: flow from its time to the present, (y, x, 2).
        back: flow from the present to its time, (y, x, 2).
        moving: share of the residual added to the readings' variance, RESTING to 1, (pixel_y,
            pixel_x).
    """

    readings: Readings
    used: NDArray[np.bool_]
    picture: Array
    there: Array
    back: Array
    moving: Array | np.float32 = ALL_MOVES

    def since(self, there: Array, back: Array) -> OtherTime:
        """Return the same one frame later; there, back: flows between these two frames."""
        return replace(self, there=joined(self.there, there), back=joined(back, self.back))

    def surfaces(self, centre: Array, margin: int, nearer: int, colours: int) -> Surfaces:
        """Return what it saw of the present texture.

        centre: the present disparity of the centre view (y, x), padded by `margin`. nearer: see
        `carried`.
        """
        psi, there = self.readings.psi, padded(self.there, margin)
        then = sampled(centre, at_places(centre.shape) + there)
        disparity, hidden = carried(then, margin, nearer, psi.light_field_shape[:4])
        views, own = disparity.shape[:2], at_places(psi.size)
        moved = np.empty((2, *disparity.shape), dtype=np.float32)
        for v, u in np.ndindex(views):
            steps = np.array([v - views[0] // 2, u - views[1] // 2], dtype=np.float32)
            met = own - disparity[v, u][..., None] * steps + np.float32(margin)
            moved[:, v, u] = np.moveaxis(sampled(there, met), -1, 0)
        return Surfaces(psi, disparity, hidden, margin, colours, moved=moved)

    def seen(
        self,
        centre: Array,
        margin: int,
        texture: Array,
        nearer: int,
        misfit: float,
        doubt: float = 1.0,
    ) -> Seen:
        """Return what it saw of the present texture; a reading counts the less the more is missed.

        centre, texture (c, y, x): at present, padded by a margin. misfit: deviation of readings
        that no texture explains. doubt: share of the residual added to the variance.
        """
        surfaces = self.surfaces(centre, margin, nearer, len(texture))
        missed = self.readings.frames - surfaces.forward(texture)
        around = mean_around(np.square(missed), self.used.astype(np.float32))
        wrong = np.float32(doubt) * self.moving * np.maximum(around - self.readings.noise, 0)
        variance = self.readings.variance(misfit) + wrong
        precision = np.where(self.used, 1 / variance, 0).astype(np.float32)
        return Seen(surfaces, self.readings.frames, precision)


def padded(flow: Array, margin: int) -> Array:
    """Return a flow (y, x, 2) padded as textures are."""
    return np.pad(flow, ((margin, margin), (margin, margin), (0, 0)), mode="edge")


def aligned(other: OtherTime, binning: int) -> Readings:
    """Return a frame of another time moved by whole pixels, as of the present scene."""
    k, theirs = binning, other.readings
    moves = np.rint(other.back[k // 2 :: k, k // 2 :: k] / k).astype(np.intp)
    at = np.indices(moves.shape[:2]) + np.moveaxis(moves, -1, 0)
    last = np.array(moves.shape[:2])[:, None, None] - 1
    inside, (y, x) = ((at >= 0) & (at <= last)).all(axis=0), np.clip(at, 0, last)
    rows, columns = (
        k * of_samples(along, other.back) + within
        for along, within in zip((y, x), np.indices(theirs.psi.size) % k, strict=True)
    )
    weights = np.moveaxis(theirs.psi.weights, 4, 3)[..., rows, columns]
    colour = theirs.psi.colour
    psi = replace(
        theirs.psi,
        weights=np.ascontiguousarray(np.moveaxis(weights, 3, 4)),
        colour=None if colour is None else colour[:, rows, columns],
    )
    usable = other.used[:, y, x] & inside
    return Readings(psi, theirs.frames[:, y, x], theirs.typical, theirs.noise[:, y, x], usable)


def together(given: Readings, others: Sequence[Readings]) -> Readings:
    """Return frames of one scene as shots of one capture."""
    every = given, *others
    psis = [readings.psi for readings in every]
    colours = [psi.colour for psi in psis if psi.colour is not None]
    psi = replace(
        given.psi,
        weights=np.concatenate([psi.weights for psi in psis]),
        colour=np.concatenate(colours) if colours else None,
        camera_json="",
    )
    frames, noise, usable = (
        np.concatenate([getattr(readings, name) for readings in every])
        for name in ("frames", "noise", "usable")
    )
    return Readings(psi, frames, given.typical, noise, usable)


def others_of(plain: Plain, shown: Sequence[tuple[Readings, Array]]) -> list[OtherTime]:
    """Return frames of other times with the flow from and to a present one.

    plain: of the present. shown: readings, not over any scale, and the picture without surfaces
    (y, x, c) of each. Readings are used where they may show the same scene: inside of the present
    picture, and not far from what total variation foretells there.
    """
    psi = plain.given.psi
    k, weight = psi.binning, plain.held.astype(np.float32)
    allowed = mean_around(np.square(plain.plain_residual), weight, HELD_WINDOW_PX)[0]
    light_field, found = mixture.values(plain.plain), []
    for readings, picture in shown:
        there, back = flow_between(picture, plain.picture)
        at = at_places(psi.size)
        views = light_field.reshape(-1, *light_field.shape[2:])
        then = np.stack([sampled(view, at + there) for view in views]).reshape(light_field.shape)
        weight = readings.usable.astype(np.float32)
        moves, still = (
            mean_around(np.square(readings.frames - readings.psi.forward(predicted)), weight).sum(
                axis=0
            )
            for predicted in (then, light_field)
        )
        rests = (still <= REST * moves).astype(np.float32)
        there, back = rested(there, back, rests)
        places = at_places(allowed.shape) + there[k // 2 :: k, k // 2 :: k] / np.float32(k)
        same = (sampled(allowed, places) * ANOTHER >= np.minimum(moves, still)) & (
            sampled(plain.held[0].astype(np.float32), places) < 0.5
        )
        inside = ((places >= 0) & (places <= np.array(same.shape) - 1)).all(axis=-1)
        moving = 1 - (1 - RESTING) * cv2.GaussianBlur(rests, (0, 0), REST_PX)
        used = readings.usable & same & inside
        used &= used.mean() >= LEAST_SEEN
        found.append(OtherTime(readings, used, picture, there, back, moving))
    return found


def rested(there: Array, back: Array, rests: Array) -> tuple[Array, Array]:
    """Return flows that are 0 where the scene rests, (pixel_y, pixel_x) at the present time."""
    smooth = np.asarray(cv2.GaussianBlur(rests, (0, 0), REST_PX), dtype=np.float32)
    rests = of_samples(smooth, back)
    then = sampled(rests, at_places(rests.shape) + there)
    return there * (1 - then)[..., None], back * (1 - rests)[..., None]


def surveyed_together(
    given: Readings,
    shown: Sequence[tuple[Readings, Array]],
    settings: AdaptiveSettings,
    on_searched: Callable[[int], None],
) -> tuple[Survey, list[OtherTime]]:
    """Return what is decided for a scene at present, from all frames as shots; and the others.

    shown: see `others_of`. The frames returned are over the scene's scale.
    """
    others = others_of(plain_of(given, 1.0, unseen_by(given), settings.start_steps), shown)
    whole = together(given, [aligned(other, given.psi.binning) for other in others])
    survey = surveyed(whole, settings, None, on_searched)
    return survey, [replace(other, readings=other.readings.over(survey.scale)) for other in others]


def of_present(survey: Survey, given: Readings) -> Survey:
    """Return a survey of several times, of the present frame alone."""
    residual = given.frames - given.psi.forward(mixture.values(survey.plain))
    return replace(
        survey,
        given=given,
        bright=given.over(survey.scale),
        held=survey.held[:1],
        plain_residual=residual,
    )


def of_samples(pixels: NDArray, of: Array) -> NDArray:
    """Return values of pixels at each of their samples; of: an array (y, x, ...) of these."""
    k = len(of) // len(pixels)
    return pixels.repeat(k, axis=0).repeat(k, axis=1)


def moved(others: Sequence[OtherTime]) -> dict[str, float]:
    """Return how far places moved at most to the furthest time, pixels, and what share is seen."""
    steps = (
        np.linalg.norm(other.there[of_samples(other.used[0], other.there)], axis=-1)
        for other in others
    )
    return {
        "moved_px": max((float(np.quantile(by, UP_TO)) for by in steps if by.size), default=0.0),
        "seen_share": float(np.mean([other.used.mean() for other in others])),
    }
