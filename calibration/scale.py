"""From raw frames to readings: the only place where raw values are normalised.

A reading is (mosaic - dark) / (gain x exposure x white): 1 is what the fully open camera reads of a
white board. The variance of a reading is that of the sensor at that signal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.bracket import fuse
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import MeanFrame, SensorGain, dark_at
from emmc_rig.model.camera import camera_of, json_of_shots, pixel_light
from emmc_rig.model.errors import ModelError
from emmc_rig.model.frames import Exposure, Frames
from emmc_rig.model.sensing import Psi

MANY = 1_000_000
"""Frames of a dark whose own noise is not known, and is left out."""


class RawValues(Protocol):
    """A frame as the sensor gave it, such as a `drivers.raw.RawFrame`."""

    @property
    def mosaic(self) -> NDArray[np.uint16]:
        """Values in DN, (y, x), black level included."""
        ...

    @property
    def black_level_dn(self) -> NDArray[np.floating]:
        """Black levels, a tile that repeats over the mosaic, DN."""
        ...

    @property
    def white_level_dn(self) -> int:
        """Value of saturated pixels, DN."""
        ...

    @property
    def exposure_s(self) -> float | None:
        """Exposure in seconds; None if unknown."""
        ...

    @property
    def gain(self) -> float | None:
        """Gain, 1 at the base sensitivity; None if unknown, taken as 1."""
        ...


@dataclass(frozen=True, eq=False)
class Scale:
    """Psi of some shots, and what turns raw frames into its readings.

    white_dn_per_s: (shot, y, x), what a reading of 1 gives at a gain of 1; 0 where no light comes.
    darks: means of dark frames, of each exposure. gain: of the sensor, at its base sensitivity.
    good: (y, x), pixels that may be used. shots: numbers of the camera's shots that Psi holds; (),
    the default: all.
    """

    psi: Psi
    white_dn_per_s: NDArray[np.floating]
    darks: tuple[MeanFrame, ...]
    gain: SensorGain
    good: NDArray[np.bool_]
    shots: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "shots", self.shots or tuple(range(self.psi.shots)))

    def of_shots(self, shots: Sequence[int]) -> Scale:
        """Return the scale of some of its shots, by the camera's numbers, in this order."""
        chosen = tuple(shots)
        if chosen == self.shots:
            return self
        places = [self.shots.index(shot) for shot in chosen]
        camera = json_of_shots(camera_of(self.psi), places) if self.psi.camera_json else ""
        psi, white = self.psi.of_shots(places, camera), self.white_dn_per_s[places]
        return replace(self, psi=psi, white_dn_per_s=white, shots=chosen)

    def frames(
        self,
        bracket_of: Callable[[int], Sequence[RawValues]],
        shots: Sequence[int] | None = None,
    ) -> Frames:
        """Return the readings of shots.

        bracket_of: called with the camera's number of each shot in turn; returns its raw frames.
        shots: by the camera's numbers (default: all of the scale); Psi is not copied for them.
        Raises CalibrationError for frames of another size, without an exposure, or of several gains
        in one shot.
        """
        shots = self.shots if shots is None else shots
        shape = (len(shots), *self.psi.frames_shape[1:])
        readings, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
        usable, exposures = np.empty(shape, bool), []
        for place, shot in enumerate(shots):
            bracket = bracket_of(shot)
            rate, spread, seen = self._linear(bracket)
            full = self.white_dn_per_s[self.shots.index(shot)]
            lit = full > 0
            white = np.where(lit, full, 1.0)
            # What a pixel that is not to be used reads says nothing, not even how much at least.
            readings[place] = rate / white * (lit & self.good)
            variance[place] = spread / white**2
            usable[place] = seen & lit & self.good
            times_s = tuple(exposure_of(frame) for frame in bracket)
            exposures.append(Exposure(shot, times_s, _gain_of(bracket[0])))
        return Frames(readings, np.sqrt(variance), usable, exposures=tuple(exposures))

    def _linear(self, bracket: Sequence[RawValues]) -> tuple[NDArray, NDArray, NDArray]:
        """Return rate and variance of a bracket at a gain of 1, and what is usable: see `fuse`."""
        gains = {_gain_of(frame) for frame in bracket}
        if len(gains) > 1:
            raise CalibrationError(
                f"frames of one shot have several gains ({', '.join(f'{g:g}' for g in gains)}): "
                "capture them at one gain"
            )
        factor, first = gains.pop(), bracket[0]
        darks = [amplified(dark, factor, first.black_level_dn) for dark in self.darks]
        rate, variance, usable = fuse(
            [frame.mosaic for frame in bracket],
            [exposure_of(frame) for frame in bracket],
            darks,
            # Shot noise per DN grows with the gain, noise in the dark with its square.
            SensorGain(
                self.gain.gain_dn_per_electron * factor, self.gain.dark_variance_dn2 * factor**2
            ),
            first.white_level_dn,
        )
        return rate / factor, variance / factor**2, usable

    def rate(self, frame: RawValues) -> NDArray[np.float32]:
        """Return DN per second above the dark at a gain of 1, (y, x): fast, without deviations."""
        exposure_s, factor = exposure_of(frame), _gain_of(frame)
        dark = amplified(dark_at(self.darks, exposure_s), factor, frame.black_level_dn)
        rate = frame.mosaic - np.asarray(dark.mean_dn, np.float32)
        rate /= np.float32(exposure_s * factor)
        return rate

    def rate_variance(self, rate: NDArray[np.floating], exposure_s: float) -> NDArray[np.floating]:
        """Return the variance of rates; the same at every gain, (DN/s)^2."""
        noise = self.gain.gain_dn_per_electron * rate + self.gain.dark_variance_dn2 / exposure_s
        return noise / exposure_s


def exposure_of(frame: RawValues) -> float:
    """Return the exposure of a frame in seconds; raises CalibrationError where it has none."""
    if not frame.exposure_s:
        raise CalibrationError("the camera does not state how long its frames were exposed")
    return float(frame.exposure_s)


def _gain_of(frame: RawValues) -> float:
    return 1.0 if frame.gain is None else float(frame.gain)


def amplified(dark: MeanFrame, factor: float, black_dn: NDArray[np.floating]) -> MeanFrame:
    """Return a dark of gain 1 as it is at another gain.

    The signal above the black level grows with the gain; the black level stays. black_dn: a tile
    that repeats over the frame.
    """
    if factor == 1:
        return dark
    rows, columns = dark.mean_dn.shape
    down, across = -(-rows // black_dn.shape[0]), -(-columns // black_dn.shape[1])
    black = np.tile(black_dn, (down, across))[:rows, :columns]
    return replace(
        dark,
        mean_dn=(black + factor * (dark.mean_dn - black)).astype(np.float32),
        variance_dn2=dark.variance_dn2 * factor**2,
        extra_variance_dn2=dark.extra_variance_dn2 * factor**2,
        level_variance_dn2=dark.level_variance_dn2 * factor**2,
        rows_dn2=dark.rows_dn2 * factor**2,
    )


def designed_scale(psi: Psi, darks: Sequence[MeanFrame] = ()) -> Scale:
    """Return the scale of a Psi by the noise model of its camera, which is coarser than a measured.

    darks: means of dark frames; by default the camera's black level and read noise. Raises
    ModelError for a Psi without a camera.
    """
    if not psi.camera_json:
        raise ModelError("this Psi does not know its camera: name the folder of its calibration")
    camera = camera_of(psi)
    noise, shape = camera.sensor.noise, psi.frames_shape[1:]
    if not darks:
        read_variance = (noise.gain_dn_per_electron * noise.read_noise_electrons) ** 2
        black = np.full(shape, noise.black_level_dn, dtype=np.float32)
        darks = (MeanFrame(black, read_variance, MANY, 0.0),)
    shortest = min(darks, key=lambda dark: dark.exposure_s)
    white = noise.gain_dn_per_electron * noise.electrons_per_s * pixel_light(camera, psi.size)
    gain = SensorGain(noise.gain_dn_per_electron, shortest.variance_dn2)
    return Scale(psi, white, tuple(darks), gain, np.ones(shape, dtype=bool))
