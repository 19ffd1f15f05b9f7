"""The first run on a machine: compiling is said once, and done by other processes meanwhile."""

import sys

from numba import njit

from emmc_rig.commands import first_run


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


def test_the_first_kernel_compiled_starts_processes_that_the_solver_waits_for(monkeypatch, capsys):
    recorder, started = Recorder(), []
    monkeypatch.setattr(
        first_run.subprocess, "Popen", lambda typed, **_: started.append(typed) or recorder
    )

    @njit
    def twice(x):
        return x + x

    with first_run.compiled_ahead(recorder, "adaptive", "rgbw-mono", 2) as watcher:
        watcher.begin("scene", None)
        assert (twice(2), twice(2.5)) == (4, 5.0)
        watcher.step("one")
        watcher.begin("reconstruct", None)
    assert started == [
        [sys.executable, "-m", "emmc_rig.commands.first_run", method, "rgbw-mono", "2"]
        for method in ("adaptive", "tv")
    ]
    assert recorder.seen == [
        "scene", "step one", "compile", "waited", "waited", "reconstruct", "killed", "waited",
        "killed", "waited",
    ]  # fmt: skip
    assert capsys.readouterr().err.count("compiling kernels for this machine, once") == 1


def test_a_run_that_compiles_nothing_starts_nothing(monkeypatch):
    recorder = Recorder()
    monkeypatch.setattr(first_run.subprocess, "Popen", lambda typed, **_: 1 / 0)
    with first_run.compiled_ahead(recorder, "adaptive", "rgbw-mono", None) as watcher:
        watcher.begin("reconstruct", None)
    assert recorder.seen == ["reconstruct"]
