"""Where patches lie, what Psi and the frames say in each, and how estimates are put together.

A patch covers `rows` x `columns` samples of all views and colours; its corner is (y, x). Where a
pixel sums k x k samples, corners and sizes are multiples of k, so that no pixel is cut.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.compiling import njit
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.errors import ReconstructionError

LANES = 16
"""Patches are padded to a multiple of this many float32 values, a vector register."""


@dataclass(frozen=True)
class PatchGrid:
    """Patches of one size: corners (patch, 2) as (y, x), shape (rows, columns) in samples."""

    corners: NDArray[np.int64]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.corners)


def regular_grid(
    size: tuple[int, int], patch: tuple[int, int], stride: int, binning: int = 1
) -> PatchGrid:
    """Return patches every `stride` samples; the last row and column end at the border.

    size: rows and columns of the light field. Raises ReconstructionError for a light field
    smaller than a patch, a stride that leaves gaps, and patches that would cut pixels.
    """
    if patch[0] > size[0] or patch[1] > size[1]:
        raise ReconstructionError(
            f"patches of {patch[0]}x{patch[1]} samples do not fit a light field of "
            f"{size[0]}x{size[1]}: use a dictionary of smaller patches"
        )
    if not 1 <= stride <= min(patch):
        raise ReconstructionError(
            f"a stride of {stride}: it must be 1 to {min(patch)}, the width of a patch"
        )
    if any(length % binning for length in (*patch, stride)):
        raise ReconstructionError(
            f"patches of {patch[0]}x{patch[1]} every {stride} samples cut pixels of "
            f"{binning}x{binning}: patch size and stride must be multiples of {binning}"
        )
    along = [
        np.unique(np.append(np.arange(0, whole - part + 1, stride), whole - part))
        for whole, part in zip(size, patch, strict=True)
    ]
    corners = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 2)
    return PatchGrid(corners.astype(np.int64), patch)


def grouped(keys: Iterable[bytes]) -> dict[bytes, list[int]]:
    """Return the places of equal keys, by key, in order of the first."""
    groups: dict[bytes, list[int]] = {}
    for place, key in enumerate(keys):
        groups.setdefault(key, []).append(place)
    return groups


def padded(length: int) -> int:
    """Return the length rounded up to whole vector registers."""
    return -(-length // LANES) * LANES


@dataclass(frozen=True, eq=False)
class PatchSensing:
    """What Psi and the frames say in some patches.

    weights: (shot, pixel, patch, ray), the coefficients of Psi; the rays of a pixel are the samples
        of its parts, a part being a view, or a colour of a view where pixels see three colours.
    data: (patch, padded measurement), 0 where not usable. usable: (patch, measurement).
    """

    weights: NDArray[np.float32]
    data: NDArray[np.float32]
    usable: NDArray[np.bool_]


def _by_pixel(
    values: NDArray[np.float32], shape: tuple[int, int], binning: int
) -> NDArray[np.float32]:
    """Return values (..., part, sample) of a patch by pixels and their rays, (..., pixel, ray)."""
    *before, parts, _ = values.shape
    rows, columns, k = shape[0] // binning, shape[1] // binning, binning
    cut = values.reshape(*before, parts, rows, k, columns, k)
    pixels_first = np.moveaxis(cut, (-4, -2), (len(before), len(before) + 1))
    return pixels_first.reshape(*before, rows * columns, parts * k * k)


def sense_patches(
    psi: Psi,
    frames: Frames,
    corners: NDArray[np.int64],
    shape: tuple[int, int],
) -> PatchSensing:
    """Cut Psi and the frames into the patches with these corners."""
    k = psi.binning
    shots, views_v, views_u, _, stored, _ = psi.weights.shape
    samples = shape[0] * shape[1]
    pixels = samples // k**2
    parts = views_v * views_u * stored
    count = len(corners)
    weights = np.empty((shots, pixels, count, parts * k**2), dtype=np.float32)
    data = np.zeros((count, padded(shots * pixels)), dtype=np.float32)
    usable = np.empty((count, shots * pixels), dtype=np.bool_)
    for i, (y, x) in enumerate(corners):
        rows, columns = slice(y, y + shape[0]), slice(x, x + shape[1])
        seen = slice(y // k, (y + shape[0]) // k), slice(x // k, (x + shape[1]) // k)
        kept = frames.usable[:, seen[0], seen[1]]
        cut = psi.weights[:, :, :, rows, :, columns].transpose(0, 1, 2, 4, 3, 5)
        weights[:, :, i] = _by_pixel(cut.reshape(shots, parts, samples), shape, k)
        data[i, : shots * pixels] = np.where(kept, frames.readings[:, seen[0], seen[1]], 0).ravel()
        usable[i] = kept.ravel()
    return PatchSensing(weights, data, usable)


def selected_atoms(
    atoms: NDArray[np.float32], colours: NDArray[np.uint8] | None, binning: int
) -> NDArray[np.float32]:
    """Return the atoms as pixels of known colour see them: (pixel, ray, atom).

    atoms: (atom, v, u, y, x, c). colours: (sample,), or None: all three, as parts.
    """
    count, views_v, views_u, rows, columns, _ = atoms.shape
    views, samples = views_v * views_u, rows * columns
    flat = atoms.reshape(count, views, samples, 3)
    if colours is None:
        parts = flat.transpose(0, 1, 3, 2).reshape(count, views * 3, samples)
    else:
        parts = flat[:, :, np.arange(samples), colours]
    rays = _by_pixel(parts, (rows, columns), binning)
    return np.ascontiguousarray(rays.transpose(1, 2, 0))


def sense_atoms(
    selected: NDArray[np.float32],
    weights: NDArray[np.float32],
    shot: int,
    out: NDArray[np.float32],
) -> None:
    """Set one shot's rows of out (patch, atom, padded measurement), the sensed dictionaries.

        out[p, j, pixels shot + i] = sum over rays of atom[i, ray, j] weights[i, p, ray]

    selected: (pixel, ray, atom). weights: (pixel, patch, ray). Operations: 2 pixels patches atoms
    rays.
    """
    pixels = len(selected)
    rows = np.matmul(weights, selected)
    out[..., shot * pixels : (shot + 1) * pixels] = rows.transpose(1, 2, 0)


@njit(cache=True, fastmath=True, nogil=True)
def overlap_add(corners, patches, share, total, weight):
    """Add patches (patch, v, u, y, x, c), weighted by share (patch,), to total and weight."""
    count, views_v, views_u, rows, columns, colours = patches.shape
    for p in range(count):
        top, left = corners[p]
        part = share[p]
        for v in range(views_v):
            for u in range(views_u):
                for y in range(rows):
                    for x in range(columns):
                        for c in range(colours):
                            total[v, u, top + y, left + x, c] += part * patches[p, v, u, y, x, c]
        for y in range(rows):
            for x in range(columns):
                weight[top + y, left + x] += part
