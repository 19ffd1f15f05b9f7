"""A coarse light field of frame after frame, quickly: blocks of samples taken as one.

Where a light field is constant over blocks of f x f samples, the (f/k)^2 pixels of a block are so
many readings of one coarse sample of every view and colour: Psi times the replication is again an
imaging matrix, of (f/k)^2 times the shots and 1/f^2 the samples, whose Psi Psi^T is one small block
per coarse sample. So the solver of `tv` applies as it is.

What varies within the blocks is taken from a picture at full size that all views share (Psi summed
over the views, by the same solver), and what it adds to the readings is subtracted first. Both
begin with the estimate and the dual variable of the frame before: what stands still converges over
several frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.problem import choose_mu
from emmc_rig.reconstruction.tv import Sweeps

Array = NDArray[np.floating]
PICTURE_NOISE, COARSE_NOISE = 0.1, 0.06
"""Of the mean reading: what the shared picture leaves to the views, and the blocks to each other.
Tried on three built-in scenes and three cameras at 192x256: half and double cost 0 to 1.5 dB."""


def coarser(psi: Psi, factor: int) -> Psi:
    """Return Psi of light fields that are constant over blocks of factor x factor samples.

    factor: a multiple of the binning. What is left of the picture beyond whole blocks is cut off.
    Its shots are the shots of Psi times the pixels of a block, row by row.
    """
    k = psi.binning
    if factor % k:
        raise ValueError(f"blocks of {factor} samples cut pixels of {k}: use a multiple of {k}")
    shots, views_v, views_u, rows, stored, columns = psi.weights.shape
    part = factor // k
    high, wide = rows // factor, columns // factor
    weights = psi.weights[:, :, :, : high * factor, :, : wide * factor]
    weights = weights.reshape(shots, views_v, views_u, high, part, k, stored, wide, part, k)
    weights = weights.sum(axis=(5, 9), dtype=psi.weights.dtype)
    weights = np.moveaxis(weights, (4, 7), (1, 2))
    colour = None
    if psi.colour is not None:
        colour = _grouped(psi.colour[:, ::k, ::k], part, high, wide)
    return Psi(
        np.ascontiguousarray(weights.reshape(-1, views_v, views_u, high, stored, wide)), colour
    )


def _grouped(frames: NDArray, part: int, high: int, wide: int) -> NDArray:
    """Return frames (shot, y, x) as those of the coarse Psi, (shot part part, high, wide)."""
    cut = frames[:, : high * part, : wide * part].reshape(-1, high, part, wide, part)
    return np.ascontiguousarray(cut.transpose(0, 2, 4, 1, 3).reshape(-1, high, wide))


class _Following:
    """Total variation of frame after frame by one Psi."""

    def __init__(self, psi: Psi, frames: Frames) -> None:
        self._data, self._usable = checked_inputs(psi, frames).readings, frames.usable
        mu = choose_mu(psi, self._data[self._usable], frames.noise_sigma)
        self.sweeps = Sweeps.usual(psi, self._data, self._usable, mu)

    def follow(self, frames: Array, steps: int) -> float:
        """Take these frames instead, do some steps; return the last one's relative change."""
        self._data[:] = np.where(self._usable, frames, 0)
        return self.sweeps.advance(steps)


class Preview:
    """A coarse light field that follows frames.

    psi: of the frames. factor: of samples along each axis that become one. The settings follow from
    the first frames, and so do the pixels used: a scene of another brightness wants another
    Preview.
    """

    def __init__(self, psi: Psi, factor: int, frames: Frames) -> None:
        readings, good = frames.readings, frames.usable
        coarse = coarser(psi, factor)
        self.size = coarse.size
        self._factor, self._part = factor, factor // psi.binning
        self._shared = psi.of_one_view()
        mean = float(np.mean(readings[good]))
        picture_noise, coarse_noise = (
            max(frames.noise_sigma, share * mean) for share in (PICTURE_NOISE, COARSE_NOISE)
        )
        self._picture = _Following(self._shared, even_frames(readings, picture_noise, good))
        self._coarse_psi = coarse
        cut = even_frames(self._cut(readings), coarse_noise, self._cut(good))
        self._coarse = _Following(coarse, cut)

    def _cut(self, frames: NDArray) -> NDArray:
        return _grouped(frames, self._part, *self.size)

    def follow(self, frames: Array, steps: int) -> float:
        """Take newer frames in place of the last ones, and do some steps of both estimates.

        Returns the relative change of the light field in the last step.
        """
        self._picture.follow(frames, steps)
        # What the shared picture varies by within blocks, (1, 1, y, colour, x).
        texture = self._picture.sweeps.planar.copy()
        high, wide = (count * self._factor for count in self.size)
        blocks = texture[0, 0, :high, :, :wide].reshape(
            self.size[0], self._factor, 3, self.size[1], self._factor
        )
        blocks -= blocks.mean(axis=(1, 4), keepdims=True)
        explained = self._shared.forward(np.ascontiguousarray(np.moveaxis(texture, -2, -1)))
        return self._coarse.follow(self._cut(frames - explained), steps)

    @property
    def light_field(self) -> NDArray[np.float32]:
        """The estimate so far, (v, u, y, x, c) in [0, 1], a copy."""
        light_field = self._coarse.sweeps.light_field
        self._coarse_psi.even_unseen_colours(light_field)
        return light_field
