"""Robust statistics of residuals: deviation by the median, Tukey's biweight, clipped correlation.

Source of the loss: Holland & Welsch 1977.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
TUKEY = 4.685
"""Times the deviation: 95 % as sure as least squares where the noise is normal."""
OUTLIER = 4.0
"""Deviations at which values are clipped before they are correlated."""


def deviation_of(residuals: Array) -> float:
    """Return the standard deviation of normal residuals about 0, by their median size."""
    return float(1.4826 * np.median(np.abs(residuals)))


def tukey_loss(scaled: Array) -> float:
    """Return Tukey's loss of residuals in deviations."""
    within = np.clip((scaled / TUKEY) ** 2, 0, 1)
    return float(TUKEY**2 / 6 * np.sum(1 - (1 - within) ** 3))


def tukey_weights(scaled: Array) -> Array:
    """Return Tukey's weights of residuals in deviations."""
    return np.clip(1 - (scaled / TUKEY) ** 2, 0, None) ** 2


def tukey_curvatures(scaled: Array) -> Array:
    """Return the second derivative of Tukey's loss of residuals in deviations."""
    within = np.clip((scaled / TUKEY) ** 2, 0, 1)
    return (1 - within) * (1 - 5 * within)


def correlation(reading: Array, drawn: Array, channels: NDArray[np.integer]) -> float:
    """Return the correlation of readings with what is drawn, (n,) each, outliers clipped.

    channels: (n,); each has a level of its own.
    """
    products = squares = drawn_squares = 0.0
    for channel in np.unique(channels):
        seen = channels == channel
        a = reading[seen] - np.median(reading[seen])
        a = np.clip(a, -OUTLIER * np.std(a), OUTLIER * np.std(a))
        a -= a.mean()
        b = drawn[seen] - drawn[seen].mean()
        products += float(a @ b)
        squares += float(a @ a)
        drawn_squares += float(b @ b)
    return products / float(np.sqrt(max(squares * drawn_squares, 1e-300)))
