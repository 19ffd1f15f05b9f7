"""The place of an axis at which the picture is sharpest: a scan, a finer one, a parabola's peak."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.stage import Stage
from emmc_rig.errors import AppError
from emmc_rig.live.focus import Sharpness

COARSE, FINE = 9, 7
"""Places of the two scans."""
MOST_SCANS = 4
"""Of the coarse one, where the sharpest place lies at its end."""


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
            one = sharpness()
            if one is None:
                found.append((-np.inf, np.inf))
            else:
                found.append((np.log(one.value), one.deviation / one.value))
        return np.array([one[0] for one in found]), np.array([one[1] for one in found])

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
            raise AppError("no sharpest place within reach: begin nearer to it, or widen the span")
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
        raise AppError("no sharpest place is seen: begin nearer to it, or expose longer")
    slope = np.array([0.0, -1 / (2 * found[2]), found[1] / (2 * found[2] ** 2)])
    deviation = float(np.sqrt(spread * slope @ inverse @ slope))
    return middle + scale * float(-found[1] / (2 * found[2])), scale * deviation
