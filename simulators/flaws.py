"""What is wrong with a simulated bench beyond where its masks sit, which the program is not told.

Vignetting here is the natural law, the fourth power of the cosine of each ray's slope, raised to a
strength; dust and rounded corners are drawn on the mask finer than its cells; the sensor's flaws
are maps. The calibration fits other, simpler forms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.noise import SensorNoise

Array = NDArray[np.floating]
DUST_GRAIN = 6
"""Parts into which a cell is split, along each axis, to draw dust on it."""


@dataclass(frozen=True)
class OpticsFlaws:
    """Of lens and masks.

    aperture_spread: relative standard deviation of what the aperture cells let through.
    vignetting: power of the cos^4 law; 0: none, 1: natural. clear, leak: what open and closed
    parts of a mask pass. dust: specks on the mask (count), their radius and transmittance.
    """

    aperture_spread: float = 0.0
    vignetting: float = 0.0
    clear: float = 1.0
    leak: float = 0.0
    dust_specks: int = 0
    dust_radius_um: tuple[float, float] = (12.0, 24.0)
    dust_transmittance: float = 0.6
    seed: int = 1

    def aperture_weights(self, views: tuple[int, int]) -> NDArray[np.float64]:
        """Return the share of light of every aperture cell, (v, u)."""
        rng = np.random.default_rng([self.seed, 1])
        return 1 + self.aperture_spread * rng.standard_normal(views)

    def falloff(
        self, size: tuple[int, int], views: tuple[int, int], lengths_um: tuple[float, float, float]
    ) -> NDArray[np.float32]:
        """Return the falloff of every ray bundle, (v, u, y, x).

        lengths_um: lens distance, sample pitch, aperture cell. (1, 1, 1, 1) where there is none.
        """
        if self.vignetting == 0 and self.aperture_spread == 0:
            return np.ones((1, 1, 1, 1), np.float32)
        lens_um, pitch_um, cell_um = lengths_um
        v, u, y, x = (
            (np.arange(count) - (count - 1) / 2) * step
            for count, step in zip(
                (*views, *size), (cell_um, cell_um, pitch_um, pitch_um), strict=True
            )
        )
        across = (x - u[:, None]) ** 2
        down = (y - v[:, None]) ** 2
        slope2 = (down[:, None, :, None] + across[None, :, None, :]) / lens_um**2
        falls = (1 + slope2) ** (-2 * self.vignetting)
        return (falls * self.aperture_weights(views)[:, :, None, None]).astype(np.float32)

    def soiled(self, cells: NDArray[np.float32], cell_um: float) -> tuple[Array, float]:
        """Return the cells (row, column, colour) as they are, and the side of what is returned."""
        cells = (self.leak + (self.clear - self.leak) * cells).astype(np.float32)
        if self.dust_specks == 0:
            return cells, cell_um
        grain_um = cell_um / DUST_GRAIN
        fine = cells.repeat(DUST_GRAIN, axis=0).repeat(DUST_GRAIN, axis=1)
        rng = np.random.default_rng([self.seed, 2])
        rows, columns = fine.shape[:2]
        for _ in range(self.dust_specks):
            # Away from the rim, which no pixel sees.
            y, x = rng.uniform(0.15, 0.85, 2) * (rows, columns)
            radius = rng.uniform(*self.dust_radius_um) / grain_um
            top, left = int(max(y - radius, 0)), int(max(x - radius, 0))
            part = fine[top : int(y + radius) + 2, left : int(x + radius) + 2]
            i, j = np.ogrid[: part.shape[0], : part.shape[1]]
            inside = (i + top + 0.5 - y) ** 2 + (j + left + 0.5 - x) ** 2 < radius**2
            part[inside] *= self.dust_transmittance
        return fine, grain_um


@dataclass(frozen=True)
class SensorFlaws:
    """Of the sensor.

    response_spread: relative deviation of the pixels' sensitivity. offset_spread_dn: of their
    black level. dark_electrons_per_s: dark current. bad_share: of pixels, half of them hot (as
    bright as hot_reading in an exposure of one second), half dead. full_well_electrons: where
    pixels saturate (None: only where the converter does). bend: relative loss of response at full
    well, quadratic in the signal.
    """

    response_spread: float = 0.0
    offset_spread_dn: float = 0.0
    dark_electrons_per_s: float = 0.0
    bad_share: float = 0.0
    hot_electrons_per_s: float = 400_000.0
    full_well_electrons: float | None = None
    bend: float = 0.0
    seed: int = 1

    def bad(self, size: tuple[int, int]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the hot and the dead pixels, (y, x) each."""
        rng = np.random.default_rng([self.seed, 3])
        chosen = rng.random(size)
        return chosen < self.bad_share / 2, chosen > 1 - self.bad_share / 2

    def expose_dn(
        self,
        noise: SensorNoise,
        reading: Array,
        exposure_s: float,
        light: Array | float,
        rng: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """Return one frame (y, x) in DN: eq. 14 with these flaws."""
        size = reading.shape
        maps = np.random.default_rng([self.seed, 4])
        response = 1 + self.response_spread * maps.standard_normal(size)
        offset_dn = self.offset_spread_dn * maps.standard_normal(size)
        hot, dead = self.bad(size)
        electrons = noise.electrons(reading, exposure_s, light) * response
        electrons = np.where(dead, 0.02 * electrons, electrons)
        electrons += self.dark_electrons_per_s * exposure_s
        electrons += np.where(hot, self.hot_electrons_per_s * exposure_s, 0)
        # A Poisson draw of a bright pixel needs no more than its normal limit, but is cheap.
        drawn = rng.poisson(electrons).astype(np.float64)
        if self.full_well_electrons is not None:
            drawn = np.minimum(drawn, self.full_well_electrons)
            drawn *= 1 - self.bend * drawn / self.full_well_electrons
        drawn += rng.normal(0.0, noise.read_noise_electrons, size)
        dn = np.floor(noise.gain_dn_per_electron * drawn + noise.black_level_dn + offset_dn + 0.5)
        return np.clip(dn, 0, noise.white_level_dn).astype(np.uint16)


PERFECT_OPTICS, PERFECT_SENSOR = OpticsFlaws(), SensorFlaws()
