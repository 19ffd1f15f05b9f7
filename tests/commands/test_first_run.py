"""The first run on a machine: compiling is said once, and other processes help and end with it."""

import os
import subprocess
import sys

import pytest
from numba import njit
from programs import done, wait_until

from emmc_rig.commands import first_run
from emmc_rig.process import reconstructing
from emmc_rig.reconstruction import kernels
from emmc_rig.reconstruction.adaptive import evidence, rays

SLEEPS = "import time; time.sleep(600)"


@pytest.fixture
def started(monkeypatch):
    """Sleeping processes in place of the helpers on other cores; four cores."""
    real, processes = subprocess.Popen, []

    def start(typed, **options):
        processes.append((typed, real([sys.executable, "-c", SLEEPS], **options)))
        return processes[-1][1]

    monkeypatch.setattr(first_run.subprocess, "Popen", start)
    monkeypatch.setattr(first_run, "get_num_threads", lambda: 4)
    return processes


def parts(started):
    return [typed[3:] for typed, _ in started]


def test_other_processes_compile_meanwhile_and_end_with_the_run(started, capsys):
    @njit
    def twice(x):
        return x + x

    with first_run.helped_to_compile("adaptive", "rgbw-mono", 2):
        assert not started
        assert (twice(2), twice(2.5)) == (4, 5.0)
        assert [process.poll() for _, process in started] == [None] * 3
    assert all(process.poll() is not None for _, process in started)
    assert parts(started) == [[part, "rgbw-mono", "2"] for part in first_run.PARTS["adaptive"]]
    assert capsys.readouterr().err.count("compiling the methods for this machine, once") == 1


def test_reconstruct_says_that_it_compiles(monkeypatch, tmp_path, run):
    asked = []
    monkeypatch.setattr(first_run.Helpers, "_start", lambda self, parts: asked.append(parts))

    @njit
    def fourth(x):
        return x / 4

    def compiled(*given, **more):
        fourth(3.0)
        return []

    monkeypatch.setattr(reconstructing, "reconstruct_captures", compiled)
    done(run("simulate", "--size", "32x40", "--out", tmp_path / "frames"))
    _, _, err = run("reconstruct", tmp_path / "frames", "--method", "tv")
    assert err.count("compiling the methods for this machine, once") == 1
    assert asked == ["tv"]


@pytest.mark.parametrize(
    ("cores", "asked"), [(1, []), (2, ["variation,fit,search"]), (3, ["variation,search", "fit"])]
)
def test_as_many_processes_help_as_cores_are_free(started, monkeypatch, cores, asked):
    monkeypatch.setattr(first_run, "get_num_threads", lambda: cores)

    @njit
    def third(x):
        return x / 3

    with first_run.helped_to_compile("adaptive", "rgbw-mono", None):
        assert third(3.0) == 1
    assert parts(started) == [[part, "rgbw-mono"] for part in asked]


def test_a_run_that_fails_leaves_no_process(started):
    @njit
    def half(x):
        return x / 2

    def stopped():
        with first_run.helped_to_compile("dict-admm", "rgbw-mono", None):
            half(3.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert parts(started) == [["dict-admm", "rgbw-mono"]]
    assert started[0][1].poll() is not None


def test_a_run_that_compiles_nothing_starts_nothing(started):
    with first_run.helped_to_compile("adaptive", "rgbw-mono", None):
        pass
    assert not started


def test_where_nothing_is_kept_that_is_said_and_no_process_is_started(started, monkeypatch, capsys):
    monkeypatch.setattr(first_run, "is_kept", lambda file: False)

    @njit
    def fifth(x):
        return x / 5

    with first_run.helped_to_compile("adaptive", "rgbw-mono", None):
        assert fifth(5.0) == 1
    assert not started
    assert "in every run: no folder to keep it" in capsys.readouterr().err


def test_where_no_process_can_be_started_the_run_compiles_alone(monkeypatch):
    def refuse(*typed, **options):
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(first_run.subprocess, "Popen", refuse)
    monkeypatch.setattr(first_run, "get_num_threads", lambda: 2)

    @njit
    def fourth(x):
        return x / 4

    with first_run.helped_to_compile("adaptive", "rgbw-mono", None):
        assert fourth(4.0) == 1


def test_a_helper_ends_when_the_process_that_started_it_is_killed(tmp_path):
    """However that ends: the end of its input says so."""
    child = (
        "import os, sys, threading, time\n"
        "from emmc_rig.commands import first_run\n"
        "threading.Thread(target=first_run._end_with_parent, daemon=True).start()\n"
        "print(os.getpid(), flush=True)\n"
        "time.sleep(600)\n"
    )
    parent = (
        "import subprocess, sys, time\n"
        f"subprocess.Popen([sys.executable, '-c', {child!r}], stdin=subprocess.PIPE)\n"
        "time.sleep(600)\n"
    )
    killed = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True)
    assert killed.stdout is not None
    helper = int(killed.stdout.readline())
    os.kill(helper, 0)
    killed.kill()
    killed.communicate()

    def is_gone():
        try:
            os.kill(helper, 0)
        except ProcessLookupError:
            return True
        with open(f"/proc/{helper}/stat") as stat:
            return ") Z" in stat.read()

    wait_until(is_gone)


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
    assert done["fit"] == {"_render"}
    assert done["variation"] == {"_sweep_band"}
    assert done["search"] >= {"evidence"}
