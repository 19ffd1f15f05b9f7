"""Learning of the network's weights: Adam on the root mean square error, and a running average.

The average weighs the last tenth or so of the steps, so that training may end at any step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray
from torch import Tensor  # pyright: ignore[reportMissingImports]

from emmc_rig.model.files import whole_file
from emmc_rig.model.reading import one_line
from reconstruction.errors import ReconstructionError
from reconstruction.unrolled.network import Capture, Unrolled
from reconstruction.unrolled.weights import Architecture, NetworkWeights

RATE = 2e-3
"""Of Adam, after WARM_UP steps; it falls as 1 / sqrt(1 + step / SETTLED)."""
WARM_UP, SETTLED = 20, 1000
AVERAGED = 10.0
"""The average's share of a step is AVERAGED / (step + AVERAGED)."""
EARLIER = 0.1
"""Weight of the loss of the stages before the last, together."""
STEEPEST = 1.0
"""Norm to which gradients are cut."""


class Learner:
    """A network in training. losses_db: -10 log10 of the error of each step's example."""

    def __init__(self, architecture: Architecture, seed: int) -> None:
        torch.manual_seed(seed)
        self.network = Unrolled(architecture)
        self.average = {k: v.detach().clone() for k, v in self.network.named_parameters()}
        self.adam = torch.optim.Adam(self.network.parameters(), RATE)
        self.losses_db: list[float] = []

    @property
    def steps(self) -> int:
        """Steps done."""
        return len(self.losses_db)

    def step(self, capture: Capture, truth: Tensor) -> float:
        """Learn from one capture of a light field (view, colour, y, x); return its PSNR, dB."""
        rate = RATE * min(1, (self.steps + 1) / WARM_UP) / (1 + self.steps / SETTLED) ** 0.5
        for group in self.adam.param_groups:
            group["lr"] = rate
        *earlier, last = [
            (found - truth / capture.brightness).square().mean().sqrt()
            for found in self.network(capture)
        ]
        loss = last + EARLIER * sum(earlier) / max(1, len(earlier))
        self.adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), STEEPEST)
        self.adam.step()
        share = AVERAGED / (self.steps + AVERAGED)
        with torch.no_grad():
            for name, now in self.network.named_parameters():
                self.average[name].lerp_(now, share)
        self.losses_db.append(-20 * math.log10(capture.brightness * float(last.detach())))
        return self.losses_db[-1]

    def weights(self, provenance: str) -> NetworkWeights:
        """Return the averaged weights."""
        arrays: dict[str, NDArray[np.float32]] = {k: v.numpy() for k, v in self.average.items()}
        return NetworkWeights(self.network.architecture, arrays, provenance)

    def save(self, path: Path, purpose: Mapping[str, object]) -> None:
        """Write a checkpoint; `purpose`, plain data, says of what training."""
        state = {
            "purpose": json.dumps(purpose),
            "network": self.network.state_dict(),
            "average": self.average,
            "adam": self.adam.state_dict(),
            "losses_db": self.losses_db,
        }
        with whole_file(path) as partial:
            torch.save(state, partial)

    def load(self, path: Path, purpose: Mapping[str, object]) -> None:
        """Go on from a checkpoint; raises ReconstructionError for one of another training."""
        try:
            state = torch.load(path, weights_only=True)
            same = state["purpose"] == json.dumps(purpose)
            self.network.load_state_dict(state["network"])
            self.adam.load_state_dict(state["adam"])
            self.average, self.losses_db = state["average"], state["losses_db"]
        except Exception as fault:
            raise ReconstructionError(
                f"{path}: no checkpoint of this training ({one_line(fault)}); delete it"
            ) from fault
        if not same:
            raise ReconstructionError(
                f"{path}: of a training with other settings; give the same, or delete it"
            )
