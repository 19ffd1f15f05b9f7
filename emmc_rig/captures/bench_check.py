"""What a bench can do: which shots and which calibration its axes, and hands, allow a camera."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.openings import parts
from emmc_rig.calibration.planning import (
    FEW_MODEL_ERROR,
    Kind,
    Light,
    plan_combined,
    plan_parametric,
)
from emmc_rig.calibration.shadow import ShadowMask, shadow_mask
from emmc_rig.captures.board_plan import (
    MORE_STAGES_UM,
    STAGE_KINDS_UM,
    plan_light,
    soft_design,
)
from emmc_rig.captures.expand import mask_offsets_um
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError

SIZE = 48, 64
TARGET = 0.005
"""Relative error of Psi for which whiteboards are planned, if so many reach it."""
MOST = 60
PINHOLE, MASK = ("aperture_x", "aperture_y"), ("mask_x", "mask_y")


@dataclass(frozen=True)
class Calibration:
    """One way to Psi."""

    name: str
    axes: tuple[str, ...]
    """Axes that it moves."""
    moves: int
    """Number of moves."""
    error: float | None
    """Expected relative error of Psi; None: only the calibration itself shows it."""


@dataclass(frozen=True)
class Ability:
    """What a bench can do for a camera."""

    camera: str
    shots: int
    """Number of the camera's shots that the bench can take."""
    of_shots: int
    """Number of shots that the camera has."""
    by_hand: int
    """Moves of the mask by hand among them."""
    calibrations: tuple[Calibration, ...]
    """Every way to Psi, the surest first."""
    possible: frozenset[str]
    """Names of the ways that stage and hands allow."""
    alone: frozenset[str]
    """Names of the ways that need no hand."""

    @property
    def best(self) -> Calibration:
        """Return the surest way that is possible."""
        return next(
            calibration for calibration in self.calibrations if calibration.name in self.possible
        )

    def hands(self, way: Calibration) -> int:
        """Return how often somebody moves something for a way."""
        return 0 if way.name in self.alone else way.moves

    def more(self, axes: Collection[str]) -> str:
        """Return what a part that the bench lacks would buy, "" for nothing; axes: the bench's."""
        lacking = [axis for axis in (*PINHOLE, *MASK) if axis not in axes]
        best = self.best
        for part in (PINHOLE, MASK):
            missing = [axis for axis in part if axis in lacking]
            surer = [
                way
                for way in self.calibrations
                if set(way.axes) & set(missing)
                and set(way.axes) <= {*axes, *missing}
                and (_known(way) < _known(best) or way.name == best.name)
            ]
            if surer:
                way = surer[0]
                named = " and ".join(missing)
                if way.name == best.name:
                    return f"{named}: no moves by hand instead of {self.hands(best)}"
                return f"{named}: {shown_error(way.error)} instead of {shown_error(best.error)}"
        return ""


def _known(way: Calibration) -> float:
    """Return an error to sort by; an assumption comes last."""
    return way.error if way.error is not None else 1.0 if way.moves else 2.0


def shown_error(error: float | None) -> str:
    """Return a relative error for people."""
    return "known after calibration" if error is None else f"{error:.2%}"


def ability(name: str, camera: Camera, axes: Collection[str], hands: bool) -> Ability:
    """Return what a bench can do for a camera.

    axes: of its stages. hands: whether a person moves the axes that the stages lack. Raises
    CameraError for a camera that no bench can be.
    """
    places = [mask_offsets_um(camera, shot) for shot in range(len(camera.shots))]
    moved = [axis for axis in MASK if len({place.get(axis) for place in places}) > 1]
    free = set(moved) <= set(axes)
    shots = len(places) if free or hands else places.count(places[0])
    changes = sum(a != b for a, b in pairwise(places))
    ways = tuple(sorted(_ways(camera), key=lambda way: (_known(way), len(way.axes))))
    alone = frozenset(way.name for way in ways if set(way.axes) <= set(axes))
    possible = frozenset(way.name for way in ways) if hands else alone
    return Ability(name, shots, len(places), 0 if free else changes, ways, possible, alone)


def _ways(camera: Camera) -> list[Calibration]:
    views = int(np.prod(camera.views))
    design = Calibration("design, not measured", (), 0, None)
    try:
        mask = shadow_mask(camera, SIZE)
    except (CalibrationError, CameraError):
        return [Calibration("pinhole before every view", PINHOLE, views, None), design]
    soft, light = soft_design(camera, mask), plan_light(camera, mask)
    every = plan_combined(mask, soft, light, TARGET).expected_error
    found = [Calibration("pinhole before every view", PINHOLE, views + 1, every), design]
    opened = [Kind(None, window=window) for window in parts(camera.views)]
    stages = STAGE_KINDS_UM if camera.moving_masks else STAGE_KINDS_UM[:1]
    whole = [Kind(None, stage) for stage in stages]
    error = _few(camera, mask, light, [*whole, *opened])
    axes = PINHOLE + (MASK if camera.moving_masks else ())
    found.append(Calibration("parts of the aperture", axes, len(opened) + len(whole), error))
    if camera.moving_masks:
        kinds = [Kind(None, stage) for stage in STAGE_KINDS_UM + MORE_STAGES_UM]
        error = _few(camera, mask, light, kinds)
        found.append(Calibration("aperture open, mask moved", MASK, len(kinds), error))
    found.append(
        Calibration("aperture open, mask still", (), 0, _few(camera, mask, light, whole[:1]))
    )
    return found


def _few(camera: Camera, mask: ShadowMask, light: Light, kinds: list[Kind]) -> float:
    planned = plan_parametric(
        mask, soft_design(camera, mask), kinds, light, TARGET, MOST, FEW_MODEL_ERROR
    )
    return planned.expected_error
