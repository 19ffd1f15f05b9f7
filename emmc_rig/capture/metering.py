"""From one whiteboard frame to the exposures of those that follow."""

from __future__ import annotations

import numpy as np

from drivers.camera import Limits
from drivers.errors import CameraSettingError
from drivers.raw import RawFrame
from emmc_rig.capture.checks import Figures
from emmc_rig.session.journal import Entry
from emmc_rig.session.session import Session

METERING_TRIES = 8
STEP = 4.0
USABLE_LEVELS = (0.02, 0.95)


def better_metering_s(
    frame: RawFrame, found: Figures, exposure_s: float, limits_s: Limits
) -> float | None:
    """Return a better exposure for a metering frame; None: this one tells, or none is possible."""
    level = found.bright_dn / (frame.white_level_dn - float(frame.black_level_dn.mean()))
    low, high = USABLE_LEVELS
    if low <= level <= high:
        return None
    next_s = exposure_s * (STEP if level < low else 1 / STEP)
    return next_s if limits_s[0] <= next_s <= limits_s[1] else None


def metered_exposure_s(
    metered: Entry, level: float, light: float, limits_s: tuple[float, float]
) -> float:
    """Return the exposure at which `light` times less light reads `level` of white.

    metered: the journal line of the metering frame. Clipped to the camera's limits. Raises
    `CameraSettingError` where the board was dark.
    """
    black_dn = float(np.mean(metered["black_level_dn"]))
    bright_dn = metered["figures"]["bright_dn"]
    if bright_dn < 1:
        raise CameraSettingError("exposure", "cannot be metered, the board is dark: light the lamp")
    wanted = level * (metered["white_level_dn"] - black_dn) / bright_dn
    low_s, high_s = limits_s
    return min(max(metered["exposure_s"] * wanted * light, low_s), high_s)


def first_meterings(session: Session) -> dict[str, Entry]:
    """Return the first journal line of every metering frame.

    The first counts even where its file is damaged by now: frames exposed by it are there, and
    those still to come must be exposed alike.
    """
    ids = {frame.id for frame in session.frames if frame.kind == "metering"}
    found: dict[str, Entry] = {}
    for entry in session.journal.entries:
        if entry["kind"] == "frame" and entry["id"] in ids:
            found.setdefault(entry["id"], entry)
    return found
