"""The network in PyTorch: stages of denoiser and exact data step, the denoiser's weights shared.

A stage takes the estimate x to z = x + D(x, Psi^T r, coverage, noise), r being the frames' residual
and D a convolutional denoiser, and z to the light field that explains the frames best near z:

    x = z + Psi^T (Psi Psi^T + var / tau^2)^-1 (I - Psi z)

var is the readings' variance, tau the deviation of z's error, learned for every stage. Psi Psi^T is
one small block per pixel, so the data step is exact. D works on 2x2 samples as channels: 3x3
convolutions within every view, alike in all of them, alternate with mixing the views of every
channel. Psi enters as data only, so one set of weights serves any Psi of these views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.problem import smooth_guess
from emmc_rig.torch import TorchPsi
from emmc_rig_unrolled.weights import Architecture, NetworkWeights

Array = NDArray[np.floating]
INPUTS = 13
"""Channels of a sample that the denoiser sees: estimate, Psi^T of the solved residual, Psi^T Psi's
diagonal, the first guess, and noise."""
LEAK = 0.2
SCALE = 5.0
"""By which what differs from the guess is multiplied, so that the denoiser sees values about 1."""
UNUSED = 1e6
"""Variance of readings that are not to be used, where white is 1."""


@dataclass(frozen=True)
class Capture:
    """What a network reconstructs from, with the views as a batch, brightness about 1.

    psi: in PyTorch. frames, variance: (shot, pixel_y, pixel_x). guess: (colour, y, x). brightness:
    by which frames were divided.
    """

    psi: TorchPsi
    frames: Tensor
    variance: Tensor
    guess: Tensor
    brightness: float

    def forward(self, light_field: Tensor) -> Tensor:
        """Return the frames of a light field (view, colour, y, x)."""
        return self.psi(light_field.unflatten(0, self.psi.light_field_shape[:2]).movedim(2, -1))

    def adjoint(self, frames: Tensor) -> Tensor:
        """Return Psi^T frames, (view, colour, y, x)."""
        return by_view(self.psi.adjoint(frames))

    def solved(self, frames: Tensor, spread: Tensor) -> Tensor:
        """Return (Psi Psi^T + var / spread^2)^-1 frames."""
        return self.psi.solve(frames, self.variance / spread**2 + 1e-6)


def by_view(light_field: Tensor) -> Tensor:
    """Return a light field (v, u, y, x, colour) as (view, colour, y, x)."""
    return light_field.flatten(0, 1).movedim(-1, 1)


def captured(psi: Psi, frames: Array, variance: Array, usable: NDArray[np.bool_]) -> Capture:
    """Return a capture as the network takes it; arrays as every method gets them."""
    guess = smooth_guess(psi, frames, usable)
    brightness = max(float(guess.mean()), 1e-9)
    var = np.where(usable, variance / brightness**2, UNUSED)
    in_torch = psi.to_torch()
    return Capture(
        replace(in_torch, weights=in_torch.weights.float()),
        torch.from_numpy(np.where(usable, frames / brightness, 0)).float(),
        torch.from_numpy(var).float(),
        torch.from_numpy(guess / brightness).float().permute(2, 0, 1).contiguous(),
        brightness,
    )


class ViewMixing(nn.Module):
    """Every channel's views as mixtures of all its views.

    Before training, every second channel gains its mean over the views; the rest gain nothing.
    """

    def __init__(self, views: int, channels: int) -> None:
        super().__init__()
        matrices = torch.zeros(channels, views, views)
        matrices[::2] = 1 / views
        self.matrices = nn.Parameter(matrices)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (view, channel, y, x)."""
        by_channel = features.transpose(0, 1).flatten(2)
        mixed = torch.bmm(self.matrices, by_channel).view(features.transpose(0, 1).shape)
        return features + mixed.transpose(0, 1)


class Block(nn.Module):
    """A residual block: within every view, then between views."""

    def __init__(self, views: int, channels: int) -> None:
        super().__init__()
        self.spatial = nn.Conv2d(channels, channels, 3, padding=1)
        self.between = ViewMixing(views, channels)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (view, channel, y, x)."""
        return features + self.between(F.leaky_relu(self.spatial(features), LEAK))


class Unrolled(nn.Module):
    """The network; `forward` yields the light field after each stage, (view, colour, y, x)."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        a = self.architecture = architecture
        views = prod(a.views)
        self.enter = nn.Conv2d(4 * INPUTS + a.channels, a.channels, 3, padding=1)
        self.between = ViewMixing(views, a.channels)
        self.blocks = nn.ModuleList(Block(views, a.channels) for _ in range(a.blocks))
        self.leave = nn.Conv2d(a.channels, 12, 3, padding=1)
        nn.init.normal_(self.leave.weight, std=1e-2)
        nn.init.zeros_(self.leave.bias)  # pyright: ignore[reportArgumentType]
        self.log_spread = nn.Parameter(torch.linspace(np.log(0.2), np.log(0.05), a.stages + 1))

    def forward(self, capture: Capture) -> list[Tensor]:
        """Return the light field after each stage; brightness as the capture's."""
        rows, columns = capture.guess.shape[1:]
        views = prod(capture.psi.light_field_shape[:2])
        pad = 0, columns % 2, 0, rows % 2
        spread = self.log_spread.exp()
        guess = capture.guess.expand(views, -1, -1, -1)
        x, fixed = guess, self._fixed(capture, guess, spread[0])
        hidden = torch.zeros(())
        stages = []
        for stage in range(self.architecture.stages):
            residual = capture.solved(capture.frames - capture.forward(x), spread[stage])
            seen = torch.cat([SCALE * (x - guess), SCALE * capture.adjoint(residual), fixed], 1)
            seen = F.pixel_unshuffle(F.pad(seen, pad, mode="replicate"), 2)
            if stage == 0:
                hidden = seen.new_zeros(views, self.architecture.channels, *seen.shape[2:])
            hidden = F.leaky_relu(self.enter(torch.cat([seen, hidden], 1)), LEAK)
            hidden = self.between(hidden)
            for block in self.blocks:
                hidden = block(hidden)
            change = F.pixel_shuffle(self.leave(hidden), 2)[:, :, :rows, :columns]
            z = x + change / SCALE
            residual = capture.solved(capture.frames - capture.forward(z), spread[stage + 1])
            x = z + capture.adjoint(residual)
            stages.append(x)
        return stages

    @staticmethod
    def _fixed(capture: Capture, guess: Tensor, spread: Tensor) -> Tensor:
        """Return what of the input is the same in all stages: coverage, guess, noise."""
        norm = capture.psi.gram.diagonal(dim1=2, dim2=3).permute(2, 0, 1).float()
        inverse = 1 / (norm + capture.variance / spread.detach() ** 2 + 1e-6)
        k = capture.psi.binning
        noise = (capture.variance.clamp(max=1) * inverse).mean(0, keepdim=True).sqrt()
        noise = noise.repeat_interleave(k, 1).repeat_interleave(k, 2)
        squares = replace(capture.psi, weights=capture.psi.weights**2)
        coverage = by_view(squares.adjoint(inverse))
        noise = SCALE * noise.expand(len(guess), 1, -1, -1)
        return torch.cat([coverage, guess - 1, noise], 1)


def estimated(
    weights: NetworkWeights,
    psi: Psi,
    frames: Array,
    variance: Array,
    usable: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return the light field (v, u, y, x, c) that a network estimates.

    Raises ReconstructionError for arrays that are not those of the architecture.
    """
    network = Unrolled(weights.architecture)
    state = {name: torch.from_numpy(array) for name, array in weights.arrays.items()}
    try:
        network.load_state_dict(state)
    except RuntimeError as fault:
        raise ReconstructionError("the network's arrays do not fit its architecture") from fault
    capture = captured(psi, frames, variance, usable)
    with torch.no_grad():
        light_field = capture.brightness * network(capture)[-1]
    return light_field.permute(0, 2, 3, 1).reshape(psi.light_field_shape).numpy()
