"""Where patches lie, what Psi and the frames say in each, and how estimates are put together.

A patch covers `rows` x `columns` samples of all views and colours; its corner is (y, x). Where a
pixel sums k x k samples, corners and sizes are multiples of k, so that no pixel is cut.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.compiling import njit
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
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


def padded(length: int) -> int:
    """Return the length rounded up to whole vector registers."""
    return -(-length // LANES) * LANES


@dataclass(frozen=True, eq=False)
class PatchSensing:
    """What Psi and the frames say in some patches.

    weights: (patch, shot, part, padded sample), the coefficients of Psi, a part being a view, or
        a colour of a view where pixels see three colours. Zero where a pixel is not usable.
    data: (patch, padded measurement), 0 where not usable. measured: usable pixels of each patch.
    """

    weights: NDArray[np.float32]
    data: NDArray[np.float32]
    measured: NDArray[np.int64]


def sense_patches(
    psi: ImagingMatrix,
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
    weights = np.zeros((count, shots, parts, padded(samples)), dtype=np.float32)
    data = np.zeros((count, padded(shots * pixels)), dtype=np.float32)
    measured = np.empty(count, dtype=np.int64)
    for i, (y, x) in enumerate(corners):
        rows, columns = slice(y, y + shape[0]), slice(x, x + shape[1])
        seen = slice(y // k, (y + shape[0]) // k), slice(x // k, (x + shape[1]) // k)
        kept = frames.usable[:, seen[0], seen[1]]
        cut = psi.weights[:, :, :, rows, :, columns].transpose(0, 1, 2, 4, 3, 5)
        if not kept.all():
            cut = cut * kept.repeat(k, axis=1).repeat(k, axis=2)[:, None, None, None]
        weights[i, :, :, :samples] = cut.reshape(shots, parts, samples)
        data[i, : shots * pixels] = np.where(kept, frames.readings[:, seen[0], seen[1]], 0).ravel()
        measured[i] = kept.sum()
    return PatchSensing(weights, data, measured)


def pixel_of_sample(shape: tuple[int, int], binning: int) -> NDArray[np.int64]:
    """Return the index of the pixel within its patch that each sample reaches: (sample,)."""
    y, x = np.indices(shape) // binning
    return (y * (shape[1] // binning) + x).ravel().astype(np.int64)


def selected_atoms(
    atoms: NDArray[np.float32], colours: NDArray[np.uint8] | None
) -> NDArray[np.float32]:
    """Return the atoms as a pixel of known colour sees them: (atom, part, padded sample).

    atoms: (atom, v, u, y, x, c). colours: (sample,), or None: all three, as parts.
    """
    count, views_v, views_u, rows, columns, _ = atoms.shape
    views, samples = views_v * views_u, rows * columns
    flat = atoms.reshape(count, views, samples, 3)
    if colours is None:
        out = np.zeros((count, views, 3, padded(samples)), dtype=np.float32)
        out[..., :samples] = flat.transpose(0, 1, 3, 2)
        return out.reshape(count, views * 3, -1)
    out = np.zeros((count, views, padded(samples)), dtype=np.float32)
    for colour in range(3):
        here = np.flatnonzero(colours == colour)
        out[:, :, here] = flat[:, :, here, colour]
    return out


@njit(cache=True, fastmath=True, nogil=True)
def sense_atoms(selected, weights, pixel, pixels, shot, out):
    """Add one shot's rows to out (patch, atom, padded measurement), the sensed dictionaries.

        row[i]                          = sum over parts of atom[part, i] weights[part, i]
        out[p, j, pixels shot + pixel[i]] = sum of row over the samples i of that pixel
    selected: (atom, part, padded sample). weights: (patch, part, padded sample).
    pixel: (sample,), see `pixel_of_sample`; `pixels` of them a shot.
    Operations: 2 patches atoms parts samples. Each atom is read once for all patches. Five parts at
    a time: fewer passes over the row.
    """
    count, parts, width = selected.shape
    first = shot * pixels
    samples = pixel.size
    row = np.empty(width, np.float32)
    whole = parts - parts % 5
    for j in range(count):
        atom = selected[j]
        for p in range(weights.shape[0]):
            seen = weights[p]
            for i in range(width):
                row[i] = 0
            for v in range(0, whole, 5):
                a, b, c, d, e = atom[v], atom[v + 1], atom[v + 2], atom[v + 3], atom[v + 4]
                f, g, h = seen[v], seen[v + 1], seen[v + 2]
                k, m = seen[v + 3], seen[v + 4]
                for i in range(width):
                    row[i] += a[i] * f[i] + b[i] * g[i] + c[i] * h[i] + d[i] * k[i] + e[i] * m[i]
            for v in range(whole, parts):
                a, f = atom[v], seen[v]
                for i in range(width):
                    row[i] += a[i] * f[i]
            line = out[p, j]
            if pixels == samples:
                for i in range(samples):
                    line[first + i] = row[i]
            else:
                for i in range(pixels):
                    line[first + i] = 0
                for i in range(samples):
                    line[first + pixel[i]] += row[i]


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
