"""Psi from whiteboards: every coefficient measured through a pinhole stepped over the views.

With the pinhole before view j and lamp colour c, a pixel reads its coefficient of (j, c) times
the lamp. The same pixel with the aperture open and the masks out reads, by Psi's normalisation,
1 from a white board. So a coefficient is the ratio of the two signals, each divided by its
exposure, and the lamp's level, the pixel's sensitivity and the lens' falloff cancel.

Where a pixel sums several samples (r < 1) the pinhole measures only their sum: it is shared out
among them as in the designed Psi.

Source: whiteboard calibration as in Marwah et al. (ACM TOG 2013), supplement, the paper's [17].
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import (
    DARKEST_REFERENCE_DN,
    LAMP_COLOURS,
    BoardFrame,
    BoardSet,
    ratio_of,
    signal_of,
)
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import MeanFrame, SensorGain, bands, photon_transfer
from emmc_rig.model.camera import measured_views
from emmc_rig.model.sensing import Psi, PsiLayout

Array = NDArray[np.floating]
LARGEST_DARK_SHARE = 0.01
IDEAL_DN = 1e6
"""White of `ideal_boards`: rounding errors below 1e-6."""
NewArray = Callable[[str, tuple[int, ...]], Any]
Plane = tuple[tuple[int, int, int, int], NDArray[np.float32], NDArray[np.float32]]


def lamps_needed(design: PsiLayout) -> tuple[str, ...]:
    """Return the lamp colours to measure under: white alone where a pixel sees one colour only."""
    return LAMP_COLOURS if design.colour is None else ("white",)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The measured Psi, how sure it is, and what turns frames into readings.

    deviation: standard deviation of every coefficient, shaped as `psi.weights`.
    white_dn_per_s: (shot, y, x), what a reading of 1 gives. gain: of the sensor. good: (y, x),
    pixels to use at all (None: all).
    """

    psi: Psi
    deviation: NDArray[np.float32]
    dark_dn: NDArray[np.float32]
    white_dn_per_s: NDArray[np.float32]
    gain: SensorGain
    good: NDArray[np.bool_] | None = None

    def of_shots(self, shots: Sequence[int], camera_json: str = "") -> Calibration:
        """Return the calibration of some shots alone; camera_json: see `Psi.of_shots`."""
        chosen = list(shots)
        return replace(
            self,
            psi=self.psi.of_shots(chosen, camera_json),
            deviation=self.deviation[chosen],
            white_dn_per_s=self.white_dn_per_s[chosen],
        )

    @property
    def stated_error(self) -> float:
        """The relative error of Psi that the deviations state, root mean square."""
        missed = total = 0.0
        for place in np.ndindex(*self.deviation.shape[:3]):
            missed += float(np.sum(np.square(self.deviation[place]), dtype=np.float64))
            total += float(np.sum(np.square(self.psi.weights[place]), dtype=np.float64))
        return float(np.sqrt(missed / max(total, 1e-300)))


def in_memory(name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an array for Psi's `weights` or their `deviation`, of any content."""
    return np.empty(shape, dtype=np.float32)


def measure_psi(
    boards: BoardSet,
    design: PsiLayout,
    empty: NewArray = in_memory,
    on_plane: Callable[[str], None] = lambda what: None,
) -> Calibration:
    """Return the measured Psi with the standard deviation of every coefficient.

    design: Psi as designed, or its layout; gives the sizes, the colour of every pixel, and how
    a pixel's coefficient is shared among its samples (of a layout: evenly). empty: makes the arrays
    of coefficients, written view by view: in memory, or on disk for sensors whose Psi does not fit
    there. on_plane: called after each. Raises CalibrationError for missing frames, frames of
    another size, and a whiteboard too dark to divide by.
    """
    designed = design.weights if isinstance(design, Psi) else None
    gain = _gain(boards, design)
    weights, deviation = (empty(name, design.weights_shape) for name in ("weights", "deviation"))
    for (shot, v, u, stored), values, spread in measured_planes(boards, design, designed):
        weights[shot, v, u, :, stored] = values
        deviation[shot, v, u, :, stored] = spread
        on_plane(f"view ({v}, {u})")
    white = np.zeros(design.frames_shape, dtype=np.float32)
    for shot, reading in enumerate(white):
        for reference in _references(boards, gain, design, shot):
            dark, least = boards.dark_at(reference.exposure_s), DARKEST_REFERENCE_DN
            for rows in bands(reading):
                signal = signal_of(reference, dark, gain, rows)[0]
                reading[rows] += np.maximum(signal, least / reference.exposure_s)
    return Calibration(design.psi(weights), deviation, boards.dark.mean_dn, white, gain)


def measured_planes(
    boards: BoardSet, layout: PsiLayout, designed: Array | None = None
) -> Iterator[Plane]:
    """Yield ((shot, v, u, stored colour), coefficients, their deviation), both (y, x).

    One plane is held at a time, and one whiteboard is read. What is computed is computed by bands
    of rows. designed: Psi's weights as
    designed, which say how a pixel's coefficient is shared among its samples (default: evenly). A
    view outside of the lens's pupil needs no whiteboard: its coefficients are 0. Raises as
    `measure_psi`.
    """
    lamps = lamps_needed(layout)
    gain = _gain(boards, layout)
    views_v, views_u = layout.views
    k = layout.binning
    pinholes = {(board.shot, board.pinhole, board.lamp): board for board in boards.frames}
    measured = measured_views(layout)
    for shot in range(layout.weights_shape[0]):
        references = _references(boards, gain, layout, shot)
        for v, u in np.ndindex(views_v, views_u):
            for stored, lamp in enumerate(lamps):
                name = f"shot {shot}, view ({v}, {u}), {lamp} lamp"
                taken = pinholes.get((shot, (v, u), lamp))
                if taken is None and not measured[v, u]:
                    shut = np.zeros(layout.size, dtype=np.float32)
                    yield (shot, v, u, stored), shut, shut
                    continue
                pinhole = _require_frame(boards, None if taken is None else taken.frame, name)
                dark = boards.dark_at(pinhole.exposure_s)
                values, deviation = (np.empty(layout.size, dtype=np.float32) for _ in range(2))
                white = references[stored]
                how = pinhole, dark, white, boards.dark_at(white.exposure_s), gain
                for rows in bands(pinhole.mean_dn):
                    ratio, variance, _ = ratio_of(*how, rows)
                    samples = slice(k * rows.start, k * rows.stop)
                    share = 1 / (k**2 * len(lamps))
                    if designed is not None and k > 1:
                        plane = designed[shot, v, u, samples, stored]
                        share = _designed_shares(plane, k) / len(lamps)
                    values[samples] = share * _repeat_samples(np.maximum(ratio, 0), k)
                    deviation[samples] = share * _repeat_samples(np.sqrt(variance), k)
                yield (shot, v, u, stored), values, deviation


def _gain(boards: BoardSet, layout: PsiLayout) -> SensorGain:
    first = boards.references.get((0, lamps_needed(layout)[0]))
    if first is None:
        raise CalibrationError("no reference whiteboard: open the aperture, take the masks out")
    return photon_transfer(boards.dark, first)


def _references(
    boards: BoardSet, gain: SensorGain, layout: PsiLayout, shot: int
) -> list[MeanFrame]:
    """Return the references of a shot, lamp by lamp; refuses those too dark to divide by."""
    found = []
    for lamp in lamps_needed(layout):
        what = f"shot {shot}, {lamp} lamp"
        frame = boards.references.get((shot, lamp))
        frame = _require_frame(boards, frame, f"{what}, open aperture without masks")
        dark = [
            (frame.mean_dn[rows] - boards.dark.mean_dn[rows] < DARKEST_REFERENCE_DN).sum()
            for rows in bands(frame.mean_dn)
        ]
        if sum(dark) > LARGEST_DARK_SHARE * frame.mean_dn.size:
            raise CalibrationError(
                f"the reference whiteboard ({what}) has pixels less than {DARKEST_REFERENCE_DN:g} "
                "DN above the dark: brighten the lamp or expose longer"
            )
        found.append(frame)
    return found


def ideal_boards(
    readings: Mapping[tuple[int, int, int, str], Array],
    lamps: tuple[str, ...],
    design: Psi,
    white: Array | None = None,
) -> BoardSet:
    """Return the whiteboards of a noise-free sensor from what a simulated bench really reads.

    readings: (pixel_y, pixel_x) through the pinhole, by (shot, v, u, lamp). white: what the open
    camera without masks reads of the white board, (pixel_y, pixel_x), of which each of several lamp
    colours gives its share; None: 1.
    """

    def frame(reading: Array) -> MeanFrame:
        return MeanFrame((reading * IDEAL_DN).astype(np.float32), 0.0, 2, 1.0)

    size = design.frames_shape[1:]
    of_lamp = frame(np.full(size, 1 / len(lamps)) if white is None else white / len(lamps))
    references = {(shot, lamp): of_lamp for shot in range(design.shots) for lamp in lamps}
    pinholes = tuple(
        BoardFrame.held(frame(reading), (0.0, 0.0), shot, (v, u), lamp)
        for (shot, v, u, lamp), reading in readings.items()
    )
    return BoardSet((frame(np.zeros(size)),), references, pinholes)


def _require_frame(boards: BoardSet, frame: MeanFrame | None, what: str) -> MeanFrame:
    """Return a frame that is there, and of the size of the others."""
    if frame is None:
        raise CalibrationError(f"whiteboard missing: {what}; capture it before measuring Psi")
    if frame.mean_dn.shape != boards.dark.mean_dn.shape:
        raise CalibrationError(f"whiteboard {what}: another size than the dark frame")
    return frame


def _repeat_samples(pixels: Array, binning: int) -> Array:
    return np.repeat(np.repeat(pixels, binning, axis=0), binning, axis=1)


def _designed_shares(designed: Array, binning: int) -> Array:
    """Return what share of its pixel's coefficient each sample has in the design, (y, x)."""
    rows, columns = designed.shape[0] // binning, designed.shape[1] // binning
    sums = designed.reshape(rows, binning, columns, binning).sum(axis=(1, 3))
    whole = _repeat_samples(sums, binning)
    even = 1 / binning**2
    return np.where(whole > 0, designed / np.where(whole > 0, whole, 1), even)
