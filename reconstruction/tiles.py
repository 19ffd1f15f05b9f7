"""Reconstruct in blocks of one canonical grid, so that any capture fits into memory.

The grid follows from the size of the light field, the settings and the capture's largest disparity
alone. Each block is reconstructed by itself, with its halo, from what was settled once for the
whole capture (`survey`). Neighbouring blocks overlap and are averaged with weights that sum to 1.
So the result is the same whatever order, process or machine the blocks are reconstructed in.

Up to `BlockSettings.whole` samples a light field is one block: the method itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import ceil, lcm
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.compiling import running_s
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.sensing import Psi, PsiLayout
from emmc_rig.reconstruction.adaptive.settings import SIDES, Side
from emmc_rig.reconstruction.adaptive.survey import contrast_of
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import check_frames
from emmc_rig.reconstruction.method import BlockSettings
from emmc_rig.reconstruction.methods import MethodSettings, find_method, reconstruct
from emmc_rig.reconstruction.methods.surfaces import patch_of
from emmc_rig.reconstruction.methods.variational import patched_weights
from emmc_rig.reconstruction.problem import choose_mu, choose_primal_step, contrast, smooth_guess
from emmc_rig.reconstruction.result import Progress, Reconstruction, Status
from emmc_rig.reconstruction.screening import screened
from emmc_rig.reconstruction.sparse import SparseSettings
from emmc_rig.reconstruction.verdict.blocks import JudgedBlock, judged_together
from emmc_rig.reconstruction.verdict.rules import Verdict
from emmc_rig.reconstruction.verdict.run import reconstruct_judged

REACH = 48
"""Samples of halo for methods that carry information from sample to sample: steps of the
variational methods move it by one, and what lies further hardly matters."""
TEXTURE_REACH, PATCHED_REACH = 16, 40
"""Pixels of halo for `adaptive` beyond the parallax: patches, stacks of blocks, windows; the second
where sparse patches are averaged with, by windows twice as wide. With 16 a smooth scene of two
shots lost 1.7 dB in blocks of 48 samples, and 5 in blocks of 80."""
STEPS = 100
"""Of the variational methods, in every block alike; the rule by change would differ between
blocks."""
SAMPLE, SAMPLES = 96, 3
"""Rows and columns of a sample window of the survey, and windows along each axis."""
SURE_PX, COVERED = 0.3, 99.0
"""The halo covers this percentile of the disparities whose deviation is at most SURE_PX. Fewer
readings of a block show surfaces beyond; the mean with the neighbouring block helps there."""

Array = NDArray[np.floating]
ArrayType = tuple[tuple[int, ...], np.dtype]
"""Shape and type of an array."""
Place = tuple[slice, slice]


@dataclass(frozen=True)
class Block:
    """A block of the grid, by rows and columns of the light field's samples.

    outer: reconstructed, with the halo; part: without the halo, overlapping the neighbours; inner:
    samples nearest to this block. sides: of the light field, which the block touches."""

    row: int
    column: int
    outer: Place
    part: Place
    inner: Place
    sides: tuple[Side, ...]

    @property
    def name(self) -> str:
        """Row and column in the grid, as files are called."""
        return f"block-{self.row:03d}-{self.column:03d}"


def within(place: Place, other: Place) -> Place:
    """Return rows and columns counted from the first of another place."""
    rows, columns = (
        slice(a.start - b.start, a.stop - b.start) for a, b in zip(place, other, strict=True)
    )
    return rows, columns


def pixels_of(place: Place, binning: int) -> tuple[slice, slice, slice]:
    """Return the readings of all shots in pixels of k x k samples."""
    rows, columns = (slice(part.start // binning, part.stop // binning) for part in place)
    return slice(None), rows, columns


class Overlap(NamedTuple):
    """Where a block reaches into a place: in the light field, and the block's weights (y, x)."""

    block: Block
    place: Place
    weight: NDArray[np.float32]


@dataclass(frozen=True)
class Grid:
    """The canonical grid of blocks of a light field.

    size: its rows and columns. multiple: divisor of all edges, in samples. halo: samples beyond a
    block's part that are reconstructed and thrown away.
    """

    size: tuple[int, int]
    multiple: int
    halo: int
    settings: BlockSettings

    @property
    def _blend(self) -> int:
        return ceil(self.settings.blend / self.multiple) * self.multiple

    @cached_property
    def edges(self) -> tuple[list[int], list[int]]:
        """Where inner parts begin along rows and columns, and the end."""
        if self.size[0] * self.size[1] <= self.settings.whole:
            return [0, self.size[0]], [0, self.size[1]]
        along = []
        for length in self.size:
            most = max(1, length // (2 * self._blend + 2 * self.multiple))
            count = min(ceil(length / self.settings.side), most)
            inner = np.linspace(0, length, count + 1)[1:-1] / self.multiple
            along.append([0, *(np.rint(inner).astype(int) * self.multiple).tolist(), length])
        return along[0], along[1]

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks, row by row."""
        return tuple(self.block(row, column) for row, column in np.ndindex(self.shape))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of blocks."""
        return len(self.edges[0]) - 1, len(self.edges[1]) - 1

    def __len__(self) -> int:
        return self.shape[0] * self.shape[1]

    def __iter__(self) -> Iterator[Block]:
        return iter(self.blocks)

    def block(self, row: int, column: int) -> Block:
        """Return a block by its row and column in the grid."""

        def place(beyond: int) -> Place:
            rows, columns = (
                slice(max(edges[at] - beyond, 0), min(edges[at + 1] + beyond, length))
                for edges, at, length in zip(self.edges, (row, column), self.size, strict=True)
            )
            return rows, columns

        halo = ceil(self.halo / self.multiple) * self.multiple
        rows, columns = self.shape
        ends = row == 0, row == rows - 1, column == 0, column == columns - 1
        sides: tuple[Side, ...] = tuple(side for side, at in zip(SIDES, ends, strict=True) if at)
        outer, part = place(self._blend + halo), place(self._blend)
        return Block(row, column, outer, part, inner=place(0), sides=sides)

    def _weight(self, axis: int, at: int, place: slice) -> NDArray[np.float32]:
        """Return the weights along an axis of the at-th blocks: ramps of 2 blend at their edges."""
        edges, blend = self.edges[axis], self._blend
        centre = np.arange(place.start, place.stop, dtype=np.float32) + np.float32(0.5)
        weight = np.ones_like(centre)
        if at > 0:
            weight *= np.clip((centre - (edges[at] - blend)) / (2 * blend), 0, 1)
        if at < len(edges) - 2:
            weight *= 1 - np.clip((centre - (edges[at + 1] - blend)) / (2 * blend), 0, 1)
        return weight.astype(np.float32)

    def overlapping(self, place: Place, blended: bool = True) -> Iterator[Overlap]:
        """Yield the blocks whose parts reach into a place, in the order of the grid.

        blended: with the parts' overlaps; else of their inner ones.
        """
        for block in self.blocks:
            reach = block.part if blended else block.inner
            rows, columns = (
                slice(max(a.start, b.start), min(a.stop, b.stop))
                for a, b in zip(place, reach, strict=True)
            )
            if rows.start < rows.stop and columns.start < columns.stop:
                down = self._weight(0, block.row, rows)
                across = self._weight(1, block.column, columns)
                yield Overlap(block, (rows, columns), np.outer(down, across))


Part = Callable[[Block, tuple], Array]
"""Returns what a block's part has of an array, at an index into it."""


def assembled(grid: Grid, place: Place, axes: int, dtype: np.dtype, part: Part) -> Array:
    """Return an array's values at a place: the weighted mean of the parts that overlap there.

    axes: of the array before (y, x). dtype: arrays of whole numbers are those of the nearest block.
    """
    lead, blended = (slice(None),) * axes, np.dtype(dtype).kind == "f" and len(grid) > 1
    total = None
    for block, shared, weight in grid.overlapping(place, blended):
        values = part(block, (*lead, *within(shared, block.part)))
        if total is None:
            size = (side.stop - side.start for side in place)
            shape = (*values.shape[:axes], *size, *values.shape[axes + 2 :])
            total = np.zeros(shape, dtype)
        at = (*lead, *within(shared, place))
        if blended:
            total[at] += weight.reshape(*weight.shape, *(1,) * (values.ndim - axes - 2)) * values
        else:
            total[at] = values
    assert total is not None
    return total


@dataclass(frozen=True)
class CaptureSurvey:
    """Decisions made once for the whole capture, on which every block depends.

    settings: of the methods, with mu, primal step and steps settled. halo: see `Grid`. left_out:
    shots, gains: of the shots, words: about both. largest_px: disparity, 0 where not searched.
    """

    settings: MethodSettings
    halo: int
    left_out: tuple[int, ...]
    gains: tuple[float, ...]
    words: tuple[str, ...]
    largest_px: float

    @classmethod
    def of_one_block(cls, settings: MethodSettings, shots: int) -> CaptureSurvey:
        """Return what settles nothing: a single block is the whole."""
        return cls(settings, 0, (), (1.0,) * shots, (), 0.0)

    def applied(self, frames: Frames) -> Frames:
        """Return frames of even brightness, without the shots left out."""
        readings, usable = frames.readings, frames.usable.copy()
        usable[list(self.left_out)] = False
        gains = np.asarray(self.gains, dtype=readings.dtype)
        if (gains != 1).any():
            readings = readings / gains[:, None, None]
        return replace(frames, readings=readings, usable=usable)


def samples(size: tuple[int, int], multiple: int) -> list[Place]:
    """Return the places of the sample windows, spread evenly over the light field."""
    along = []
    for length in size:
        side = min(ceil(SAMPLE / multiple) * multiple, length)
        last = (length - side) // multiple
        firsts = sorted({round(share * last) for share in np.linspace(0, 1, SAMPLES)})
        along.append([slice(first * multiple, first * multiple + side) for first in firsts])
    return [(rows, columns) for rows, columns in product(*along)]


def grid_of(
    psi: PsiLayout, dictionary: Dictionary | None, settings: MethodSettings, halo: int = 0
) -> Grid:
    """Return the grid of blocks of a capture; halo: see `Grid`."""
    return Grid(psi.size, multiple_of(psi.binning, dictionary, settings), halo, settings.blocks)


def multiple_of(binning: int, dictionary: Dictionary | None, settings: MethodSettings) -> int:
    """Return of what blocks' edges are multiples: pixels, and the strides of patches.

    So every block cuts the patches of the whole, and sees colour filters as a whole does.
    """
    return lcm(2 * binning, settings.sparse.stride if dictionary is not None else 1)


@dataclass(frozen=True, eq=False)
class _Sample:
    """Sample windows of a capture, beside each other as one.

    psi, frames: of all windows, along x. windows: Psi of each.
    """

    psi: Psi
    frames: Frames
    windows: list[Psi]

    @classmethod
    def of(cls, psi: PsiLayout, frames: Frames, multiple: int) -> _Sample:
        """Return the sample windows, whose edges are multiples of so many samples."""
        places = samples(psi.size, multiple)
        windows = [psi.window(*place) for place in places]
        colours = [window.colour for window in windows if window.colour is not None]
        mosaic = replace(
            windows[0],
            weights=np.concatenate([window.weights for window in windows], axis=5),
            colour=np.concatenate(colours, axis=2) if colours else None,
        )
        seen = [pixels_of(place, psi.binning) for place in places]
        usable = np.concatenate([frames.usable[place] for place in seen], axis=2)
        readings = np.concatenate([frames.readings[place] for place in seen], axis=2)
        readings = np.where(usable, readings.astype(np.float32), 0)
        return cls(mosaic, even_frames(readings, frames.noise_sigma, usable), windows)

    def largest_disparity(self, scout: str, settings: MethodSettings) -> float:
        """Return the largest |disparity| that a method is sure of in a window, 0 for none."""
        largest, first = 0.0, 0
        for window in self.windows:
            frames = self.frames.cut(np.s_[:, :, first : first + window.frames_shape[2]])
            first += window.frames_shape[2]
            if frames.usable.any():
                maps = reconstruct(scout, window, frames, None, settings).maps
                sure = maps["disparity"][maps["disparity_sigma"] < SURE_PX]
                if sure.size:
                    largest = max(largest, float(np.percentile(np.abs(sure), COVERED)))
        return largest

    def contrast(self, settings: MethodSettings) -> float:
        """Return the contrast that `adaptive` presumes of the scene's texture."""
        if settings.adaptive.contrast:
            return settings.adaptive.contrast
        readings, usable = self.frames.readings, self.frames.usable
        picture = smooth_guess(self.psi, readings, usable).astype(np.float32)
        noise = np.full(readings.shape, self.frames.noise_sigma**2)
        return contrast_of(self.psi, readings, picture, noise, usable)


def surveyed(
    name: str,
    psi: PsiLayout,
    frames: Frames,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
) -> CaptureSurvey:
    """Return what is settled from sample windows of a capture, read one at a time."""
    settings, method = settings or MethodSettings(), find_method(name)
    sample = _Sample.of(psi, frames, multiple_of(psi.binning, dictionary, settings))
    left_out, gains, words = (), (1.0,) * psi.shots, ()
    if settings.screening and sample.frames.usable.any():
        seen = screened(sample.psi, sample.frames)
        left_out = tuple(sorted((*seen.dark, *seen.double)))
        gains = tuple(float(gain) for gain in seen.gains)
        # Bad pixels and lines are left to the blocks.
        words = seen.notes[: len(seen.notes) - bool(seen.bad.any()) - bool(seen.lines.any())]
        sample = replace(sample, frames=seen.frames)
    halo, largest_px = REACH, 0.0
    sparse = method.patches(sample.psi, settings)
    if method.scout is not None:
        largest_px = sample.largest_disparity(method.scout, settings)
        reach = TEXTURE_REACH if sparse is None else PATCHED_REACH
        halo = reach * psi.binning + ceil(largest_px * (max(psi.views) // 2))
        # What a block would decide by its own size is decided for all.
        count = None if sparse is None else settings.adaptive.patches
        update = {"contrast": sample.contrast(settings), "patches": count}
        adaptive = settings.adaptive.model_copy(update=update)
        settings = settings.model_copy(update={"adaptive": adaptive})
    if dictionary is not None:
        halo = max(halo, *dictionary.patch_shape[2:4])
    patch = patch_of(sample.psi) if dictionary is None else dictionary.patch_shape[2:4]
    settled = _settled(sample.psi, sample.frames, settings, sparse, patch)
    return CaptureSurvey(settled, halo, left_out, gains, words, largest_px)


def _settled(
    psi: Psi,
    frames: Frames,
    settings: MethodSettings,
    sparse: SparseSettings | None,
    patch: tuple[int, int],
) -> MethodSettings:
    """Return the settings with a block's own choices made once for all blocks.

    sparse: settings of the patches, of methods that draw total variation towards some. patch: their
    rows and columns, in samples.
    """
    readings, noise_sigma, tv = frames.readings[frames.usable], frames.noise_sigma, settings.tv
    if not readings.size:
        return settings
    if sparse is not None:
        tv = patched_weights(tv, sparse, patch, psi, readings, noise_sigma)
    mu = tv.mu or choose_mu(psi, readings, noise_sigma, tv.order)
    guess = smooth_guess(psi, frames.readings, frames.usable)
    step = tv.primal_step or choose_primal_step(contrast(guess), mu, tv.chroma_weight, tv.order)
    tv = tv.model_copy(
        update={"mu": mu, "primal_step": step, "rtol": 1e-12, "max_steps": min(STEPS, tv.max_steps)}
    )
    return settings.model_copy(update={"tv": tv})


@dataclass(frozen=True, eq=False)
class SolvedBlock:
    """What a block adds: its part's arrays by name, `light_field` among them, and the verdict.

    result: without its arrays. verdict: None where no pixel is usable.
    """

    arrays: Mapping[str, Array]
    result: Reconstruction
    verdict: Verdict | None


def solve_block(
    name: str,
    psi: Psi,
    frames: Frames,
    block: Block,
    settings: MethodSettings,
    dictionary: Dictionary | None = None,
) -> SolvedBlock:
    """Return a block's part. psi, frames: of its outer place, after the survey's steps.

    settings: as the survey settled them. A block without usable pixels is black.
    """
    if not frames.usable.any():
        views = psi.light_field_shape[:2]
        dark = np.zeros((*views, *(part.stop - part.start for part in block.part), 3), np.float32)
        result = Reconstruction(name, dark, Status.INCOMPLETE, "", 0, (), 0.0, {})
        return SolvedBlock({"light_field": dark}, result.without_light_field(), None)
    edges = tuple(side for side in settings.adaptive.edges if side in block.sides)
    adaptive = settings.adaptive.model_copy(update={"edges": edges})
    own = settings.model_copy(update={"adaptive": adaptive})
    result, verdict = reconstruct_judged(name, psi, frames, dictionary, own)
    place = within(block.part, block.outer)
    arrays = {"light_field": result.light_field[:, :, *place]}
    for key, values in result.maps.items():
        arrays[key] = values[(slice(None),) * (values.ndim - 2) + place]
    arrays = {key: np.ascontiguousarray(values) for key, values in arrays.items()}
    return SolvedBlock(arrays, result.without_light_field(), verdict)


AXES = {"light_field": 2, "sigma": 2}
"""Axes before (y, x) of the arrays of a result; other maps have 0."""


def summed_up(
    name: str, results: Iterable[Reconstruction], survey: CaptureSurvey, seconds: float
) -> Reconstruction:
    """Return what blocks say together, without arrays: the mean of their figures.

    The halo's largest disparity is the survey's; steps are those of all blocks.
    """
    solved = [result for result in results if result.status != Status.INCOMPLETE]
    keys = dict.fromkeys(key for result in solved for key in result.parameters)
    each = {
        key: [result.parameters[key] for result in solved if key in result.parameters]
        for key in keys
    }
    parameters = {key: float(np.mean(values)) for key, values in each.items()}
    for key, extreme in (("lowest_px", min), ("highest_px", max)):
        if key in each:
            parameters[key] = extreme(each[key])
    # Where the whole has no single place, the verdict names the block.
    for key in ("misfit_row", "misfit_column"):
        parameters.pop(key, None)
    advice = [result.advice for result in solved if result.advice]
    return Reconstruction(
        method=name,
        light_field=np.empty((0, 0, 0, 0, 3), np.float32),
        status=Status.IN_TILES,
        advice=f"{len(advice)} of {len(solved)} blocks, the first: {advice[0]}" if advice else "",
        steps=sum(result.steps for result in solved),
        objective=(),
        seconds=seconds,
        parameters={**parameters, "halo": survey.halo, "largest_px": survey.largest_px},
        screening=survey.words,
    )


def verdict_on(grid: Grid, verdicts: Iterable[Verdict | None], binning: int) -> Verdict:
    """Return the verdict on the whole from the verdicts on its blocks, in the order of the grid.

    verdicts: None for a block without usable pixels. binning: samples along a pixel's side. Raises
    ReconstructionError where every verdict is None.
    """
    judged = []
    for block, verdict in zip(grid, verdicts, strict=True):
        if verdict is not None:
            rows, columns = block.inner
            samples = (rows.stop - rows.start) * (columns.stop - columns.start)
            row, column = (part.start // binning for part in block.outer)
            judged.append(JudgedBlock(verdict, row, column, samples // binning**2))
    if not judged:
        raise ReconstructionError(
            "no usable pixel, every one is saturated or excluded: expose shorter"
        )
    return judged_together(judged)


def whole_shapes(grid: Grid, parts: Sequence[Mapping[str, ArrayType]]) -> dict[str, ArrayType]:
    """Return shape and type of the arrays of the whole that every block has a part of, by name.

    parts: shape and type of the arrays of each block.
    """
    shapes = {}
    for name, (shape, dtype) in parts[0].items():
        if all(name in part for part in parts):
            axes = AXES.get(name, 0)
            shapes[name] = (*shape[:axes], *grid.size, *shape[axes + 2 :]), dtype
    return shapes


def reconstruct_in_blocks(
    name: str,
    psi: PsiLayout,
    frames: Frames,
    dictionary: Dictionary | None,
    settings: MethodSettings,
    on_step: Callable[[Progress], None] | None = None,
) -> tuple[Reconstruction, Verdict]:
    """Return a light field and the verdict on it, block by block in this process.

    Raises ReconstructionError as `reconstruct` does.
    """
    started = running_s()
    check_frames(psi.frames_shape, frames.readings)
    if not frames.usable.any():
        raise ReconstructionError(
            "no usable pixel, every one is saturated or excluded: expose shorter"
        )
    survey = surveyed(name, psi, frames, dictionary, settings)
    grid = grid_of(psi, dictionary, settings, survey.halo)
    frames = survey.applied(frames.of_one_deviation())
    blocks: dict[str, SolvedBlock] = {}
    for done, block in enumerate(grid, 1):
        seen = pixels_of(block.outer, psi.binning)
        blocks[block.name] = solve_block(
            name, psi.window(*block.outer), frames.cut(seen), block, survey.settings, dictionary
        )
        if on_step is not None:
            on_step(Progress(done, None, None, len(grid)))
    solved = list(blocks.values())
    parts = [
        {key: (values.shape, values.dtype) for key, values in block.arrays.items()}
        for block in solved
    ]
    everywhere = slice(0, grid.size[0]), slice(0, grid.size[1])
    arrays: dict[str, Array] = {}
    for key, (_, dtype) in whole_shapes(grid, parts).items():

        def part(block: Block, at: tuple, key: str = key) -> Array:
            return blocks[block.name].arrays[key][at]

        arrays[key] = assembled(grid, everywhere, AXES.get(key, 0), dtype, part)
    whole = summed_up(name, [block.result for block in solved], survey, running_s() - started)
    light_field = arrays.pop("light_field")
    verdict = verdict_on(grid, [block.verdict for block in solved], psi.binning)
    return replace(whole, light_field=light_field, maps=arrays), verdict
