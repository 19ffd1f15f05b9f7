"""A Dask cluster computes the blocks: the same bytes as a local run, and faults in a line."""

import json
import subprocess
import sys
import threading
import time

import numba
import pytest
from programs import program

from emmc_rig.commands.simulate import simulate_into
from emmc_rig.formats.cameras import find_camera
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.reconstructing import reconstruct_undrawn
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.method import BlockSettings
from emmc_rig.reconstruction.methods import MethodSettings
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
            with pytest.raises(WorkersError, match=r"lost .*run the same command again"):
                next(done)
    finally:
        for part in parts:
            part.kill()
            part.wait()
