"""How well a Gaussian texture on a plane explains a patch's readings, for every disparity.

Within a patch the scene is a texture T on a plane at disparity d, seen by the ray through sample x
of view u as T(x - d u). T less a smooth picture is Gaussian with covariance a k(|x - x'|) in
luminance and a b k in each chrominance, k(r) = exp((e - sqrt(r^2 + e^2)) / l): power laws like a
natural picture's up to the optics' blur e. The patch's m readings are then Gaussian too, with
covariance Psi K_d Psi^T + noise; their log-likelihood (marginal likelihood, evidence) compares d,
the amplitude a and the colourfulness b alike, and pays for what a model could have explained but
did not see (Occam's factor, log det). The same holds for l, which differs from leaf to wall:
textures of several lengths are compared, and the likelihood is their mean. With one length alone a
picture that is finer than it seems to lie nearer to d = 0, where fewer rays of a pixel are
averaged.

Products of a patch: m R S for spectra of its rays, 2 m^2 / 2 S to correlate them, m^2 / 2 S of each
texture (a length and a disparity) for its covariance, and m^3 / 6 of each and of each of P trials
of the kinds, for its factor; R rays a pixel (25, or 25 k^2), S distinct separations of them (81).
For m = 64 and 20 textures, P = 27: 0.1, 0.3, 3.5 and 2.1 million. Behind a coded aperture alone all
patches share the spectra and covariances.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.evidence_kernels import SIZE, Hypotheses, evidence
from emmc_rig.reconstruction.adaptive.register_tiles import LANES, SIDE
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings

Array = NDArray[np.floating]
PROBES = 4
"""Of the disparities, at which the kinds of texture are compared. 2x -0.03, 0.5x -0.23 dB."""
GROUPS = 16
"""Of LANES patches, that a thread works on at a time."""


@dataclass(frozen=True)
class TexturePrior:
    """Covariances of textures, lengths in samples, and the kinds of texture to compare.

    Attributes:
        length_px: correlation length l.
        finer_px: lengths of further textures that evidence compares, as likely as the first.
        blur_px: of the optics, e.
        kinds: pairs (a, b): variance of the luminance (R + G + B) / sqrt(3) over the squared
            brightness, and variance of a chrominance over it. The first is next to flat.
        kept: number of kinds compared at a patch's other probes after the first, half as many of
            further lengths; None: all.
        freedom: degrees of the Student t of the readings.
    """

    length_px: float = 3.0
    finer_px: tuple[float, ...] = ()
    blur_px: float = 0.7
    kinds: tuple[tuple[float, float], ...] = (
        (3e-5, 0.1),
        (1e-3, 0.2),
        (1e-3, 0.03),
        (2e-2, 0.2),
        (2e-2, 0.03),
        (4e-1, 0.2),
        (4e-1, 0.03),
    )
    kept: int | None = None
    freedom: float = 3.0

    def covariance(self, square_px: Array) -> Array:
        """Return the correlation of points at a squared distance, 1 at 0 (any shape)."""
        blur = self.blur_px
        return np.exp((blur - np.sqrt(square_px + blur**2)) / self.length_px)

    def slope(self, square_px: Array) -> Array:
        """Return the derivative of `covariance` by the squared distance (any shape)."""
        apart = np.sqrt(square_px + self.blur_px**2)
        return -self.covariance(square_px) / (2 * self.length_px * apart)


@dataclass(frozen=True)
class EvidencePatches:
    """Patches of pixels: corners (y, x) every `stride` pixels, `side` x `side` pixels, `spacing`
    apart."""

    side: int
    stride: int
    spacing: int = 1

    def grid(
        self, pixels: tuple[int, int], first: int = 0
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and the columns of corners that cover a sensor of `pixels`.

        first: the corner after that at 0, if it is not a stride further.
        """
        span = (self.side - 1) * self.spacing + 1
        if min(pixels) < span:
            raise ReconstructionError(
                f"patches of {span} pixels do not fit a sensor of {pixels[0]}x{pixels[1]}: "
                "reconstruct a larger part"
            )
        along = [
            np.unique([0, *range(first, whole - span + 1, self.stride), whole - span])
            for whole in pixels
        ]
        return along[0], along[1]

    def places(self, shots: int) -> NDArray[np.int64]:
        """Return the patch's readings: shot, row and column from the corner, (reading, 3)."""
        steps = np.arange(self.side) * self.spacing
        parts = np.meshgrid(np.arange(shots), steps, steps, indexing="ij")
        return np.stack([part.ravel() for part in parts], axis=1).astype(np.int64)


def _spectrum(
    views: tuple[int, int], binning: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float64]]:
    """Return the waves that rays are analysed into, their separations, and the waves back.

    Pairs of rays matter by how far they lie apart only: a correlation, which for the discrete
    Fourier transforms over all separations is a product. Waves (wave, ray): cosine and sine by
    turns, of the mean first; separations (separation, 4), two in samples and two in views; waves
    back (separation, wave). Rays and waves are padded with zeros to multiples of SIDE.
    """
    lengths = np.array([binning, binning, *views])
    v, u, y, x = (axis.ravel() for axis in np.indices((*views, binning, binning)))
    rays = np.stack([y, x, v, u], axis=1)
    apart = np.indices(tuple(2 * lengths - 1)).reshape(4, -1).T - (lengths - 1)
    # The first half of the frequencies is the second's negative: a real function's says no more.
    once = 2 * np.pi * apart[len(apart) // 2 :] / (2 * lengths - 1)
    short = -len(once) % (SIDE // 2)

    def analysed(positions: NDArray[np.int64]) -> Array:
        phase = positions @ once.T
        both = np.stack([np.cos(phase), np.sin(phase)], axis=-1).reshape(len(phase), -1)
        return np.pad(both, ((0, 0), (0, 2 * short)))

    waves = np.pad(analysed(rays).T, ((0, 0), (0, -len(rays) % SIDE)))
    back = 2 * analysed(apart) / len(apart)
    back[:, 0] /= 2
    return np.ascontiguousarray(waves, dtype=np.float32), apart, back


@dataclass(frozen=True, eq=False)
class PatchEvidence:
    """How well textures explain patches.

    Attributes:
        log_likelihood: (patch, disparity), without constants (m/2 log 2 pi): of the kind of texture
            that explains the patch best, mean likelihood over lengths; -inf where not evaluated.
        kinds: the best kind for each length, an index of the prior's kinds, (patch, length).
        kind: the best kind for the likeliest length, (patch,).
    """

    log_likelihood: NDArray[np.float32]
    kinds: NDArray[np.int64]
    kind: NDArray[np.int64]


def _alike(psi: Psi) -> bool:
    """Return whether Psi is the same at every pixel, as that of a coded aperture alone."""
    row = psi.weights[:, :, :, :1]
    return bool((row == row[..., :1]).all() and (psi.weights == row).all())


def _sets(
    pixels_apart: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of readings (set, SIDE, 2), the sets' offsets (set,), and all (offset, 2).

    pixels_apart: (reading, reading, 2). A set's pairs, the first reading not before the second, lie
    equally far apart; those that have too few repeat their last.
    """
    pairs = np.stack(np.tril_indices(len(pixels_apart)), axis=1)
    apart, which = np.unique(pixels_apart[pairs[:, 0], pairs[:, 1]], axis=0, return_inverse=True)
    which = which.ravel()  # by NumPy 2.0 it has the axes of what is compared
    order = np.argsort(which, kind="stable")
    counts = np.bincount(which)
    sets = -(-counts // SIDE)
    offsets = np.repeat(np.arange(len(apart)), sets)
    number = np.arange(len(offsets)) - np.repeat(np.cumsum(sets) - sets, sets)
    within = number[:, None] * SIDE + np.arange(SIDE)
    within = np.minimum(within, counts[offsets, None] - 1)
    firsts = np.cumsum(counts) - counts
    return pairs[order[firsts[offsets, None] + within]], offsets, apart


def _spots(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where pairs (..., 2), row and column, lie among tiles of the lower triangle."""
    tile, within = np.divmod(pairs, SIDE)
    number = tile[..., 0] * (tile[..., 0] + 1) // 2 + tile[..., 1]
    return number * SIZE + (within[..., 0] * SIDE + within[..., 1]) * LANES


def _textures(
    possible: NDArray[np.bool_], lengths: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the textures that each group compares, their number, and the group's probes among
    them.

    possible: (group, disparity). Textures (group, texture) count disparities of the first length,
    then of the next; what is beyond a group's number repeats its last.
    """
    disparities = possible.shape[1]
    counts = possible.sum(axis=1)
    ordered = np.argsort(~possible, axis=1, kind="stable")
    at = np.arange(lengths * counts.max())[None]
    length, rank = np.divmod(np.minimum(at, lengths * counts[:, None] - 1), counts[:, None])
    textures = length * disparities + np.take_along_axis(ordered, rank, axis=1)
    # The middle one first: most patches' disparities are nearest to it.
    order = np.argsort(np.abs(np.arange(PROBES) - PROBES // 2), kind="stable") + 1
    probes = np.rint(order * (counts[:, None] - 1) / (PROBES + 1)).astype(np.int64)
    return textures, lengths * counts, probes


def _trials(lengths: int, kinds: int, kept: int | None) -> NDArray[np.int64]:
    """Return (trial, 3): length, probe and rank of the kinds that are tried one after the other."""
    if kept is None:
        numbers = np.full((lengths, PROBES), kinds)
    else:
        numbers = np.full((lengths, PROBES), min(-(-kept // 2), kinds))
        numbers[0] = min(kept, kinds)
        numbers[0, 0] = kinds if kept else 0
    tried = [(*at, rank) for at, number in np.ndenumerate(numbers) for rank in range(number)]
    return np.array(tried, dtype=np.int64).reshape(-1, 3)


def patch_evidence(
    residual: Readings,
    brightness: Array,
    corners: NDArray[np.int64],
    places: NDArray[np.int64],
    disparities: NDArray[np.floating],
    prior: TexturePrior,
    possible: NDArray[np.bool_] | None = None,
    kinds: NDArray[np.int64] | None = None,
) -> PatchEvidence:
    """Return how well textures at these disparities explain each patch.

    residual: readings less those of the smooth picture. brightness: (patch,), of that picture; sets
    the amplitudes' scale. corners: (patch, 2) pixels, places: (reading, 3), see `EvidencePatches`.
    possible: (patch, disparity), those to evaluate (default all): LANES patches in a row share a
    group, which evaluates every disparity possible for any patch of it. kinds: (patch, length) of
    texture, where known.
    """
    psi, count = residual.psi, len(corners)
    if possible is None:
        possible = np.ones((count, len(disparities)), dtype=bool)
    padded = np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
    groups = possible[padded].reshape(-1, LANES, len(disparities))
    asked = np.logical_or.reduce(groups, axis=1)
    used = np.logical_or.reduce(asked, axis=0)
    waves, separations, back = _spectrum(psi.light_field_shape[:2], psi.binning)
    pairs, offsets, pixels_apart = _sets(places[:, None, 1:] - places[None, :, 1:])
    lengths = [replace(prior, length_px=length) for length in (prior.length_px, *prior.finer_px)]
    evaluated = np.flatnonzero(used)
    tables = np.empty((len(pixels_apart), len(lengths), len(evaluated), len(waves)), np.float32)

    def tabulate(number: int) -> None:
        apart = pixels_apart[:, None] * psi.binning + separations[:, :2]
        apart = apart - float(disparities[evaluated[number]]) * separations[:, 2:]
        square_px = np.square(apart).sum(axis=-1)
        for length, texture in enumerate(lengths):
            tables[:, length, number] = texture.covariance(square_px) @ back

    textures, counts, probes = _textures(asked[:, used], len(lengths))
    out = np.full((len(padded), len(lengths) * len(evaluated)), -np.inf, dtype=np.float32)
    known = np.zeros((count, len(lengths)), dtype=np.int64) if kinds is None else kinds
    chosen = known[padded]
    amplitudes, chromas = np.array(prior.kinds, dtype=np.float32).T.copy()
    given = Hypotheses(
        psi.weights,
        psi.colour_map,
        residual.usable,
        np.asarray(residual.frames, np.float32),
        np.asarray(residual.noise, np.float32),
        places,
        psi.binning,
        waves,
        pairs,
        _spots(pairs),
        offsets,
        tables.reshape(len(pixels_apart), -1, len(waves)),
        amplitudes,
        chromas,
        _trials(len(lengths), len(prior.kinds), prior.kept if kinds is None else 0),
        np.float32(prior.freedom),
        np.empty(0, dtype=np.int64),
    )
    alike = _alike(psi)
    scales = np.square(brightness).astype(np.float32)[padded]

    def evaluate(first: int) -> None:
        groups = slice(first, first + GROUPS)
        lanes = slice(first * LANES, (first + GROUPS) * LANES)
        shared = np.unique(textures[groups]) if alike else given.shared
        evidence(
            given._replace(shared=shared),
            corners[padded[lanes]],
            scales[lanes],
            textures[groups],
            counts[groups],
            probes[groups],
            out[lanes],
            chosen[lanes],
        )

    with ThreadPoolExecutor(get_num_threads()) as pool:
        list(pool.map(tabulate, range(len(evaluated))))
        list(pool.map(evaluate, range(0, len(asked), GROUPS)))
    each = out[:count].reshape(count, len(lengths), -1)
    mean = np.full((count, len(disparities)), -np.inf, dtype=np.float32)
    mean[:, used] = np.logaddexp.reduce(each, axis=1) - np.float32(np.log(len(lengths)))
    likeliest = each.max(axis=-1).argmax(axis=1)
    return PatchEvidence(mean, chosen[:count], chosen[np.arange(count), likeliest])
