"""The engine of the studies: what is measured, kept, recalled and left out; its CSV and pages."""

import csv
import io
import math
from dataclasses import dataclass

import pytest

from emmc_rig.errors import AppError, StoppedError
from emmc_rig.progress import Watcher
from emmc_rig.report.page import number
from emmc_rig.study.points import Journal, NotApplicableError, Study, study_folder
from emmc_rig.study.rows import csv_text, plain


@dataclass
class Squares(Study[int]):
    """Squares of numbers, tens together; a negative number has none."""

    noun = "numbers"

    def __post_init__(self):
        self.calls: list[list[int]] = []

    def planned(self):
        return [1, 12]

    def inputs(self, point):
        if point < 0:
            raise NotApplicableError("no root is negative")
        return {"size": abs(point) % 100}

    def group(self, point):
        return point // 10

    def measured(self, points):
        self.calls.append(list(points))
        for point in points:
            if point == 66:
                raise NotApplicableError("66 is unlucky")
            if point == 55:
                yield {"failed": "full", "keep": False}
            else:
                yield {"square": point * point, "missing": math.inf}


class Counted(Watcher):
    """Counts results, and presses Ctrl-C after some."""

    def __init__(self, patience=1000):
        self.total, self.steps, self.patience = 0, 0, patience

    def begin(self, stage, steps):
        self.total, self.steps = steps, 0

    def at(self, done, steps, detail=""):
        self.steps, self.total = done, steps
        if done == self.patience:
            raise KeyboardInterrupt


def test_points_are_measured_in_groups_and_recalled_in_their_order(tmp_path):
    first, watcher = Squares(None, tmp_path), Counted()
    results = first.run([3, 12, 1, 3], watcher)
    assert list(results) == [3, 12, 1]
    assert first.calls == [[3, 1], [12]]
    assert results[12] == {"square": 144, "missing": None}
    assert watcher.steps == watcher.total == 3
    again, watcher = Squares(None, tmp_path), Counted()
    assert again.run([1, 3, 12], watcher) == {1: results[1], 3: results[3], 12: results[12]}
    assert again.calls == []
    assert watcher.steps == watcher.total == 3


def test_points_of_one_digest_are_measured_once(tmp_path):
    study = Squares(None, tmp_path)
    results = study.run([7, 107], Watcher())
    assert study.calls == [[7]]
    assert results[107] == results[7]


def test_what_cannot_be_measured_is_left_out_and_the_others_are_not(tmp_path):
    study, watcher = Squares(None, tmp_path), Counted()
    results = study.run([-1, 65, 66, 67, 2], watcher)
    assert list(results) == [65, 2]
    assert study.left_out == dict.fromkeys((66, 67), "66 is unlucky") | {-1: "no root is negative"}
    assert watcher.steps == watcher.total == 4


def test_a_failure_that_may_pass_is_measured_again(tmp_path):
    for _ in range(2):
        study = Squares(None, tmp_path)
        study.run([55, 5], Watcher())
        assert [55] in study.calls
        assert study.failures() == ["55: full"]
    assert (tmp_path / "points.jsonl").read_text().count("\n") == 1


def test_ctrl_c_says_what_is_kept_and_closes_what_measures(tmp_path):
    closed = []

    class Closing(Squares):
        def measured(self, points):
            try:
                yield from super().measured(points)
            finally:
                closed.append(points)

    with pytest.raises(StoppedError, match="2 of 4 numbers are kept in"):
        Closing(None, tmp_path).run([1, 2, 3, 4], Counted(2))
    assert closed == [[1, 2, 3, 4]]
    study = Squares(None, tmp_path)
    assert len(study.run([1, 2, 3, 4], Watcher())) == 4
    assert study.calls == [[3, 4]]


def test_other_figures_of_a_point_are_another_digest(tmp_path, monkeypatch):
    Squares(None, tmp_path).run([1], Watcher())
    monkeypatch.setattr(Squares, "revision", 2)
    study = Squares(None, tmp_path)
    study.run([1], Watcher())
    assert study.calls == [[1]]


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    with pytest.raises(AppError, match="what was measured is kept: make room"):
        Squares(None, tmp_path / "missing").run([1], Watcher())


@pytest.mark.parametrize(
    ("fault", "error", "reported"),
    [
        (KeyboardInterrupt(), StoppedError, "run the same command again"),
        (OSError(28, "No space left on device"), AppError, "No space left"),
    ],
)
def test_a_stop_or_a_full_disk_while_the_page_is_written_keeps_what_is_measured(
    tmp_path, monkeypatch, fault, error, reported
):
    def failing(*_):
        raise fault

    monkeypatch.setattr(Squares, "report", failing)
    with pytest.raises(error, match=reported):
        Squares(None, tmp_path / "out").carry_out(Watcher())
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["points.jsonl"]
    study = Squares(None, tmp_path / "out")
    study.run([1, 12], Watcher())
    assert study.calls == []


def test_a_torn_line_is_ignored_and_the_next_one_stands_alone(tmp_path):
    path = tmp_path / "points.jsonl"
    journal = Journal(path, lambda digest: {})
    journal.add("a", {"psnr_db": 1.0})
    journal.add("b", {"psnr_db": 2.0})
    path.write_bytes(path.read_bytes()[:-9])
    torn = Journal(path, lambda digest: {})
    assert (torn.get("a"), torn.get("b")) == ({"psnr_db": 1.0}, None)
    torn.add("c", {"psnr_db": 3.0})
    again = Journal(path, lambda digest: {})
    assert again.get("c") == {"psnr_db": 3.0}
    assert again.get("a") == {"psnr_db": 1.0}


def test_a_full_disk_is_reported_and_nothing_is_lost(tmp_path, monkeypatch):
    add = Journal.add

    def filling(self, *arguments):
        if len(self) == 2:
            raise OSError(28, "No space left on device")
        return add(self, *arguments)

    study = Squares(None, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Journal, "add", filling)
        with pytest.raises(AppError, match=r"No space left.*run the same command again"):
            study.run(range(4), Watcher())
    assert len(Journal(tmp_path / "points.jsonl", lambda digest: {})) == 2
    assert len(study.run(range(4), Watcher())) == 4


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "cat.jpg").write_text("meow")
    for place, why in (
        (tmp_path, "something other"),
        (tmp_path / "cat.jpg", "a file of that name"),
    ):
        with pytest.raises(AppError, match=why), study_folder(place, "cells.jsonl", "tables"):
            pytest.fail("taken")
    assert [path.name for path in tmp_path.iterdir()] == ["cat.jpg"]


def test_rows_of_csv_are_quoted_and_unknown_values_are_empty():
    rows = [{"name": 'a "b", c', "db": 1 / 3, "on": True}, {"db": None, "more": 2.0}]
    read = list(csv.DictReader(io.StringIO(csv_text(rows, ["name", "db", "more"]))))
    assert read == [
        {"name": 'a "b", c', "db": "0.333333", "more": ""},
        {"name": "", "db": "", "more": "2"},
    ]


def test_a_result_is_kept_as_json_gives_it_back():
    assert plain({"a": (1, math.nan), "b": {2: -math.inf}}) == {"a": [1, None], "b": {"2": None}}


def test_a_figure_that_is_not_known_is_a_dash():
    assert [number(value, ".1f") for value in (1.25, None, math.nan)] == ["1.2", "–", "–"]
