"""A sensor that shares no code with the program: light to electrons to DN, with real chips' faults.

NumPy alone. `Chip.take` returns the next frame; `Chip.truth` the quantities that a data sheet
should state. Faults act in the order of the signal path: photons, pixels that share charge, charge
left behind by the frame before, the response, read noise, black level, converter, coding of the
file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

HOT_ELECTRONS_PER_S, LEAST_HOT_ELECTRONS_PER_S = 3_000.0, 8.0


@dataclass
class Chip:
    """The sensor and its lamp.

    electrons_per_s: of the lamp; flicker: its relative deviation from frame to frame; falls_off:
    loss of light in the corners. gain: DN per electron. full_well, read_noise, dsnu in electrons;
    prnu relative. hot, dead: shares of the pixels. column_electrons, column_response: half the
    difference of odd and even columns, of offset and relative response.
    black_drift_dn: deviation of a frame's black level; black_creep_dn: its growth per frame.
    lag: share of the charge that stays in the pixel for the next frame. bend: relative loss of
    response at full well. to_each_side: share of the charge that each of four neighbours receives.
    step: of the values in DN, `black_dn` is no multiple of it. root: electrons at which the step
    of the coding is 1 DN; the step grows with the root of the signal (0: no coding). row_noise: in
    electrons, of a row of one frame.
    """

    size: tuple[int, int] = (120, 160)
    electrons_per_s: float = 200_000.0
    flicker: float = 0.0
    falls_off: float = 0.0
    gain: float = 0.25
    black_dn: float = 512.0
    white_dn: int = 16383
    full_well: float = 60_000.0
    read_noise: float = 3.0
    dark_per_s: float = 5.0
    prnu: float = 0.01
    dsnu: float = 3.0
    hot: float = 0.001
    dead: float = 0.001
    column_electrons: float = 0.0
    column_response: float = 0.0
    black_drift_dn: float = 0.0
    black_creep_dn: float = 0.0
    lag: float = 0.0
    bend: float = 0.0
    to_each_side: float = 0.0
    step: float = 1.0
    root: float = 0.0
    row_noise: float = 0.0
    seed: int = 0
    taken: int = 0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        """Draw the pixels."""
        self.rng = np.random.default_rng([self.seed, 0])
        fixed = np.random.default_rng([self.seed, 1])
        odd = np.where(np.arange(self.size[1]) % 2, 1.0, -1.0)
        self.response = 1 + self.prnu * fixed.standard_normal(self.size)
        self.response = self.response * (1 + self.column_response * odd)
        self.offset = self.dsnu * fixed.standard_normal(self.size) + self.column_electrons * odd
        drawn = fixed.random(self.size)
        self.is_hot, self.is_dead = drawn < self.hot, drawn > 1 - self.dead
        self.response[self.is_dead] *= 0.2
        rows, columns = (np.linspace(-1, 1, count) for count in self.size)
        self.lens = 1 - self.falls_off * (rows[:, None] ** 2 + columns**2) / 2
        self.left_behind = np.zeros(self.size)
        # A hot pixel that shares its charge makes its neighbours hot.
        spilt = self._shared(HOT_ELECTRONS_PER_S * self.is_hot)
        self.is_hot_in_frames = spilt > LEAST_HOT_ELECTRONS_PER_S

    def take(self, exposure_s: float, lit: bool = True) -> np.ndarray:
        """Return the next frame, uint16 (y, x)."""
        rng = self.rng
        lamp = self.electrons_per_s * (1 + self.flicker * rng.standard_normal()) if lit else 0.0
        rate = lamp * self.lens * self.response + self.dark_per_s
        rate = rate + HOT_ELECTRONS_PER_S * self.is_hot
        charge = self._shared(rng.poisson(rate * exposure_s).astype(float))
        held = charge + self.left_behind
        self.left_behind = self.lag * held
        electrons = np.minimum(held - self.left_behind, self.full_well)
        electrons = electrons * (1 - self.bend * electrons / self.full_well) + self.offset
        electrons = electrons + self.read_noise * rng.standard_normal(self.size)
        electrons = electrons + self.row_noise * rng.standard_normal((self.size[0], 1))
        black = self.black_dn + self.black_drift_dn * rng.standard_normal()
        black += self.black_creep_dn * self.taken
        self.taken += 1
        return self._coded(self.gain * electrons + black)

    def _shared(self, charge: np.ndarray) -> np.ndarray:
        if not self.to_each_side:
            return charge
        wide = np.pad(charge, 1, mode="edge")
        sides = wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]
        return (1 - 4 * self.to_each_side) * charge + self.to_each_side * sides

    def _coded(self, dn: np.ndarray) -> np.ndarray:
        # The lattice of the steps starts at 5 DN: as after a black level of the camera's own.
        start = 5.0 if self.step > 1 else 0.0
        dn = start + self.step * np.rint((dn - start) / self.step)
        if self.root:
            # Codes 2 sqrt(root signal) apart by one: the step is sqrt(signal / root).
            above, at_root = dn - self.black_dn, self.root * self.gain
            code = np.rint(2 * np.sqrt(np.maximum(above, 0) * at_root))
            coded = np.rint((code / 2) ** 2 / at_root)
            dn = np.where(above > at_root, self.black_dn + coded, dn)
        return np.clip(dn, 0, self.white_dn).astype(np.uint16)

    def truth(self, flats_s: tuple[float, ...]) -> dict[str, float]:
        """Return the true quantities, in the units of the sheet."""
        well = min(self.full_well, (self.white_dn - self.black_dn) / self.gain)
        # Dark electrons fill the well too: of the first exposure that fills it.
        filled_s = [time_s for time_s in flats_s if time_s * self.electrons_per_s > well]
        well -= self.dark_per_s * min(filled_s, default=max(flats_s))
        read = float(np.hypot(self.read_noise, self.row_noise))
        least = np.hypot(read, self.step / np.sqrt(12) / self.gain) + 0.5
        return {
            "gain_dn_per_electron": self.gain,
            "read_noise_electrons": read,
            "dark_current_electrons_per_s": self.dark_per_s,
            "black_level_dn": self.black_dn,
            "full_well_electrons": well,
            "saturation_dn": self.gain * (well - self.bend * self.full_well),
            "linearity_error_percent": 100 * self._linearity(flats_s, well),
            "snr_max_db": 10 * np.log10(well),
            "dynamic_range_db": 20 * np.log10(well / least),
            "hot_pixels": int(self.is_hot_in_frames.sum()),
            "dead_pixels": int(self.is_dead.sum()),
            "dsnu": float(np.hypot(self.dsnu, self.column_electrons)),
            "prnu": float(np.hypot(self.prnu, self.column_response)),
        }

    def _linearity(self, flats_s: tuple[float, ...], well: float) -> float:
        """Return half the greatest difference of relative residuals of a line, 5 to 95 %."""
        t = np.array(flats_s)
        charge = self.electrons_per_s * t
        y = charge * (1 - self.bend * charge / self.full_well)
        top = well * (1 - self.bend)
        inside = (y > 0.05 * top) & (y < 0.95 * top) & (charge < well)
        slope, zero = np.polyfit(t[inside], y[inside], 1, w=1 / y[inside])
        residual = y[inside] / (slope * t[inside] + zero) - 1
        return float(np.ptp(residual)) / 2
