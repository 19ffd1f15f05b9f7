"""Psi, its proximal step and total variation in float64 through SciPy's sparse matrices.

Written from the formulas, not from the kernels: what the kernels are compared with.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
AXES = (3, 2, 1, 0)
"""Directions of the differences, x y u v, as axes of (v, u, y, x, c)."""


@dataclass(frozen=True, eq=False)
class Reference:
    """metric: (3, 3), turns colours into those whose differences count (see `reconstruct_tv`)."""

    psi: ImagingMatrix
    metric: NDArray[np.float64]

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """Psi as it is stored, in float64."""
        return self.psi.to_scipy().astype(np.float64).tocsr()

    @cached_property
    def differences(self) -> list[sparse.csr_array]:
        """Forward differences along x, y, u and v, 0 across the far border, of mixed colours."""
        shape = self.psi.light_field_shape
        found = []
        for axis in AXES:
            parts: list = [sparse.eye_array(n) for n in shape[:4]]
            step = np.eye(shape[axis], k=1) - np.eye(shape[axis])
            step[-1] = 0
            parts[axis] = sparse.csr_array(step)
            found.append(reduce(sparse.kron, [*parts, self.metric]).tocsr())
        return found

    def forward(self, light_field: Array) -> NDArray[np.float64]:
        """Return Psi light_field, (shot, pixel_y, pixel_x)."""
        flat = np.asarray(light_field, dtype=np.float64).ravel()
        return (self.matrix @ flat).reshape(self.psi.frames_shape)

    def adjoint(self, frames: Array) -> NDArray[np.float64]:
        """Return Psi^T frames, (v, u, y, x, c)."""
        flat = np.asarray(frames, dtype=np.float64).ravel()
        return (self.matrix.T @ flat).reshape(self.psi.light_field_shape)

    def _system(self, gamma: float) -> sparse.csc_array:
        matrix, readings = self.matrix, self.psi.shape[0]
        return sparse.csc_array(matrix @ matrix.T + sparse.eye_array(readings) / gamma)

    def data_step(self, light_field: Array, frames: Array, gamma: float) -> NDArray[np.float64]:
        """Return the proximal point of gamma / 2 |Psi z - frames|^2: the normal equations."""
        missed = self.forward(light_field) - np.asarray(frames, dtype=np.float64)
        return np.asarray(light_field, np.float64) - self.adjoint(
            splu(self._system(gamma)).solve(missed.ravel()).reshape(missed.shape)
        )

    def variation(self, light_field: Array) -> float:
        """Return the sum over samples of the length of their differences, colours together."""
        flat = np.asarray(light_field, dtype=np.float64).ravel()
        square = sum(np.square(one @ flat).reshape(-1, 3).sum(axis=1) for one in self.differences)
        return float(np.sqrt(square).sum())

    def steps(
        self, frames: Array, start: Array, mu: float, gamma: float, dual_step: float, relax: float
    ) -> Iterator[NDArray[np.float64]]:
        """Yield the light fields of over-relaxed primal-dual steps (Condat 2013, algorithm 3.1)."""
        matrix, shape = self.matrix, self.psi.light_field_shape
        now = np.asarray(start, dtype=np.float64).ravel()
        duals = [np.zeros(now.size) for _ in self.differences]
        data = np.asarray(frames, dtype=np.float64).ravel()
        factor = splu(self._system(gamma))
        while True:
            pulled = sum(one.T @ dual for one, dual in zip(self.differences, duals, strict=True))
            down = now - gamma * pulled
            new = down - matrix.T @ factor.solve(matrix @ down - data)
            ahead = 2 * new - now
            raised = [
                dual + dual_step * (one @ ahead)
                for one, dual in zip(self.differences, duals, strict=True)
            ]
            square = sum(np.square(one).reshape(-1, 3).sum(axis=1) for one in raised)
            shrink = np.repeat(1 / np.maximum(np.sqrt(square) / mu, 1), 3)
            duals = [
                relax * shrink * one + (1 - relax) * dual
                for one, dual in zip(raised, duals, strict=True)
            ]
            now = relax * new + (1 - relax) * now
            yield now.reshape(shape)
