"""The first run on a machine compiles kernels: it says so, and other processes compile ahead.

Numba keeps what it compiled on the disk, so that what one process compiled another loads. One
process reconstructs a small light field through the same camera by the same method while this one
still simulates the capture; another by `tv`, whose step is a late part of most methods.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numba.core import event

from emmc_rig.commands.output import say
from emmc_rig.progress import Watcher

SIZE = (48, 64)
"""Of the light field that is compiled for: no kernel depends on it."""
SOLVING = "reconstruct"
"""The stage before which the other processes must be done."""
STEP = "tv"
"""The method of the step alone: a quarter of what `adaptive` compiles."""


@dataclass
class Compiling(event.Listener):
    """A `Watcher` that starts the other processes when the first kernel is compiled.

    method: and then the other arguments of this module. watcher: is shown every stage.
    """

    watcher: Watcher
    method: str
    arguments: Sequence[str]
    ahead: list[subprocess.Popen] = field(default_factory=list, init=False)

    def on_start(self, event: event.Event) -> None:
        """A kernel that the disk does not hold is about to be compiled."""
        if not self.ahead:
            say("first run", "compiling kernels for this machine, once; later runs start at once")
            quiet = subprocess.DEVNULL  # Ctrl-C reaches it too, and what fails there fails here
            for method in dict.fromkeys((self.method, STEP)):
                command = [sys.executable, "-m", __name__, method, *self.arguments]
                self.ahead.append(
                    subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
                )

    def on_end(self, event: event.Event) -> None:
        """Nothing: the other processes go on."""

    def begin(self, stage: str, steps: int | None) -> None:
        """Wait for the kernels before the stage that needs them."""
        if stage == SOLVING and self.ahead:
            self.watcher.begin("compile", None)
            for one in self.ahead:
                one.wait()
        self.watcher.begin(stage, steps)

    def step(self, detail: str) -> None:
        """Pass it on."""
        self.watcher.step(detail)


@contextmanager
def compiled_ahead(
    watcher: Watcher, method: str, camera: str, shots: int | None
) -> Iterator[Watcher]:
    """Yield a watcher for a run that ends in a reconstruction by this method and camera."""
    compiling = Compiling(watcher, method, (camera, *(() if shots is None else (str(shots),))))
    with event.install_listener("numba:compile", compiling):
        try:
            yield compiling
        finally:
            for one in compiling.ahead:
                one.kill()
                one.wait()


def compile_for(method: str, camera: str, shots: int | None) -> None:
    """Reconstruct a small light field, so that every kernel of it is compiled and kept."""
    import emmc_rig as emmc

    described = emmc.camera(camera, shots)
    psi = described.psi(SIZE)
    texture = np.random.default_rng(0).random((*SIZE, 3), dtype=np.float32)
    near = np.s_[SIZE[0] // 3 :, SIZE[1] // 3 :]
    light_field = np.empty((*described.views, *texture.shape), np.float32)
    for v, u in np.ndindex(described.views):  # a near surface before a far one
        light_field[v, u] = texture
        light_field[v, u][near] = np.roll(texture, (v, u), axis=(0, 1))[near]
    emmc.reconstruct(psi, psi @ light_field, method)


if __name__ == "__main__":
    compile_for(sys.argv[1], sys.argv[2], int(sys.argv[3]) if sys.argv[3:] else None)
