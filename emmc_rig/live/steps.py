"""The steps from an unpacked box to a plan: centre the mask, expose, align it, focus, save."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emmc_rig.bench.hands import APERTURE, MASK
from emmc_rig.bench.hardware import FOCUS
from emmc_rig.live.save import Found
from emmc_rig.session.brightness import (
    GOOD_LEVELS,
    OVEREXPOSED,
    exposure_for_s,
    is_well_exposed,
)

LONGEST_UNASKED_S = 4.0
"""Exposure of one frame that an automatic exposure takes without being asked for more."""
AWAY_UM = 5.0
"""From where an axis centres the mask or opens the aperture, it is not there."""
ALIGNED_DEG = 0.1
NO_FOCUS = (
    "this stage has no axis named focus, and the camera's driver moves no lens: turn the lens by "
    "hand until the sharpness no longer grows"
)


NEEDS = {
    "centre the mask": "and open the aperture",
    "exposure": "at 70 to 90 % of white, none saturated",
    "align": "the mask with the sensor's rows, to 0.1\u00b0",
    "focus": "on the scene, where it will be captured",
    "save": "what was found in the plan and the rig",
}
"""Condition of every step, in words that follow its name."""


@dataclass(frozen=True)
class Saving:
    """Kinds of files that can be saved, and the files that were written."""

    takes: Sequence[str] = ()
    written: Sequence[str] = ()


def steps(
    figures: Mapping[str, Any] | None,
    mask: Mapping[str, Any] | None,
    off_um: Mapping[str, float | None],
    axes: Sequence[str],
    found: Found,
    saving: Saving,
    hint: Mapping[str, Any] | None,
) -> list[dict[str, Any]]:
    """Return name, condition, state, text and action of every step.

    figures, mask: of the page's state. off_um: by axis, how far it stands from where it centres the
    mask or opens the aperture; None: not homed. axes: of the stage. hint: what to do next.
    """
    made = [
        _centre(off_um, axes, figures),
        _exposure(figures, hint),
        _align(mask, found),
        _focus(FOCUS in axes, found),
        _save(saving),
    ]
    return [{"need": NEEDS[step["name"]], **step} for step in made]


def _save(saving: Saving) -> dict[str, Any]:
    takes, text = saving.takes, f"wrote {', '.join(Path(one).name for one in saving.written)}"
    if not saving.written:
        text = f"{', '.join(takes)} can be written into your files"
    if not takes:
        text = "to write it into your files start the page with a plan and a file of devices"
    action = "preview" if takes else ""
    return {"name": "save", "done": bool(saving.written), "text": text, "action": action}


def _exposure(figures: Mapping[str, Any] | None, hint: Mapping[str, Any] | None) -> dict[str, Any]:
    if figures is None:
        return {"name": "exposure", "done": False, "text": "no frame yet", "action": ""}
    level, saturated = figures["level"], figures["saturated"]
    done = is_well_exposed(level, saturated)
    text = f"the brightest readings reach {100 * level:.0f} % of white"
    if saturated > OVEREXPOSED:
        text += f", {100 * saturated:.1f} % are saturated"
    step = {"name": "exposure", "done": done, "text": text, "action": "" if done else "autoexpose"}
    if hint is not None and hint["action"] == "centre":
        return step | {"text": "the picture is dark: centre the mask first", "action": ""}
    if hint is not None and "values" in hint:
        return step | {name: hint[name] for name in ("values", "label")}
    return step


def exposure_hint(level: float, exposure_s: float, longest_s: float) -> dict[str, Any]:
    """Return the hint for a picture that is underexposed, but not dark.

    level: its brightest reading, of white. longest_s: that the camera offers.
    """
    text = f"The brightest reading is {100 * level:.1f} % of white"
    needed_s = exposure_for_s(sum(GOOD_LEVELS) / 2, exposure_s, level)
    if needed_s <= LONGEST_UNASKED_S:
        return {"text": f"{text}.", "action": "autoexpose"}
    text += f": {needed_s:.2g} s are needed"
    if needed_s > longest_s:
        return {
            "text": f"{text}, the camera offers {longest_s:g} s: give it more light.",
            "action": "",
        }
    # What is not known to a few percent may take a little longer.
    values, label = {"longest_s": 1.5 * needed_s}, f"expose for {needed_s:.2g} s"
    return {"text": f"{text}.", "action": "autoexpose", "values": values, "label": label}


def _centre(
    off_um: Mapping[str, float | None],
    axes: Sequence[str],
    figures: Mapping[str, Any] | None,
) -> dict[str, Any]:
    by_hand = [
        name for name, own in (("mask", MASK), ("aperture", APERTURE)) if not {*own} & {*axes}
    ]
    if len(by_hand) == 2:
        lit = figures is not None and not figures["dark"]
        text = "light comes through" if lit else "put the mask in and open the aperture by hand"
        return {"name": "centre the mask", "done": lit, "text": text, "action": ""}
    if not off_um:
        text = "it is not known where the mask is centred: name zero_um in the rig's file"
        return {"name": "centre the mask", "done": False, "text": text, "action": ""}
    away = [axis for axis, um in off_um.items() if um is None or abs(um) > AWAY_UM]
    text = "mask centred, aperture open"
    if away:
        unknown = [axis for axis in away if off_um[axis] is None]
        text = (
            f"not homed yet: {', '.join(unknown)}"
            if unknown
            else f"not there yet: {', '.join(away)}"
        )
    if by_hand:
        text += f"; the {by_hand[0]} is moved by hand"
    action = "centre" if away else ""
    return {"name": "centre the mask", "done": not away, "text": text, "action": action}


def _align(mask: Mapping[str, Any] | None, found: Found) -> dict[str, Any]:
    place = found.mask
    if place is None:
        text = (mask or {}).get("why") or "looking for the mask's shadow: show it a white board"
        return {"name": "align", "done": False, "text": text, "action": "", "look": "whiteboard"}
    turn, deviation = place.rotation_deg, place.rotation_deviation_deg
    done = abs(turn) <= ALIGNED_DEG + 2 * deviation
    way = "clockwise" if turn > 0 else "counterclockwise"
    text = (
        f"rotation {turn:.2f} \u00b1 {deviation:.2f}\u00b0, scale {100 * (place.scale - 1):+.2f} "
        f"\u00b1 {100 * place.scale_deviation:.2f} %"
    )
    if not done:
        text += f": turn the mask {way} in the picture"
    return {"name": "align", "done": done, "text": text, "action": ""}


def _focus(has_focus: bool, found: Found) -> dict[str, Any]:
    if found.focus is not None:
        text = (
            f"sharpest at {found.focus.place_um:.0f} \u00b1 {found.focus.deviation_um:.0f} \u00b5m"
        )
        return {"name": "focus", "done": True, "text": text, "action": "autofocus"}
    if has_focus:
        text = "show it the scene: a white board has nothing to focus on"
        return {"name": "focus", "done": False, "text": text, "action": "autofocus"}
    return {"name": "focus", "done": False, "text": NO_FOCUS, "action": ""}
