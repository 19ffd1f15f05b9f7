"""How sharp the picture is, from two frames in a row, and how that compares with a moment ago.

Noise differs between two frames, edges do not: the product of both frames' differences between
neighbours is the edges' energy alone, which noise neither raises nor, in the dark, imitates.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.drivers.raw import RawFrame
from emmc_rig.drivers.stage import Stage
from emmc_rig.errors import AppError
from emmc_rig.report.frame_view import colour_planes

LONGEST_PX = 1024
"""Of the frame's middle, in pixels of one colour."""
CLEAR = 5.0
"""Deviations that edges must lie above nothing, and brightness above black, to count."""
CORRELATED = 2.0
"""On the deviation: a pixel's noise is in the differences to two neighbours along each axis."""
REMEMBERED_S = 60.0
COARSE, FINE = 9, 7
"""Places of the two scans."""
MOST_SCANS = 4
"""Of the coarse one, where the sharpest place lies at its end."""


@dataclass(frozen=True)
class Sharpness:
    """Energy of the differences between neighbours over that of the picture, and its deviation."""

    value: float
    deviation: float


def sharpness(now: RawFrame, before: RawFrame) -> Sharpness | None:
    """Return the sharpness of two frames of a scene; None if frames differ or are dark."""
    alike = (now.mosaic.shape, now.cfa, now.exposure_s)
    if alike != (before.mosaic.shape, before.cfa, before.exposure_s):
        return None
    plane, other = _plane(now), _plane(before)
    noise = float(np.var(plane - other, dtype=np.float64)) / 2
    levels = float(plane.mean(dtype=np.float64)), float(other.mean(dtype=np.float64))
    surely_lit = CLEAR * np.sqrt(noise / plane.size) + 0.5
    if min(levels) <= surely_lit:
        return None
    energy, variance = 0.0, 0.0
    for axis in (0, 1):
        first, second = np.diff(plane, axis=axis), np.diff(other, axis=axis)
        product = float(np.vdot(first, second))
        spread = float(np.mean((first - second) ** 2, dtype=np.float64)) / 2
        energy += product / first.size
        variance += (2 * max(product, 0.0) * spread + first.size * spread**2) / first.size**2
    deviation = CORRELATED * float(np.sqrt(variance))
    if energy <= CLEAR * deviation:
        return None
    power = levels[0] * levels[1]
    return Sharpness(energy / power, deviation / power)


def _plane(frame: RawFrame) -> NDArray[np.float32]:
    """Return the middle of the frame's pixels of one colour, above black."""
    frame = frame.with_one_black()
    planes = colour_planes(frame)
    plane = planes.get("green", planes.get("grey", []))[0]
    cuts = []
    for length in plane.shape:
        kept = min(length, LONGEST_PX)
        cuts.append(slice((length - kept) // 2, (length - kept) // 2 + kept))
    return plane[tuple(cuts)].astype(np.float32) - np.float32(frame.black_dn)


class FocusMeter:
    """Measures the sharpness of each frame, relative to the sharpest frame of the last minute."""

    def __init__(self) -> None:
        self._before: RawFrame | None = None
        self._seen: deque[tuple[float, Sharpness]] = deque()

    def forget(self) -> None:
        """Compare with nothing seen so far: something else is before the camera.

        Another thread may call this method while `add` works: `add` keeps its frame.
        """
        self._before = None
        self._seen = deque()

    def add(self, frame: RawFrame, now_s: float) -> dict[str, float] | None:
        """Return the share of the best sharpness and its deviation; None where unknown."""
        before, self._before = self._before, frame
        found = None if before is None else sharpness(frame, before)
        seen = self._seen
        while seen and now_s - seen[0][0] > REMEMBERED_S:
            seen.popleft()
        if found is None:
            return None
        seen.append((now_s, found))
        best = max((sharp for _, sharp in seen), key=lambda sharp: sharp.value)
        share = found.value / best.value
        relative = np.hypot(found.deviation / found.value, best.deviation / best.value)
        return {
            "share": share,
            "deviation": 0.0 if found is best else float(share * relative),
            "value": found.value,
        }


@dataclass(frozen=True)
class FocusFound:
    """Where an axis has the picture sharpest, and the standard deviation of that place."""

    axis: str
    place_um: float
    deviation_um: float


class _StoppedError(Exception):
    """Somebody stopped the stage."""


def focused(
    stage: Stage,
    axis: str,
    span_um: float,
    sharpness: Callable[[], Sharpness | None],
    stopped: Callable[[], bool],
) -> FocusFound | None:
    """Move an axis to where the picture is sharpest, within `span_um` of where it stands.

    sharpness: of frames taken from now on. Returns None when stopped. Raises AppError where
    nothing is sharp enough to compare or no peak is seen, the axis back where it stood, and a
    `DriverError`.
    """
    begin_um = stage.position_um(axis)
    limits_um = stage.limits_um(axis)

    def seen(places_um: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the logarithm of the sharpness at each place, and its deviation."""
        found = []
        for place_um in places_um:
            if stopped():
                raise _StoppedError
            stage.move_to_um({axis: float(place_um)})
            sharp = sharpness()
            if sharp is None:
                found.append((-np.inf, np.inf))
            else:
                found.append((np.log(sharp.value), sharp.deviation / sharp.value))
        return np.array([value[0] for value in found]), np.array([value[1] for value in found])

    try:
        middle_um = begin_um
        for _ in range(MOST_SCANS):
            ends_um = np.clip([middle_um - span_um, middle_um + span_um], *limits_um)
            places_um = np.linspace(ends_um[0], ends_um[1], COARSE)
            values, _ = seen(places_um)
            best = int(values.argmax())
            if not np.isfinite(values[best]):
                raise AppError("no edge above the noise: light the scene, expose longer")
            middle_um = float(places_um[best])
            if 0 < best < COARSE - 1:
                break
        else:
            raise AppError(
                "no sharpest position within the span: start nearer to it, or widen the span"
            )
        step_um = float(places_um[1] - places_um[0])
        places_um = np.linspace(middle_um - step_um, middle_um + step_um, FINE)
        values, errors = seen(places_um)
        place_um, deviation_um = peak(places_um, values, errors)
        stage.move_to_um({axis: place_um})
    except _StoppedError:
        return None
    except AppError:
        stage.move_to_um({axis: begin_um})
        raise
    return FocusFound(axis, place_um, deviation_um)


def peak(places: np.ndarray, values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """Return the peak of a parabola through values with errors, and its deviation.

    The deviation is that of the fit, no smaller than the scatter about the parabola says. Raises
    AppError where there is no peak between the places.
    """
    good = np.isfinite(values)
    if good.sum() < 4:
        raise AppError("no edge above the noise: light the scene, expose longer")
    middle, scale = float(places.mean()), float(np.ptp(places)) / 2
    x = (places[good] - middle) / scale
    rows = np.stack([np.ones_like(x), x, x**2], axis=1) / errors[good, None]
    inverse = np.linalg.inv(rows.T @ rows)
    found = inverse @ (rows.T @ (values[good] / errors[good]))
    left = values[good] / errors[good] - rows @ found
    spread = max(1.0, float(left @ left) / max(1, len(x) - 3))
    if found[2] >= 0 or abs(found[1] / (2 * found[2])) > 1:
        raise AppError("no sharpest position is seen: start nearer to it, or expose longer")
    slope = np.array([0.0, -1 / (2 * found[2]), found[1] / (2 * found[2] ** 2)])
    deviation = float(np.sqrt(spread * slope @ inverse @ slope))
    return middle + scale * float(-found[1] / (2 * found[2])), scale * deviation
