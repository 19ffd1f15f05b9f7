"""The first run on a machine compiles kernels: it says so, and another process compiles first.

Numba keeps what it compiled on the disk, so that what one process compiled another loads. When this
process needs a first kernel, another one reconstructs a small light field by the same method.

This process waits for it: machine code depends on whether what a kernel calls was compiled or
loaded, and a process that compiled itself would compute with other code than the disk has for later
runs, whose results then differ.
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


@dataclass
class CompileFirst(event.Listener):
    """Lets another process compile when the first kernel is about to be.

    watcher: is shown the stage. arguments: of this module.
    """

    watcher: Watcher
    arguments: Sequence[str]
    done: bool = field(default=False, init=False)

    def on_start(self, event: event.Event) -> None:
        """A kernel that the disk does not hold is about to be compiled."""
        if self.done:
            return
        self.done = True
        say("first run", "compiling kernels for this machine, once; later runs start at once")
        self.watcher.begin("compile", None)
        quiet = subprocess.DEVNULL  # Ctrl-C reaches it too, and what fails there fails here
        command = [sys.executable, "-m", __name__, *self.arguments]
        process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
        try:
            process.wait()
        finally:
            process.kill()
            process.wait()

    def on_end(self, event: event.Event) -> None:
        """Nothing: the kernel is compiled here."""


@contextmanager
def compiled_first(watcher: Watcher, method: str, camera: str, shots: int | None) -> Iterator[None]:
    """Have kernels compiled before a run that reconstructs by this method and camera needs them."""
    arguments = (method, camera, *(() if shots is None else (str(shots),)))
    with event.install_listener("numba:compile", CompileFirst(watcher, arguments)):
        yield


def compile_for(method: str, camera: str, shots: int | None) -> None:
    """Reconstruct a small light field: the method's kernels are compiled and kept."""
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
    emmc.reconstruct(psi, psi @ light_field, method)


if __name__ == "__main__":
    compile_for(sys.argv[1], sys.argv[2], int(sys.argv[3]) if sys.argv[3:] else None)
