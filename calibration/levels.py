"""What lamp and sensor response did while whiteboards were taken, from boards seen more than once.

A check is the mean level of a board that is seen repeatedly: with the aperture open and the masks
in one place, or without masks, at one exposure or several. For every colour of pixels

    log(level / exposure_s) = c_board + l(taken_s) - b level

with c_board the logarithm of the board's rate under the lamp of the first knot, l the lamp's
logarithm (a line between knots in time, 0 at the first knot), and b the bend of the sensor's
response, per DN, alike for all colours. All are the linear least squares of all checks together;
b has the prior b level_brightest ~ N(0, BEND_PRIOR^2), and the lamp's second differences between
knots N(0, CURVATURE_PRIOR^2).
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
"""Red, green and blue pixels, and those that see all colours."""
MOST_KNOTS = 8
"""Of the lamp's line in time: a lamp warms up over minutes."""
TRIMMED = 0.01
"""Share of the pixels at either end that a check's mean leaves out: hot pixels saturate."""
LEAST_DEVIATION = 5e-5
"""Of a check's logarithm: lamps and shutters flicker by that much at best."""
BEND_PRIOR = 0.2
"""Of the response's loss at the brightest check: its standard deviation before any check."""
CURVATURE_PRIOR = 0.01
"""Of the lamp's second differences between knots."""
SIGNIFICANT = 4.0
"""Standard deviations: exceeded by chance once in 16 000."""
LEAST_BEND = 5e-4
"""Relative loss of the brightest check: ten times LEAST_DEVIATION."""
LEAST_DRIFT = 5e-4
"""Relative change of the lamp: ten times LEAST_DEVIATION."""


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
    """Lamp and response as fitted.

    knots_s: (knot,), times on the clock of the capture.
    lamp: (knot, channel), the lamp's logarithm, 0 at the first knot.
    bend_per_dn, bend_deviation: of the response, and its standard deviation.
    bend_known: boards were seen at several exposures.
    brightest_dn: largest level of a check above the dark.
    drift: peak to peak of the lamp's logarithm, the largest of the colours.
    colour_drift: peak to peak of a colour against the mean of all.
    deviation: standard deviation of the lamp's logarithm, median over knots and colours.
    significance: largest change of the lamp since the first knot, in standard deviations.
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
    above = (frame.mean_dn - dark_dn).astype(np.float64)
    means = tuple(
        _trimmed_mean(above[channels == c]) if (channels == c).any() else np.nan
        for c in range(CHANNELS)
    )
    level = max(float(above.mean()), 1e-9)
    # At most: shot noise at 1 DN per electron.
    deviation = np.sqrt(CHANNELS / above.size / frame.count / level)
    return Check(board, frame.taken_s, frame.exposure_s, means, float(deviation), masks_in)


def _trimmed_mean(values: Array) -> float:
    """Return the mean of values (n,) without TRIMMED of them at either end."""
    # As scipy.stats.trim_mean, which takes a third of a second to load.
    left_out = int(TRIMMED * len(values))
    kept = slice(left_out, len(values) - left_out)
    return float(np.partition(values, (kept.start, kept.stop - 1))[kept].mean())


@dataclass(frozen=True, eq=False)
class _Equations:
    """Linear equations of checks and priors, scaled to unit deviation.

    Unknowns, for each of `channels` in turn: c_board of every board, then the lamp's logarithm at
    every knot but the first; last, the loss b level_brightest.

    channels: the colours that some pixels see. lamp_places: the lamp's unknowns, by channel.
    knots_s: (knot,). matrix: (equation, unknown). right: (equation,).
    """

    channels: NDArray[np.intp]
    lamp_places: list[slice]
    knots_s: NDArray[np.float64]
    matrix: NDArray[np.float64]
    right: NDArray[np.float64]


def _equations(checks: Sequence[Check], boards: Sequence[str], brightest: float) -> _Equations:
    """Return the equations of all checks, and the priors of the lamp's curvature and the bend."""
    times = np.array([check.taken_s for check in checks])
    levels = np.array([check.above_dn for check in checks])
    channels = np.flatnonzero(np.isfinite(levels).all(axis=0))
    count = int(np.clip(len(np.unique(times)) - len(boards), 2, MOST_KNOTS))
    knots_s = np.linspace(times.min(), max(times.max(), times.min() + 1e-9), count)
    # What every knot counts at every check: 1 at the knot, 0 at the others, lines between.
    hats = np.stack([np.interp(times, knots_s, row) for row in np.eye(count)], axis=1)
    per_channel = len(boards) + count - 1
    size = len(channels) * per_channel + 1
    lamp_places = [
        slice(k * per_channel + len(boards), (k + 1) * per_channel) for k in range(len(channels))
    ]
    rows, values = [], []
    for lamp, channel in zip(lamp_places, channels, strict=True):
        for i, check in enumerate(checks):
            row = np.zeros(size)
            row[lamp.start - len(boards) + boards.index(check.board)] = 1
            row[lamp] = hats[i, 1:]
            row[-1] = -levels[i, channel] / brightest
            deviation = max(check.deviation, LEAST_DEVIATION)
            rows.append(row / deviation)
            values.append(np.log(levels[i, channel] / check.exposure_s) / deviation)
        for knot in range(1, count - 1):
            second_difference = np.zeros(count)
            second_difference[knot - 1 : knot + 2] = 1, -2, 1
            row = np.zeros(size)
            row[lamp] = second_difference[1:]
            rows.append(row / CURVATURE_PRIOR)
            values.append(0.0)
    bend = np.zeros(size)
    bend[-1] = 1 / BEND_PRIOR
    return _Equations(
        channels, lamp_places, knots_s, np.stack([*rows, bend]), np.array([*values, 0.0])
    )


def fit_levels(checks: Sequence[Check]) -> Levels | None:
    """Return lamp and response from checks; None where no board was seen twice.

    The deviations are those of least squares, (M^T M)^-1, times the residual where that is
    larger than the noise stated. Raises CalibrationError for a dark board.
    """
    boards = sorted({check.board for check in checks})
    if len(checks) <= len(boards):
        return None
    if any(np.nanmin(check.above_dn) <= 0 for check in checks):
        raise CalibrationError(
            "a whiteboard that was seen again is dark: is the lamp on, and the aperture open?"
        )
    brightest = float(np.nanmax([check.above_dn for check in checks]))
    equations = _equations(checks, boards, brightest)
    matrix, right, channels = equations.matrix, equations.right, equations.channels
    solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
    freedom = max(len(checks) * len(channels) - len(solution), 1)
    residual = float(np.sqrt(np.sum((right - matrix @ solution) ** 2) / freedom))
    covariance = np.linalg.pinv(matrix.T @ matrix)
    deviation = np.sqrt(np.diag(covariance)) * max(residual, 1.0)
    lamp = np.zeros((len(equations.knots_s), CHANNELS))
    for place, channel in zip(equations.lamp_places, channels, strict=True):
        lamp[1:, channel] = solution[place]
    lamp_deviation = np.array([deviation[place] for place in equations.lamp_places])
    seen = lamp[:, channels]
    # One exposure of every board tells nothing of the bend.
    known = len({(check.board, check.exposure_s) for check in checks}) > len(boards)
    return Levels(
        knots_s=equations.knots_s,
        lamp=lamp,
        bend_per_dn=float(solution[-1]) / brightest if known else 0.0,
        bend_deviation=float(deviation[-1]) / brightest,
        bend_known=known,
        brightest_dn=brightest,
        drift=float(np.ptp(seen, axis=0).max()),
        colour_drift=float(np.ptp(seen - seen.mean(axis=1, keepdims=True), axis=0).max()),
        deviation=float(np.median(lamp_deviation)),
        significance=float(np.max(np.abs(seen[1:].T) / lamp_deviation)),
    )
