"""How long a capture will take and how much it will write, before it begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from drivers.stage import needs_approach
from emmc_rig.capture.order import APPROACH_UM
from emmc_rig.session.planned import PlannedFrame

USUAL_SPEED_UM_S = 2000.0
DOWNLOAD_BYTES_PER_S = 40e6
FILE_OVERHEAD_BYTES = 4096
JOURNAL_BYTES_PER_FRAME = 1500
EXCHANGES_S = 0.15
"""Commands to the camera and the stage that a frame needs, and what a camera takes to be ready."""
MOVE_S = 0.2
"""A move's acceleration, polling and settling."""


@dataclass(frozen=True)
class Estimate:
    """Seconds by what they are spent on, and bytes on the disk.

    by_hand: how often somebody must change something at the bench; his time is not reckoned with.
    """

    frames: int
    moving_s: float
    exposing_s: float
    downloading_s: float
    bytes: int
    by_hand: int

    @property
    def seconds(self) -> float:
        """Total, without what is done by hand."""
        return self.moving_s + self.exposing_s + self.downloading_s


def estimate(
    frames: Iterable[PlannedFrame],
    frame_bytes: int,
    speeds_um_s: Mapping[str, float],
    settle_s: float,
    metered_s: float,
) -> Estimate:
    """Return what frames in this order will take.

    frame_bytes: of one file. speeds_um_s: by axis. settle_s: after each move. metered_s: what a
    reference exposure is taken for while it is not metered yet.
    """
    at_um: dict[str, float] = {}
    stood: tuple | None = None
    count, by_hand = 0, 0
    moving_s = exposing_s = 0.0
    for frame in frames:
        count += 1
        bench = frame.bench
        moves_s = [
            _move_s(goal - at_um.get(axis, goal), speeds_um_s.get(axis, USUAL_SPEED_UM_S))
            for axis, goal in bench.offsets_um.items()
            if at_um.get(axis) != goal
        ]
        if moves_s:
            moving_s += max(moves_s) + MOVE_S + settle_s
        at_um |= bench.offsets_um
        if bench.lamp != "off":
            by_hand += stood is not None and stood != bench.set_by_hand
            stood = bench.set_by_hand
        exposing_s += metered_s * frame.light if frame.exposure_s is None else frame.exposure_s
    size = frame_bytes + FILE_OVERHEAD_BYTES
    downloading_s = count * (size / DOWNLOAD_BYTES_PER_S + EXCHANGES_S)
    total = count * (size + JOURNAL_BYTES_PER_FRAME)
    return Estimate(count, moving_s, exposing_s, downloading_s, total, by_hand)


def _move_s(step_um: float, speed_um_s: float) -> float:
    back_um = 2 * APPROACH_UM if needs_approach(0.0, step_um, APPROACH_UM) else 0.0
    return (abs(step_um) + back_um) / speed_um_s
