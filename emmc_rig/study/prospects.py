"""What the methods would reach on the frames at hand: a trial on windows of them.

`adaptive` states a standard deviation sigma of every sample, calibrated on held-out readings; the
mean of sigma^2 over the windows, times TAILS, is its expected squared error e. The trial shows how
far the light field M of another method is from its A. The error of M, |M - L|^2, is

    |M - A|^2 + e   where the error of A does not depend on M - A (expected),
    |M - A|^2 - e   where the errors of A and M do not depend on each other (at best).

e itself is known within UNSURE_DB only: the deviation of a sample does not follow from that of a
reading alone, which averages over many rays. A method far from A is therefore predicted closely,
and A itself within an interval.

Seconds are those of the trial on this machine, times the light field's values over the window's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.methods import reconstruct

CANDIDATES = ("tv", "adaptive-fast", "adaptive")
"""From quick to accurate. The methods of sparse patches take longer than `adaptive` and are less
accurate in every pooled chart of `emmc-rig chart`."""
WINDOW = 96
"""Samples a side of a window, at most."""
PLACES = (1 / 3, 2 / 3)
"""Of the windows' middles, as shares of rows and columns."""
TAILS = 1.7
"""Mean squared error over mean sigma^2, which is calibrated on the bulk of the errors: on average
over the 21 captures of group A below."""
UNSURE_DB = 3.0
"""By which the expected error e may be off, to both sides: 17 of 21 captures of group A lie within
(96x96 at noise 0.0005 and 0.004, 160x160 at 0.002)."""
SURE_DB = 1.0
"""Half the width of an interval that counts as an answer."""


@dataclass(frozen=True)
class Prospect:
    """What is expected of a method on a capture: PSNR in dB with the ends of its interval, and
    seconds. The interval is from 0 to infinity where no deviation could be stated."""

    method: str
    seconds: float
    psnr_db: float
    low_db: float
    high_db: float

    @property
    def is_sure(self) -> bool:
        """Whether the frames say it within SURE_DB."""
        return self.high_db - self.low_db <= 2 * SURE_DB


def prospects(psi: ImagingMatrix, frames: Frames) -> list[Prospect]:
    """Return what each of CANDIDATES would reach on these frames.

    Raises ReconstructionError for frames that do not fit Psi.
    """
    apart, seconds, expected = [], [], []
    values = float(np.prod(psi.light_field_shape))
    for part, seen in _windows(psi, frames):
        results = [
            reconstruct(name, part, seen.readings, seen.noise_sigma, usable=seen.usable)
            for name in CANDIDATES
        ]
        best = results[-1]
        more = values / float(np.prod(part.light_field_shape))
        apart.append([np.square(one.light_field - best.light_field).mean() for one in results])
        seconds.append([one.seconds * more for one in results])
        sigma = best.maps.get("sigma")
        expected.append(np.nan if sigma is None else TAILS * float(np.square(sigma).mean()))
    errors, off = np.mean(apart, axis=0), 10 ** (UNSURE_DB / 10)
    stated = float(np.mean(expected))
    took = np.min(seconds, axis=0)
    return [
        Prospect(name, float(one), *_decibels(float(error), stated, off))
        for name, one, error in zip(CANDIDATES, took, errors, strict=True)
    ]


def _decibels(apart: float, stated: float, off: float) -> tuple[float, float, float]:
    """Return the expected PSNR, and the lowest and highest, of a method so far from `adaptive`."""
    if not np.isfinite(stated):
        return -_db(apart) if apart > 0 else np.inf, 0.0, np.inf
    least = max(apart - stated, stated / off)
    return -_db(apart + stated), -_db(apart + stated * off), -_db(least)


def _db(error: float) -> float:
    return 10 * float(np.log10(max(error, 1e-12)))


def _windows(psi: ImagingMatrix, frames: Frames) -> Iterator[tuple[ImagingMatrix, Frames]]:
    """Yield windows of Psi and the frames, one where they cover each other."""
    k = psi.binning
    starts: Sequence[tuple[int, ...]] = [
        tuple(_start(place, length, k) for length in psi.size) for place in PLACES
    ]
    for first in dict.fromkeys(starts):
        rows, columns = (
            slice(at, at + min(WINDOW // k * k, length))
            for at, length in zip(first, psi.size, strict=True)
        )
        pixels = np.s_[:, rows.start // k : rows.stop // k, columns.start // k : columns.stop // k]
        seen = Frames(frames.readings[pixels], frames.deviation[pixels], frames.usable[pixels])
        yield psi.window(rows, columns), seen


def _start(place: float, length: int, k: int) -> int:
    """Return the first sample of a window about a place, on a pixel's edge."""
    side = min(WINDOW // k * k, length)
    return min(max(round(place * length - side / 2), 0), length - side) // k * k
