"""Replaying blocks: drawn from those measured, and never quicker than any schedule could be."""

import pytest

from emmc_rig.study.replay import Replayed, drawn_seconds, greedy_s, replayed


def test_tasks_are_drawn_from_those_measured():
    drawn = drawn_seconds([1.0, 2.0, 4.0], 300)
    assert len(drawn) == 300
    assert set(drawn) == {1.0, 2.0, 4.0}


def test_the_next_task_goes_to_the_worker_that_is_free_first():
    assert greedy_s([3, 1, 1, 1], 2) == 3
    assert greedy_s([1, 1, 1, 3], 2) == 4
    assert greedy_s([2, 2], 64) == 2


def test_shares_follow_from_the_times():
    found = Replayed(4, 8, ideal_s=90, best_s=95, took_s=100)
    assert found.efficiency == pytest.approx(0.9)
    assert found.scheduler_share == pytest.approx(0.05)


@pytest.mark.filterwarnings("ignore")
def test_a_replay_takes_at_least_the_tasks_time_and_leaves_none_out():
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    found = replayed([10.0] * 8, 4, speed_up=100)
    assert found.tasks == 8
    assert found.took_s >= found.best_s == found.ideal_s == 20
    assert found.efficiency <= 1
