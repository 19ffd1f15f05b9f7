"""Psi as a physics of deepinv: views as a sequence of images, data steps block by block."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from deepinv.physics import LinearPhysics
from torch import Tensor

from emmc_rig.torch.operator import TorchPsi


class ViewsPhysics(LinearPhysics):
    """A x = Psi x of images x (batch, 3, view, y, x), see `emmc_rig.torch.physics`.

    Psi Psi^T has one block per pixel: `A_dagger` and `prox_l2` need no iterations.
    """

    def __init__(self, psi: TorchPsi, **options: Any) -> None:
        v, u, rows, columns, colours = psi.light_field_shape
        super().__init__(img_size=(colours, v * u, rows, columns), **options)
        self._psi = psi
        self.register_buffer("weights", psi.weights)
        self.register_buffer("colour", psi.colour)

    @property
    def psi(self) -> TorchPsi:
        """Psi of the buffers, which `to` moves and `update` replaces."""
        if self._psi.weights is not self.weights:
            self._psi = replace(self._psi, weights=self.weights, colour=self.colour)
        return self._psi

    def light_field(self, x: Tensor) -> Tensor:
        """Return the light field (batch, v, u, y, x, 3) of images."""
        return x.unflatten(2, self.psi.light_field_shape[:2]).movedim(1, -1)

    def images(self, light_field: Tensor) -> Tensor:
        """Return the images (batch, 3, view, y, x) of a light field (batch, v, u, y, x, 3)."""
        return light_field.movedim(-1, 1).flatten(2, 3)

    def A(self, x: Tensor, **_: Any) -> Tensor:  # noqa: N802
        """Return the readings (batch, shot, pixel_y, pixel_x) without noise."""
        return self.psi(self.light_field(x))

    def A_adjoint(self, y: Tensor, **_: Any) -> Tensor:  # noqa: N802
        """Return Psi^T y."""
        return self.images(self.psi.adjoint(y))

    def A_dagger(self, y: Tensor, **_: Any) -> Tensor:  # noqa: N802
        """Return Psi^+ y, see `TorchPsi.pseudo_inverse`."""
        return self.images(self.psi.pseudo_inverse(y))

    def prox_l2(self, z: Any, y: Tensor, gamma: Any, **_: Any) -> Tensor:
        """Return the images x of least gamma/2 |A x - y|^2 + 1/2 |x - z|^2,

        z + Psi^T (Psi Psi^T + 1 / gamma)^-1 (y - Psi z).
        """
        if not isinstance(z, Tensor):
            z = torch.full_like(self.A_adjoint(y), z or 0.0)
        ridge = 1 / torch.as_tensor(gamma, dtype=torch.double).reshape(-1, 1, 1, 1)
        return z + self.A_adjoint(self.psi.solve(y - self.A(z), ridge))
