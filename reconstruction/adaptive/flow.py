"""Optical flow between pictures of two times, and fields carried along it.

Dense inverse search (Kroeger et al. 2016), as OpenCV has it, between the centre views of light
fields without surfaces: they blur as the scene does, whatever the mask. Of real light fields that
slide by 1 to 3 pixels it is off by 0.1 to 0.2 pixels, of the true pictures by as much.

A flow is (y, x, 2): the point at p of one time is at p + flow(p), along y and x, at the other.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
WHITE = 99.5
"""Percentile of the pictures' values that codes up to 255 are for."""


def _codes(pictures: tuple[Array, Array]) -> list[NDArray[np.uint8]]:
    """Return the root of the brightness of pictures (y, x, c), as codes of one scale."""
    grey = [np.sqrt(np.maximum(picture.mean(axis=-1), 0)) for picture in pictures]
    white = max(float(np.percentile(np.stack(grey), WHITE)), 1e-6)
    return [(np.clip(picture / white, 0, 1) * 255).astype(np.uint8) for picture in grey]


def flow_between(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the flows from the first of two pictures (y, x, c) to the second, and back."""
    codes = _codes((first, second))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def flow(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> Array:
        across_first = search.calc(source, target, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        return np.ascontiguousarray(across_first[..., ::-1], dtype=np.float32)

    return flow(*codes), flow(*codes[::-1])


def at_places(shape: tuple[int, int]) -> Array:
    """Return the place of every sample, (y, x, 2)."""
    return np.moveaxis(np.indices(shape, dtype=np.float32), 0, -1)


def sampled(field: Array, places: Array, cubic: bool = False) -> Array:
    """Return a field (y, x) or (y, x, c) at places (y, x, 2); beyond its ends as there."""
    down, across = (np.ascontiguousarray(places[..., axis], dtype=np.float32) for axis in (0, 1))
    way = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    field = np.ascontiguousarray(field, dtype=np.float32)
    found = cv2.remap(field, across, down, way, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)


def joined(first: Array, second: Array) -> Array:
    """Return the flow of one time after the other."""
    return first + sampled(second, at_places(first.shape[:2]) + first)
