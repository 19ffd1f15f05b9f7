"""Rows are of other code once that code changes, and only then."""

import subprocess

import measured_code
import pytest
import results_page

BEFORE = '''"""Words."""

LIMIT = 3
"""Of what."""


def check(name):
    if name != "a":
        raise ValueError(f"{name}: unknown")
'''


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
        ("one.py", BEFORE.replace(": unknown", " is not known"), ()),
        ("one.py", BEFORE.replace("ValueError", "KeyError"), ("room/one.py",)),
        ("one.py", BEFORE.replace('"a"', '"b"'), ("room/one.py",)),
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
