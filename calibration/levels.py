"""What lamp and sensor response did while whiteboards were taken, from boards seen more than once.

A check is a board's mean level, seen again and again: with the aperture open and the masks in one
place, or without masks, at one exposure or several. Its logarithm is the sum
of the board's, the lamp's at that time, and the response's loss: log(level / exposure) = c_board +
l(time) - b level. l is a line between knots in time, for every colour of pixels, and b a figure of
the sensor; both are the linear least squares of all checks together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import MeanFrame

Array = NDArray[np.floating]
CHANNELS = 4
MOST_KNOTS = 8
TRIMMED = 0.01
LEAST_DEVIATION = 5e-5
"""Of a check's logarithm: lamps and shutters flicker by that much at best."""
BEND_PRIOR = 0.2
"""Of the response's loss at the brightest check: its standard deviation before any check."""
CURVATURE_PRIOR = 0.01
"""Of the lamp's second differences between knots."""
SIGNIFICANT = 4.0
LEAST_BEND = 5e-4
LEAST_DRIFT = 5e-4


@dataclass(frozen=True)
class Check:
    """One look at a board that is seen several times.

    board: which one; masks_in: seen through the masks. above_dn: mean above the dark by the colour
    pixels see (3: all), NaN for colours without pixels. deviation: relative, of that mean.
    """

    board: str
    taken_s: float
    exposure_s: float
    above_dn: tuple[float, ...]
    deviation: float
    masks_in: bool = False


@dataclass(frozen=True, eq=False)
class Levels:
    """The lamp's logarithm at knots in time, (knot, channel), and the response's bend per DN.

    drift: peak to peak of the lamp over the checks, the largest of the colours. bend_known:
    more than one exposure shows it. deviation: of the lamp's logarithm, typical; significance: of
    the largest step of it from the first knot.
    """

    knots_s: NDArray[np.float64]
    lamp: NDArray[np.float64]
    bend_per_dn: float
    bend_deviation: float
    bend_known: bool
    brightest_dn: float
    drift: float
    colour_drift: float
    deviation: float
    significance: float

    @property
    def bent(self) -> bool:
        """Whether the response bends by more than its own deviation and enough to matter."""
        loss = abs(self.bend_per_dn) * self.brightest_dn
        return loss > LEAST_BEND and abs(self.bend_per_dn) > SIGNIFICANT * self.bend_deviation

    @property
    def drifting(self) -> bool:
        """Whether the lamp drifts beyond its deviation and enough to matter."""
        return self.drift > LEAST_DRIFT and self.significance > SIGNIFICANT

    def corrected(self, frame: MeanFrame, dark_dn: Array, channels: NDArray[np.uint8]) -> MeanFrame:
        """Return a frame as a straight sensor sees it under the lamp of the first check.

        dark_dn: of its exposure; channels: (y, x), the colour that each pixel sees.
        """
        if not (self.bent or self.drifting):
            return frame
        above = frame.mean_dn - dark_dn
        if self.bent:
            above = above * np.exp(self.bend_per_dn * np.maximum(above, 0))
        extra = frame.extra_variance_dn2
        if self.drifting:
            lamp = np.array(
                [np.interp(frame.taken_s, self.knots_s, self.lamp[:, c]) for c in range(CHANNELS)]
            )
            above = above / np.exp(lamp)[channels]
            extra += float((np.mean(above) * self.deviation) ** 2)
        mean = (dark_dn + above).astype(np.float32)
        return replace(frame, mean_dn=mean, extra_variance_dn2=extra)


def check_of(
    frame: MeanFrame,
    masks_in: bool,
    dark_dn: Array,
    channels: NDArray[np.uint8],
    turn_deg: float = 0,
) -> Check:
    """Return the check that a frame of the open aperture is.

    dark_dn, channels: (y, x), as `Levels.corrected`'s. turn_deg: of the white board.
    """
    board = f"{'masks in' if masks_in else 'without masks'}, turned by {turn_deg:g}"
    # Hot pixels saturate, and would bend the mean. scipy.stats loads for a second: here only.
    from scipy.stats import trim_mean

    above = (frame.mean_dn - dark_dn).astype(np.float64)
    means = tuple(
        float(trim_mean(above[channels == c], TRIMMED)) if (channels == c).any() else np.nan
        for c in range(CHANNELS)
    )
    level = max(float(above.mean()), 1e-9)
    # At most: shot noise at 1 DN per electron.
    deviation = np.sqrt(CHANNELS / above.size / frame.count / level)
    return Check(board, frame.taken_s, frame.exposure_s, means, float(deviation), masks_in)


def fit_levels(checks: Sequence[Check]) -> Levels | None:
    """Return lamp and response from checks; None where no board was seen twice.

    Raises CalibrationError for a dark board.
    """
    boards = sorted({check.board for check in checks})
    if len(checks) <= len(boards):
        return None
    if any(np.nanmin(check.above_dn) <= 0 for check in checks):
        raise CalibrationError(
            "a whiteboard that was seen again is dark: is the lamp on, and the aperture open?"
        )
    times = np.array([check.taken_s for check in checks])
    levels = np.array([check.above_dn for check in checks])
    channels = np.flatnonzero(np.isfinite(levels).all(axis=0))
    brightest = float(np.nanmax(levels))
    repeats = len(np.unique(times))
    count = int(np.clip(repeats - len(boards), 2, MOST_KNOTS))
    knots = np.linspace(times.min(), max(times.max(), times.min() + 1e-9), count)
    hats = np.stack([np.interp(times, knots, row) for row in np.eye(count)], axis=1)
    per_channel = len(boards) + count - 1
    size = len(channels) * per_channel + 1
    rows, values = [], []
    for k, channel in enumerate(channels):
        for i, check in enumerate(checks):
            row = np.zeros(size)
            at = k * per_channel
            row[at + boards.index(check.board)] = 1
            row[at + len(boards) : at + per_channel] = hats[i, 1:]
            row[-1] = -levels[i, channel] / brightest
            deviation = max(check.deviation, LEAST_DEVIATION)
            rows.append(row / deviation)
            values.append(np.log(levels[i, channel] / check.exposure_s) / deviation)
        for knot in range(1, count - 1):
            row = np.zeros(size)
            for step, share in ((-1, 1), (0, -2), (1, 1)):
                if knot + step > 0:
                    row[k * per_channel + len(boards) + knot + step - 1] = share
            rows.append(row / CURVATURE_PRIOR)
            values.append(0.0)
    prior = np.zeros(size)
    prior[-1] = 1 / BEND_PRIOR
    matrix, right = np.stack([*rows, prior]), np.array([*values, 0.0])
    solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
    covariance = np.linalg.pinv(matrix.T @ matrix)
    left = right - matrix @ solution
    freedom = max(len(checks) * len(channels) - size, 1)
    residual = float(np.sqrt(np.sum(left**2) / freedom))
    lamp = np.zeros((count, CHANNELS))
    deviations, steps = [], []
    for k, channel in enumerate(channels):
        part = slice(k * per_channel + len(boards), (k + 1) * per_channel)
        lamp[1:, channel] = solution[part]
        deviations.append(np.sqrt(np.diag(covariance)[part]) * max(residual, 1.0))
        steps.append(np.abs(lamp[1:, channel]))
    known = len({(check.board, check.exposure_s) for check in checks}) > len(boards)
    spread = np.ptp(lamp[:, channels], axis=0)
    differences = lamp[:, channels] - lamp[:, channels].mean(axis=1, keepdims=True)
    return Levels(
        knots,
        lamp,
        float(solution[-1]) / brightest if known else 0.0,
        float(np.sqrt(covariance[-1, -1])) * max(residual, 1.0) / brightest,
        known,
        brightest,
        float(spread.max()),
        float(np.ptp(differences, axis=0).max()),
        float(np.median(deviations)),
        float(np.max(np.array(steps) / np.array(deviations))),
    )
