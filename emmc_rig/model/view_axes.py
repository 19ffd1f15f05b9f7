"""What rows and columns of views are: angles, spectral bands or times, as Psi and its results say.

Views at several angles show parallax. Bands and times do not: each is a picture of its own, and no
page speaks of their disparity.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any, Literal

ViewAxis = Literal["angle", "band", "time"]
ViewAxes = tuple[str, str]
ANGLES: ViewAxes = ("angle", "angle")
PICTURES = {"angle": "view", "band": "band", "time": "time"}
"""Name of a picture by the name of the axis along which pictures differ."""
VIEW_AXES = tuple(product(PICTURES, PICTURES))
ATTRIBUTE = "view_axes"
"""Of files; without it, views are at angles."""


def stored_as(axes: ViewAxes) -> str:
    """Return the axes as an attribute of a file."""
    return ",".join(axes)


def axes_from(value: Any, source: object, error: type[Exception]) -> ViewAxes:
    """Return the axes of a file's attribute, None where it has none; raises `error`."""
    text = stored_as(ANGLES) if value is None else str(value)
    for axes in VIEW_AXES:
        if stored_as(axes) == text:
            return axes
    raise error(f"{source}: {ATTRIBUTE} '{text}': two of {', '.join(PICTURES)} are needed")


def axes_of(metrics: Mapping[str, object]) -> ViewAxes:
    """Return the axes that metrics.json has; without any, views are at angles."""
    named = metrics.get(ATTRIBUTE)
    return next((axes for axes in VIEW_AXES if named in (axes, list(axes))), ANGLES)


def shows_parallax(axes: ViewAxes) -> bool:
    """Return whether all views are at angles."""
    return axes == ANGLES


def picture_name(axes: ViewAxes) -> str:
    """Return what one of the pictures is called: view, band or time."""
    return PICTURES[next((name for name in axes if name != "angle"), "angle")]


def grid_name(axes: ViewAxes, views: tuple[int, int]) -> str:
    """Return a grid of pictures in words, such as `5x5 views` or `1x24 bands`."""
    return f"{views[0]}x{views[1]} {picture_name(axes)}s"


def middle_name(axes: ViewAxes) -> str:
    """Return what the picture in the middle is called."""
    return "centre view" if shows_parallax(axes) else f"middle {picture_name(axes)}"


def axis_names(axes: ViewAxes, views: tuple[int, int]) -> list[str]:
    """Return what a place along rows and along columns of views is called; "" where is but one."""
    return ["" if count == 1 else PICTURES[name] for name, count in zip(axes, views, strict=True)]


def place_name(axes: ViewAxes, views: tuple[int, int], place: tuple[int, int]) -> str:
    """Return what the picture in a row and column of views is called: `view (2, 3)`, `band 17`."""
    if shows_parallax(axes):
        return f"view {place}"
    named = zip(axis_names(axes, views), place, strict=True)
    return ", ".join(f"{name} {at}" for name, at in named if name)


def view_names(views: Iterable[Sequence[int]]) -> str:
    """Return views (v, u) by name: "view (0, 0)", "views (0, 0), (0, 4)"; of none: ""."""
    names = [f"({v}, {u})" for v, u in views]
    return f"view{'s' * (len(names) > 1)} {', '.join(names)}" if names else ""
