"""`emmc-rig demo --own-data`: the files of a simulated bench, as the page on own data begins."""

import errno
import os
import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from programs import contents, done, refused

from emmc_rig.captures.import_table import read_table
from emmc_rig.formats.own_arrays import read_own

PAGE = (Path(__file__).parents[2] / "docs/own-data.md").read_text("utf-8")
FOLDER = "own"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    from programs import program

    folder = tmp_path_factory.mktemp("made") / FOLDER
    done(program("demo", "--own-data", folder))
    return folder


def shown(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.M | re.S)


def test_the_page_shows_the_camera_and_the_table_as_they_are_written(made):
    assert yaml.safe_load((made / "mine.yaml").read_text()) == yaml.safe_load(shown("yaml")[0])
    assert "seed 0" in (made / "mine.yaml").read_text()
    assert (made / "table.csv").read_text() == shown("csv")[0]


def test_frames_are_16_bit_files_that_import_reads(made):
    listed = read_table(made / "table.csv")
    assert {row.row.kind for row in listed} == {
        "dark", "reference", "open", "validation", "shot"
    }  # fmt: skip
    frames = {row.path.name: read_own(row.path, "", set()).frames for row in listed}
    assert {(frame.dtype, frame.shape) for frame in frames.values()} == {
        (np.dtype(np.uint16), (1, 56, 56))
    }
    assert 60 < frames["dark-1.tif"].mean() < 70
    assert all(frames[f"{kind}-1.tif"].max() > 1500 for kind in ("scene", "open", "reference"))


def test_same_seed_same_bytes_and_another_seed_another_film_and_noise(made, run, tmp_path):
    done(run("demo", "--own-data", "again"))
    done(run("demo", "--own-data", "other", "--seed", 1))
    assert contents(tmp_path / "again") == contents(made)
    for name in ("photo.tif", "scene-1.tif"):
        first, other = (tifffile.imread(folder / name) for folder in (made, tmp_path / "other"))
        assert (first != other).mean() > 0.5


def filled(place):
    place.mkdir()
    (place / "thesis.txt").write_text("years of work")


SITUATIONS = {
    "holds something": (filled, "own: holds something already; choose another folder"),
    "a file": (lambda place: place.write_text("mine"), "own: a file of that name exists"),
    "below a file": (
        lambda place: place.symlink_to(Path(__file__) / "x"), "own: cannot be",
    ),
    "a link in a circle": (lambda place: place.symlink_to(place), "own: cannot be"),
}  # fmt: skip


@pytest.mark.parametrize("situation", SITUATIONS)
def test_a_place_that_cannot_be_used_is_refused_in_one_line(situation, run, tmp_path):
    prepare, words = SITUATIONS[situation]
    prepare(tmp_path / FOLDER)
    before = contents(tmp_path)
    assert words in refused(run("demo", "--own-data", FOLDER))
    assert contents(tmp_path) == before


def test_the_folder_of_an_earlier_run_is_not_replaced(made, run):
    before = contents(made)
    assert "holds something already" in refused(run("demo", "--own-data", made))
    assert contents(made) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_may_not_be_written_is_refused(run, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o555)
    assert "cannot be written (Permission denied)" in refused(run("demo", "--own-data", "locked/a"))


def test_a_full_disk_leaves_nothing(run, tmp_path, monkeypatch):
    write = tifffile.imwrite

    def full(path, *arguments, **more):
        if str(path).endswith("scene-1.tif"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, *arguments, **more)

    monkeypatch.setattr(tifffile, "imwrite", full)
    words = refused(run("demo", "--own-data", FOLDER))
    assert words.endswith(f"{FOLDER}: cannot be written (No space left on device)")
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("option", ["--scene", "--camera", "--size", "--method", "--out"])
def test_options_without_effect_are_refused(option, run, tmp_path):
    code, _, err = run("demo", "--own-data", FOLDER, option, "x")
    assert code == 2
    assert f"{option}: no effect with --own-data; leave it out" in " ".join(
        err.replace("│", " ").split()
    )
    assert contents(tmp_path) == {}


def test_a_negative_seed_is_wrong_usage(run):
    assert run("demo", "--own-data", FOLDER, "--seed", "-1")[0] == 2
