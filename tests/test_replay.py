"""Replaying blocks: drawn from those measured, and never quicker than any schedule could be."""

import json

import pytest
import typer
from typer.testing import CliRunner

from emmc_rig.study.replay import Replayed, best_schedule_s, drawn_seconds, main, replayed


def test_tasks_are_drawn_from_those_measured():
    drawn = drawn_seconds([1.0, 2.0, 4.0], 300)
    assert len(drawn) == 300
    assert set(drawn) == {1.0, 2.0, 4.0}


def test_the_next_task_goes_to_the_worker_that_is_free_first():
    assert best_schedule_s([3, 1, 1, 1], 2) == 3
    assert best_schedule_s([1, 1, 1, 3], 2) == 4
    assert best_schedule_s([2, 2], 64) == 2


def test_computing_idling_and_scheduling_are_all_of_the_workers_time():
    found = Replayed(4, 8, computed_s=360, best_s=95, scheduler_s=5, replay_s=1)
    assert found.total_s == 100
    shares = found.efficiency, found.idle_share, found.scheduler_share
    assert shares == pytest.approx((0.9, 0.05, 0.05))


@pytest.mark.filterwarnings("ignore")
def test_a_replay_takes_at_least_the_tasks_time_and_leaves_none_out():
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    found = replayed([10.0] * 8, 5000, 4, speed_up=100)
    assert found.tasks == 8
    assert found.best_s == 20
    assert found.replay_s >= 0.2
    assert found.scheduler_s >= 0
    assert found.efficiency <= 1


@pytest.mark.filterwarnings("ignore")
def test_the_command_reads_the_metrics_of_a_reconstruction_in_blocks(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps({"block_cpu_seconds": [0.5, 0.6], "task_bytes": 4000}))
    app = typer.Typer()
    app.command()(main)
    given = [str(path), "--blocks", "8", "--workers", "4", "--seconds", "0.2"]
    out = CliRunner().invoke(app, given, catch_exceptions=False).stdout
    assert "8 blocks of 0.5" in out or "8 blocks of 0.6" in out
    assert "4 workers: 0.0 min, efficiency 0." in out
    path.write_text("{}")
    refused = CliRunner().invoke(app, given, catch_exceptions=False)
    assert (refused.exit_code, "states no blocks" in refused.output) == (1, True)
