"""The range of what every pixel's neighbours of its colour read: two quantiles."""

from __future__ import annotations

import numpy as np

from emmc_rig.model.bands import row_kernel


@row_kernel("values", 0)
def neighbour_range(begin, end, values, colours, good, radius, tail, fewest, low, high):
    """Set low and high (y, x) to quantiles `tail` and 1 - `tail` of each pixel's neighbours.

    values (y, x), colours (y, x) uint8, good (y, x) bool: neighbours are the good pixels of the
    same colour up to `radius` rows and columns away, without the pixel itself. With fewer than
    `fewest` of them the range is endless.
    """
    rows, columns = values.shape
    for y in range(begin, end):
        sorted_ = np.empty((2 * radius + 1) ** 2, values.dtype)
        for x in range(columns):
            count = 0
            for j in range(max(0, y - radius), min(rows, y + radius + 1)):
                for i in range(max(0, x - radius), min(columns, x + radius + 1)):
                    if (j == y and i == x) or not good[j, i] or colours[j, i] != colours[y, x]:
                        continue
                    value, place = values[j, i], count
                    while place > 0 and sorted_[place - 1] > value:
                        sorted_[place] = sorted_[place - 1]
                        place -= 1
                    sorted_[place] = value
                    count += 1
            if count < fewest:
                low[y, x], high[y, x] = -np.inf, np.inf
            else:
                step = int(tail * (count - 1) + 0.5)
                low[y, x], high[y, x] = sorted_[step], sorted_[count - 1 - step]
