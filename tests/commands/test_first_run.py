"""The first run on a machine: compiling is said once, and done by another process first."""

import sys

from numba import njit

from emmc_rig.commands import first_run
from reconstruction import kernels
from reconstruction.adaptive import evidence, rays


class Recorder:
    """A watcher, and a second process, that keep what happens to them in order."""

    def __init__(self):
        self.seen = []

    def begin(self, stage, steps):
        self.seen.append(stage)

    def step(self, detail):
        self.seen.append(f"step {detail}")

    def wait(self):
        self.seen.append("waited")

    def kill(self):
        self.seen.append("killed")


def test_the_first_kernel_compiled_waits_for_another_process(monkeypatch, capsys):
    recorder, started = Recorder(), []
    monkeypatch.setattr(
        first_run.subprocess, "Popen", lambda typed, **_: started.append(typed) or recorder
    )

    @njit
    def twice(x):
        return x + x

    with first_run.compiled_first(recorder, "adaptive", "rgbw-mono", 2):
        recorder.begin("scene", None)
        assert (twice(2), twice(2.5)) == (4, 5.0)
        recorder.begin("reconstruct", None)
    command = [sys.executable, "-m", "emmc_rig.commands.first_run", "adaptive", "rgbw-mono", "2"]
    assert started == [command]
    assert recorder.seen == ["scene", "compile", "waited", "killed", "waited", "reconstruct"]
    assert capsys.readouterr().err.count("compiling kernels for this machine, once") == 1


def test_a_run_that_compiles_nothing_starts_nothing(monkeypatch):
    monkeypatch.setattr(first_run.subprocess, "Popen", lambda typed, **_: 1 / 0)
    with first_run.compiled_first(Recorder(), "adaptive", "rgbw-mono", None):
        pass


def test_the_other_process_runs_the_kernels_of_search_and_fit(monkeypatch):
    ran = set()

    def note(module, kernel):
        real = getattr(module, kernel)
        monkeypatch.setattr(module, kernel, lambda *given: ran.add(kernel) or real(*given))

    for module, kernel in ((evidence, "evidence"), (kernels, "_sweep_band"), (rays, "_render")):
        note(module, kernel)
    first_run.compile_for("adaptive", "rgbw-bayer-3shots", 2)
    assert ran == {"evidence", "_sweep_band", "_render"}
