"""Checks before anything moves: what the rig can never do."""

from __future__ import annotations

from collections.abc import Iterable

from drivers.camera import Limits
from emmc_rig.acquisition.checks import exposure_setting
from emmc_rig.bench.hardware import Rig
from emmc_rig.errors import AppError
from emmc_rig.session.planned import PlannedFrame

ROUNDING = 1e-9
"""Limits that went through a device's own units come back rounded."""


def refuse_impossible(rig: Rig, frames: Iterable[PlannedFrame]) -> None:
    """Raise AppError for the first frame that the stage cannot reach or the camera not expose."""
    exposures_s, gains = rig.camera.exposure_limits_s, rig.camera.gain_limits
    for frame in frames:
        for axis, offset_um in frame.bench.offsets_um.items():
            _refuse_place(rig, frame, axis, offset_um)
        exposure_s = frame.exposure_s
        # A camera whose exposure cannot be chosen says for each frame what it is.
        chosen = exposures_s[0] < exposures_s[1]
        if chosen and exposure_s is not None and not _within(exposure_s, exposures_s):
            raise AppError(
                f"frame {frame.id}: the camera exposes from {exposures_s[0]:g} to "
                f"{exposures_s[1]:g} s, not {exposure_s:g} s: change "
                f"{exposure_setting(frame)} in the plan"
            )
        if not _within(frame.gain, gains):
            raise AppError(
                f"frame {frame.id}: the camera's gain goes from {gains[0]:g} to {gains[1]:g}, not "
                f"to {frame.gain:g}: change shots.{frame.bench.shot}.gain in the plan"
            )


def _refuse_place(rig: Rig, frame: PlannedFrame, axis: str, offset_um: float) -> None:
    if axis not in rig.stage.axes or axis not in rig.zero_um:
        known = ", ".join(name for name in rig.stage.axes if name in rig.zero_um)
        raise AppError(
            f"frame {frame.id} needs a stage axis '{axis}', the rig has {known or 'none'}: name it "
            "in the rig's file, with its zero_um"
        )
    low_um, high_um = rig.stage.limits_um(axis)
    if not low_um <= rig.zero_um[axis] + offset_um <= high_um:
        raise AppError(
            f"frame {frame.id}: {axis} cannot go {offset_um:g} um from its zero "
            f"({rig.zero_um[axis]:g} um), it reaches {low_um:g} to {high_um:g} um: change the "
            "place in the plan, or zero_um in the rig's file"
        )


def _within(value: float, limits: Limits) -> bool:
    return limits[0] * (1 - ROUNDING) <= value <= limits[1] * (1 + ROUNDING)
