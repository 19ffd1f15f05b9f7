"""Pictures from where no view was: between the views, by their disparities.

Positions are in view steps: (v, u) = (1.5, 2) lies halfway between two views of column 2. Samples
between pixels are bilinear, and beyond an edge its last pixel continues. The viewer's shader is
the twin of `between`: change both together.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import row_kernel
from emmc_rig.model.lightfield import centre_view, disagreement, focus_disparities, small_grey_views

Array = NDArray[np.floating]
STEPS = 3
"""Fixed point steps from a view's disparity to that of the ray; shifts are below one view step."""
TOLERANCE_PX = 0.25
"""Disparities this far apart are of two surfaces; below the least step that occlusion shows."""
LEAST_WEIGHT = 1e-3
"""Of a view that no other view confirms: so that surfaces seen by a single view are shown."""
CANDIDATES, WINDOW_PX = 33, 7
"""Disparities tried, and the side of the square over which views are compared."""
UNSEEN = np.finfo(np.float32).max
"""What OpenCV takes a picture to have beyond its edge, where the least is looked for."""
CRACK_SHARE = 0.5
"""Of unseen samples around one: fewer are a crack in a surface that widens, not its outline."""
LARGEST_PX = 320
"""Width of the views that disparity is estimated on."""


def sampled(picture: Array, y: Array, x: Array) -> Array:
    """Return a picture (y, x) or (y, x, c) at places (row, column), bilinear."""
    colours = picture.reshape(*picture.shape[:2], -1)
    found = np.empty((*y.shape, colours.shape[2]), np.float32)
    _sample(colours, y, x, found)
    return found.reshape(*y.shape, *picture.shape[2:])


@row_kernel("found", 0)
def _sample(begin, end, picture, y, x, found):
    """Set found (row, column, c) to the picture (y, x, c) at places y and x (row, column)."""
    last_y, last_x = picture.shape[0] - 1, picture.shape[1] - 1
    for row in range(begin, end):
        for column in range(found.shape[1]):
            at_y, at_x = y[row, column], x[row, column]
            at_y = min(at_y, last_y) if at_y > 0 else 0.0  # also where it is not a number
            at_x = min(at_x, last_x) if at_x > 0 else 0.0
            top, left = int(at_y), int(at_x)
            down, right = at_y - top, at_x - left
            bottom, beside = min(top + 1, last_y), min(left + 1, last_x)
            for c in range(found.shape[2]):
                above = (1 - right) * picture[top, left, c] + right * picture[top, beside, c]
                below = (1 - right) * picture[bottom, left, c] + right * picture[bottom, beside, c]
                found[row, column, c] = (1 - down) * above + down * below


def estimated_disparity(light_field: Array) -> NDArray[np.float32]:
    """Return a disparity (y, x) of the centre view, pixels per view step, by a plane sweep.

    At each place the disparity at which the views agree best, over a small window; for methods
    that estimate none. Even places have the disparity that happens to agree best there.
    """
    height, width = light_field.shape[2:4]
    small, shrink = small_grey_views(light_field, LARGEST_PX)
    back, _, front = focus_disparities(light_field)
    margin = max(0.15 * (front - back), 0.1)
    tried = np.linspace(back - margin, front + margin, CANDIDATES) / shrink
    cost = np.stack([disagreement(small, float(d), WINDOW_PX) for d in tried])
    best = cv2.medianBlur(tried[cost.argmin(axis=0)].astype(np.float32), 5)
    return cv2.resize(best, (width, height), interpolation=cv2.INTER_NEAREST) * np.float32(shrink)


def view_disparities(centre: Array, views: tuple[int, int]) -> NDArray[np.float32]:
    """Return the disparity (v, u, y, x) that every view sees, from that of the centre view.

    Surfaces move with the view, near ones over far ones; what they uncover continues what lies
    behind.
    """
    height, width = centre.shape
    order = np.argsort(centre, axis=None)
    rows, columns = np.divmod(order, width)
    depth = centre.ravel()[order].astype(np.float32)
    seen = np.empty((*views, height, width), np.float32)
    for v, u in np.ndindex(*views):
        y = np.rint(rows + depth * (v - views[0] // 2)).astype(int)
        x = np.rint(columns + depth * (u - views[1] // 2)).astype(int)
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        view = np.full((height, width), UNSEEN, np.float32)
        view[y[inside], x[inside]] = depth[inside]  # the nearest comes last
        if not inside.any():
            view[:] = centre
        hole = view == UNSEEN
        cracks = hole & (cv2.blur(hole.astype(np.float32), (3, 3)) < CRACK_SHARE)
        view[cracks] = cv2.erode(view, np.ones((3, 3), np.uint8))[cracks]
        # A near surface uncovers a strip as wide as its shift against the background.
        steps = max(abs(v - views[0] // 2), abs(u - views[1] // 2))
        wide = 2 * int(np.ceil(steps * (depth[-1] - depth[0]))) + 3
        while (hole := view == UNSEEN).any():
            view[hole] = cv2.erode(view, np.ones((wide, wide), np.uint8))[hole]
        seen[v, u] = cv2.medianBlur(view, 3)
    return seen


def between(light_field: Array, disparities: Array, v: float, u: float) -> Array:
    """Return the picture (y, x, c) at a position between the views.

    The colour of a ray is a mean of the four nearest views, each sampled at the ray's surface.
    Views whose disparity contradicts the surface, and occluded surfaces, have small weights.

    light_field: (v, u, y, x, c). disparities: (v, u, y, x), see `view_disparities`. v, u: position.
    """
    y, x = np.mgrid[: light_field.shape[2], : light_field.shape[3]].astype(np.float32)
    least, most = float(disparities.min()), float(disparities.max())
    top, left = (
        min(max(int(np.floor(at)), 0), max(count - 2, 0))
        for at, count in zip((v, u), light_field.shape, strict=False)
    )
    found = []
    for j, i in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
        share = (1 - abs(j - v)) * (1 - abs(i - u))
        if share <= 0:
            continue

        def at(d, picture, j=j, i=i):
            return sampled(picture[j, i], y + d * np.float32(j - v), x + d * np.float32(i - u))

        d = disparities[j, i]
        for guess in (least, (least + most) / 2, most):
            d = np.maximum(d, at(np.float32(guess), disparities))
        for _ in range(STEPS):
            d = at(d, disparities)
        missed = np.abs(at(d, disparities) - d)
        found.append((np.float32(share), d, missed, at(d, light_field)))
    nearest = np.max([d - missed for _, d, missed, _ in found], axis=0)
    total = np.zeros(light_field.shape[2:], np.float32)
    weights = np.zeros_like(nearest)
    for share, d, missed, colour in found:
        agreeing = 1 / (1 + (missed / TOLERANCE_PX) ** 2)
        weight = share * (
            agreeing * np.exp(-(nearest - (d - missed)) / TOLERANCE_PX) + LEAST_WEIGHT
        )
        total += weight[..., None] * colour
        weights += weight
    return total / weights[..., None]


def all_in_focus(light_field: Array, disparity: Array) -> NDArray[np.float32]:
    """Return the centre view (y, x, c) with less noise: the mean of all views along its disparity.

        mean = sum_k w_k L_k / sum_k w_k,   w_k = exp(-|L_k - L_0|^2 / (2 m)),

    with L_k what view k has at each point of the centre view L_0, and m the median of |L_k - L_0|^2
    over views and points: surfaces that a view does not see, and reflections, count little.

    disparity: (y, x) of the centre view, finite.
    """
    y, x = np.mgrid[: light_field.shape[2], : light_field.shape[3]].astype(np.float32)
    views, at = light_field.shape[:2], []
    for v, u in np.ndindex(views):
        down, right = np.float32(v - views[0] // 2), np.float32(u - views[1] // 2)
        view = np.ascontiguousarray(light_field[v, u], np.float32)
        place = x + disparity * right, y + disparity * down
        moved = cv2.remap(view, *place, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        at.append(moved.reshape(view.shape))  # OpenCV drops the axis of a single colour
    seen = np.stack(at)
    apart = np.square(seen - centre_view(light_field)).sum(axis=-1, keepdims=True)
    weights = np.exp(-apart / np.float32(2 * np.median(apart) + 1e-12))
    return np.clip((weights * seen).sum(axis=0) / weights.sum(axis=0), 0, 1)


def centre_disparity(light_field: Array, disparity: Array | None) -> NDArray[np.float32]:
    """Return a finite disparity (y, x) of the centre view: the given one, or an estimate."""
    if disparity is None or disparity.shape != centre_view(light_field).shape[:2]:
        return estimated_disparity(light_field)
    middle = (
        float(np.median(disparity[np.isfinite(disparity)])) if np.isfinite(disparity).any() else 0.0
    )
    return np.nan_to_num(disparity.astype(np.float32), nan=middle, posinf=middle, neginf=middle)
