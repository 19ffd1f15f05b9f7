"""What rows and columns of views are: angles, spectral bands or times, as Psi and its results say.

Views at several angles show parallax. Bands and times do not: each is a picture of its own, and no
page speaks of their disparity.
"""

from __future__ import annotations

from itertools import product
from typing import Any

ViewAxes = tuple[str, str]
ANGLES: ViewAxes = ("angle", "angle")
PICTURES = {"angle": "view", "band": "band", "time": "time"}
"""By the name of an axis, what one picture along it is called."""
VIEW_AXES = tuple(product(PICTURES, PICTURES))
ATTRIBUTE = "view_axes"
"""Of files; without it, views are at angles."""


def stored_as(axes: ViewAxes) -> str:
    """Return the axes as an attribute of a file."""
    return ",".join(axes)


def axes_from(value: Any, source: object, error: type[Exception]) -> ViewAxes:
    """Return the axes of a file's attribute, None where it has none; raises `error`."""
    axes = ANGLES if value is None else tuple(str(value).split(","))
    if axes not in VIEW_AXES:
        raise error(f"{source}: {ATTRIBUTE} '{value}': two of {', '.join(PICTURES)} are needed")
    return axes


def shows_parallax(axes: ViewAxes) -> bool:
    """Return whether all views are at angles."""
    return axes == ANGLES


def picture_name(axes: ViewAxes) -> str:
    """Return what one of the pictures is called: view, band or time."""
    return PICTURES[next((name for name in axes if name != "angle"), "angle")]


def place_name(axes: ViewAxes, v: int, u: int) -> str:
    """Return what the picture in row v, column u is called: `view (2, 3)`, `band 17`."""
    if shows_parallax(axes):
        return f"view ({v}, {u})"
    named = zip(axes, (v, u), ("row", "column"), strict=True)
    return ", ".join(
        f"{name} {at}" if name != "angle" else f"{row} {at}" for name, at, row in named
    )
