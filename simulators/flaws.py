"""Faults of a simulated bench beyond the placement of its masks, unknown to the program.

Vignetting here is the natural law, the fourth power of the cosine of each ray's slope, raised to a
strength; dust, blur and diffraction are drawn on the mask finer than its cells; the sensor's flaws
are maps. The calibration fits other, simpler forms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter

from emmc_rig.model.noise import SensorNoise
from emmc_rig.model.pupil import Pupil

Array = NDArray[np.floating]
DUST_GRAIN = 6
"""Parts into which a cell is split, along each axis, to draw dust or a blur on it."""
DIFFRACTION_GRAIN = 18
"""The same for diffraction: parts of 2 um of a cell of 36 um, a quarter of the first fringe."""
WAVELENGTHS_UM = ((0.60, 0.62, 0.64), (0.52, 0.54, 0.56), (0.45, 0.465, 0.48))
"""Of red, green and blue light, three over each filter's band, which wash out the far fringes."""
WARM_UP_S = 120.0
DOUBLING_K = 6.5


@dataclass(frozen=True)
class OpticsFlaws:
    """Of lens, microlenses and masks.

    aperture_spread: relative standard deviation of what the aperture cells let through.
    vignetting: power of the cos^4 law; 0: none, 1: natural. clear, leak: what open and closed
    parts of a mask pass. dust: specks on the mask (count), their radius and transmittance.
    microlens_power: a pixel's response falls as that power of the cosine between the ray and its
    microlens' axis; chief_ray_error: share of the chief ray's slope by which that axis misses it.
    diffraction: at the mask's edges (angular spectrum, from mask to sensor). colour_blur_um:
    standard deviation of the mask's edges in red, green and blue light. glare: share of the light
    of every colour that is spread over the whole picture in front of the colour filters;
    glare_after: of all colours' together, behind the filters. hole_spread: relative standard
    deviation of the area of the hole before every view; plate_turn_deg: of the pinhole plate and
    its stage about the axis, x to y. creep_um_per_s: of the mask, in x. warming_um: by which the
    lens gets farther from the sensor, with WARM_UP_S.
    pupil: what the real lens leaves open; None: what the camera describes.
    """

    aperture_spread: float = 0.0
    vignetting: float = 0.0
    clear: float = 1.0
    leak: float = 0.0
    dust_specks: int = 0
    dust_radius_um: tuple[float, float] = (12.0, 24.0)
    dust_transmittance: float = 0.6
    microlens_power: float = 0.0
    chief_ray_error: float = 0.0
    diffraction: bool = False
    colour_blur_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    glare: float = 0.0
    glare_after: float = 0.0
    hole_spread: float = 0.0
    plate_turn_deg: float = 0.0
    creep_um_per_s: float = 0.0
    warming_um: float = 0.0
    pupil: Pupil | None = None
    seed: int = 1

    def aperture_weights(self, views: tuple[int, int]) -> NDArray[np.float64]:
        """Return the share of light of every aperture cell, (v, u)."""
        rng = np.random.default_rng([self.seed, 1])
        return 1 + self.aperture_spread * rng.standard_normal(views)

    def hole_areas(self, views: tuple[int, int]) -> NDArray[np.float64]:
        """Return the area of the hole before every view, (v, u), over that of its cell."""
        rng = np.random.default_rng([self.seed, 5])
        return 1 + self.hole_spread * rng.standard_normal(views)

    def moved(self, at_um: Mapping[str, float], seconds: float) -> dict[str, float]:
        """Return where mask and plate are when the stages report at_um, and the lens ("lens")."""
        turn, warmed = np.deg2rad(self.plate_turn_deg), 1 - np.exp(-seconds / WARM_UP_S)
        x, y = at_um["aperture_x"], at_um["aperture_y"]
        return {
            **at_um,
            "aperture_x": float(np.cos(turn) * x - np.sin(turn) * y),
            "aperture_y": float(np.sin(turn) * x + np.cos(turn) * y),
            "mask_x": at_um["mask_x"] + self.creep_um_per_s * seconds,
            "lens": float(self.warming_um * warmed),
        }

    def with_glare(self, readings: Array, response: Array) -> NDArray[np.float64]:
        """Return readings (y, x) of light of one colour with its glare.

        response: of the pixels' filters to this colour, (y, x).
        """
        arrives = readings[response > 0] / response[response > 0]
        in_front = response * (arrives.mean() if arrives.size else 0.0)
        found = (1 - self.glare) * readings + self.glare * in_front
        return (1 - self.glare_after) * found + self.glare_after * found.mean()

    def falloff(
        self, size: tuple[int, int], views: tuple[int, int], lengths_um: tuple[float, float, float]
    ) -> NDArray[np.float32]:
        """Return the falloff of every ray bundle, (v, u, y, x).

        lengths_um: lens distance, sample pitch, aperture cell. (1, 1, 1, 1) where there is none.
        """
        if self.vignetting == 0 and self.aperture_spread == 0 and self.microlens_power == 0:
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
        if self.microlens_power:
            missed = self.chief_ray_error
            off2 = ((v[:, None] - missed * y) ** 2)[:, None, :, None] + (
                (u[:, None] - missed * x) ** 2
            )[None, :, None, :]
            falls = falls * (1 + off2 / lens_um**2) ** (-self.microlens_power / 2)
        return (falls * self.aperture_weights(views)[:, :, None, None]).astype(np.float32)

    def soiled(
        self, cells: NDArray[np.float32], cell_um: float, distance_um: float
    ) -> tuple[Array, float]:
        """Return the cells (row, column, colour) as they are, and the side of what is returned.

        distance_um: from the sensor, over which edges diffract.
        """
        cells = (self.leak + (self.clear - self.leak) * cells).astype(np.float32)
        if self.dust_specks == 0 and not self.diffraction and not any(self.colour_blur_um):
            return cells, cell_um
        grain = DIFFRACTION_GRAIN if self.diffraction else DUST_GRAIN
        grain_um = cell_um / grain
        fine = cells.repeat(grain, axis=0).repeat(grain, axis=1)
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
        for colour, (blur_um, wavelengths_um) in enumerate(
            zip(self.colour_blur_um, WAVELENGTHS_UM, strict=True)
        ):
            if blur_um:
                fine[..., colour] = gaussian_filter(fine[..., colour], blur_um / grain_um)
            if self.diffraction:
                fine[..., colour] = np.mean(
                    [
                        diffracted(fine[..., colour], grain_um, distance_um, wavelength_um)
                        for wavelength_um in wavelengths_um
                    ],
                    axis=0,
                )
        return fine, grain_um


def diffracted(
    transmittance: NDArray[np.float32], grain_um: float, distance_um: float, wavelength_um: float
) -> NDArray[np.float32]:
    """Return the intensity (row, column) behind a mask lit by a plane wave, at a distance.

    The angular spectrum of plane waves: Goodman, Introduction to Fourier Optics, section 3.10.
    """
    shape = [fft.next_fast_len(count) for count in transmittance.shape]
    amplitude = fft.fft2(np.sqrt(transmittance), shape)
    across, down = (fft.fftfreq(count, grain_um).astype(np.float32) for count in reversed(shape))
    cosine2 = 1 - wavelength_um**2 * (down[:, None] ** 2 + across**2)
    phase = 2 * np.pi * distance_um / wavelength_um * np.sqrt(np.maximum(cosine2, 0))
    amplitude *= np.exp(1j * phase)
    rows, columns = transmittance.shape
    field = np.asarray(fft.ifft2(amplitude))[:rows, :columns]
    return np.square(np.abs(field)).astype(np.float32)


@dataclass(frozen=True)
class BoardFlaws:
    """Of the white board: how its radiance differs from the mean, peak to peak.

    angle_spread: over the directions into the aperture. place_spread: over the board's width;
    parallax_px: by how much the outermost view sees the board shifted (0: the board is in focus,
    and the spread over place cancels). Both turn with the board.
    """

    angle_spread: float = 0.0
    place_spread: float = 0.0
    parallax_px: float = 0.0

    def radiance(
        self, size: tuple[int, int], views: tuple[int, int], turn_deg: float
    ) -> NDArray[np.float32]:
        """Return what every ray bundle brings from the board turned so, (v, u, y, x), mean 1.

        Over angle a gradient along a slant and a saddle, which no turn by 90 degrees maps onto
        itself; a board that is brighter in the middle whatever its turn is not described.
        """
        turn = np.deg2rad(turn_deg)
        cosine, sine = np.cos(turn), np.sin(turn)

        def turned(down: Array, across: Array) -> tuple[Array, Array]:
            return cosine * down - sine * across, sine * down + cosine * across

        v, u = (np.linspace(-1, 1, count) if count > 1 else np.zeros(1) for count in views)
        y, x = ((np.arange(count) - (count - 1) / 2) / (max(size) / 2) for count in size)
        down, across = turned(v[:, None], u)
        angle = 1 + self.angle_spread * (0.3 * across + 0.2 * down + 0.125 * (across**2 - down**2))
        parallax = self.parallax_px / (max(size) / 2)
        seen_y = (y[None, :] + parallax * v[:, None])[:, None, :, None]
        seen_x = (x[None, :] + parallax * u[:, None])[None, :, None, :]
        down, across = turned(seen_y, seen_x)
        place = 1 + self.place_spread * (0.4 * across - 0.3 * down)
        return (angle[:, :, None, None] * place).astype(np.float32)


@dataclass(frozen=True)
class LampFlaws:
    """Of the lamp: relative drift of level and colour during warm-up.

    colour_drift: red rises by so much, and blue falls.
    """

    level_drift: float = 0.0
    colour_drift: float = 0.0

    def levels(self, seconds: float) -> NDArray[np.float64]:
        """Return the level in red, green and blue, so long after it was switched on."""
        warmed = 1 - np.exp(-seconds / WARM_UP_S)
        colours = np.array([1.0, 0.0, -1.0]) * self.colour_drift
        return 1 + warmed * (self.level_drift + colours)


@dataclass(frozen=True)
class SensorFlaws:
    """Of the sensor.

    response_spread: relative deviation of the pixels' sensitivity. offset_spread_dn: of their
    black level. dark_electrons_per_s: dark current. bad_share: of pixels, half of them hot (as
    bright as hot_reading in an exposure of one second), half dead. full_well_electrons: where
    pixels saturate (None: only where the converter does). bend: relative loss of response at full
    well, quadratic in the signal. row_noise_electrons: common to a row of one frame. warming_k: by
    which the sensor warms up, with WARM_UP_S; dark current doubles every DOUBLING_K. crosstalk:
    share of a filter's response that is to the neighbouring colours. odd_gain, odd_dn: by which
    odd columns respond more, relative, and are brighter in the dark.
    """

    response_spread: float = 0.0
    offset_spread_dn: float = 0.0
    dark_electrons_per_s: float = 0.0
    bad_share: float = 0.0
    hot_electrons_per_s: float = 400_000.0
    full_well_electrons: float | None = None
    bend: float = 0.0
    row_noise_electrons: float = 0.0
    warming_k: float = 0.0
    crosstalk: float = 0.0
    odd_gain: float = 0.0
    odd_dn: float = 0.0
    seed: int = 1

    def mixed(self, response: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the response of filters (..., colour) that let neighbouring colours through."""
        k = self.crosstalk
        through = np.array([[1 - k, k, 0], [k / 2, 1 - k, k / 2], [0, k, 1 - k]], np.float32)
        filtered = response.sum(axis=-1, keepdims=True) == 1
        return np.where(filtered, response @ through, response)

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
        seconds: float = 0.0,
    ) -> NDArray[np.uint16]:
        """Return one frame (y, x) in DN: eq. 14 with these flaws; seconds: since switching on."""
        size = reading.shape
        maps = np.random.default_rng([self.seed, 4])
        response = 1 + self.response_spread * maps.standard_normal(size)
        offset_dn = self.offset_spread_dn * maps.standard_normal(size)
        hot, dead = self.bad(size)
        electrons = noise.electrons(reading, exposure_s, light) * response
        electrons = np.where(dead, 0.02 * electrons, electrons)
        warmer_k = self.warming_k * (1 - np.exp(-seconds / WARM_UP_S))
        electrons += self.dark_electrons_per_s * exposure_s * 2 ** (warmer_k / DOUBLING_K)
        electrons += np.where(hot, self.hot_electrons_per_s * exposure_s, 0)
        # A Poisson draw of a bright pixel needs no more than its normal limit, but is cheap.
        drawn = rng.poisson(electrons).astype(np.float64)
        if self.full_well_electrons is not None:
            drawn = np.minimum(drawn, self.full_well_electrons)
            drawn *= 1 - self.bend * drawn / self.full_well_electrons
        drawn += rng.normal(0.0, noise.read_noise_electrons, size)
        if self.row_noise_electrons:
            drawn += rng.normal(0.0, self.row_noise_electrons, (size[0], 1))
        odd = np.arange(size[1]) % 2
        drawn *= 1 + self.odd_gain * odd
        offset_dn += self.odd_dn * odd
        dn = np.floor(noise.gain_dn_per_electron * drawn + noise.black_level_dn + offset_dn + 0.5)
        return np.clip(dn, 0, noise.white_level_dn).astype(np.uint16)


PERFECT_OPTICS, PERFECT_SENSOR = OpticsFlaws(), SensorFlaws()
EVEN_BOARD, STEADY_LAMP = BoardFlaws(), LampFlaws()
