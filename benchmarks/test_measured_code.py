"""Rows are of other code once that code changes, and only then."""

import json
import subprocess
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import everything
import lab
import measured_code
import pytest
import results_page

from emmc_rig.study.design.bench import load_bench

BEFORE = '"""Words."""\n\nLIMIT = 3\n"""Of what."""\nif not LIMIT:\n    raise ValueError("no")\n'
BEFORE += 'NAME = "tv"\nprint(f"no limit: {LIMIT}")\nCOST = cost_words(1.4, 6.8)\n'


@pytest.fixture
def commit(tmp_path, monkeypatch):
    """The commit of a folder whose room has a module and a camera."""
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "one.py").write_text(BEFORE, "utf-8")
    (tmp_path / "room" / "camera.yaml").write_text("views: 5\n", "utf-8")
    monkeypatch.setattr(measured_code, "ROOT", tmp_path)
    measured_code.changed_since.cache_clear()
    who = "-c", "user.name=a", "-c", "user.email=a@b.c"
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-qm", "first"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    yield measured_code.commit_of_code(("room",))
    measured_code.changed_since.cache_clear()


@pytest.mark.parametrize(
    ("name", "text", "changed"),
    [
        ("one.py", BEFORE, ()),
        ("one.py", BEFORE.replace("Words", "Other words").replace("Of what", "Of all"), ()),
        ("one.py", BEFORE.replace("\n\nLIMIT", "\n\n# Three.\nLIMIT"), ()),
        ("one.py", BEFORE.replace('"no"', 'f"no {LIMIT}: raise it"'), ()),
        ("one.py", BEFORE.replace("no limit: {LIMIT}", "{LIMIT} is no limit"), ()),
        ("one.py", BEFORE.replace("1.4, 6.8", "0.48, 1.2"), ()),
        ("one.py", BEFORE.replace("{LIMIT}", "{-LIMIT}"), ("room/one.py",)),
        ("one.py", BEFORE.replace("tv", "adaptive"), ("room/one.py",)),
        ("one.py", BEFORE.replace("ValueError", "KeyError"), ("room/one.py",)),
        ("one.py", BEFORE.replace("3", "4"), ("room/one.py",)),
        ("camera.yaml", "views: 7\n", ("room/camera.yaml",)),
    ],
)
def test_words_may_change_and_code_may_not(commit, tmp_path, name, text, changed):
    (tmp_path / "room" / name).write_text(text, "utf-8")
    assert measured_code.changed_since(commit, ("room",)) == changed


def test_rows_of_changed_files_and_of_no_commit_count_as_changed(commit, tmp_path):
    (tmp_path / "room" / "one.py").write_text(BEFORE.replace("3", "4"), "utf-8")
    assert measured_code.commit_of_code(("room",)) == f"{commit}+"
    for unknown in (f"{commit}+", "", "0123456789"):
        assert measured_code.changed_since(unknown, ("room",)) == ("room",)


def test_a_file_is_stale_without_rows_and_with_rows_of_changed_code(commit, tmp_path, monkeypatch):
    monkeypatch.setattr(measured_code, "RESULTS", tmp_path)
    monkeypatch.setattr(measured_code, "FITTING", ("room",))
    assert measured_code.stale("table") == "not measured"
    (tmp_path / "table.csv").write_text(f"scene,commit\none,{commit}\n", "utf-8")
    assert measured_code.stale("table") == ""
    (tmp_path / "table.csv").write_text(f"scene,commit\none,{commit}\ntwo,\n", "utf-8")
    assert "1 rows are of code, which no commit here has" in measured_code.stale("table")


def test_a_stopped_run_goes_on_and_is_of_this_code_when_it_has_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(measured_code, "RESULTS", tmp_path)
    monkeypatch.setattr(measured_code, "changed_since", lambda *given: ())
    monkeypatch.setattr(lab, "changed_since", lambda *given: ())
    args, points, measured = SimpleNamespace(out=tmp_path, jobs=1), [{"at": 1}, {"at": 2}], []

    def measure(at, last):
        if at > last:
            raise KeyboardInterrupt
        measured.append(at)
        return {"psnr_db": 30.0 + at}

    with pytest.raises(KeyboardInterrupt):
        lab.measured(points, partial(measure, last=1), "table", args)
    assert measured_code.stale("table") == "not measured"
    rows = lab.measured(points, partial(measure, last=2), "table", args)
    assert rows.psnr_db.tolist() == [31.0, 32.0]
    assert measured == [1, 2]
    assert measured_code.stale("table") == ""
    assert {path.name for path in tmp_path.iterdir()} == {"table.csv", "runs.csv"}


def test_the_page_is_not_written_from_rows_of_other_code_but_as_a_draft(monkeypatch, capsys):
    written = []
    monkeypatch.setattr(results_page, "stale", lambda name: "changed since: a.py")
    monkeypatch.setattr(results_page, "made", lambda: written.append("page") or {})
    monkeypatch.setattr("sys.argv", ["results_page.py"])
    with pytest.raises(SystemExit, match="nothing written"):
        results_page.main()
    assert not written
    assert "full-frames.csv: changed since: a.py" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["results_page.py", "--draft"])
    results_page.main()
    assert written


def test_masks_are_designed_for_the_sensors_that_the_rows_name(tmp_path, monkeypatch):
    seen = []

    def program(command, bench, *words):
        seen.append(load_bench(Path(bench)))
        found = [{"name": name, "psnr_db": {"scene": db}} for name, db in (("own", 1), ("b", 2))]
        text = json.dumps({"simulated": found, "manufacturing_db": {"RGBW": 0}})
        (tmp_path / "metrics.json").write_text(text)
        return tmp_path

    stored = {}
    monkeypatch.setattr(everything, "WORK", tmp_path)
    monkeypatch.setattr(everything, "program", program)
    monkeypatch.setattr(everything, "scenes", lambda group: [])
    monkeypatch.setattr(everything, "store", lambda name, rows, command: stored.update(rows=rows))
    everything.design("design")
    kinds = {"mono": "monochrome", "rggb": "Bayer"}
    assert [(kinds[bench.sensor.cfa_name], bench.shots) for bench in seen] == [
        (row["sensor"], row["shots"]) for row in stored["rows"]
    ]
    assert {row["best_shipped"] for row in stored["rows"]} == {"b"}
