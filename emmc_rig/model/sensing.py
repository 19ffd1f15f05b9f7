"""The imaging matrix Psi as an operator: forward, adjoint, exact per-pixel solve, norms, export.

Frames f (shot, pixel_y, pixel_x) of a light field L (v, u, y, x, c) are, with the weights W and
pixels of k x k samples,

    f[s, i, j] = sum of W[s, v, u, y, c, x] L[v, u, y, x, c], over v, u, c, y // k = i, x // k = j

The columns of Psi follow the light field's memory order, its rows the frames'. Every sample of the
light field reaches one pixel only, so Psi Psi^T is block diagonal: one (shot x shot) block per
pixel.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.model import kernels
from emmc_rig.model.arguments import numbers_of, pair_of, path_of, refusal
from emmc_rig.model.errors import SensingError
from emmc_rig.model.files import whole_file
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.masks import cfa_tile
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.view_axes import (
    ANGLES,
    ATTRIBUTE,
    VIEW_AXES,
    ViewAxes,
    axes_from,
    stored_as,
)

if TYPE_CHECKING:  # SciPy loads for a third of a second, which few need
    from scipy import sparse

    from emmc_rig.torch import TorchPsi

Array = NDArray[np.floating]
WEIGHTS_TAKE = "an array (shot, v, u, y, stored colour, x), float32 or float64"
NO_COLOUR_MAP = np.zeros((1, 1, 1), dtype=np.uint8)
FORMAT = "emmc-rig imaging matrix 1"
NEGATIVE_NOISE = 0.05
"""Of the largest weight: measured weights of closed cells lie below 0 by noise, a percent or two;
what is negative by design, such as -1 of a Hadamard code, is half of the range."""


def checksum_of(
    binning: int,
    camera_json: str,
    planes: Iterable[Array],
    colour: NDArray,
    view_axes: ViewAxes = ANGLES,
) -> str:
    """Return the SHA-256 of a Psi; planes, colour: as `view_planes` and `colour_map`.

    A damaged file's text may hold what no UTF-8 is; it then has another checksum.
    """
    head = f"{FORMAT}|{binning}|{camera_json}"
    if view_axes != ANGLES:  # earlier versions' Psi keep theirs
        head += f"|{stored_as(view_axes)}"
    digest = hashlib.sha256(head.encode(errors="surrogatepass"))
    for plane in planes:
        digest.update(np.ascontiguousarray(plane).view(np.uint8).data)
    digest.update(np.ascontiguousarray(colour).view(np.uint8).data)
    return digest.hexdigest()


def rows_of_colours(light_field: Array) -> Array:
    """Return a view of a light field (v, u, y, x, c) as the solvers' (v, u, y, c, x)."""
    return np.moveaxis(light_field, -1, -2)


def _check_binning(binning: object) -> None:
    """Raise ArgumentError for what is no number of samples."""
    if not isinstance(binning, int) or binning < 1:
        raise refusal(binning, "binning", "the number of samples along a pixel's side")


class PsiLayout:
    """Sizes, colours and camera of a Psi: all that Psi in memory and in files have in common.

    Alone it stands for a Psi without coefficients, of sensors whose Psi does not fit into memory.
    weights_shape: (shot, v, u, y, stored colour, x). Others: see `Psi`.
    """

    def __init__(
        self,
        weights_shape: tuple[int, ...],
        colour: NDArray[np.uint8] | None,
        binning: int = 1,
        camera_json: str = "",
        view_axes: ViewAxes = ANGLES,
    ) -> None:
        self._weights_shape, self.colour, self.binning = weights_shape, colour, binning
        self.camera_json, self.view_axes = camera_json, view_axes

    @property
    def weights_shape(self) -> tuple[int, ...]:
        """Shape of the weights."""
        return self._weights_shape

    def psi(self, weights: Array) -> Psi:
        """Return the Psi that this is the layout of."""
        return Psi(weights, self.colour, self.binning, self.camera_json, self.view_axes)

    def window(self, rows: slice, columns: slice) -> Psi:
        """Return Psi of some rows and columns of samples, whole pixels."""
        raise SensingError("this Psi has no coefficients")

    @property
    def shots(self) -> int:
        """Number of shots."""
        return self.weights_shape[0]

    @property
    def views(self) -> tuple[int, int]:
        """Rows and columns of views."""
        return self.weights_shape[1], self.weights_shape[2]

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the light field."""
        return self.weights_shape[3], self.weights_shape[5]

    @property
    def frames_shape(self) -> tuple[int, int, int]:
        """(shot, pixel_y, pixel_x)."""
        return self.shots, self.size[0] // self.binning, self.size[1] // self.binning

    @property
    def light_field_shape(self) -> tuple[int, int, int, int, int]:
        """(v, u, y, x, c)."""
        return *self.views, *self.size, 3

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of Psi as a matrix."""
        return int(np.prod(self.frames_shape)), int(np.prod(self.light_field_shape))


@dataclass(frozen=True, eq=False)
class Psi(PsiLayout):
    """The imaging matrix as an operator: `psi @ light_field` are frames.

    `psi.T` is the adjoint. Light fields are (v, u, y, x, c), frames (shot, pixel_y, pixel_x);
    `scipy.sparse.linalg.aslinearoperator(psi)` takes both flattened. Psi is made by `Camera.psi`,
    `from_weights`, `from_scipy` or `load`, seldom by its fields:

    weights: (shot, v, u, y, stored colour, x), float32 or float64. One stored colour where every
    pixel sees one colour only, else three. A Psi larger than memory has an HDF5 dataset instead of
    an array: it can be saved and read view by view, and is no operator.
    colour: (shot, y, x) uint8, the colour stored there, 0 red, 1 green, 2 blue; None when three are
    stored.
    binning: k; a pixel sums k x k samples.
    camera_json: the description of the camera, or "" when unknown.
    view_axes: what rows and columns of views are, each "angle", "band" or "time".

    Raises:
        SensingError: weights or colours that fit no light field.
        ArgumentError: weights that are no floating array.

    >>> weights = np.full((1, 1, 1, 4, 3, 6), 1 / 3, dtype=np.float32)
    >>> psi = Psi(weights, colour=None)
    >>> psi
    Psi(1 shot, 1x1 views, 4x6, three colours a pixel, 0.00029 MB)
    >>> frames = psi @ np.ones((1, 1, 4, 6, 3), dtype=np.float32)
    >>> frames.shape, (psi.T @ frames).shape, psi.shape
    ((1, 4, 6), (1, 1, 4, 6, 3), (24, 72))
    """

    weights: Array
    colour: NDArray[np.uint8] | None
    binning: int = 1
    camera_json: str = ""
    view_axes: ViewAxes = ANGLES

    def __post_init__(self) -> None:
        if self.view_axes not in VIEW_AXES:
            raise refusal(self.view_axes, "view_axes", "a pair such as ('angle', 'band')")
        if getattr(self.weights, "dtype", np.dtype(object)).kind != "f":
            raise refusal(self.weights, "weights", WEIGHTS_TAKE)
        if self.weights.ndim != 6 or self.weights.shape[4] != (1 if self.colour is not None else 3):
            raise SensingError(f"weights of shape {self.weights.shape} do not make a Psi")
        if self.colour is not None and self.colour.shape != (self.shots, *self.size):
            raise SensingError(f"colour map of shape {self.colour.shape} does not fit the weights")
        if self.colour is not None and self.colour.max() > 2:
            raise SensingError("the colour map names colours beyond red, green and blue")
        if self.colour is not None:  # kernels are compiled for one layout
            object.__setattr__(self, "colour", np.array(self.colour, order="C", copy=None))
        if self.size[0] % self.binning or self.size[1] % self.binning:
            raise SensingError(
                f"pixels of {self.binning}x{self.binning} samples do not divide {self.size}"
            )
        if not all(np.isfinite(plane).all() for plane in self.view_planes()):
            raise SensingError(
                "Psi has entries that are not finite: give numbers, or measure it again"
            )

    def __repr__(self) -> str:
        shots, (v, u), (rows, columns) = self.shots, self.views, self.size
        megabytes = self.weights.nbytes / 1e6
        memory = f"{megabytes:.2g} MB" if megabytes < 1000 else f"{megabytes / 1000:.2g} GB"
        named = "" if self.view_axes == ANGLES else f" ({', '.join(self.view_axes)})"
        return (
            f"Psi({shots} shot{'s' * (shots > 1)}, {v}x{u} views{named}, {rows}x{columns}, "
            f"{self._sensor()}, {memory})"
        )

    def _repr_html_(self) -> str:
        from emmc_rig.model.notebook import figure_html, shadow_pictures  # with OpenCV

        return figure_html(repr(self), shadow_pictures(self.weights, self.colour))

    def _sensor(self) -> str:
        """Return the name of the colour filter tile, or how many colours a pixel sees."""
        if self.camera_json:
            cfa = parse_json(self.camera_json, "the camera of Psi", SensingError)["sensor"]["cfa"]
            return cfa if isinstance(cfa, str) else "custom colour filters"
        return "one colour a pixel" if self.colour is not None else "three colours a pixel"

    @property
    def weights_shape(self) -> tuple[int, ...]:
        """Shape of the weights."""
        return self.weights.shape

    @property
    def colour_map(self) -> NDArray[np.uint8]:
        """The colour map as the kernels take it (a dummy when three colours are stored)."""
        return NO_COLOUR_MAP if self.colour is None else self.colour

    def _checked(self, array: Array, shape: tuple[int, ...], what: str) -> Array:
        if array.shape != shape:
            raise SensingError(f"{what} of shape {array.shape} given, Psi needs {shape}")
        return np.asarray(array, dtype=self.weights.dtype)

    def window(self, rows: slice, columns: slice) -> Psi:
        """Return Psi of some rows and columns of samples, contiguous in memory.

        Raises SensingError when the slices cut a pixel.
        """
        for part, whole in zip((rows, columns), self.size, strict=True):
            first, last, _ = part.indices(whole)
            if first % self.binning or last % self.binning:
                raise SensingError(
                    f"a window from {first} to {last} cuts pixels of {self.binning} samples"
                )
        weights = np.ascontiguousarray(self.weights[:, :, :, rows, :, columns])
        colour = self.colour
        if colour is not None:
            colour = np.ascontiguousarray(colour[:, rows, columns])
        return replace(self, weights=weights, colour=colour)

    def of_shots(self, shots: Sequence[int], camera_json: str = "") -> Psi:
        """Return Psi of some shots, in the order given; camera_json: of a camera with these."""
        chosen = list(shots)
        colour = None if self.colour is None else self.colour[chosen]
        return replace(self, weights=self.weights[chosen], colour=colour, camera_json=camera_json)

    def forward(self, light_field: Array) -> Array:
        """Return the frames (shot, pixel_y, pixel_x) of a light field (v, u, y, x, c), no noise.

        Raises SensingError for a light field of another shape.
        """
        light_field = self._checked(light_field, self.light_field_shape, "a light field")
        frames = np.empty(self.frames_shape, dtype=self.weights.dtype)
        kernels.project(self.weights, self.colour_map, light_field, self.binning, frames)
        return frames

    def adjoint(self, frames: Array) -> Array:
        """Return Psi^T frames, a light field (v, u, y, x, c), of frames (shot, pixel_y, pixel_x).

        Raises SensingError for frames of another shape.
        """
        frames = np.ascontiguousarray(self._checked(frames, self.frames_shape, "frames"))
        light_field = np.empty(self.light_field_shape, dtype=self.weights.dtype)
        kernels.back_project(self.weights, self.colour_map, frames, self.binning, light_field)
        return light_field

    def __matmul__(self, light_field: ArrayLike) -> Array:
        return self.forward(numbers_of(light_field, "light field", "an array (v, u, y, x, 3)"))

    @property
    def T(self) -> TransposedPsi:  # noqa: N802
        """Psi^T, whose product with frames is a light field."""
        return TransposedPsi(self)

    @property
    def dtype(self) -> np.dtype:
        """The type of the weights, and of what the operator returns."""
        return self.weights.dtype

    def matvec(self, light_field: Array) -> Array:
        """Return the flattened frames of a flattened light field, as SciPy's solvers call it."""
        return self.forward(light_field.reshape(self.light_field_shape)).ravel()

    def rmatvec(self, frames: Array) -> Array:
        """Return the flattened light field Psi^T frames, for flattened frames."""
        return self.adjoint(frames.reshape(self.frames_shape)).ravel()

    @cached_property
    def gram(self) -> NDArray[np.float64]:
        """The blocks of Psi Psi^T: (shot, shot, pixel_y, pixel_x), float64.

        G[s, t, i, j] = sum over v, u, c, and the samples (y, x) of the pixel, of W_s W_t.
        """
        blocks = np.empty((self.shots, *self.frames_shape), dtype=np.float64)
        kernels.gram(self.weights, self.colour_map, self.binning, blocks)
        return blocks

    def inverted_blocks(self, ridge: float | Array) -> Array:
        """Return (Psi Psi^T + diag(ridge))^-1, one block per pixel: (shot, shot, pixel_y, pixel_x).

        ridge: a number or an array (shot, pixel_y, pixel_x), at least 0; infinite where a
            measurement is not to be used.
        Raises SensingError when a block is singular (repeated or dark shots without ridge).
        """
        spread = np.broadcast_to(np.asarray(ridge, dtype=np.float64), self.frames_shape)
        if not (spread >= 0).all():
            raise SensingError("the ridge of the per-pixel solve must be at least 0")
        inverse = np.empty((self.shots, *self.frames_shape), dtype=self.weights.dtype)
        failed = np.zeros(self.frames_shape[1], dtype=np.int64)
        kernels.invert_blocks(self.gram, spread, inverse, failed)
        if failed.any():
            raise SensingError(
                f"Psi Psi^T is singular at {failed.sum()} pixels (repeated or dark shots): "
                "use a ridge above 0"
            )
        return inverse

    def of_one_view(self) -> Psi:
        """Return Psi of light fields of one view, which stands for all."""
        summed = self.weights.sum(axis=(1, 2), keepdims=True, dtype=np.float64)
        return Psi(summed.astype(self.weights.dtype), self.colour, self.binning)

    @cached_property
    def picture_weights(self) -> Array:
        """Coefficients of a picture that all views are, (shot, y, x, c): sums over the views."""
        summed = np.moveaxis(self.of_one_view().weights[:, 0, 0], 2, 3)
        if self.colour is None:
            return np.ascontiguousarray(summed)
        weights = np.zeros((*summed.shape[:3], 3), dtype=summed.dtype)
        np.put_along_axis(weights, self.colour[..., None].astype(np.intp), summed, axis=-1)
        return weights

    def forward_picture(self, picture: Array) -> Array:
        """Return the frames (shot, pixel_y, pixel_x) of a picture (y, x, c) that all views are."""
        seen = np.einsum("syxc,yxc->syx", self.picture_weights, picture)
        (shots, rows, columns), k = self.frames_shape, self.binning
        return seen.reshape(shots, rows, k, columns, k).sum(axis=(2, 4))

    def adjoint_picture(self, frames: Array) -> Array:
        """Return the sum over the views of Psi^T frames, a picture (y, x, c)."""
        samples = frames.repeat(self.binning, axis=1).repeat(self.binning, axis=2)
        return np.einsum("syxc,syx->yxc", self.picture_weights, samples)

    def row_norms(self) -> NDArray[np.float64]:
        """Return the Euclidean norm of every row of Psi: (shot, pixel_y, pixel_x)."""
        return np.sqrt(np.einsum("ssyx->syx", self.gram))

    def light_efficiency(self) -> float:
        """Return the mean reading of a white light field over shots and pixels; 1: no mask."""
        return float(self.weights.sum(dtype=np.float64) / np.prod(self.frames_shape))

    def to_torch(self, device: Any = None) -> TorchPsi:
        """Return Psi as an operator of PyTorch, whose results have gradients.

        Args:
            device: the device that computes, as PyTorch names it. None: the CPU.

        Raises:
            SensingError: PyTorch is not installed.
        """
        from emmc_rig.torch import TorchPsi

        return TorchPsi.of(self, device)

    def to_scipy(self) -> sparse.csr_array:
        """Return Psi as an explicit sparse matrix, without its zeros.

        Rows are readings (shot, pixel_y, pixel_x), columns samples (v, u, y, x, c), both row-major.
        """
        from scipy import sparse

        _, _, views_u, rows, _, columns = self.weights.shape
        s, v, u, y, k, x = np.ogrid[tuple(slice(n) for n in self.weights.shape)]
        colour = k if self.colour is None else self.colour[s, y, x]
        column = (((v * views_u + u) * rows + y) * columns + x) * 3 + colour
        pixel_y, pixel_x = y // self.binning, x // self.binning
        row = (s * self.frames_shape[1] + pixel_y) * self.frames_shape[2] + pixel_x
        shape = self.weights.shape
        kept = self.weights != 0
        entries = (
            self.weights[kept],
            (np.broadcast_to(row, shape)[kept], np.broadcast_to(column, shape)[kept]),
        )
        return sparse.csr_array(entries, shape=self.shape)

    @classmethod
    def from_scipy(
        cls,
        matrix: sparse.sparray | sparse.spmatrix,
        views: tuple[int, int],
        size: tuple[int, int],
        cfa: str | tuple[str, ...] = "mono",
        binning: int = 1,
        view_axes: ViewAxes = ANGLES,
    ) -> Psi:
        """Return Psi from an explicit sparse matrix, such as another program's.

        Args:
            matrix: rows are readings (shot, pixel_y, pixel_x), row-major. Columns are samples of
                the light field, (v, u, y, x, c) as `to_scipy` has them, or (v, u, y, x): light of
                the colour that the pixel sees, of a monochrome sensor's white light.
            views: rows and columns of views.
            size: rows and columns of samples of a view.
            cfa: the colour filters, where the columns have no colour.
            binning: k; a pixel sums k x k samples.
            view_axes: what rows and columns of views are, each "angle", "band" or "time".

        Raises:
            SensingError: a wrong shape; entries that are infinite, NaN, all 0, or below 0 by more
                than noise; a reading that depends on samples of another pixel.
            ArgumentError: an argument of another type.

        >>> from scipy import sparse
        >>> psi = Psi.from_scipy(sparse.eye_array(6), views=(1, 1), size=(2, 3))
        >>> psi, psi.to_scipy().nnz
        (Psi(1 shot, 1x1 views, 2x3, three colours a pixel, 7.2e-05 MB), 18)
        """
        from scipy import sparse

        if not sparse.issparse(matrix):
            raise refusal(matrix, "matrix", "a sparse matrix of SciPy")
        views = pair_of(views, "views", "rows and columns of views, such as (5, 5)")
        size = pair_of(size, "size", "rows and columns of samples, such as (192, 256)")
        _check_binning(binning)
        summed = sparse.csr_array(matrix, dtype=np.float32, copy=True)
        summed.sum_duplicates()
        entries = sparse.coo_array(summed)
        pixels = size[0] // binning, size[1] // binning
        readings, samples = int(np.prod(pixels)), int(np.prod((*views, *size)))
        rows, columns = entries.shape  # pyright: ignore[reportGeneralTypeIssues]
        row, column = entries.row, entries.col
        shots, per_sample = rows // max(readings, 1), columns // samples
        if rows != shots * readings or not shots or columns not in (samples, 3 * samples):
            raise SensingError(
                f"a matrix of {rows} x {columns} is no Psi: {views} views of {size} samples need "
                f"{samples} or {3 * samples} columns, and {readings} rows a shot"
            )
        v, u, y, x, c = np.unravel_index(column, (*views, *size, per_sample))
        shot, pixel_y, pixel_x = np.unravel_index(row, (shots, *pixels))
        astray = np.flatnonzero((y // binning != pixel_y) | (x // binning != pixel_x))
        if astray.size:
            n = astray[0]
            raise SensingError(
                f"{astray.size} entries lie off their pixel, the first in row {row[n]}, column "
                f"{column[n]}: pixel ({pixel_y[n]}, {pixel_x[n]}) would see the sample ({y[n]}, "
                f"{x[n]}); Psi here is of cameras whose pixels see the views at their own place"
            )
        weights = np.zeros((shots, *views, *size, per_sample), dtype=np.float32)
        weights[shot, v, u, y, x, c] = entries.data
        if per_sample == 3:
            return cls.from_weights(weights, binning=binning, view_axes=view_axes)
        return cls.from_weights(weights[..., 0], cfa, binning, view_axes)

    @classmethod
    def from_weights(
        cls,
        weights: ArrayLike,
        cfa: str | tuple[str, ...] | None = None,
        binning: int = 1,
        view_axes: ViewAxes = ANGLES,
    ) -> Psi:
        """Return Psi from what every pixel sees of every view, such as a mask's transmittances.

        A reading is the sum over the views of weight times light, so that weights that sum to 1 at
        a typical pixel keep light and readings within [0, 1]: divide transmittances by
        `transmittances.sum(axis=(1, 2)).mean()`, or by the number of views where a reading of 1 is
        a white board's without masks.

        Args:
            weights: (shot, v, u, y, x), of the light that the pixel sees; or (shot, v, u, y, x, 3),
                of linear red, green and blue. The views are what a code multiplies: angles, bands
                or times, any number, and bands are views (1, count).
            cfa: the colour filters, for weights without colours. None: the light has no colours
                either, as for a monochrome sensor. It is stored as red, since one unknown colour is
                faster and surer than three; `reconstruct` returns three equal colours.
            binning: k; a pixel sums k x k samples, y and x count the samples.
            view_axes: what v and u are, each "angle", "band" or "time".

        Raises:
            SensingError: weights that are not finite, below 0 by more than noise, or all 0; pixels
                that do not divide the samples.
            ArgumentError: an argument of another type or number of axes.

        >>> opened = np.zeros((2, 1, 2, 4, 6))  # two shots, each through one of two openings
        >>> opened[0, 0, 0] = opened[1, 0, 1] = 1
        >>> psi = Psi.from_weights(opened)
        >>> psi, round(psi.light_efficiency(), 6)
        (Psi(2 shots, 1x2 views, 4x6, one colour a pixel, 0.00038 MB), 1.0)
        """
        takes = "an array (shot, v, u, y, x) or (shot, v, u, y, x, 3) of real numbers"
        given = numbers_of(weights, "weights", takes)
        if given.ndim not in (5, 6) or not given.size or given.shape[5:] not in ((), (3,)):
            raise refusal(weights, "weights", takes)
        _check_binning(binning)
        given = given.astype(np.float32, copy=False)
        if not given.any():
            raise SensingError("weights that are all 0: no pixel sees any light")
        if given.min() < -NEGATIVE_NOISE * given.max():
            raise SensingError(
                f"weights down to {given.min():.3g}, and a pixel sees no less than no light: a "
                "difference of two shots is given as two shots"
            )
        if given.ndim == 5 and cfa is None:
            red = np.zeros((len(given), *given.shape[3:]), dtype=np.uint8)
            stored = np.ascontiguousarray(given[:, :, :, :, None])
            return cls(stored, red, binning, view_axes=view_axes)
        if given.ndim == 5 and cfa is not None:
            tile = cfa_tile(cfa)
            at = (np.arange(side) // binning for side in given.shape[3:])
            seen = tile[np.ix_(*(i % n for i, n in zip(at, tile.shape[:2], strict=True)))]
            given = given[..., None] * (seen / seen.sum(axis=-1, keepdims=True))
        stored = np.ascontiguousarray(rows_of_colours(given))
        return cls(stored, None, binning, view_axes=view_axes)._compact()

    def _compact(self) -> Psi:
        """Return Psi with one stored colour where every sample's pixel sees one at most."""
        seen = self.weights.any(axis=(1, 2))  # (shot, y, colour, x)
        if seen.sum(axis=2).max() > 1:
            return self
        colour = seen.argmax(axis=2).astype(np.uint8)
        chosen = colour[:, None, None, :, None, :].astype(np.intp)
        return replace(
            self, weights=np.take_along_axis(self.weights, chosen, axis=4), colour=colour
        )

    def even_unseen_colours(self, light_field: Array) -> None:
        """Where every pixel sees the same colour, make the others of (v, u, y, x, c) equal to it.

        Nothing was seen of them: light without colours, or a picture in one.
        """
        if self.colour is not None and (self.colour == self.colour.flat[0]).all():
            light_field[...] = light_field[..., self.colour.flat[0], None]

    def relative_difference(self, reference: Psi) -> float:
        """Return |Psi - reference| / |reference| in the Frobenius norm."""
        if self.weights.shape != reference.weights.shape:
            raise SensingError("only Psi of the same camera and size compare")
        difference = np.linalg.norm((self.weights - reference.weights).ravel())
        return float(difference / np.linalg.norm(reference.weights.ravel()))

    def view_planes(self) -> Iterator[Array]:
        """Yield the weights of every shot and view, (y, stored colour, x)."""
        return (self.weights[place] for place in np.ndindex(*self.weights.shape[:3]))

    def checksum(self) -> str:
        """Return the SHA-256 of weights, colours, binning, camera and names of the view axes."""
        planes, colour = self.view_planes(), self.colour_map
        return checksum_of(self.binning, self.camera_json, planes, colour, self.view_axes)

    def save(self, path: str | Path) -> None:
        """Write Psi as an HDF5 file, whole or not at all; an earlier file is replaced.

        Raises SensingError where the file cannot be written, ArgumentError for what is no path.
        """
        path = path_of(path, "path", "the name of the file to write")
        try:
            with whole_file(path) as partial, h5py.File(partial, "w") as file:
                file["weights"] = self.weights
                self.describe(file)
        except OSError as fault:
            raise SensingError(f"{path}: Psi cannot be written ({fault})") from fault

    def describe(self, file: h5py.File) -> None:
        """Write what makes a file that holds the weights one of Psi."""
        facts = {"format": FORMAT, "binning": self.binning, "camera": self.camera_json}
        file.attrs.update(**facts, view_axes=stored_as(self.view_axes), sha256=self.checksum())
        if self.colour is not None:
            file["colour"] = self.colour

    @classmethod
    def load(cls, path: str | Path) -> Psi:
        """Return the Psi of a file that `save` wrote.

        Raises SensingError for a file that is missing, damaged or no Psi, and ArgumentError for
        what is no path.
        """
        path = path_of(path, "path", "the file of a Psi")
        with stored_arrays(path, SensingError, "measure Psi again") as stored:
            if stored.attributes.get("format") != FORMAT:
                raise SensingError(f"{path}: not a Psi of this program")
            matrix = cls(
                stored.array("weights"),
                stored.array("colour") if "colour" in stored else None,
                int(np.asarray(stored.attributes["binning"])),
                str(stored.attributes["camera"]),
                axes_from(stored.attributes.get(ATTRIBUTE), path, SensingError),
            )
            expected = stored.attributes["sha256"]
        if matrix.checksum() != expected:
            raise SensingError(f"{path}: damaged (its checksum differs); measure Psi again")
        return matrix


@dataclass(frozen=True, eq=False)
class TransposedPsi:
    """A view of Psi as Psi^T: `psi.T @ frames` is a light field (v, u, y, x, c)."""

    T: Psi

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of Psi^T as a matrix."""
        rows, columns = self.T.shape
        return columns, rows

    def __matmul__(self, frames: ArrayLike) -> Array:
        return self.T.adjoint(numbers_of(frames, "frames", "an array (shot, pixel_y, pixel_x)"))

    def __repr__(self) -> str:
        return f"{self.T!r}.T"
