"""The steps from an unpacked box to a plan: centre the mask, expose, align it, focus, save."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
"""Longest exposure of a frame that an automatic exposure takes unless a longer limit is set."""
AWAY_UM = 5.0
"""Distance of an axis from the centre of the mask or the aperture that counts as away."""
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
Step = dict[str, Any]


def steps(
    figures: Mapping[str, Any] | None,
    mask: Mapping[str, Any] | None,
    off_um: Mapping[str, float | None],
    axes: Sequence[str],
    found: Found,
    takes: Sequence[str],
    written: Sequence[str],
    hint: Mapping[str, Any] | None,
    wants: str,
) -> list[Step]:
    """Return name, condition (need), state (done), text and action of every step.

    figures, mask: of the page's state. off_um: by axis, its distance from the centre of the mask or
    aperture; None: not homed. axes: of the stage. takes: kinds of values that can be saved.
    written: files that were saved. hint: for the next step. wants: see `Watch`.
    """
    return [
        _centre(off_um, axes, figures),
        _exposure(figures, hint),
        _align(mask, found),
        _focus(FOCUS in axes, found),
        _save(takes, written, wants),
    ]


def _step(name: str, done: bool, text: str, action: str = "", **more: Any) -> Step:
    return {"need": NEEDS[name], "name": name, "done": done, "text": text, "action": action, **more}


def _save(takes: Sequence[str], written: Sequence[str], wants: str) -> Step:
    text = wants
    if takes and written:
        text = f"wrote {', '.join(Path(path).name for path in written)}"
    elif takes:
        text = f"{', '.join(takes)} can be written into your files"
    return _step("save", bool(written), text, "preview" if takes else "")


def _exposure(figures: Mapping[str, Any] | None, hint: Mapping[str, Any] | None) -> Step:
    if figures is None:
        return _step("exposure", False, "no frame yet")
    level, saturated = figures["level"], figures["saturated"]
    done = is_well_exposed(level, saturated)
    if hint is not None and hint["action"] == "centre":
        return _step("exposure", done, "the picture is dark: centre the mask first")
    text = f"the brightest readings reach {100 * level:.0f} % of white"
    if saturated > OVEREXPOSED:
        text += f", {100 * saturated:.1f} % are saturated"
    offer = {name: hint[name] for name in ("values", "label") if name in hint} if hint else {}
    return _step("exposure", done, text, "" if done else "autoexpose", **offer)


def hint_of(text: str, action: str = "", **more: Any) -> dict[str, Any]:
    """Return a hint for the person at the bench; action: of the page, "": the person's own."""
    return {"text": text, "action": action, **more}


def exposure_hint(level: float, exposure_s: float, longest_s: float) -> dict[str, Any]:
    """Return the hint for a picture that is underexposed, but not dark.

    level: its brightest reading, of white. longest_s: that the camera offers.
    """
    text = f"The brightest reading is {100 * level:.1f} % of white"
    needed_s = exposure_for_s(sum(GOOD_LEVELS) / 2, exposure_s, level)
    if needed_s <= LONGEST_UNASKED_S:
        return hint_of(f"{text}.", "autoexpose")
    text += f": {needed_s:.2g} s are needed"
    if needed_s > longest_s:
        return hint_of(f"{text}, the camera offers {longest_s:g} s: give it more light.")
    # The level is known to a few percent, so that the exposure may become a little longer.
    values, label = {"longest_s": 1.5 * needed_s}, f"expose for {needed_s:.2g} s"
    return hint_of(f"{text}.", "autoexpose", values=values, label=label)


def _centre(
    off_um: Mapping[str, float | None],
    axes: Sequence[str],
    figures: Mapping[str, Any] | None,
) -> Step:
    name, parts = "centre the mask", {"mask": MASK, "aperture": APERTURE}
    by_hand = [part for part, own in parts.items() if not {*own} & {*axes}]
    if len(by_hand) == len(parts):
        lit = figures is not None and not figures["dark"]
        text = "light comes through" if lit else "put the mask in and open the aperture by hand"
        return _step(name, lit, text)
    if not off_um:
        text = "it is not known where the mask is centred: name zero_um in the rig's file"
        return _step(name, False, text)
    unknown = [axis for axis, um in off_um.items() if um is None]
    away = unknown or [axis for axis, um in off_um.items() if abs(um or 0.0) > AWAY_UM]
    text = "mask centred, aperture open"
    if away:
        text = f"not {'homed' if unknown else 'there'} yet: {', '.join(away)}"
    if by_hand:
        text += f"; the {by_hand[0]} is moved by hand"
    return _step(name, not away, text, "centre" if away else "")


def _align(mask: Mapping[str, Any] | None, found: Found) -> Step:
    place = found.mask
    if place is None:
        text = (mask or {}).get("why") or "looking for the mask's shadow: show it a white board"
        return _step("align", False, text, look="whiteboard")
    turn, deviation = place.rotation_deg, place.rotation_deviation_deg
    done = abs(turn) <= ALIGNED_DEG + 2 * deviation
    text = (
        f"rotation {turn:.2f} \u00b1 {deviation:.2f}\u00b0, scale {100 * (place.scale - 1):+.2f} "
        f"\u00b1 {100 * place.scale_deviation:.2f} %"
    )
    if not done:
        way = "clockwise" if turn > 0 else "counterclockwise"
        text += f": turn the mask {way} in the picture"
    return _step("align", done, text)


def _focus(has_axis: bool, found: Found) -> Step:
    if found.focus is not None:
        place_um, deviation_um = found.focus.place_um, found.focus.deviation_um
        text = f"sharpest at {place_um:.0f} \u00b1 {deviation_um:.0f} \u00b5m"
        return _step("focus", True, text, "autofocus")
    text = "show it the scene: a white board has nothing to focus on" if has_axis else NO_FOCUS
    return _step("focus", False, text, "autofocus" if has_axis else "")
