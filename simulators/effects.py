"""What can be wrong with a simulated bench, by the name of the effect.

The sizes are those of an ordinary bench: a mask glued 0.2 degrees askew, filters that pass 5 % of
their neighbours' light, a lamp that drifts by 2 % while it warms up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from emmc_rig.simulators.bench import MountingErrors
from emmc_rig.simulators.flaws import (
    EVEN_BOARD,
    PERFECT_OPTICS,
    PERFECT_SENSOR,
    STEADY_LAMP,
    BoardFlaws,
    LampFlaws,
    OpticsFlaws,
    SensorFlaws,
)

USUAL_MOUNTING = MountingErrors()


@dataclass(frozen=True)
class Flaws:
    """What is wrong with a simulated bench."""

    mounting: MountingErrors = USUAL_MOUNTING
    optics: OpticsFlaws = PERFECT_OPTICS
    sensor: SensorFlaws = PERFECT_SENSOR
    board: BoardFlaws = EVEN_BOARD
    lamp: LampFlaws = STEADY_LAMP


Bench = TypeVar("Bench", bound=Flaws)
ORDINARY = "ordinary"
TOGETHER = "together"
EFFECTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    ORDINARY: {
        "mounting": {
            "offset_um": (23.7, -14.2),
            "rotation_deg": 0.11,
            "stretch": 1.0012,
            "skew": 0.0006,
            "distance_share": 0.045,
            "distortion_um": 1.5,
            "edge_blur_um": 2.5,
        },
        "optics": {
            "aperture_spread": 0.04,
            "vignetting": 2.0,
            "clear": 0.94,
            "leak": 0.03,
            "dust_specks": 6,
        },
        "sensor": {
            "response_spread": 0.01,
            "offset_spread_dn": 1.0,
            "dark_electrons_per_s": 20.0,
            "bad_share": 0.002,
            "full_well_electrons": 80_000.0,
        },
    },
    "tilt": {"mounting": {"tilt_deg": (0.2, -0.1)}},
    "bow": {"mounting": {"bow_um": 6.0}},
    "glass": {"mounting": {"substrate_um": 80.0}},
    "microlenses": {"optics": {"microlens_power": 8.0, "chief_ray_error": 0.3}},
    "diffraction": {"optics": {"diffraction": True}},
    "colour-blur": {"optics": {"colour_blur_um": (3.0, 1.0, 2.0)}},
    "response": {"sensor": {"bend": 0.01, "full_well_electrons": 80_000.0}},
    "crosstalk": {"sensor": {"crosstalk": 0.05}},
    "dark": {
        "sensor": {
            "row_noise_electrons": 3.0,
            "dark_electrons_per_s": 100.0,
            "warming_k": 1.0,
        }
    },
    "board": {"board": {"angle_spread": 0.1, "place_spread": 0.1, "parallax_px": 1.0}},
    "lamp": {"lamp": {"level_drift": 0.02, "colour_drift": 0.01}},
    "glare": {"optics": {"glare": 0.01, "glare_after": 0.01}},
    "holes": {"optics": {"hole_spread": 0.05}},
    "plate": {"optics": {"plate_turn_deg": 1.0}},
    "creep": {"optics": {"creep_um_per_s": 0.05}},
    "warming": {"optics": {"warming_um": 200.0}},
    "columns": {"sensor": {"odd_gain": 0.02, "odd_dn": 2.0}},
}
"""By name: what it changes in the fields of Flaws."""
APART = ("holes", "plate", "creep", "warming", "glare")
"""Left out of TOGETHER: faults of a bench to mend rather than to calibrate, and glare, beside which
the others are stated too large."""


def flawed(base: Bench, names: Iterable[str]) -> Bench:
    """Return a bench with these effects beside what is wrong with it already.

    names: of EFFECTS, or TOGETHER: all of them but APART. Keeps the class of `base`.
    """
    together = [effect for effect in EFFECTS if effect not in APART]
    for name in names:
        for effect in together if name == TOGETHER else (name,):
            for part, changes in EFFECTS[effect].items():
                base = replace(base, **{part: replace(getattr(base, part), **changes)})
    return base
