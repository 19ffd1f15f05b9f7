"""Rows are of other code once that code changes, and only then."""

import subprocess

import measured_code
import pytest

BEFORE = '"""Words."""\n\nLIMIT = 3\n"""Of what."""\n'


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
