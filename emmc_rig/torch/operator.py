"""Psi as operations of PyTorch: forward, adjoint and exact per-pixel solves, all with gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from emmc_rig.model.errors import SensingError

if TYPE_CHECKING:
    from emmc_rig.model.sensing import Psi
    from emmc_rig.torch.views_physics import ViewsPhysics

SINGULAR = 1e-9
"""Relative to a block's largest eigenvalue, as which the others count as 0: equal shots leave 1e-16
of float32 weights, by the rounding of float64, and different shots 1e-4 or more."""


@dataclass(frozen=True, eq=False, repr=False)
class TorchPsi:
    """Psi in PyTorch: `psi(light_field)` are frames, with gradients of light field and weights.

        frames[s, i, j] = sum of weights[s, v, u, y, c, x] light_field[v, u, y, x, c]

    over views, colours and the samples of pixel (i, j). Light fields (..., v, u, y, x, 3) and
    frames (..., shot, pixel_y, pixel_x) may have leading axes, a batch. The device and the type are
    those of the weights; blocks of Psi Psi^T are float64.

    weights: (shot, v, u, y, stored colour, x). colour: (shot, y, x) int64, the colour stored
        there; None when three are stored. binning: a pixel sums binning x binning samples.
    """

    weights: Tensor
    colour: Tensor | None
    binning: int = 1

    @classmethod
    def of(cls, psi: Psi, device: Any = None) -> TorchPsi:
        """Return a copy of Psi."""
        colour = None if psi.colour is None else torch.tensor(psi.colour, device=device).long()
        return cls(torch.tensor(psi.weights, device=device), colour, psi.binning)

    @property
    def light_field_shape(self) -> tuple[int, ...]:
        """(v, u, y, x, 3)."""
        _, v, u, rows, _, columns = self.weights.shape
        return v, u, rows, columns, 3

    @property
    def frames_shape(self) -> tuple[int, ...]:
        """(shot, pixel_y, pixel_x)."""
        shots, _, _, rows, _, columns = self.weights.shape
        return shots, rows // self.binning, columns // self.binning

    def __repr__(self) -> str:
        return f"TorchPsi({self.light_field_shape} -> {self.frames_shape}, {self.weights.device})"

    def __call__(self, light_field: Tensor) -> Tensor:
        """Return the frames (..., shot, pixel_y, pixel_x) of a light field (..., v, u, y, x, 3)."""
        rows = _required(light_field, self.light_field_shape, "a light field").transpose(-1, -2)
        seen = [
            (weights * stored_colour(rows, self.colour, shot)).sum((-5, -4, -2))
            for shot, weights in enumerate(self.weights)
        ]
        return self._pixels(torch.stack(seen, -3))

    def adjoint(self, frames: Tensor) -> Tensor:
        """Return Psi^T frames, a light field (..., v, u, y, x, 3)."""
        samples = self._samples(_required(frames, self.frames_shape, "frames"))
        every = torch.zeros((), dtype=samples.dtype, device=samples.device)
        for shot, weights in enumerate(self.weights):
            rows = weights * samples[..., shot, None, None, :, None, :]
            if self.colour is not None:
                zeros = rows.new_zeros(*rows.shape[:-2], 3, rows.shape[-1])
                rows = zeros.scatter(-2, self.colour[shot][:, None].expand(rows.shape), rows)
            every = every + rows
        return every.transpose(-1, -2)

    @property
    def gram(self) -> Tensor:
        """The blocks of Psi Psi^T, (pixel_y, pixel_x, shot, shot), float64.

        They are computed once, or of weights that have gradients at every use.
        """
        return self._blocks() if self.weights.requires_grad else self._kept_blocks

    @cached_property
    def _kept_blocks(self) -> Tensor:
        return self._blocks()

    def _blocks(self) -> Tensor:
        rows = []
        for shot, weights in enumerate(self.weights.double()):
            products = (weights * self.weights).sum((1, 2, 4))  # (shot, y, x)
            if self.colour is not None:
                products = products * (self.colour[shot] == self.colour)
            rows.append(self._pixels(products).movedim(0, -1))
        return torch.stack(rows, -2)

    def solve(self, frames: Tensor, ridge: Any) -> Tensor:
        """Return (Psi Psi^T + diag(ridge))^-1 frames; ridge: above 0, broadcast to the frames."""
        by_pixel = _required(frames, self.frames_shape, "frames").double().movedim(-3, -1)
        spread = torch.as_tensor(ridge, dtype=torch.double, device=by_pixel.device)
        spread = spread.expand(frames.shape).movedim(-3, -1)
        if len(self.weights) == 1:  # many times faster than a solver for blocks
            solved = by_pixel / (self.gram[..., 0] + spread)
        else:
            blocks = self.gram + torch.diag_embed(spread)
            solved = torch.linalg.solve(blocks, by_pixel[..., None])[..., 0]
        return solved.movedim(-1, -3).to(frames.dtype)

    def pseudo_inverse(self, frames: Tensor) -> Tensor:
        """Return Psi^T (Psi Psi^T)^+ frames: of the light fields that fit best, that of least norm.

        It needs no iterations; shots may repeat each other, pixels may see nothing.
        """
        by_pixel = _required(frames, self.frames_shape, "frames").double().movedim(-3, -1)
        inverse = torch.linalg.pinv(self.gram, rtol=SINGULAR, hermitian=True)
        solved = (inverse @ by_pixel[..., None])[..., 0].movedim(-1, -3)
        return self.adjoint(solved.to(frames.dtype))

    def of_usable(self, usable: Any) -> TorchPsi:
        """Return Psi whose rows are 0 where `usable` (shot, pixel_y, pixel_x) is False."""
        kept = _required(torch.as_tensor(usable).to(self.weights), self.frames_shape, "usable")
        return replace(self, weights=self.weights * self._samples(kept)[:, None, None, :, None, :])

    def _pixels(self, samples: Tensor) -> Tensor:
        """Return the sums of every pixel's samples (..., y, x)."""
        k = self.binning
        return samples.unflatten(-2, (-1, k)).unflatten(-1, (-1, k)).sum((-3, -1))

    def _samples(self, pixels: Tensor) -> Tensor:
        """Return what every sample's pixel holds, (..., y, x)."""
        return pixels.repeat_interleave(self.binning, -2).repeat_interleave(self.binning, -1)


def stored_colour(rows: Tensor, colour: Tensor | None, shot: int) -> Tensor:
    """Return the stored colours (..., y, stored colour, x) of rows (..., y, 3, x) in a shot."""
    if colour is None:
        return rows
    return rows.gather(-2, colour[shot][:, None].expand(*rows.shape[:-2], 1, rows.shape[-1]))


def _required(tensor: Tensor, shape: tuple[int, ...], what: str) -> Tensor:
    """Return a tensor whose last axes have this shape; raises SensingError for another one."""
    if tensor.shape[-len(shape) :] != shape:
        raise SensingError(f"{what} of shape {tuple(tensor.shape)} given, Psi needs (..., {shape})")
    return tensor


def physics(psi: Psi | TorchPsi, usable: Any = None, **options: Any) -> ViewsPhysics:
    """Return Psi as a `LinearPhysics` of deepinv, its data steps exact.

    Images x are (batch, 3, view, y, x), readings y (batch, shot, pixel_y, pixel_x). To deepinv,
    views are a sequence of images: `deepinv.models.TimeAgnosticNet(denoiser)` denoises each view.

    Args:
        psi: the imaging matrix.
        usable: (shot, pixel_y, pixel_x), such as `frames.usable`: False where a reading is ignored.
        options: of deepinv's LinearPhysics, such as `noise_model`.

    Raises:
        SensingError: deepinv is not installed, or `usable` has another shape.
    """
    if find_spec("deepinv") is None:
        raise SensingError('a physics of deepinv needs deepinv: pip install "emmc-rig[torch]"')
    from emmc_rig.torch.views_physics import ViewsPhysics  # deepinv loads for seconds

    in_torch = psi if isinstance(psi, TorchPsi) else psi.to_torch()
    return ViewsPhysics(in_torch if usable is None else in_torch.of_usable(usable), **options)
