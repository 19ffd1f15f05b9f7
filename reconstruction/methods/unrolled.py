"""The method `unrolled`: a learned denoiser between exact data steps (extra `learned`)."""

from __future__ import annotations

from importlib import import_module, resources
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from emmc_rig.model.settings import Settings
from reconstruction.errors import ReconstructionError
from reconstruction.inputs import checked_inputs, checked_noise
from reconstruction.method import Given, Method
from reconstruction.result import Reconstruction, Status
from reconstruction.unrolled.weights import NetworkWeights

if TYPE_CHECKING:
    from reconstruction.methods import MethodSettings


class UnrolledSettings(Settings):
    """Which network."""

    weights: Path | None = Field(
        default=None, description="a file of `emmc-rig train --network`; None: the shipped one"
    )


def with_torch(module: str) -> ModuleType:
    """Return a module of `reconstruction.unrolled` that needs PyTorch, or say how to get that."""
    try:
        import_module("torch")
    except ImportError as fault:
        raise ReconstructionError(
            "'unrolled' needs PyTorch: pip install 'emmc-rig[learned]'"
        ) from fault
    return import_module(f"reconstruction.unrolled.{module}")


def shipped_weights() -> Path:
    """Return the file of the weights that come with the program."""
    return Path(str(resources.files("reconstruction.unrolled") / "any-psi.h5"))


def _solve(given: Given, settings: MethodSettings) -> Reconstruction:
    started, psi, network = given.clock(), given.psi, with_torch("network")
    typical, variance = checked_noise(psi, given.noise_sigma, given.usable)
    frames, usable = checked_inputs(psi, given.frames, typical, given.usable)
    path = settings.of(UnrolledSettings).weights or shipped_weights()
    weights = NetworkWeights.load(path)
    trained, views = weights.architecture.views, psi.light_field_shape[:2]
    if trained != views:
        raise ReconstructionError(
            f"{path.name}: a network for {trained[0]}x{trained[1]} views, Psi has "
            f"{views[0]}x{views[1]}: train one with `emmc-rig train --network`"
        )
    light_field = network.applied(weights, psi, frames, variance, usable)
    return Reconstruction(
        method="unrolled",
        light_field=np.clip(light_field, 0, 1),
        status=Status.CONVERGED,
        advice="",
        steps=weights.architecture.stages,
        objective=(),
        seconds=given.clock() - started,
        parameters={"noise_sigma": typical},
    )


METHODS = (
    Method(
        "unrolled",
        "a learned denoiser between exact data steps, Psi as an input",
        "scenes like the random worlds of its training, of the views that it was trained for",
        "stages (blocks 4.5 channels^2 + 160 channels) N operations",
        "to compare what learning buys; needs PyTorch",
        _solve,
        "unrolled",
        UnrolledSettings,
        package="torch",
    ),
)
