"""A ceiling of memory: refused with the one that works, and kept by all processes together."""

import json
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import yaml
from pools import children, held_bytes
from programs import PROGRAM

from emmc_rig.commands.simulate import simulate_into
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.store.pool import Ceiling, Processes, WorkersError

CAMERA, SIZE = "rgbw-bayer-1shot", (64, 80)
MIB = 2**20
LINUX = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="limits data, by Linux")


def test_as_many_workers_run_as_fit_beside_the_program():
    ceiling = Ceiling(1000 * MIB, 400 * MIB)
    assert [ceiling.workers(need * MIB) for need in (600, 301, 300, 100)] == [1, 1, 2, 6]
    assert ceiling.share(3) == 200 * MIB
    with pytest.raises(AppError, match=r"1000 MiB: .* need 1001 MiB; allow 1001MiB"):
        ceiling.workers(600 * MIB + 1)


WITHOUT_A_LIMIT_OF_THE_SYSTEM = """
import sys, time
import numpy as np, psutil
from emmc_rig.model.memory_limit import held_bytes, limit_memory
sys.platform = "darwin"
limit_memory(held_bytes() + 100 * 2**20, "too large")
kept = [np.ones(5 * 2**20)]
time.sleep(0.2)
print("40 MiB are held", flush=True)
kept.append(np.ones(20 * 2**20))
time.sleep(60)
"""


def test_a_process_that_exceeds_its_limit_ends_where_the_system_has_none():
    typed = [sys.executable, "-c", WITHOUT_A_LIMIT_OF_THE_SYSTEM]
    ended = subprocess.run(typed, capture_output=True, text=True, timeout=50)
    assert (ended.returncode, ended.stderr) == (1, "too large\n")
    assert ended.stdout == "40 MiB are held\n"


@pytest.mark.slow
@LINUX
def test_a_task_that_needs_more_than_its_share_is_done_by_fewer_workers():
    pool = Processes(2, Ceiling(1200 * MIB, 0))
    try:
        done = list(pool.run(held_bytes, [MIB, 700 * MIB, 2 * MIB]))
        assert sorted(count for count, _ in done) == [MIB, 2 * MIB, 700 * MIB]
        assert pool.size == 1
        with pytest.raises(WorkersError, match="needs more memory than the 1200 MiB"):
            list(pool.run(held_bytes, [2000 * MIB]))
    finally:
        pool.end()


def test_workers_become_fewer_when_a_capture_needs_more():
    pool = Processes(4, Ceiling(1200 * MIB, 0))
    pool.fit(300 * MIB)
    assert pool.size == 4
    pool.fit(500 * MIB)
    pool.fit(100 * MIB)
    assert pool.size == 2
    with pytest.raises(AppError, match="1201MiB"):
        pool.fit(1201 * MIB)


def peaks_mib(process):
    """Return the peak of resident memory of a process and of each it starts, until it ends."""
    peaks, ended = {}, threading.Event()

    def look():
        while not ended.wait(0.02):
            for item in [process.pid, *children(process.pid)]:
                try:
                    status = Path(f"/proc/{item}/status").read_text()
                except OSError:
                    continue
                if found := re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE):
                    peaks[item] = int(found[1]) / 1024

    watch = threading.Thread(target=look)
    watch.start()
    _, err = process.communicate(timeout=300)
    ended.set()
    watch.join()
    return peaks, err


@pytest.mark.slow
@LINUX
def test_the_ceiling_that_a_refusal_names_works_and_is_kept(tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    simulate_into(frames, "deep-occlusions", CAMERA, find_camera(CAMERA), SIZE, 0)
    blocks = {"blocks": {"whole": 1000, "side": 32, "blend": 4}, "tv": {"max_steps": 5}}
    (tmp_path / "blocks.yaml").write_text(yaml.safe_dump(blocks))

    def started(memory):
        return subprocess.Popen(
            [
                *PROGRAM, "reconstruct", str(frames), "--method", "tv", "--settings",
                str(tmp_path / "blocks.yaml"), "--out", str(tmp_path / "out"), "--memory", memory,
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    refused = started("300MiB")
    _, err = refused.communicate(timeout=300)
    assert refused.returncode == 1
    least = re.search(r"allow (\d+)MiB", err)
    assert least is not None, err
    assert not (tmp_path / "out").exists()
    running = started(f"{least[1]}MiB")
    peaks, err = peaks_mib(running)
    assert running.returncode == 0, err
    assert sum(peaks.values()) < int(least[1])
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["workers"] == 1
    others = sorted(peak for pid, peak in peaks.items() if pid != running.pid)
    assert metrics["peak_gib"] * 1024 == pytest.approx(others[-1], rel=0.05)
    assert metrics["program_peak_gib"] * 1024 == pytest.approx(peaks[running.pid], rel=0.05)
