"""Light fields, float32 arrays (v, u, y, x, c): reading, writing, views of them, comparison.

Views come first, rows of views before columns; colours are linear RGB in [0, 1]. The centre view
is view (V // 2, U // 2). Disparity is signed, in pixels per view step: a point at x in the centre
view is at x + disparity (u - U // 2) in view u, and likewise along (v, y). Picture files hold the
linear values themselves, with no gamma.
"""

import os
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import h5py
import numpy as np

from emmc_rig.model.arguments import light_field_remedy
from emmc_rig.model.bands import in_views
from emmc_rig.model.decoding.stored import light_of, read_codes, read_views
from emmc_rig.model.errors import SceneError
from emmc_rig.model.files import whole_file
from emmc_rig.model.reading import one_line, stored_arrays
from emmc_rig.model.view_axes import (
    ATTRIBUTE,
    ViewAxes,
    axes_from,
)

_DATASET = "light_field"
_VIEW_NAME = re.compile(r"view_(\d+)_(\d+)\.(png|tiff?|exr)", re.IGNORECASE)
_LIKE_A_VIEW = re.compile(r"view|[^.].*\d\D+\d+\.(png|tiff?|exr|jpe?g|bmp|webp)$", re.IGNORECASE)
"""Begins as a view's name, or is a picture's with two numbers."""
_MOST_VIEWS = 10_000
"""In a grid with most views missing; names with larger numbers hold a time or the like."""
_SSIM_WINDOW_PX, _SSIM_SIGMA_PX = 11, 1.5
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2
OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Luminance and two chrominances (opponent colour, RGB), orthonormal."""


def check_light_field(lf: np.ndarray, source: str) -> np.ndarray:
    """Return `lf` as contiguous float32; right is floating (v, u, y, x, 3) in [0, 1], two views.

    source: where it came from, for the message. Raises SceneError for another shape or type, and
    where a sample is not finite or not in [0, 1].
    """
    lf = np.asarray(lf)
    remedy = light_field_remedy(lf)
    if lf.ndim != 5:
        raise SceneError(f"{source}: shape {lf.shape} is not (v, u, y, x, c){remedy}")
    if lf.shape[0] * lf.shape[1] < 2:
        raise SceneError(f"{source}: {lf.shape[0]}x{lf.shape[1]} views, needs two or more")
    if lf.shape[4] != 3:
        raise SceneError(f"{source}: {lf.shape[4]} colours, needs 3 (RGB){remedy}")
    if lf.size == 0:
        raise SceneError(f"{source}: views of {lf.shape[2]}x{lf.shape[3]} pixels hold nothing")
    if not np.issubdtype(lf.dtype, np.floating):
        needs = f"needs floating values in [0, 1]{remedy}"
        raise SceneError(f"{source}: values are {lf.dtype}, {needs}")
    if not (lf.min() >= 0 and lf.max() <= 1):
        wrong = ~((lf >= 0) & (lf <= 1))
        v, u, y, x, c = (int(i) for i in np.unravel_index(wrong.argmax(), lf.shape))
        raise SceneError(
            f"{source}: {np.count_nonzero(wrong)} samples are not in [0, 1], the first "
            f"{lf[v, u, y, x, c]:.4g} at view ({v}, {u}), y {y}, x {x}, colour {c}"
        )
    return np.ascontiguousarray(lf, dtype=np.float32)


def load_views(folder: str | os.PathLike) -> np.ndarray:
    """Return the light field of pictures `view_ROW_COL.png`, or `.tif` or `.exr`, RGB or grey.

    Code values are divided by the full scale; floating values are as they are. Raises SceneError
    for missing views, views with other names or of different sizes, and damaged files.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder")
    paths: dict[tuple[int, int], Path] = {}
    odd = []
    for path in sorted(folder.iterdir()):
        if match := _VIEW_NAME.fullmatch(path.name):
            place = int(match[1]), int(match[2])
            if place in paths:
                raise SceneError(f"{folder}: {paths[place].name} and {path.name} are the same view")
            paths[place] = path
        elif _LIKE_A_VIEW.match(path.name):
            odd.append(path.name)
    names = "views are named view_ROW_COL.png, or .tif or .exr"
    if not paths:
        raise SceneError(f"{folder}: no views; {names}")
    endings = {path.suffix.lower() for path in paths.values()}
    if odd or len(endings) > 1:
        what = f"{', '.join(odd[:6])}: named otherwise" if odd else "views of several formats"
        raise SceneError(f"{folder}: {what}; {names}: rename or move away what is none")
    rows, columns = grid_of_views(paths, folder)
    places = {place: paths[rows[place[0]], columns[place[1]]] for place in np.ndindex(
        len(rows), len(columns)
    )}  # fmt: skip
    if endings != {".png"}:
        lf = read_views(list(places.values()), SceneError)
        return check_light_field(lf.reshape(len(rows), len(columns), *lf.shape[1:]), str(folder))
    first = read_picture(places[0, 0])
    lf = np.empty((len(rows), len(columns), *first.shape), np.float32)

    def read(place: tuple[int, ...]) -> None:
        view = read_picture(places[place])
        if view.shape != first.shape:
            raise SceneError(
                f"{places[place]}: {view.shape[0]}x{view.shape[1]} pixels, but the first view "
                f"has {first.shape[0]}x{first.shape[1]}"
            )
        lf[place] = view

    with ThreadPoolExecutor() as pool:
        list(pool.map(read, places))
    return check_light_field(lf, str(folder))


def grid_of_views(paths: Mapping[tuple[int, int], Path], folder: Path) -> tuple[range, range]:
    """Return the rows and columns of views that files make; raises SceneError where one is missing.

    paths: by row and column, from any first ones on.
    """
    rows, columns = (
        range(min(place[k] for place in paths), max(place[k] for place in paths) + 1)
        for k in (0, 1)
    )
    count = len(rows) * len(columns)
    if count > max(_MOST_VIEWS, 4 * len(paths)):
        middle = np.median(list(paths), axis=0)
        odd = max(paths, key=lambda place: np.abs(place - middle).sum())
        raise SceneError(
            f"{folder}: {len(paths)} views do not fill {len(rows)}x{len(columns)}, as "
            f"{paths[odd].name} asks for; names are view_ROW_COL, rows and columns counted from "
            "0: rename it or move it away"
        )
    if len(paths) < count:
        places = ((row, column) for row in rows for column in columns)
        ending = next(iter(paths.values())).suffix
        missing = [f"view_{r}_{c}{ending}" for r, c in places if (r, c) not in paths]
        rest = f" and {len(missing) - 6} more" if len(missing) > 6 else ""
        raise SceneError(
            f"{folder}: {len(missing)} of {len(rows)}x{len(columns)} views missing: "
            f"{', '.join(missing[:6])}{rest}"
        )
    return rows, columns


def load_hdf5(path: str | os.PathLike) -> np.ndarray:
    """Return the dataset `light_field` of an HDF5 file: floating in [0, 1], or 8- or 16-bit codes.

    Raises SceneError for no such file or dataset, a damaged one, or no light field.
    """
    path = Path(path)
    with stored_arrays(path, SceneError, "copy it again") as stored:
        if _DATASET not in stored:
            held = ", ".join(sorted(stored.file)) or "none"
            raise SceneError(f"{path}: no dataset '{_DATASET}'; it holds {held}")
        lf = stored.array(_DATASET)
    return check_light_field(scaled(lf), str(path))


def scaled(lf: np.ndarray) -> np.ndarray:
    """Return codes of 8 or 16 bits divided by their full scale, and other values as they are."""
    if lf.dtype not in (np.uint8, np.uint16):
        return lf
    light = lf.astype(np.float32)
    light /= np.iinfo(lf.dtype).max
    return light


def load_view_axes(path: str | os.PathLike) -> ViewAxes:
    """Return what rows and columns of views of `load_hdf5`'s file are; raises SceneError."""
    path = Path(path)
    with stored_arrays(path, SceneError, "copy it again") as stored:
        return axes_from(stored.dataset(_DATASET).attrs.get(ATTRIBUTE), path, SceneError)


def save_hdf5(
    path: str | os.PathLike, lf: np.ndarray, attributes: Mapping[str, str | int | float]
) -> None:
    """Write float32 dataset `light_field` with its attributes; the file appears whole or not.

    The folder is made where missing. Values of lf (v, u, y, x, 3) outside [0, 1] are clipped.
    Raises SceneError for no light field even when clipped, or where nothing can be written.
    """
    path = Path(path)
    if not (lf.min() >= 0 and lf.max() <= 1):
        lf = np.clip(lf, 0, 1)
    lf = check_light_field(lf, str(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{path.parent}: cannot be made a folder ({error.strerror})") from error
    try:
        with whole_file(path) as partial, h5py.File(partial, "w") as file:
            dataset = file.create_dataset(_DATASET, data=lf)
            dataset.attrs.update(attributes)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({one_line(error)})") from error


def centre_view(lf: np.ndarray) -> np.ndarray:
    """View (V // 2, U // 2): (v, u, y, x, c) -> (y, x, c)."""
    return lf[lf.shape[0] // 2, lf.shape[1] // 2]


def replicate_centre(lf: np.ndarray) -> np.ndarray:
    """The centre view in place of every view, read-only: the estimate that others must beat."""
    return np.broadcast_to(centre_view(lf), lf.shape)


def epi_horizontal(lf: np.ndarray, v: int, y: int) -> np.ndarray:
    """Row `y` of every view of row `v`: (u, x, c); disparity is the lines' slope dx/du."""
    return lf[v, :, y]


def shear(lf: np.ndarray, disparity_px: float) -> np.ndarray:
    """Shift every view so that points of this disparity stay where the centre view has them.

    disparity_px: d, pixels per view step. Returns (v, u, y, x, c) float32, interpolated by
    `shifted`: lf[v, u, y + d (v - V // 2), x + d (u - U // 2)].
    """
    sheared = np.empty(lf.shape, np.float32)
    for v, u in np.ndindex(lf.shape[:2]):
        steps_v, steps_u = v - lf.shape[0] // 2, u - lf.shape[1] // 2
        view = np.ascontiguousarray(lf[v, u], dtype=np.float32)
        sheared[v, u] = shifted(view, disparity_px * steps_v, disparity_px * steps_u)
    return sheared


def shifted(view: np.ndarray, shift_y_px: float, shift_x_px: float) -> np.ndarray:
    """Sample a view (y, x, c), float32, between its pixels, at (y + shift_y_px, x + shift_x_px).

    Catmull-Rom interpolation: exact for whole pixels and for polynomials of the second degree;
    may overshoot a little at edges. Beyond the view's edge its last pixel continues.
    """
    height, width = view.shape[:2]
    # OpenCV's warps round coordinates to 1/32 pixel; a constant shift, a convolution, need not.
    # Further out than the picture is long, every sample is the edge pixel.
    shift_y_px = float(np.clip(shift_y_px, -height - 2, height + 2))
    shift_x_px = float(np.clip(shift_x_px, -width - 2, width + 2))
    down, right = int(np.floor(shift_y_px)), int(np.floor(shift_x_px))
    above, below = max(0, 1 - down), max(0, down + 2)
    before, after = max(0, 1 - right), max(0, right + 2)
    framed = cv2.copyMakeBorder(view, above, below, before, after, cv2.BORDER_REPLICATE)
    framed = framed.reshape(*framed.shape[:2], -1)
    top, left = above + down - 1, before + right - 1
    blended = cv2.sepFilter2D(
        framed[top : top + height + 3, left : left + width + 3],
        cv2.CV_32F,
        _catmull_rom(shift_x_px - right),
        _catmull_rom(shift_y_px - down),
        anchor=(1, 1),
    )
    return blended[1 : 1 + height, 1 : 1 + width].reshape(view.shape)


def small_grey_views(lf: np.ndarray, most_columns: int) -> tuple[np.ndarray, float]:
    """Return the views (v, u, y, x, 1), grey, at most so many columns wide, and the shrinkage."""
    shrink = max(1.0, lf.shape[3] / most_columns)
    grey = lf.mean(axis=4, dtype=np.float32)
    size = max(2, round(lf.shape[3] / shrink)), max(2, round(lf.shape[2] / shrink))
    small = np.stack(
        [
            cv2.resize(np.ascontiguousarray(grey[place]), size, interpolation=cv2.INTER_AREA)
            for place in np.ndindex(grey.shape[:2])
        ]
    )
    return small.reshape(*grey.shape[:2], size[1], size[0], 1), shrink


BACK_TO_FRONT = 5, 50, 95
"""Percentiles of a scene's disparity."""


def focus_disparities(lf: np.ndarray) -> tuple[float, float, float]:
    """Return the disparities of the scene's back, middle and front, pixels per view step.

    The disparity at which the views agree best is found per textured pixel, on views shrunk to
    at most 256 columns and within 4 % of the width; the 5th, 50th and 95th percentiles come back,
    after two sweeps over the range just found. Good enough to choose a focus, not a depth map.
    """
    small, shrink = small_grey_views(lf, 256)
    width = small.shape[3]
    slope_y, slope_x = np.gradient(centre_view(small)[..., 0])
    steepness = np.hypot(slope_y, slope_x)
    # Near an edge the sheared views hold nothing of the scene.
    inner = tuple(slice(n // 10, n - n // 10) for n in steepness.shape)
    textured = steepness[inner] >= np.median(steepness[inner])
    front = 0.04 * width
    back, middle, margin = -front, 0.0, 0.0
    for _ in range(3):
        candidates = np.linspace(back - margin, front + margin, 41)
        spread = np.stack([disagreement(small, float(d), 5) for d in candidates])
        best = candidates[spread.argmin(axis=0)][inner][textured]
        back, middle, front = (float(d) for d in np.percentile(best, BACK_TO_FRONT))
        margin = float(candidates[1] - candidates[0])
    return back * shrink, middle * shrink, front * shrink


def sum_of_squares(values: np.ndarray) -> float:
    """Return that of a picture, summed in float64."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    return float(flat @ flat)


def psnr_db(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio, -10 log10(mean squared error), dB; infinite for equal samples.

    Raises SceneError where the shapes differ.
    """
    _check_same_shape(estimate, truth)
    squares = 0.0
    for place in np.ndindex(truth.shape[: max(truth.ndim - 3, 0)]):
        squares += sum_of_squares(np.subtract(estimate[place], truth[place], dtype=np.float64))
    if squares == 0:
        return float("inf")
    return float(10 * np.log10(truth.size / squares))


def ssim(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity, the mean over views, colours and every window inside a view.

        SSIM = (2 m_a m_b + C1) (2 s_ab + C2) / ((m_a^2 + m_b^2 + C1) (s_a^2 + s_b^2 + C2))

    with means m, variances s^2 and the covariance s_ab of a window: Gaussian, 11x11 pixels, sigma
    1.5; C1 = 0.01^2 and C2 = 0.03^2 for values up to 1. Source: Wang et al. 2004, eq. 13.

    estimate, truth: (v, u, y, x, c). Raises SceneError where the shapes differ, or a view is
    smaller than the window.
    """
    _check_same_shape(estimate, truth)
    if min(truth.shape[2:4]) < _SSIM_WINDOW_PX:
        raise SceneError(
            f"SSIM needs views of {_SSIM_WINDOW_PX}x{_SSIM_WINDOW_PX} pixels or more, "
            f"these have {truth.shape[2]}x{truth.shape[3]}"
        )
    means = np.empty(truth.shape[:2])

    def work(place: tuple[int, int]) -> None:
        found, true = estimate[place], truth[place]  # a colour at a time: a third of the memory
        colours = range(true.shape[-1])
        means[place] = np.mean([_plane_ssim(found[..., c], true[..., c]) for c in colours])

    in_views(work, means.shape)
    return float(means.mean())


def read_picture(path: Path) -> np.ndarray:
    """Return the picture of a file as float32 (y, x, 3), 1 for white; raises SceneError."""
    return light_of(*read_codes(path, SceneError, opaque=True))


def _catmull_rom(fraction: float) -> np.ndarray:
    """Weights of the samples at -1, 0, 1, 2 for a value at `fraction` in [0, 1)."""
    f = fraction
    return np.array(
        [
            ((-0.5 * f + 1) * f - 0.5) * f,
            (1.5 * f - 2.5) * f * f + 1,
            ((-1.5 * f + 2) * f + 0.5) * f,
            (0.5 * f - 0.5) * f * f,
        ]
    )


def disagreement(lf: np.ndarray, disparity_px: float, window_px: int) -> np.ndarray:
    """Variance over grey views sheared to this disparity, averaged over a window: (y, x)."""
    return cv2.blur(shear(lf, disparity_px).var(axis=(0, 1))[..., 0], (window_px, window_px))


def _check_same_shape(estimate: np.ndarray, truth: np.ndarray) -> None:
    if estimate.shape != truth.shape:
        raise SceneError(f"estimate has shape {estimate.shape}, the truth {truth.shape}")


def _plane_ssim(estimate: np.ndarray, truth: np.ndarray) -> float:
    """SSIM of (y, x); float64, as variances are differences of near-equal numbers."""

    def window_mean(picture: np.ndarray) -> np.ndarray:
        edge = _SSIM_WINDOW_PX // 2
        size = _SSIM_WINDOW_PX, _SSIM_WINDOW_PX
        return cv2.GaussianBlur(picture, size, _SSIM_SIGMA_PX)[edge:-edge, edge:-edge]

    a, b = estimate.astype(np.float64), truth.astype(np.float64)
    mean_a, mean_b = window_mean(a), window_mean(b)
    means_product = mean_a * mean_b
    means_squares = mean_a * mean_a + mean_b * mean_b
    covariance = window_mean(a * b) - means_product
    variances = window_mean(a * a + b * b) - means_squares
    similarity = ((2 * means_product + _SSIM_C1) * (2 * covariance + _SSIM_C2)) / (
        (means_squares + _SSIM_C1) * (variances + _SSIM_C2)
    )
    return float(similarity.mean())
