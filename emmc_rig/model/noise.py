"""The sensor's noise (paper, eq. 14): readings to digital numbers, and back with their variance.

A reading of 1 is what a pixel of the fully open camera measures from a white light field. Pixels
that see several colours, or sum several samples, collect proportionally more light: `light` counts
them (1 for a Bayer pixel, 3 for a monochrome one, x k^2 for pixels of k x k samples).

The photon unit: the paper gives the gain, the read noise and the exposure (0.8 DN per electron,
2.5 electrons, 1/20 s) but not how many electrons a reading of 1 is worth. `electrons_per_s` is
pinned by the PSNR of its RGB frames of the dragons, one 1/60 s shot a colour: 42.88 dB in the
paper, 42.89 dB here (`emmc-rig simulate --scene DRAGONS --camera scenario-i-rgb`). The paper's
other two figures do not follow from one unit: its three monochrome shots have 45.90 dB, here
47.67; its CFA shot "over 50 dB", here 47.73.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from emmc_rig.model.settings import Settings

Array = NDArray[np.floating]


class SensorNoise(Settings):
    """Gain, noise and range of the sensor."""

    electrons_per_s: float = Field(
        default=310_000.0, gt=0, description="at reading 1, one colour, k = 1"
    )
    gain_dn_per_electron: float = Field(default=0.8, gt=0)
    read_noise_electrons: float = Field(default=2.5, ge=0)
    black_level_dn: int = Field(default=256, ge=0)
    white_level_dn: int = Field(default=65_535, gt=0, le=65_535)

    @model_validator(mode="after")
    def _range(self) -> SensorNoise:
        if self.black_level_dn >= self.white_level_dn:
            raise ValueError("black_level_dn must be below white_level_dn")
        return self

    def electrons(self, reading: Array, exposure_s: Array | float, light: Array | float) -> Array:
        """Return the mean electrons of normalised readings (any shape)."""
        return np.asarray(reading) * (self.electrons_per_s * exposure_s) * light

    def expose_dn(
        self,
        reading: Array,
        exposure_s: Array | float,
        light: Array | float,
        rng: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """Return what the sensor reads out, uint16 DN: eq. 14 with its offset, rounded, clipped.

        Rounding down after adding the black level and half a DN is eq. 14's U(0, 1) less its mean.
        """
        electrons = rng.poisson(self.electrons(reading, exposure_s, light)).astype(np.float64)
        electrons += rng.normal(0.0, self.read_noise_electrons, electrons.shape)
        dn = np.floor(self.gain_dn_per_electron * electrons + self.black_level_dn + 0.5)
        return np.clip(dn, 0, self.white_level_dn).astype(np.uint16)

    def normalise(
        self, dn: NDArray[np.uint16], exposure_s: Array | float, light: Array | float
    ) -> NDArray[np.float32]:
        """Return readings from DN: the inverse of the noise-free `expose_dn`, float32.

        A pixel that no light reaches reads 0.
        """
        scale = np.asarray(self.gain_dn_per_electron * self.electrons_per_s * exposure_s * light)
        above = dn.astype(np.float64) - self.black_level_dn
        return np.where(scale > 0, above / np.where(scale > 0, scale, 1), 0).astype(np.float32)

    def variance(
        self, reading: Array, exposure_s: Array | float, light: Array | float
    ) -> NDArray[np.float64]:
        """Return the variance of a normalised reading: shot, read and quantisation noise.

        Infinite where no light reaches the pixel.
        """
        per_reading = np.asarray(self.electrons_per_s * exposure_s * light)
        electrons = np.maximum(np.asarray(reading, dtype=np.float64), 0) * per_reading
        quantisation = 1 / 12 / self.gain_dn_per_electron**2
        with np.errstate(divide="ignore"):
            return (electrons + self.read_noise_electrons**2 + quantisation) / per_reading**2

    def saturated(self, dn: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Return which pixels reached the white level."""
        return dn >= self.white_level_dn
