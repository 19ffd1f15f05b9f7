"""The disparity of a light field estimated from its true views, which no method can have.

A plane sweep: every view is carried to the centre view at each disparity and compared. A point that
some views do not see is still seen by those of one side, so that the mean is taken over the views
of each half plane of (v, u), and the least of the eight counts (half occlusion: Kang, Szeliski and
Chai 2001). Costs are averaged over 3 x 3 samples and the winner's map is median filtered (5 x 5).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
COARSE_STEP_PX, STEP_PX = 0.5, 0.05
TRIMMED_PERCENT = 0.5
"""Of the coarse sweep's disparities, at either end: featureless places match anywhere."""
BOX, MEDIAN = 3, 5
HALF_PLANES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
FEWEST_VIEWS = 3
"""Views of a half plane that must see a sample, or the half plane is left out there."""


def matched_disparity(light_field: Array, furthest_px: float = 24.0) -> Array:
    """Return the centre view's disparity (y, x), pixels per view step, float32.

    light_field: (v, u, y, x, c), the truth. furthest_px: the largest disparity, to both sides.
    """
    rough = _swept(light_field, np.arange(-furthest_px, furthest_px + 1e-6, COARSE_STEP_PX))
    low, high = np.percentile(rough, (TRIMMED_PERCENT, 100 - TRIMMED_PERCENT))
    planes = np.arange(low - COARSE_STEP_PX, high + COARSE_STEP_PX + 1e-6, STEP_PX)
    return _swept(light_field, planes)


def _swept(light_field: Array, planes: Array) -> Array:
    """Return the disparity (y, x), of these, that the views of a light field match best at."""
    views_v, views_u, rows, columns, _ = light_field.shape
    centre = np.asarray(light_field[views_v // 2, views_u // 2], dtype=np.float32)
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    others = [
        (v - views_v // 2, u - views_u // 2, np.ascontiguousarray(light_field[v, u], np.float32))
        for v, u in np.ndindex(views_v, views_u)
        if (v, u) != (views_v // 2, views_u // 2)
    ]
    least = np.full((rows, columns), np.inf, dtype=np.float32)
    disparity = np.zeros((rows, columns), dtype=np.float32)
    for plane in planes:
        costs = np.zeros((len(HALF_PLANES), rows, columns), dtype=np.float32)
        counts = np.zeros_like(costs)
        for dv, du, view in others:
            at_y, at_x = y + np.float32(plane * dv), x + np.float32(plane * du)
            carried = cv2.remap(view, at_x, at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            within = (at_y >= 0) & (at_y <= rows - 1) & (at_x >= 0) & (at_x <= columns - 1)
            cost = np.square(carried - centre).mean(axis=-1) * within
            for half, (along_v, along_u) in enumerate(HALF_PLANES):
                if along_v * dv + along_u * du >= 0:
                    costs[half] += cost
                    counts[half] += within
        for half, count in enumerate(counts):
            seen = cv2.blur(count, (BOX, BOX))
            mean = cv2.blur(costs[half], (BOX, BOX)) / np.maximum(seen, 1e-3)
            better = (mean < least) & (seen >= FEWEST_VIEWS)
            least[better], disparity[better] = mean[better], plane
    return np.asarray(cv2.medianBlur(disparity, MEDIAN), dtype=np.float32)
