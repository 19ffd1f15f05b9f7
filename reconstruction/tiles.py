"""Reconstruct in tiles that overlap, so that any capture fits into memory.

What a method would choose from its frames (mu, rho, the primal step, the number of steps) is
chosen once from the whole capture. Tiles start at multiples of the patches' stride, so that
every tile cuts the patches of the whole: sparse patches come out the same in any tiling once
tiles overlap by a patch. A step of the variational methods carries information by a sample; what
lies further than the overlap hardly matters, see OVERLAP.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import lcm
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.errors import SensingError
from emmc_rig.model.reading import StoredArrays, stored_arrays
from emmc_rig.model.sensing import FORMAT, ImagingMatrix
from reconstruction.choices import choose_mu, choose_primal_step, contrast, smooth_guess
from reconstruction.dictionary import Dictionary
from reconstruction.errors import ReconstructionError
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.methods.tv_dict import patched_weights
from reconstruction.result import Reconstruction

OVERLAP = 48
"""Samples beside a tile that are reconstructed and thrown away."""
STEPS = 100
"""Of the variational methods, in every tile alike; the rule by change would differ from tile to
tile."""
SAMPLED = 256
"""Rows and columns of the window from which contrast and brightness are judged."""

Array = NDArray[np.floating]


class PsiSource(Protocol):
    """An imaging matrix of which a window can be had at a time."""

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the light field."""
        ...

    @property
    def binning(self) -> int:
        """k; a pixel sums k x k samples."""
        ...

    def window(self, rows: slice, columns: slice) -> ImagingMatrix:
        """Return the imaging matrix of some samples; the slices are multiples of k."""
        ...


class SavedPsi:
    """The imaging matrix in a file, read window by window.

    The file's checksum is not verified, which would need all of it: `ImagingMatrix.load` does.
    Raises SensingError when the file is no imaging matrix.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._opened() as stored:
            weights = stored.dataset("weights")
            self.size = weights.shape[3], weights.shape[5]
            self.binning = int(np.asarray(stored.attributes["binning"]))
            self.checksum = str(stored.attributes["sha256"])

    @contextmanager
    def _opened(self) -> Iterator[StoredArrays]:
        with stored_arrays(self._path, SensingError, "measure Psi again") as stored:
            if stored.attributes.get("format") != FORMAT or "weights" not in stored:
                raise SensingError(f"{self._path}: not an imaging matrix of this program")
            yield stored

    def window(self, rows: slice, columns: slice) -> ImagingMatrix:
        """Return the imaging matrix of some samples; the slices are multiples of k."""
        with self._opened() as stored:
            colour = stored.dataset("colour") if "colour" in stored else None
            return ImagingMatrix(
                stored.dataset("weights")[:, :, :, rows, :, columns],
                None if colour is None else colour[:, rows, columns],
                self.binning,
            )


@dataclass(frozen=True)
class Tile:
    """outer: rows and columns reconstructed; inner: those kept, in the light field's samples."""

    outer: tuple[slice, slice]
    inner: tuple[slice, slice]

    def kept(self) -> tuple[slice, slice]:
        """Return the inner part within the outer."""
        return tuple(
            slice(i.start - o.start, i.stop - o.start)
            for i, o in zip(self.inner, self.outer, strict=True)
        )  # type: ignore[return-value]


def tiles(size: tuple[int, int], tile: int, overlap: int, multiple: int) -> Iterator[Tile]:
    """Yield tiles that cover `size` with inner parts of about `tile` samples a side.

    multiple: of which all inner starts and the overlap are; the last tiles end at the border.
    """
    step = max(tile // multiple, 1) * multiple
    margin = -(-overlap // multiple) * multiple
    sides = [
        [
            (
                slice(max(start - margin, 0), min(start + step + margin, whole)),
                slice(start, min(start + step, whole)),
            )
            for start in range(0, whole, step)
        ]
        for whole in size
    ]
    for row_outer, row_inner in sides[0]:
        for column_outer, column_inner in sides[1]:
            yield Tile((row_outer, column_outer), (row_inner, column_inner))


def _settled(
    psi: PsiSource,
    frames: Array,
    noise_sigma: float,
    usable: NDArray[np.bool_],
    settings: MethodSettings,
    patched: bool,
) -> MethodSettings:
    """Return the settings with all that a tile would choose for itself chosen for all of them."""
    k = psi.binning
    middle = [max(0, (whole - SAMPLED) // 2 // k * k) for whole in psi.size]
    rows, columns = (
        slice(first, first + min(SAMPLED, whole))
        for first, whole in zip(middle, psi.size, strict=True)
    )
    part = psi.window(rows, columns)
    seen = np.s_[:, rows.start // k : rows.stop // k, columns.start // k : columns.stop // k]
    readings = frames[usable]
    tv = settings.tv
    if patched:
        tv = patched_weights(tv, settings.sparse, part, readings, noise_sigma)
    mu = tv.mu or choose_mu(part, readings, noise_sigma, tv.order)
    kept = np.where(usable[seen], frames[seen], 0).astype(np.float32)
    guess = smooth_guess(part, kept, usable[seen])
    step = tv.primal_step or choose_primal_step(contrast(guess), mu, tv.chroma_weight, tv.order)
    tv = tv.model_copy(
        update={"mu": mu, "primal_step": step, "rtol": 1e-12, "max_steps": min(STEPS, tv.max_steps)}
    )
    return settings.model_copy(update={"tv": tv})


def reconstruct_in_tiles(
    name: str,
    psi: PsiSource,
    frames: Array,
    noise_sigma: float,
    out: Any,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    tile: int = 512,
    overlap: int = OVERLAP,
    on_tile: Callable[[int, int], None] | None = None,
) -> list[Reconstruction]:
    """Reconstruct by the method called `name` into out (v, u, y, x, c), tile by tile.

    psi: an ImagingMatrix, or one read window by window (`SavedPsi`). out: an array, a memory map
    or an HDF5 dataset. on_tile: called with the tiles done and their number. The variational
    methods take a fixed number of steps. Returns the tiles' results without their light fields.
    Raises ReconstructionError as `reconstruct`, and for a tile of no samples.
    """
    if tile < 1 or overlap < 0:
        raise ReconstructionError(
            f"tiles of {tile} samples, overlap {overlap}: use 1 and 0 or more"
        )
    if usable is None:
        usable = np.ones(frames.shape, dtype=bool)
    if not usable.any():
        raise ReconstructionError("no usable pixel: every one is saturated or excluded")
    settings = settings or MethodSettings()
    settled = _settled(psi, frames, noise_sigma, usable, settings, name == "tv-dict")
    k = psi.binning
    multiple = lcm(k, settings.sparse.stride) if dictionary is not None else k
    if dictionary is not None:
        overlap = max(overlap, *dictionary.patch_shape[2:4])
    places = list(tiles(psi.size, tile, overlap, multiple))
    results = []
    for done, place in enumerate(places):
        rows, columns = place.outer
        seen = np.s_[:, rows.start // k : rows.stop // k, columns.start // k : columns.stop // k]
        if not usable[seen].any():
            out[:, :, place.inner[0], place.inner[1]] = 0
            continue
        result = reconstruct(
            name,
            psi.window(rows, columns),
            frames[seen],
            noise_sigma,
            dictionary,
            settled,
            usable[seen],
        )
        kept = place.kept()
        out[:, :, place.inner[0], place.inner[1]] = result.light_field[:, :, kept[0], kept[1]]
        results.append(result.without_light_field())
        if on_tile is not None:
            on_tile(done + 1, len(places))
    return results
