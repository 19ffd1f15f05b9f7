"""The method `unrolled`: a learned denoiser between exact data steps, Psi as an input (PyTorch)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.method import Given, Method, cost_words
from emmc_rig.reconstruction.result import Reconstruction, Status
from emmc_rig_unrolled.weights import NetworkWeights

if TYPE_CHECKING:
    from emmc_rig.reconstruction.methods import MethodSettings

SHIPPED = Path(__file__).with_name("any-psi.h5")


class UnrolledSettings(Settings):
    """Which network."""

    weights: Path | None = Field(
        default=None,
        description="a file of `benchmarks/train_network.py`; None: the one that comes with it",
    )


def _solve(given: Given, settings: MethodSettings) -> Reconstruction:
    # PyTorch takes seconds to import, which a command with another method need not wait for.
    from emmc_rig_unrolled.network import estimated

    started, psi = time.perf_counter(), given.psi
    known = Readings.of(psi, given.frames)
    path = settings.of(UnrolledSettings).weights or SHIPPED
    weights = NetworkWeights.load(path)
    trained, views = weights.architecture.views, psi.light_field_shape[:2]
    if trained != views:
        raise ReconstructionError(
            f"{path.name}: a network for {trained[0]}x{trained[1]} views, Psi has "
            f"{views[0]}x{views[1]}: train one with `benchmarks/train_network.py`"
        )
    light_field = estimated(weights, psi, known.frames, known.noise, known.usable)
    return Reconstruction(
        method="unrolled",
        light_field=np.clip(light_field, 0, 1),
        status=Status.CONVERGED,
        advice="",
        steps=weights.architecture.stages,
        objective=(),
        seconds=time.perf_counter() - started,
        parameters={"noise_sigma": known.typical},
    )


METHODS = (
    Method(
        "unrolled",
        "a learned denoiser between exact data steps, Psi as an input",
        "scenes like the random worlds of its training, of the views that it was trained for",
        cost_words(0.14, 0.17),
        "to compare what learning buys; needs PyTorch",
        _solve,
        "unrolled",
        UnrolledSettings,
        package="torch",
    ),
)
