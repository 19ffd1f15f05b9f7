"""The peer `deepinv-pnp`: deepinv's plug-and-play HQS, with its total variation denoiser.

Exact data steps of Psi and the denoiser of all epipolar images alternate, with noise levels that
fall from step to step.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.method import Given, Method
from emmc_rig.reconstruction.result import Reconstruction, Status

if TYPE_CHECKING:
    from emmc_rig.reconstruction.methods import MethodSettings


class DeepinvSettings(Settings):
    """Strength of the denoiser, first and last, and its iterations.

    Tried on 48x64 of dragons and buttercup, one shot: half the steps lose 3.5 and 0.0 dB, a first
    strength of 0.3 loses 0.2 and 0.0; views instead of epipolar images lose 0.4 and 0.6 (ADMM, 20
    steps).
    """

    steps: int = Field(default=60, ge=1)
    first_sigma: float = Field(default=1.0, gt=0)
    last_sigma: float = Field(default=0.02, gt=0)
    denoiser_steps: int = Field(default=8, ge=1)


def _solve(given: Given, settings: MethodSettings) -> Reconstruction:
    # PyTorch and deepinv take seconds to import, which a command without them need not wait for.
    import deepinv
    import torch

    from emmc_rig.torch import physics

    started, own, frames = time.perf_counter(), settings.of(DeepinvSettings), given.frames
    operator = physics(given.psi, usable=frames.usable)
    readings = torch.tensor(frames.readings, dtype=torch.float32)[None]
    even = torch.ones_like(operator.A_adjoint(readings))
    even *= readings.sum() / (operator.A(even) * torch.tensor(frames.usable)).sum()
    views = given.psi.light_field_shape[:2]
    denoiser = deepinv.models.TimeAgnosticNet(
        deepinv.models.TVDenoiser(n_it_max=own.denoiser_steps)
    )

    def denoised(x: torch.Tensor, strength: torch.Tensor) -> torch.Tensor:
        for order in ((0, 1, 2, 4, 3, 5), (0, 1, 3, 5, 2, 4)):  # images (u, x), then (v, y)
            slices = x.unflatten(2, views).permute(order)
            smooth = denoiser(slices.flatten(2, 3), strength).reshape(slices.shape)
            x = smooth.permute(*np.argsort(order).tolist()).flatten(2, 3)
        return x

    sigmas = np.geomspace(own.first_sigma, own.last_sigma, own.steps)
    solver = deepinv.optim.HQS(
        data_fidelity=deepinv.optim.L2(),
        prior=deepinv.optim.PnP(denoised),
        g_param=sigmas.tolist(),
        stepsize=((sigmas / frames.noise_sigma) ** 2).tolist(),
        max_iter=own.steps,
        custom_init=lambda *_: even,
    )
    with torch.no_grad():
        light_field = operator.light_field(solver(readings, operator))[0].numpy()
    return Reconstruction(
        method="deepinv-pnp",
        light_field=np.clip(light_field, 0, 1),
        status=Status.CONVERGED,
        advice="",
        steps=own.steps,
        objective=(),
        seconds=time.perf_counter() - started,
        parameters={"noise_sigma": frames.noise_sigma},
    )


METHODS = (
    Method(
        "deepinv-pnp",
        "deepinv's plug-and-play with total variation of epipolar images",
        "smooth areas with sharp edges, small disparities",
        "about 9 CPU s for 64x80 pixels from one shot",
        "to compare with another library; needs deepinv",
        _solve,
        "deepinv_pnp",
        DeepinvSettings,
        package="deepinv",
    ),
)
