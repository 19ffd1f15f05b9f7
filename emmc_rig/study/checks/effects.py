"""Every effect of a real bench, alone and all together: the error of Psi, true and as stated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from emmc_rig.calibrate.bench import HARSH_MOUNTING, HARSH_OPTICS, HARSH_SENSOR, BenchTruth
from emmc_rig.calibrate.settings import CalibrateSettings
from emmc_rig.calibrate.simulated import run_calibration
from emmc_rig.study.checks.rows import Row, judged
from simulators.flaws import BoardFlaws, LampFlaws

TRUE_ERROR = 0.01
COVERED, COVERED_TWICE, MARGIN = 0.683, 0.954, 0.03
MOUNTING = {"tilt_deg": (0.2, -0.1), "bow_um": 6.0, "substrate_um": 80.0}
OPTICS = {
    "microlens_power": 8.0,
    "chief_ray_error": 0.3,
    "diffraction": True,
    "colour_blur_um": (3.0, 1.0, 2.0),
}
SENSOR = {
    "bend": 0.01,
    "crosstalk": 0.05,
    "row_noise_electrons": 3.0,
    "dark_electrons_per_s": 100.0,
    "warming_k": 1.0,
}
BOARD, LAMP = BoardFlaws(0.1, 0.1, 1.0), LampFlaws(0.02, 0.01)


def effects(shipped: BenchTruth) -> Mapping[str, BenchTruth]:
    """Return benches by what is wrong with them beside what is wrong with every one."""

    def mounting(*names: str) -> BenchTruth:
        return replace(
            shipped, mounting=replace(HARSH_MOUNTING, **{name: MOUNTING[name] for name in names})
        )

    def optics(*names: str) -> BenchTruth:
        return replace(
            shipped, optics=replace(HARSH_OPTICS, **{name: OPTICS[name] for name in names})
        )

    def sensor(*names: str) -> BenchTruth:
        return replace(
            shipped, sensor=replace(HARSH_SENSOR, **{name: SENSOR[name] for name in names})
        )

    return {
        "shipped": shipped,
        "tilt": mounting("tilt_deg"),
        "bow": mounting("bow_um"),
        "glass": mounting("substrate_um"),
        "microlenses": optics("microlens_power", "chief_ray_error"),
        "diffraction": optics("diffraction"),
        "colour-blur": optics("colour_blur_um"),
        "response": sensor("bend"),
        "crosstalk": sensor("crosstalk"),
        "dark": sensor("row_noise_electrons", "dark_electrons_per_s", "warming_k"),
        "board": replace(shipped, board=BOARD),
        "lamp": replace(shipped, lamp=LAMP),
        "together": BenchTruth(
            replace(HARSH_MOUNTING, **MOUNTING),
            replace(HARSH_OPTICS, **OPTICS),
            replace(HARSH_SENSOR, **SENSOR),
            shipped.rays_per_view,
            shipped.stage,
            BOARD,
            LAMP,
        ),
    }


def check_effect(settings: CalibrateSettings, name: str) -> tuple[list[Row], dict]:
    """One effect: true and stated error, and the coefficients within one and two deviations."""
    truth = effects(settings.truth)[name]
    metrics = run_calibration(replace(settings, route="auto", truth=truth)).metrics
    chosen = metrics["chosen"]
    true, stated = (metrics[key][chosen] for key in ("psi_relative_error", "psi_stated_error"))
    once, twice = metrics["psi_coverage"][chosen]
    rows = [
        judged(f"{name}: true error of Psi ({chosen}, states {stated:.2%})", true, TRUE_ERROR,
               ".2%"),
        _covered(f"{name}: within one deviation", once, COVERED),
        _covered(f"{name}: within two", twice, COVERED_TWICE),
    ]  # fmt: skip
    return rows, {key: metrics[key] for key in KEPT}


KEPT = (
    "chosen",
    "why",
    "findings",
    "advice",
    "held_out",
    "psi_relative_error",
    "psi_stated_error",
    "psi_coverage",
)


def _covered(what: str, share: float, asked: float) -> Row:
    met = abs(share - asked) <= MARGIN
    return Row(what, f"{share:.1%}", f"{asked:.0%} +- {MARGIN:.0%}", "met" if met else "missed")
