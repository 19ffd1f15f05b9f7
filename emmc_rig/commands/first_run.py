"""The first run on a machine compiles kernels, in several processes, with a message.

Numba keeps compiled kernels on the disk, and each kernel is compiled by a single process: the other
processes wait for its machine code (`emmc_rig.model.compiling`). So this process runs the simulated
capture and the first kernels of the reconstruction, while other processes compile the later
kernels, the slowest first. All cores are busy until every kernel is compiled. The other processes
end with this process.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
from numba import get_num_threads
from numba.core import event
from numpy.typing import NDArray

from emmc_rig.commands.output import say
from emmc_rig.model.compiling import is_kept
from emmc_rig.model.frames import even_frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction import kernels
from emmc_rig.reconstruction.result import Progress

SIZE = (32, 40)
"""Of the light field that is compiled for: no kernel depends on it."""
NOISE = 0.002
PARTS = {
    "adaptive": ("variation", "fit", "search"),
    "adaptive-fast": ("variation", "fit", "search"),
}
"""By method, the groups of kernels that other processes compile: the slowest group first, last the
group that this process needs first. For a method without an entry they compile all its kernels."""

NOT_KEPT = "no folder to keep it is writable (set NUMBA_CACHE_DIR to one that is)"


@dataclass
class Helpers(event.Listener):
    """Other processes that compile, started when the first kernel is about to be.

    method: and then the other arguments of this module. ended: ends them when it is closed.
    """

    method: str
    arguments: Sequence[str]
    ended: ExitStack
    started: bool = field(default=False, init=False)

    def on_start(self, event: event.Event) -> None:
        """A kernel that the disk does not hold is about to be compiled."""
        if self.started:
            return
        self.started = True
        if not is_kept(kernels.__file__):
            say("note", f"compiling the methods, in every run: {NOT_KEPT}")
            return
        say("first run", "compiling the methods for this machine, once; later runs start at once")
        parts = PARTS.get(self.method, (self.method,))
        others = min(len(parts), get_num_threads() - 1)  # on one core they would only be in the way
        with suppress(OSError):  # no process more can be had
            for first in range(others):
                self._start(",".join(parts[first::others]))

    def _start(self, parts: str) -> None:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, parts, *self.arguments],
            stdin=subprocess.PIPE,  # closed when this process ends, however it does
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,  # what fails there fails here
        )
        self.ended.enter_context(process)
        self.ended.callback(process.kill)

    def on_end(self, event: event.Event) -> None:
        """Nothing: the kernel is compiled here."""


@contextmanager
def helped_to_compile(
    method: str, camera: str = "rgbw-bayer-1shot", shots: int | None = None
) -> Iterator[None]:
    """Have other processes compile, too, while a run reconstructs by this method and camera.

    Nearly all cameras need the same kernels.
    """
    arguments = (camera, *(() if shots is None else (str(shots),)))
    with (
        ExitStack() as ended,
        event.install_listener("numba:compile", Helpers(method, arguments, ended)),
    ):
        yield


def compile_for(part: str, camera: str, shots: int | None) -> None:
    """Reconstruct a small light field, or do that part of it: its kernels are compiled and kept."""
    import emmc_rig as emmc
    from emmc_rig.reconstruction.tv import few_steps

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
    elif part == "variation":
        few_steps(psi, frames, np.ones(frames.shape, dtype=bool), 0.01, count=1)
    elif part == "fit":
        _fit(psi, frames, near, texture)
    else:
        emmc.reconstruct(psi, frames, part)


def _search(psi: Psi, frames: NDArray[np.floating]) -> None:
    """Reconstruct as far as the first fit: search disparities, and start by total variation."""
    from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive

    class FitError(Exception):
        """The first step of a fit is done."""

    def stop(progress: Progress) -> None:
        if progress.step > 2:
            raise FitError

    with suppress(FitError):
        reconstruct_adaptive(psi, even_frames(frames, NOISE), on_step=stop)


def _fit(
    psi: Psi,
    frames: NDArray[np.floating],
    disparity: NDArray[np.floating],
    picture: NDArray[np.floating],
) -> None:
    """Fit surfaces of this disparity (y, x), sweep a plane with them and draw their views."""
    from emmc_rig.reconstruction.adaptive.joint import TextureSettings, solve
    from emmc_rig.reconstruction.adaptive.sweep import plane_frames

    precision = np.full(psi.frames_shape, NOISE**-2, dtype=np.float32)
    scene = solve(psi, disparity, 1, frames, precision, picture, TextureSettings())
    margin = (scene.texture.shape[1] - SIZE[0]) // 2
    plane_frames(psi, scene.clean, 0.0, margin)
    scene.surfaces.light_field(scene.texture)


def _end_with_parent() -> None:
    """End this process when its parent ends: standard input closes then."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for named in sys.argv[1].split(","):
        compile_for(named, sys.argv[2], int(sys.argv[3]) if sys.argv[3:] else None)
