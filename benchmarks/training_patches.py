"""Choose training patches: seeded candidates from several light fields, and a coreset of them.

Candidates are places in the scenes, each seen through one of the eight symmetries that turn a
light field into a light field (rows mirrored, columns mirrored, rows and columns exchanged, of
views and pixels alike). A coreset keeps those that matter: a candidate is drawn with a probability
that is half uniform and half its share of the energy left when every colour's mean is taken out,
and its error counts 1 / probability, so that the weighted error stays an unbiased estimate of all
candidates' (Bachem, Lucic, Krause 2018, "Scalable k-means clustering via lightweight coresets",
with the flat patches in place of the one mean). The weight is put into the patch itself: a patch
times sqrt(w) has the same code times sqrt(w). Systematic sampling in the order of the places
spreads the kept ones over all scenes.

Two passes over the scenes keep one scene and the chosen patches in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.errors import DictionaryError

Array = NDArray[np.float32]
_BATCH_BYTES = 48 << 20


class PatchSettings(Settings):
    """Which patches to take."""

    rows: int = Field(default=9, ge=1, description="pixels of a patch downwards")
    columns: int = Field(default=9, ge=1, description="pixels of a patch across")
    count: int = Field(default=10_000, ge=1, description="patches to keep")
    candidates_per_patch: int = Field(
        default=8, ge=1, description="candidates for each patch kept; 1: keep all, weigh none"
    )
    seed: int = Field(default=0, ge=0)


def cut_patches(
    light_field: Array,
    corners: NDArray[np.int64],
    symmetries: NDArray[np.int64],
    size: tuple[int, int],
) -> Array:
    """Cut patches (patch, v, u, y, x, c) of `size` rows and columns.

    corners: (patch, 2), first row and column. symmetries: (patch,), 1 mirrors columns, + 2 rows,
    + 4 exchanges both (square views and patches only); views and pixels together.
    """
    windows = np.lib.stride_tricks.sliding_window_view(light_field, size, axis=(2, 3))
    cut = windows[:, :, corners[:, 0], corners[:, 1]]
    patches = np.ascontiguousarray(cut.transpose(2, 0, 1, 4, 5, 3))
    for bit in (1, 2, 4):
        turned = (symmetries & bit) > 0
        if not turned.any():
            continue
        some = patches[turned]
        if bit == 1:
            patches[turned] = some[:, :, ::-1, :, ::-1]
        elif bit == 2:
            patches[turned] = some[:, ::-1, :, ::-1]
        else:
            patches[turned] = some.transpose(0, 2, 1, 4, 3, 5)
    return patches


def coreset(
    energies: NDArray[np.floating], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Draw `count` candidates, none twice; return their places, ascending, and weights of mean 1.

    energies: (candidate,), what each adds to the error of representing all by flat patches.
    """
    total = float(energies.sum())
    share = np.full(len(energies), 0.5 / len(energies))
    share += 0.5 * energies / total if total > 0 else share
    probability = np.minimum(1, count * share)
    # Probabilities above 1 are cut to 1; the others rise until all add up to `count`.
    while (missing := count - probability.sum()) > 1e-9 * count:
        free = probability < 1
        probability[free] *= 1 + missing / probability[free].sum()
        probability = np.minimum(1, probability)
    ticks = (np.arange(count) + rng.random()) * (probability.sum() / count)
    chosen = np.searchsorted(np.cumsum(probability), ticks, side="right")
    chosen = np.minimum(chosen, len(energies) - 1)
    weights = 1 / probability[chosen]
    return chosen, weights / weights.mean()


def training_patches(
    scenes: Sequence[Callable[[], Array]],
    settings: PatchSettings,
    on_scene: Callable[[int], None] | None = None,
) -> Array:
    """Return weighted patches (patch, v, u, y, x, c) of light fields opened one at a time.

    Args:
        scenes: each returns a light field (v, u, y, x, c); called twice.
        settings: which patches; every scene has an equal share of the candidates.
        on_scene: called with the scene's number whenever it was read.

    Raises:
        DictionaryError: no scenes, scenes of different views or colours, one smaller than a
            patch, or values that are not finite.
    """
    if not scenes:
        raise DictionaryError("no scenes to take patches from")
    count = settings.count * settings.candidates_per_patch
    edges = np.linspace(0, count, len(scenes) + 1).astype(np.int64)
    energies = np.empty(count)
    kind = (0, 0, 0)
    for number, scene in enumerate(scenes):
        light_field = scene()
        own_kind = light_field.shape[0], light_field.shape[1], light_field.shape[4]
        kind = kind if number else own_kind
        _check(light_field, number, own_kind, kind, settings)
        filled = edges[number]
        for batch in _candidates(light_field, number, edges, settings):
            pixels = batch.reshape(len(batch), -1, batch.shape[-1])
            spread = pixels - pixels.mean(axis=1, keepdims=True)
            energies[filled : filled + len(batch)] = np.einsum("pic,pic->p", spread, spread)
            filled += len(batch)
        if on_scene is not None:
            on_scene(number)
    if settings.candidates_per_patch == 1:
        chosen, weights = np.arange(count), np.ones(count)
    else:
        rng = np.random.default_rng(settings.seed)
        chosen, weights = coreset(energies, settings.count, rng)
    scale = np.sqrt(weights).astype(np.float32).reshape(-1, 1, 1, 1, 1, 1)
    kept = np.empty((settings.count, *kind[:2], settings.rows, settings.columns, kind[2]), "f4")
    for number, scene in enumerate(scenes):
        first, last = np.searchsorted(chosen, edges[number : number + 2])
        wanted = chosen[first:last] - edges[number]
        for batch in _candidates(scene(), number, edges, settings, wanted):
            kept[first : first + len(batch)] = batch * scale[first : first + len(batch)]
            first += len(batch)
        if on_scene is not None:
            on_scene(number)
    return kept


def _check(
    light_field: Array,
    number: int,
    own_kind: tuple[int, int, int],
    kind: tuple[int, int, int],
    settings: PatchSettings,
) -> None:
    height, width = light_field.shape[2:4]
    if own_kind != kind:
        raise DictionaryError(
            f"scene {number} has {own_kind[0]}x{own_kind[1]} views of {own_kind[2]} colours, the "
            f"first {kind[0]}x{kind[1]} of {kind[2]}: train on scenes of the same views"
        )
    if height < settings.rows or width < settings.columns:
        raise DictionaryError(
            f"scene {number} has {height}x{width} pixels, less than a patch of "
            f"{settings.rows}x{settings.columns}: leave it out or train smaller patches"
        )
    if not np.isfinite(light_field).all():
        raise DictionaryError(f"scene {number} holds values that are not finite")


def _candidates(
    light_field: Array,
    number: int,
    edges: NDArray[np.int64],
    settings: PatchSettings,
    wanted: NDArray[np.int64] | None = None,
) -> Iterator[Array]:
    """Yield a scene's candidates, or the wanted ones among them, in batches in their order."""
    rng = np.random.default_rng([settings.seed, number])
    count = int(edges[number + 1] - edges[number])
    size = settings.rows, settings.columns
    views_v, views_u, height, width, colours = light_field.shape
    corners = rng.integers(0, (height - size[0] + 1, width - size[1] + 1), (count, 2))
    square = views_v == views_u and size[0] == size[1]
    symmetries = rng.integers(0, 8 if square else 4, count)
    order = np.lexsort((corners[:, 1], corners[:, 0]))
    order = order if wanted is None else order[wanted]
    step = max(1, _BATCH_BYTES // (4 * views_v * views_u * size[0] * size[1] * colours))
    for start in range(0, len(order), step):
        part = order[start : start + step]
        yield cut_patches(light_field, corners[part], symmetries[part], size)
