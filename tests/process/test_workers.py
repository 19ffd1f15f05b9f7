"""Blocks on workers: the same bytes whoever computes them, and whatever is killed."""

import errno
import json
import os
import signal
import subprocess
import time
from itertools import count
from pathlib import Path

import h5py
import numba
import numpy as np
import pytest
import yaml
from fuzzing import FUZZ
from pools import Here, StoppedHereError, children
from programs import PROGRAM, program

from emmc_rig.commands.simulate import simulate_into
from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.lightfield import load_hdf5
from emmc_rig.process import block_tasks
from emmc_rig.process.captures import opened_capture
from emmc_rig.process.cost import parse_memory
from emmc_rig.process.reconstructing import load_settings, reconstruct_undrawn
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.store.folders import result_folder

CAMERA, SIZE, SCENE = "rgbw-bayer-1shot", (64, 80), "deep-occlusions"
BLOCKS = {"blocks": {"whole": 1000, "side": 32, "blend": 4}, "tv": {"max_steps": 20}}
KILLS = 2 * FUZZ


@pytest.fixture(scope="module", autouse=True)
def threads():
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with two captures, settings that make six blocks, and the result of one process."""
    folder = tmp_path_factory.mktemp("blocks")
    for name, seed in (("frames", 0), ("others", 1)):
        (folder / name).mkdir()
        simulate_into(folder / name, SCENE, CAMERA, find_camera(CAMERA), SIZE, seed)
    (folder / "blocks.yaml").write_text(yaml.safe_dump(BLOCKS))
    here(folder, "alone")
    return folder


def here(folder, out, pool=None, frames="frames", settings="blocks.yaml", method="tv", **more):
    """Reconstruct in this process; return the metrics."""
    with result_folder(folder / out, "reconstruct", resumes=True) as new:
        return reconstruct_undrawn(
            opened_capture(folder / frames), new, method, settings=load_settings(folder / settings),
            pool=pool or Here(), **more,
        )[0]  # fmt: skip


def reconstructed(folder, out, *more, frames=("frames",)):
    return program(
        "reconstruct", *(folder / name for name in frames), "--method", "tv",
        "--settings", folder / "blocks.yaml", "--out", folder / out, *more,
    )  # fmt: skip


def content(folder):
    return (folder / "light_field.h5").read_bytes()


@pytest.mark.slow
def test_results_are_byte_identical_in_any_order(place):
    metrics = here(place, "backwards", Here(backwards=True))
    assert metrics["blocks"] == [2, 3]
    assert content(place / "backwards") == content(place / "alone")


def test_the_truth_and_the_verdict_cover_all_blocks(place):
    metrics = here(place, "compared", truth=SCENE)
    assert 10 < metrics["psnr_db"] < 40
    assert metrics["verdict"]["features"]["kept"] > 30
    assert content(place / "compared") == content(place / "alone")


def test_the_seconds_of_blocks_are_those_from_the_first_to_the_last(place, monkeypatch):
    """A clock that a second passes on whenever it is read: before all blocks, and after them."""
    monkeypatch.setattr(block_tasks, "running_s", count().__next__)
    metrics = here(place, "timed", Here())
    assert metrics["blocks"] == [2, 3]
    assert metrics["seconds"] == 1


@pytest.mark.slow
def test_blocks_state_the_psnr_that_their_deviations_stand_for(place):
    (place / "wide.yaml").write_text(yaml.safe_dump({"blocks": {"whole": 1000, "side": 64}}))
    metrics = here(place, "stated", settings="wide.yaml", method="adaptive-fast")
    assert metrics["blocks"] == [1, 2]
    with h5py.File(place / "stated/maps.h5") as maps:
        sigma = np.asarray(maps["sigma"], dtype=np.float64)
    # The map is blended between blocks, the sum is of each block's own part.
    expected = -10 * np.log10(np.mean(np.square(sigma)))
    tails, within = (metrics["parameters"][f"stated_{name}_db"] for name in ("tails", "within"))
    assert metrics["stated_db"] == pytest.approx(expected - tails, abs=0.3)
    low, high = metrics["stated_interval_db"]
    assert (high - low) / 2 == pytest.approx(within)
    assert within > 1
    row, column = metrics["stated_worst_at"]
    around = np.square(sigma[:, :, row - 12 : row + 12, column - 12 : column + 12]).mean()
    assert metrics["stated_worst_db"] == pytest.approx(-10 * np.log10(around) - tails, abs=0.3)
    assert metrics["stated_worst_db"] < metrics["stated_db"]
    assert (high + low) / 2 == pytest.approx(metrics["stated_db"])
    assert json.loads((place / "alone/metrics.json").read_text())["stated_db"] is None


@pytest.mark.slow
def test_several_captures_share_processes_and_a_bad_one_does_not_stop_the_others(place):
    (place / "bad").mkdir()
    code, out, _ = reconstructed(place, "all", "--workers", 2, frames=("frames", "bad", "others"))
    assert code == 1
    assert "holds no frames.h5" in out
    assert content(place / "all/frames") == content(place / "alone")
    assert content(place / "all/others") != content(place / "alone")
    metrics = json.loads((place / "all/frames/metrics.json").read_text())
    assert 0.05 < metrics["peak_gib"] < 1
    assert not (place / "all/bad").exists()


@pytest.mark.slow
def test_a_capture_of_one_block_comes_out_as_without_workers(place):
    (place / "none.yaml").write_text(yaml.safe_dump({"tv": BLOCKS["tv"]}))
    here(place, "shared", settings="none.yaml", method="adaptive-fast")
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)  # pyright: ignore
    with result_folder(place / "one", "reconstruct") as new:
        settings = load_settings(place / "none.yaml")
        capture = opened_capture(place / "frames")
        reconstruct_undrawn(capture, new, "adaptive-fast", settings=settings)
    alone, shared = (load_hdf5(place / out / "light_field.h5") for out in ("one", "shared"))
    np.testing.assert_array_equal(alone, shared)


def command(place, out, *more):
    return subprocess.Popen(
        [
            *PROGRAM, "reconstruct", str(place / "frames"), "--method", "tv", "--settings",
            str(place / "blocks.yaml"), "--out", str(place / out), *map(str, more),
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def kept(place, out):
    return place / out / ".emmc-rig.partial/kept"


def wait_for(condition, process, steps=6000):
    """Return whether the condition came true before the process ended."""
    for _ in range(steps):
        if condition():
            return True
        if process.poll() is not None:
            return False
        time.sleep(0.01)
    raise AssertionError("nothing happened")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for processes in /proc")
def test_killed_at_any_time_the_same_command_goes_on_to_the_same_bytes(place):
    """Every run but the last of a result is killed; KILLS in all."""
    rng = np.random.default_rng(KILLS)
    kills = finished = resumed = 0
    while kills < KILLS or kept(place, f"killed-{finished}").exists():
        out = f"killed-{finished}"
        before = done_blocks(place, out)
        resumed += before > 0
        running = command(place, out, "--workers", 1)
        if kills < KILLS:
            after = before + int(rng.integers(0, 3))
            if wait_for(lambda out=out, after=after: done_blocks(place, out) >= after, running):
                time.sleep(float(rng.uniform(0, 0.2 if after else 2)))
                workers = children(running.pid)
                if rng.random() < 0.3 and workers:
                    os.kill(workers[-1], signal.SIGKILL)  # the command starts another
                    kills += 1
                else:
                    running.kill()
                    kills += running.wait() != 0
        _, err = running.communicate(timeout=300)
        assert "Traceback" not in err
        if running.returncode == 0:
            assert content(place / out) == content(place / "alone")
            assert not kept(place, out).exists()
            finished += 1
            print(f"{kills} kills, {finished} results, {resumed} runs went on from blocks kept")
        else:
            assert running.returncode == -signal.SIGKILL, err
    assert finished > 0
    assert resumed > KILLS / 4


def done_blocks(place, out):
    return len(list(kept(place, out).glob("block-*.h5")))


def stopped_after(place, out, blocks):
    """Reconstruct until so many blocks are done; return the folder that keeps them."""
    with pytest.raises(StoppedHereError):
        here(place, out, Here(stop_after=1 + blocks))
    found = sorted(kept(place, out).glob("block-*.h5"))
    assert len(found) == blocks
    return found


def test_blocks_that_are_done_are_not_computed_again(place):
    stopped_after(place, "stopped", 4)
    pool = Here()
    here(place, "stopped", pool)
    assert len(pool.done) == 2
    assert content(place / "stopped") == content(place / "alone")
    assert not kept(place, "stopped").exists()


@pytest.mark.slow
def test_blocks_that_were_damaged_on_the_disk_are_computed_again(place):
    found = stopped_after(place, "damaged", 4)
    content_of = bytearray(found[0].read_bytes())
    content_of[len(content_of) // 2] ^= 1
    found[0].write_bytes(content_of)
    found[1].write_bytes(found[1].read_bytes()[:5000])
    found[2].unlink()
    pool = Here()
    here(place, "damaged", pool)
    assert len(pool.done) == 5
    assert content(place / "damaged") == content(place / "alone")


def test_a_full_disk_is_reported_in_one_line_and_the_same_command_goes_on(place, monkeypatch):
    pool, written = Here(), block_tasks._write

    def write_arrays(path, arrays, about):
        if len(pool.done) == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return written(path, arrays, about)

    monkeypatch.setattr(block_tasks, "_write", write_arrays)
    with pytest.raises(AppError, match="No space left"):
        here(place, "full", pool)
    monkeypatch.undo()
    assert not (place / "full/light_field.h5").exists()
    again = Here()
    here(place, "full", again)
    assert len(again.done) == 4
    assert content(place / "full") == content(place / "alone")


def test_a_block_that_fails_is_named_and_the_others_are_kept(place, monkeypatch):
    pool, solved = Here(), block_tasks.solve_block

    def solve_block(*given):
        if len(pool.done) == 4:
            raise ReconstructionError("the frames hold values that are not finite: exclude them")
        return solved(*given)

    monkeypatch.setattr(block_tasks, "solve_block", solve_block)
    with pytest.raises(AppError, match=r"rows 0 to 32, columns 54 to 80 .* not finite"):
        here(place, "bad-block", pool)
    assert len(list(kept(place, "bad-block").glob("block-*.h5"))) == 2


@pytest.mark.slow
def test_blocks_of_other_frames_are_not_taken(place):
    stopped_after(place, "changed", 4)
    here(place, "changed", frames="others")
    here(place, "fresh", frames="others")
    assert content(place / "changed") == content(place / "fresh") != content(place / "alone")


@pytest.mark.parametrize(
    ("text", "count"), [("2GiB", 2**31), ("800MB", 8 * 10**8), ("1.5 gib", 3 * 2**29)]
)
def test_memory_is_read_with_its_unit(text, count):
    assert parse_memory(text) == count


def test_ceilings_and_places_that_cannot_be_are_reported_in_one_line(place):
    with pytest.raises(WrongUsageError, match="2GiB"):
        parse_memory("much")
    with pytest.raises(WrongUsageError, match="a unit"):
        parse_memory("2")
    code, _, err = reconstructed(place, "small", "--memory", "10MB")
    assert code == 1
    assert "set smaller blocks" in err
    code, _, err = reconstructed(place, "both", "--workers", 2, "--cluster", "tcp://localhost:1")
    assert code == 2
    assert not (place / "both").exists()
    code, _, err = reconstructed(place, "twice", frames=("frames", "frames"))
    assert code == 2
