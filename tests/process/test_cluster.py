"""A Dask cluster computes the blocks: the same bytes as a local run, and faults in a line."""

import errno
import json
import os
import pickle
import subprocess
import sys
import threading
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from programs import program

from emmc_rig.commands.simulate import simulate_into
from emmc_rig.formats.cameras import find_camera
from emmc_rig.process import block_tasks
from emmc_rig.process.block_tasks import BlockJob, BlockTask
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.reconstructing import reconstruct_undrawn
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.method import BlockSettings
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.tiles import CaptureSurvey, Grid
from emmc_rig.reconstruction.tv import TVSettings
from emmc_rig.store import pool as pools
from emmc_rig.store.folders import result_folder
from emmc_rig.store.pool import WorkersError, opened_pool
from emmc_rig.study.stability.stability_study import StabilityStudy, stability_settings

pytestmark = pytest.mark.timing("workers that answer late are taken for lost")
CAMERA, SIZE, SCENE = "rgbw-bayer-1shot", (64, 80), "deep-occlusions"
SETTINGS = MethodSettings(
    blocks=BlockSettings(whole=1000, side=32, blend=4), tv=TVSettings(max_steps=20)
)


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers in this process, answering at an address."""
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None,
        protocol="tcp", host="127.0.0.1",
    ) as cluster:  # fmt: skip
        yield cluster


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(WorkersError, match=r"pip install 'emmc-rig\[cluster\]'"),
        opened_pool(1, "tcp://127.0.0.1:1"),
    ):
        pass


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_is_not_there_is_reported_in_one_line(monkeypatch, tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    monkeypatch.setattr(pools, "CONNECT_S", 0.2)
    for address in ("tcp://127.0.0.1:1", "nonsense"):
        code, _, err = program(
            "reconstruct", tmp_path, "--cluster", address, "--out", tmp_path / "out"
        )
        assert code == 1
        assert "no Dask scheduler answers there" in err
        assert "Traceback" not in err
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_gives_the_bytes_of_this_machine(cluster, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    simulate_into(frames, SCENE, CAMERA, find_camera(CAMERA), SIZE, 0)
    threads = numba.get_num_threads()
    with opened_pool(1, cluster.scheduler_address) as pool:
        assert pool.size == 2
        with result_folder(tmp_path / "there", "reconstruct", resumes=True) as new:
            capture = opened_capture(frames)
            metrics, _ = reconstruct_undrawn(capture, new, "tv", settings=SETTINGS, pool=pool)
    assert metrics["blocks"] == [2, 3]
    assert numba.get_num_threads() == threads
    with opened_pool(1) as pool, result_folder(tmp_path / "here", "reconstruct") as new:
        reconstruct_undrawn(opened_capture(frames), new, "tv", settings=SETTINGS, pool=pool)
    there, here = ((tmp_path / at / "light_field.h5").read_bytes() for at in ("there", "here"))
    assert there == here


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_shares_the_trials_of_a_sweep(cluster, tmp_path, monkeypatch):
    chosen = stability_settings(True, ["dark"], (32, 48), methods=("tv",), faults=("flicker",))
    monkeypatch.setattr(StabilityStudy, "write", lambda *_: None)
    ran = [StabilityStudy(chosen, tmp_path / name) for name in ("here", "there")]
    for study, address in zip(ran, (None, cluster.scheduler_address), strict=True):
        study.carry_out(Watcher(), cluster=address)
    for here, there in zip(*(study.curves for study in ran), strict=True):
        assert there.levels == pytest.approx(here.levels, abs=1e-3)


@pytest.mark.filterwarnings("ignore")
def test_workers_of_another_version_are_refused(cluster, monkeypatch):
    own = pools.fingerprint()

    def fingerprint():
        mine = threading.current_thread() is threading.main_thread()
        return own if mine else {**own, "emmc-rig": "0.1"}

    monkeypatch.setattr(pools, "fingerprint", fingerprint)
    with (
        pytest.raises(WorkersError, match=r"has emmc-rig 0\.1.*install the same"),
        opened_pool(1, cluster.scheduler_address),
    ):
        pass


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_full_disk_on_one_worker_is_one_line_and_the_same_command_goes_on(
    cluster, monkeypatch, tmp_path
):
    frames, settings = tmp_path / "frames", tmp_path / "blocks.yaml"
    frames.mkdir()
    simulate_into(frames, SCENE, CAMERA, find_camera(CAMERA), SIZE, 0)
    settings.write_text(SETTINGS.model_dump_json(exclude_unset=True))
    given = (
        "reconstruct", frames, "--method", "tv", "--settings", settings, "--out", tmp_path / "out",
        "--cluster", cluster.scheduler_address,
    )  # fmt: skip
    written, first = block_tasks._write, threading.Lock()

    def write_arrays(path, arrays, about):
        if path.name.startswith("block-") and first.acquire(blocking=False):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return written(path, arrays, about)

    monkeypatch.setattr(block_tasks, "_write", write_arrays)
    code, _, err = program(*given)
    assert (code, "No space left" in err, "Traceback" in err) == (1, True, False), err
    assert not (tmp_path / "out/light_field.h5").exists()
    code, _, err = program(*given)
    assert code == 0, err


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_is_killed_is_one_line(monkeypatch, tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    monkeypatch.setattr(pools, "CONNECT_S", 10.0)
    place = tmp_path / "scheduler.json"
    parts = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{part}", "--scheduler-file", str(place),
             *more, "--no-dashboard"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path,
        )
        for part, more in (
            ("scheduler", ("--port", "0", "--host", "127.0.0.1")),
            ("worker", ("--no-nanny", "--nthreads", "1", "--death-timeout", "60")),
        )
    ]  # fmt: skip
    try:
        while not place.exists():
            assert all(part.poll() is None for part in parts)
            time.sleep(0.05)
        with opened_pool(1, json.loads(place.read_text())["address"]) as pool:
            monkeypatch.setattr(vars(pool)["_client"], "_timeout", 0.5)
            done = pool.run(time.sleep, [0.0, 600.0])
            assert next(done)[0] == 0.0
            parts[0].kill()
            with pytest.raises(WorkersError, match=r"lost .*the same command goes on"):
                next(done)
    finally:
        for part in parts:
            part.kill()
            part.wait()


def test_arrays_do_not_travel_with_the_tasks():
    """A task is names and numbers: what 64 workers ask a scheduler for stays small."""
    job = BlockJob(Path("/kept"), Path("/psi.h5"), "adaptive", None, SETTINGS, 0.01, "0" * 64)
    block = Grid((8000, 6000), 2, 40, MethodSettings().blocks).block(3, 4)
    assert (
        len(pickle.dumps(BlockTask(job, CaptureSurvey.of_one_block(SETTINGS, 3), block))) < 10_000
    )
    assert np.prod([part.stop - part.start for part in block.outer]) > 10**5
