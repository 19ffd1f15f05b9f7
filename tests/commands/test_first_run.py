"""The first run on a machine: compiling is said once, and done by other processes first."""

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


def test_the_first_kernel_compiled_waits_for_other_processes(monkeypatch, capsys):
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
    assert started == [
        [sys.executable, "-m", "emmc_rig.commands.first_run", part, "rgbw-mono", "2"]
        for part in ("search", "fit")
    ]
    assert recorder.seen == [
        "scene", "compile", *2 * ["waited"], *2 * ["killed", "waited"], "reconstruct",
    ]  # fmt: skip
    assert capsys.readouterr().err.count("compiling kernels for this machine, once") == 1


def test_a_run_that_compiles_nothing_starts_nothing(monkeypatch):
    monkeypatch.setattr(first_run.subprocess, "Popen", lambda typed, **_: 1 / 0)
    with first_run.compiled_first(Recorder(), "adaptive", "rgbw-mono", None):
        pass


def test_a_method_of_other_parts_is_compiled_by_one_process(monkeypatch):
    started = []
    monkeypatch.setattr(
        first_run.subprocess, "Popen", lambda typed, **_: started.append(typed[3:]) or Recorder()
    )

    @njit
    def half(x):
        return x / 2

    with first_run.compiled_first(Recorder(), "dict-omp", "rgbw-mono", None):
        assert half(3.0) == 1.5
    assert started == [["dict-omp", "rgbw-mono"]]


def test_each_part_runs_the_kernels_that_it_is_named_after(monkeypatch):
    ran = []

    def note(module, kernel):
        real = getattr(module, kernel)
        monkeypatch.setattr(module, kernel, lambda *given: ran.append(kernel) or real(*given))

    for module, kernel in (
        (evidence, "evidence"), (kernels, "_sweep_band"), (rays, "_render"),
    ):  # fmt: skip
        note(module, kernel)
    done = {}
    for part in first_run.PARTS["adaptive"]:
        first_run.compile_for(part, "rgbw-bayer-3shots", 2)
        done[part] = set(ran)
        ran.clear()
    assert done == {
        "search": {"evidence", "_sweep_band"}, "fit": {"_render"},
    }  # fmt: skip
