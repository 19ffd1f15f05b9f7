"""Machine code kept on the disk is never older than any of its sources."""

import ast
import fcntl
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emmc_rig.model import compiling

ROOT = Path(__file__).parents[2]
PACKAGES = ("emmc_rig", "drivers", "calibration", "reconstruction", "simulators")
RENDER = """
import numpy as np
from emmc_rig.reconstruction.adaptive import rays
out = np.zeros((1, 1, 4, 6, 1), np.float32)
texture = np.arange(192, dtype=np.float32).reshape(1, 12, 16)
rays._render(np.full((1, 1, 4, 6), 0.3, np.float32), texture, 4, 0, 4, out)
kept = rays._render.stats.cache_hits
print(out.sum(), sum(kept.values()), rays._render.stats.cache_path)
"""
RECONSTRUCT = """
import hashlib
import numpy as np
import emmc_rig as emmc
from emmc_rig.reconstruction.adaptive import rays
psi = emmc.camera("scenario-ii-cfa").psi((48, 64))
frames = psi @ emmc.scene("near-planar", size=(48, 64))
frames += np.float32(0.01) * np.random.default_rng(0).standard_normal(frames.shape, np.float32)
found = emmc.reconstruct(psi, frames, "adaptive-fast", noise_sigma=0.01)
digest = int(hashlib.sha256(found.light_field.tobytes()).hexdigest()[:12], 16)
kept = rays._render.stats.cache_hits
print(digest, sum(kept.values()), rays._render.stats.cache_path)
"""


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """The package, copied to where a test may change them, without machine code."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    source = tmp_path / "source"
    shutil.copytree(
        ROOT / "emmc_rig", source / "emmc_rig", ignore=shutil.ignore_patterns("__pycache__")
    )
    return source


def run(source, program=RENDER):
    """Return what a program prints in a new process: here a sum, 1 if kept code ran, its folder."""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=source, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    total, kept, folder = done.stdout.split()
    return float(total), int(kept), Path(folder)


def edit(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


@pytest.mark.slow
def test_a_helper_changed_in_another_file_changes_what_kernels_compute(copied, monkeypatch):
    before, kept, _ = run(copied)
    assert kept == 0
    assert run(copied)[:2] == (before, 1)
    edit(
        copied / "emmc_rig/reconstruction/adaptive/lanes.py",
        "(0.0, 1.0, 0.0, 0.0)",
        "(0.0, 1.3, 0.0, 0.0)",
    )
    after = run(copied)[0]
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(copied / "empty"))
    anew, kept, folder = run(copied)
    assert kept == 0
    assert copied / "empty" in folder.parents
    assert after == anew != before


@pytest.mark.slow
def test_where_the_folder_beside_the_source_is_not_writable_the_users_keeps_the_code(copied):
    blocked = copied / "emmc_rig/reconstruction/adaptive/__pycache__"
    blocked.mkdir(exist_ok=True)
    (blocked / "kernels").write_text("no folder")
    before, _, folder = run(copied)
    assert copied.parent / "home" in folder.parents
    assert run(copied)[:2] == (before, 1)


def test_every_kernel_whose_file_imports_others_of_the_project_is_compiled_with_its_sources():
    plain = re.compile(r"^from numba import .*\bn?jit\b|\bnumba\.n?jit\b", re.MULTILINE)
    project = re.compile(r"^(from|import) +emmc_rig\b", re.MULTILINE)
    own = ROOT / "emmc_rig/model/compiling.py"
    for name in PACKAGES:
        for file in sorted(set((ROOT / name).rglob("*.py")) - {own}):
            text = file.read_text()
            assert not (plain.search(text) and project.search(text)), file


def kernels():
    """Yield file, syntax tree and decorators of every function that is compiled."""
    for name in PACKAGES:
        for file in sorted((ROOT / name).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.FunctionDef):
                    how = " ".join(map(ast.unparse, node.decorator_list))
                    if re.match(r"njit|row_kernel|_helper\b|_kernel\b", how):
                        yield file, node, how


def test_what_a_kernel_calls_is_compiled_into_it():
    """Else which of several copies of the machine code it calls depends on what was loaded first.

    `_helper` of the ray caster is an `njit` that does so.
    """
    every = list(kernels())
    names = {node.name for _, node, _ in every}
    called = {
        call.func.id
        for _, node, _ in every
        for call in ast.walk(node)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
    } & names
    assert {"cubic", "_dual_rows", "_texel"} <= called
    for file, node, how in every:
        if node.name in called:
            assert re.search(r"forceinline=True|inline='always'|_helper", how), (file, node.name)


KERNEL = """
from emmc_rig.model.compiling import njit

@njit(forceinline=True)
def half(x):
    return x / 2

@njit(cache=True)
def halves(values):
    total = 0.0
    for x in values:
        total += half(x)
    return total
"""
CALL = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from own_kernel import halves
print("ready", flush=True)
sys.stdin.readline()
assert halves(np.ones(6)) == 3
print(sum(halves.stats.cache_misses.values()))
"""


@pytest.fixture
def own_kernel(tmp_path, monkeypatch):
    """A module with a kernel of its own and no machine code yet."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(compiling._numba, "CACHE_DIR", "")
    file = tmp_path / "own_kernel.py"
    file.write_text(KERNEL)
    spec = importlib.util.spec_from_file_location("own_kernel", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def held(own_kernel):
    """The kernel's lock, held as if another process compiled the kernel."""
    line = own_kernel.halves.py_func.__code__.co_firstlineno
    folder = compiling._folder(Path(own_kernel.__file__), "")
    assert folder is not None
    with (folder / f"halves-{line}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield file


def test_of_two_processes_that_need_a_kernel_one_compiles_it(own_kernel, tmp_path):
    typed = [sys.executable, "-c", CALL, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    both: list[Any] = [subprocess.Popen(typed, cwd=ROOT, **pipes) for _ in range(2)]
    for item in both:
        assert item.stdout.readline() == "ready\n"
    for item in both:
        item.stdin.write("\n")
        item.stdin.flush()
    missed = [int(item.communicate(timeout=100)[0]) for item in both]
    assert sorted(missed) == [0, 1]


def test_a_kernel_that_another_process_compiles_is_waited_for(own_kernel, held):
    found = []
    waiting = threading.Thread(target=lambda: found.append(own_kernel.halves(np.ones(6))))
    waiting.start()
    waiting.join(0.3)
    assert not found
    fcntl.flock(held, fcntl.LOCK_UN)
    waiting.join(60)
    assert found == [3]


def test_a_process_that_never_ends_compiling_is_not_waited_for_forever(
    own_kernel, held, monkeypatch
):
    monkeypatch.setattr(compiling, "WAIT_S", 0.1)
    assert own_kernel.halves(np.ones(6)) == 3


def test_what_is_compiled_into_kernels_alone_says_so_when_it_is_called(own_kernel):
    assert own_kernel.halves(np.ones(6)) == 3
    with pytest.raises(TypeError, match="call its `py_func`"):
        own_kernel.half(1.0)
    assert own_kernel.half.py_func(1.0) == 0.5


@pytest.mark.slow
def test_the_process_that_compiles_computes_what_later_ones_load(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    totals, kept, _ = zip(*(run(ROOT, RECONSTRUCT) for _ in range(2)), strict=True)
    assert totals[0] == totals[1]
    assert kept[0] == 0 < kept[1]


def test_the_clock_stands_still_while_a_kernel_is_compiled():
    @compiling.njit
    def kernel(x):
        return x * 2 + 1

    started, running, compiled = time.perf_counter(), compiling.running_s(), compiling.compiling_s()
    assert kernel(3) == 7
    took_s = time.perf_counter() - started
    compiled = compiling.compiling_s() - compiled
    assert 0 < compiled <= took_s
    assert compiling.running_s() - running == pytest.approx(took_s - compiled, abs=0.01)
    before = compiling.compiling_s()
    assert kernel(4) == 9
    assert compiling.compiling_s() == before


def test_code_that_no_process_used_for_a_month_is_removed(tmp_path):
    file = tmp_path / "kernels.py"
    file.write_text("ONE = 1\n")
    for name, days in (("old", 31), ("recent", 29)):
        folder = tmp_path / "__pycache__" / "kernels" / name
        folder.mkdir(parents=True)
        then = time.time() - days * 86400
        os.utime(folder, (then, then))
    mine = compiling._folder(file, "")
    assert mine is not None
    assert {path.name for path in mine.parent.iterdir()} == {"recent", mine.name}
