"""The first run on a machine compiles kernels: it says so, and other processes compile first.

Numba keeps what it compiled on the disk, so that what one process compiled another loads. When this
process needs a first kernel, one other searches disparities in a small light field and one fits it:
each needs kernels that the other does not. Of a method that does neither, one process reconstructs.

This process waits for them, and then loads what they compiled: else it would compile the same.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from emmc_rig.commands.output import say
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.progress import Watcher
from reconstruction.result import Progress

SIZE = (48, 64)
"""Of the light field that is compiled for: no kernel depends on it."""
NOISE = 0.002
PARTS = {"adaptive": ("search", "fit"), "adaptive-fast": ("search", "fit")}
"""What the other processes do for a method; for one that is not here, the whole of it."""


@dataclass
class CompileFirst(event.Listener):
    """Lets other processes compile when the first kernel is about to be.

    method: and then the other arguments of this module. watcher: is shown the stage.
    """

    watcher: Watcher
    method: str
    arguments: Sequence[str]
    done: bool = field(default=False, init=False)

    def on_start(self, event: event.Event) -> None:
        """A kernel that the disk does not hold is about to be compiled."""
        if self.done:
            return
        self.done = True
        say("first run", "compiling kernels for this machine, once; later runs start at once")
        self.watcher.begin("compile", None)
        quiet = subprocess.DEVNULL  # Ctrl-C reaches them too, and what fails there fails here
        commands = [
            [sys.executable, "-m", __name__, part, *self.arguments]
            for part in PARTS.get(self.method, (self.method,))
        ]
        processes = [
            subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
            for command in commands
        ]
        try:
            for process in processes:
                process.wait()
        finally:
            for process in processes:
                process.kill()
                process.wait()

    def on_end(self, event: event.Event) -> None:
        """Nothing: the kernel is compiled here."""


@contextmanager
def compiled_first(watcher: Watcher, method: str, camera: str, shots: int | None) -> Iterator[None]:
    """Have kernels compiled before a run that reconstructs by this method and camera needs them."""
    arguments = (camera, *(() if shots is None else (str(shots),)))
    with event.install_listener("numba:compile", CompileFirst(watcher, method, arguments)):
        yield


def compile_for(part: str, camera: str, shots: int | None) -> None:
    """Reconstruct a small light field, or do that part of it: its kernels are compiled and kept."""
    import emmc_rig as emmc

    described = emmc.camera(camera, shots)
    psi = described.psi(SIZE)
    texture = np.random.default_rng(0).random((*SIZE, 3), dtype=np.float32)
    near = np.zeros(SIZE, dtype=np.float32)
    near[SIZE[0] // 3 :, SIZE[1] // 3 :] = 1
    light_field = np.empty((*described.views, *texture.shape), np.float32)
    for v, u in np.ndindex(described.views):  # a near surface before a far one
        light_field[v, u] = texture
        light_field[v, u][near > 0] = np.roll(texture, (v, u), axis=(0, 1))[near > 0]
    frames = psi @ light_field
    if part == "search":
        _search(psi, frames)
    elif part == "fit":
        _fit(psi, frames, near, texture)
    else:
        emmc.reconstruct(psi, frames, part)


def _search(psi: ImagingMatrix, frames: NDArray[np.floating]) -> None:
    """Reconstruct as far as the first fit: search disparities, and start by total variation."""
    from reconstruction.adaptive.method import reconstruct_adaptive

    class FitError(Exception):
        """The first step of a fit is done."""

    def stop(progress: Progress) -> None:
        if progress.step > 2:
            raise FitError

    with suppress(FitError):
        reconstruct_adaptive(psi, frames, NOISE, on_step=stop)


def _fit(
    psi: ImagingMatrix,
    frames: NDArray[np.floating],
    disparity: NDArray[np.floating],
    picture: NDArray[np.floating],
) -> None:
    """Fit surfaces of this disparity (y, x), sweep a plane with them and draw their views."""
    from reconstruction.adaptive.joint import TextureSettings, solve
    from reconstruction.adaptive.sweep import plane_frames

    precision = np.full(psi.frames_shape, NOISE**-2, dtype=np.float32)
    scene = solve(psi, disparity, 1, frames, precision, picture, TextureSettings())
    margin = (scene.texture.shape[1] - SIZE[0]) // 2
    plane_frames(psi, scene.clean, 0.0, margin)
    scene.surfaces.light_field(scene.texture)


if __name__ == "__main__":
    compile_for(sys.argv[1], sys.argv[2], int(sys.argv[3]) if sys.argv[3:] else None)
