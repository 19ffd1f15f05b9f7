"""A dictionary is a set of light-field patches of unit norm: check it, keep it in a file.

`lambertian_dictionary` needs no training, and fits any views, patch and disparities.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from emmc_rig.model.files import whole_file
from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.reading import one_line, stored_arrays
from emmc_rig.reconstruction.errors import DictionaryError

KINDS = ("ksvd", "lambertian")
FORMAT = "emmc-rig dictionary 1"
REMEDY = "benchmarks/train_dictionary.py makes a dictionary"
NORM_TOLERANCE = 1e-3
"""Of an atom's norm, which is 1; far above float32's rounding of any patch."""
CHUNK_BYTES = 1 << 20
"""Of a file, read and checked at a time."""
BLUR_PX, CHROMA_BLUR_PX = 0.7, 1.0
"""Deviation of edges, lines and spots: as sharp as a pixel allows, and softer in colour."""
SAME = 0.995
"""|cosine| of two atoms above which the second repeats the first."""
FAINT = 1e-2
"""Root mean square of a texture less its mean, of values about 1, below which it is left out."""


@dataclass(frozen=True, eq=False)
class Dictionary:
    """atoms: (atom, v, u, y, x, c) float32, each of unit l2 norm. kind: one of KINDS.

    provenance: JSON about the training: scenes, seed, settings, error history, versions. Raises
    DictionaryError for a wrong shape, values not finite, norms other than 1.
    """

    atoms: NDArray[np.float32]
    kind: str
    provenance: str = ""

    def __post_init__(self) -> None:
        norms = _norms(self.atoms, self.kind)
        wrong = np.flatnonzero(np.abs(norms - 1) > NORM_TOLERANCE)
        if wrong.size:
            raise DictionaryError(
                f"atom {wrong[0]} has norm {norms[wrong[0]]:.4g}, needs 1: "
                "build the dictionary with Dictionary.normalised"
            )
        # A frozen dataclass sets its fields so; solvers want one contiguous float32 matrix.
        object.__setattr__(self, "atoms", np.ascontiguousarray(self.atoms, dtype=np.float32))

    @classmethod
    def normalised(cls, atoms: NDArray[np.floating], kind: str, provenance: str = "") -> Dictionary:
        """Return the dictionary of atoms (atom, v, u, y, x, c) brought to unit norm.

        Raises DictionaryError as the constructor does, and for an atom that is zero.
        """
        norms = _norms(atoms, kind)
        zero = np.flatnonzero(norms == 0)
        if zero.size:
            raise DictionaryError(f"atom {zero[0]} is zero everywhere: leave it out")
        scaled = (atoms / norms.reshape(-1, 1, 1, 1, 1, 1)).astype(np.float32)
        return cls(scaled, kind, provenance)

    @property
    def size(self) -> int:
        """Number of atoms."""
        return self.atoms.shape[0]

    @property
    def patch_shape(self) -> tuple[int, int, int, int, int]:
        """Rows and columns of views, rows and columns of pixels, colours of a patch."""
        v, u, y, x, c = self.atoms.shape[1:]
        return v, u, y, x, c

    @property
    def matrix(self) -> NDArray[np.float32]:
        """The atoms as rows (atom, v u y x c), a view of the same memory."""
        return self.atoms.reshape(self.size, -1)

    def check_views(self, views: tuple[int, int]) -> None:
        """Raise DictionaryError for patches of other views, or of other colours than RGB."""
        v, u, _, _, colours = self.patch_shape
        if (v, u) != tuple(views) or colours != 3:
            raise DictionaryError(
                f"the dictionary's patches have {v}x{u} views (colours: {colours}), not "
                f"{views[0]}x{views[1]} (colours: 3): train or choose a dictionary for these views"
            )

    def save(self, path: str | os.PathLike) -> None:
        """Write HDF5 (checksummed); the file appears whole or not at all.

        Raises DictionaryError when it cannot be written.
        """
        path = Path(path)
        rows = min(self.size, max(1, CHUNK_BYTES // self.atoms[0].nbytes))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as partial, h5py.File(partial, "w") as file:
                file.attrs["format"] = FORMAT
                file.attrs["kind"] = self.kind
                file.create_dataset(
                    "atoms", data=self.atoms, chunks=(rows, *self.atoms.shape[1:]), fletcher32=True
                )
                file["provenance"] = self.provenance
        except OSError as fault:
            raise DictionaryError(f"{path}: cannot be written ({one_line(fault)})") from fault

    @classmethod
    def load(cls, path: str | os.PathLike) -> Dictionary:
        """Read what `save` wrote.

        Raises DictionaryError: no such file, not HDF5, cut short or damaged, or no dictionary.
        """
        path = Path(path)
        with stored_arrays(path, DictionaryError, REMEDY) as stored:
            format_ = stored.attributes.get("format")
            if format_ != FORMAT:
                raise DictionaryError(
                    f"{path}: not a dictionary of this program (format {format_!r}, "
                    f"needs {FORMAT!r}); benchmarks/train_dictionary.py makes one"
                )
            atoms, kind = stored.array("atoms"), str(stored.attributes["kind"])
            provenance = stored.text("provenance")
        try:
            return cls(atoms, kind, provenance)
        except DictionaryError as fault:
            raise DictionaryError(f"{path}: {fault}") from fault


def _norms(atoms: NDArray[np.floating], kind: str) -> NDArray[np.float64]:
    """Return the norm of every atom, or raise DictionaryError for what is no set of atoms."""
    if kind not in KINDS:
        raise DictionaryError(f"unknown kind of dictionary '{kind}': one of {', '.join(KINDS)}")
    atoms = np.asarray(atoms)
    if atoms.ndim != 6 or atoms.size == 0 or not np.issubdtype(atoms.dtype, np.floating):
        raise DictionaryError(
            f"atoms of shape {atoms.shape} and type {atoms.dtype}: "
            "needs floating (atom, v, u, y, x, c), none of them 0"
        )
    rows = atoms.reshape(len(atoms), -1)
    norms = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))
    wrong = np.flatnonzero(~np.isfinite(norms))
    if wrong.size:
        raise DictionaryError(f"atom {wrong[0]} holds values that are not finite")
    return norms


Textures = NDArray[np.float32]
"""Atoms of one colour: (atom, v, u, y, x)."""


def lambertian_dictionary(
    views: tuple[int, int],
    patch: tuple[int, int],
    disparities: Sequence[float] | None = None,
) -> Dictionary:
    """Return textures on planes: texture(y - d (v - V // 2), x - d (u - U // 2)), in one colour.

    The textures are straight edges and lines (8 directions, every 1.5 pixels, as sharp as a
    pixel allows) and spots, less their mean, which one flat atom per colour holds; for the
    chrominances fewer and softer edges, at every other disparity. Disparities are in pixels per
    view step, with the sign of `emmc_rig.model.lightfield`. Nearly equal atoms come once.

    Args:
        views: rows and columns of views.
        patch: rows and columns of pixels.
        disparities: of the planes; default `plane_disparities`.

    Raises:
        DictionaryError: no disparity, one not finite or so large that the outer views of a patch
            share nothing with the centre; an axis of no samples.
    """
    _check_patch(views, patch)
    if disparities is None:
        disparities = plane_disparities(views, patch)
    planes = np.unique(np.asarray(disparities, dtype=float))
    largest = max(patch) / _reach(views)
    if planes.size == 0 or not np.isfinite(planes).all() or np.abs(planes).max() > largest:
        raise DictionaryError(
            f"disparities {tuple(disparities)}: needs one or more, finite, within "
            f"+-{largest:.4g} pixels per view step for these views and patches"
        )
    samples = [_plane_samples(views, patch, disparity) for disparity in planes]
    textures = [
        *(_ridges(plane, 8, 1.5, (_edge(BLUR_PX), _line(BLUR_PX))) for plane in samples),
        *(_spots(plane, patch, 1.5, 1.0) for plane in samples),
    ]
    # Every other plane, the one nearest to the focus among them.
    coarse = samples[int(np.abs(planes).argmin()) % 2 :: 2]
    soft = [_ridges(plane, 6, 2.0, (_edge(CHROMA_BLUR_PX),)) for plane in coarse]
    flat = np.ones((1, *views, *patch), np.float32)
    atoms = _coloured(_distinct([flat, *textures]), _distinct([flat, *soft]))
    return Dictionary.normalised(atoms, "lambertian")


RARE = 0.01
"""Share of the lowest, and of the highest disparities of a scene that need no plane."""
MOST_READINGS = 243
"""Of a patch with several shots: the cost of a patch grows with their cube. In the mean of
`adaptive`, group A, 96x96, two and three shots, patches of 6 samples 4 apart gain 0.07 dB over 9
samples 5 apart and take a quarter of the time (dice -0.1 dB, buttercup +0.5); 5 samples 4 apart
lose 0.05 dB."""


def usual_patch(binning: int, shots: int = 1, views: tuple[int, int] = (5, 5)) -> tuple[int, int]:
    """Return rows and columns of a patch: 9 samples, or the nearest multiple of k below.

    With several shots 6 pixels, or more for the disparities that 5x5 views of 6 pixels show (with
    8x8 views, three shots, 9 pixels gain 0.4 dB over 6), or as few as 4 for MOST_READINGS.
    """
    pixels = 9 // binning or 1
    if shots > 1:
        wanted = max(6, 3 * _reach(views))
        pixels = min(pixels, max(4, min(wanted, int((MOST_READINGS / shots) ** 0.5))))
    return pixels * binning, pixels * binning


def plane_disparities(views: tuple[int, int], patch: tuple[int, int]) -> tuple[float, ...]:
    """Return disparities in steps of a pixel in the outermost view, +-2 or what a patch can show.

    An outermost view is to share half a patch with the centre. For 5x5 views of 9x9 pixels:
    -2, -1.5, ... 2 pixels per view step.
    """
    step = 1 / _reach(views)
    last = int(min(2 / step, max(patch) / 2))
    return tuple(step * i for i in range(-last, last + 1))


def planes_of_scene(
    views: tuple[int, int], patch: tuple[int, int], disparity: NDArray[np.floating]
) -> tuple[float, ...]:
    """Return those of `plane_disparities` that a scene needs: to a step beyond all but its rarest.

    disparity: of the scene, of any shape. With three shots (96x96, groups A and B) the others gain
    0.00 to 0.02 dB, and cost up to half of the time.
    """
    planes = np.array(plane_disparities(views, patch))
    low, high = np.clip(np.quantile(disparity, (RARE, 1 - RARE)), planes[0], planes[-1])
    step = 1 / _reach(views)
    return tuple(float(plane) for plane in planes if low - step < plane < high + step)


def _reach(views: tuple[int, int]) -> int:
    """Return how many steps the outermost view is from the centre view."""
    return max(max(views) // 2, 1)


def _check_patch(views: tuple[int, int], patch: tuple[int, int]) -> None:
    if min(*views, *patch) < 1:
        raise DictionaryError(
            f"{views[0]}x{views[1]} views of {patch[0]}x{patch[1]} pixels: needs 1x1 of 1x1 or more"
        )


def _coloured(luminance: Textures, chrominance: Textures) -> NDArray[np.float32]:
    """Return atoms (atom, v, u, y, x, c): textures in the opponent colours."""
    sets = luminance, chrominance, chrominance
    return np.concatenate(
        [textures[..., None] * mix for textures, mix in zip(sets, OPPONENT, strict=True)]
    ).astype(np.float32)


class _PlaneSamples(NamedTuple):
    """Where in a plane's texture the samples (v, u, y, x) of a patch look, from its middle."""

    y: NDArray[np.float64]
    x: NDArray[np.float64]
    disparity: float


def _plane_samples(
    views: tuple[int, int], patch: tuple[int, int], disparity: float
) -> _PlaneSamples:
    """Return y - d (v - V // 2), x - d (u - U // 2), y and x from the patch's middle."""
    v, u, y, x = np.meshgrid(
        np.arange(views[0]) - views[0] // 2,
        np.arange(views[1]) - views[1] // 2,
        np.arange(patch[0]) - (patch[0] - 1) / 2,
        np.arange(patch[1]) - (patch[1] - 1) / 2,
        indexing="ij",
    )
    return _PlaneSamples(y - disparity * v, x - disparity * u, disparity)


def _edge(blur_px: float) -> Callable[[NDArray], NDArray]:
    """Return the profile of an edge, the integral of `_line`."""
    return lambda t: erf(t / (np.sqrt(2) * blur_px))


def _line(blur_px: float) -> Callable[[NDArray], NDArray]:
    """Return the profile exp(-t^2 / 2 blur^2) of a line."""
    return lambda t: np.exp(-0.5 * np.square(t / blur_px))


def _offsets(reach_px: float, step_px: float) -> NDArray[np.float64]:
    """Return the multiples of a step within +-reach."""
    last = int(reach_px / step_px)
    return np.arange(-last, last + 1, dtype=np.float64) * step_px


def _ridges(
    plane: _PlaneSamples,
    directions: int,
    step_px: float,
    profiles: Sequence[Callable[[NDArray], NDArray]],
) -> Textures:
    """Return profile(t - offset), t = x cos(angle) + y sin(angle), for offsets across the patch."""
    textures = []
    for angle in np.pi * np.arange(directions) / directions:
        t = np.cos(angle) * plane.x + np.sin(angle) * plane.y
        offsets = _offsets(0.9 * float(np.abs(t).max()), step_px)
        textures += [profile(t - offset) for profile in profiles for offset in offsets]
    return np.array(textures, dtype=np.float32)


def _spots(
    plane: _PlaneSamples, patch: tuple[int, int], step_px: float, blur_px: float
) -> Textures:
    """Return round spots, products of a line down and a line across, all over the patch."""

    def lines(along: NDArray[np.float64], length: int) -> NDArray[np.float64]:
        offsets = _offsets(length / 2 + abs(plane.disparity), step_px)
        return _line(blur_px)(along - offsets[:, None, None, None, None])

    down, across = lines(plane.y, patch[0]), lines(plane.x, patch[1])
    return (down[:, None] * across).reshape(-1, *plane.y.shape).astype(np.float32)


def _distinct(sets: Sequence[Textures]) -> Textures:
    """Return the first set as it is, then the others less their means, leaving out repetitions.

    An atom goes that is hardly there, or nearly parallel to an earlier one.
    """
    shape = sets[0].shape[1:]
    kept = np.concatenate(sets).reshape(-1, int(np.prod(shape)))
    first = len(sets[0])
    kept[first:] -= kept[first:].mean(axis=1, keepdims=True)
    norms = np.linalg.norm(kept, axis=1)
    kept = kept[norms > FAINT * np.sqrt(kept.shape[1])]
    kept /= np.linalg.norm(kept, axis=1, keepdims=True)
    near = np.abs(kept @ kept.T) > SAME
    stays = np.ones(len(kept), bool)
    for i in range(len(kept)):
        if stays[i]:
            stays[i + 1 :] &= ~near[i, i + 1 :]
    return kept[stays].reshape(-1, *shape)


def open_dictionary(spec: str | None, views: tuple[int, int], binning: int) -> Dictionary:
    """Return the dictionary of a file, or for None and "lambertian" one of `usual_patch`.

    Raises DictionaryError for a file that is none.
    """
    if spec in (None, "lambertian"):
        return lambertian_dictionary(views, usual_patch(binning))
    return Dictionary.load(spec)
