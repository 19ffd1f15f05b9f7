"""Cells are done once, survive interruptions, and never meet a dictionary that saw their scene."""

import csv
import io
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.model.lightfield import psnr_db, save_hdf5
from emmc_rig.pages.pictures import epipolar_lines, pictures_of
from emmc_rig.progress import Silent
from emmc_rig.study.points import Journal, StudyStopped, study_folder
from emmc_rig.study.rows import digest_of
from emmc_rig.study.scores import colour_scored
from emmc_rig.study.tables import tables_study
from emmc_rig.study.tables.cells import Capture, Cell, Part
from emmc_rig.study.tables.shots import demosaiced_rggb, shots_of
from emmc_rig.study.tables.table_scenes import (
    Scenes,
    check_dictionary,
    middle,
    scene_specs,
)
from emmc_rig.study.tables.tables_page import cells_csv
from emmc_rig.study.tables.tables_study import FAST, TablesSettings, TablesStudy
from reconstruction.bpdn import BPDNSettings
from reconstruction.dictionary import Dictionary, dct_dictionary
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.sparse import SparseSettings
from reconstruction.tv import TVSettings

SIZE = (18, 20)
TINY = TablesSettings(
    size=SIZE,
    binned_size=SIZE,
    methods=MethodSettings(
        tv=TVSettings(max_steps=5),
        sparse=SparseSettings(stride=9, solver=BPDNSettings(method="admm", max_steps=20, rtol=0.1)),
    ),
    binned_stride=8,
)
CAPTURES = (Capture("ii", 1), Capture("ii", 1, noisy=True), Capture("iii", 2))
PART = Part("table2", "a small table", "other", CAPTURES)
NAMES = ("attic", "cellar", "shed")


@pytest.fixture(scope="module", autouse=True)
def small_dictionary():
    """A dictionary of few atoms in place of `lambertian`, which has 1,024."""
    few = dct_dictionary((5, 5), (9, 9), (1, 1, 3, 3), (1, 1, 1, 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables_study, "open_dictionary_once", lambda *_: few)
        yield few


def light_field(seed, size=(22, 26), views=(5, 5)):
    """A coloured texture at a disparity of one pixel."""
    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.random((size[0] + 8, size[1] + 8, 3)), (0, 0), 1.2)
    picture = np.clip(0.5 + 2 * (picture - 0.5), 0, 1).astype(np.float32)
    shifted = [
        [picture[v : v + size[0], u : u + size[1]] for u in range(views[1])]
        for v in range(views[0])
    ]
    return np.asarray(shifted)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for seed, name in enumerate(NAMES):
        save_hdf5(folder / f"{name}.h5", light_field(seed), {})
    (folder / "notes.txt").write_text("not a scene")
    return folder


def a_run(scenes, out, parts=(PART,), settings=TINY):
    out.mkdir(exist_ok=True)
    return TablesStudy(settings, out, tuple(parts), Scenes(scene_specs(scenes), settings.seed))


def figures(run):
    """Return the rows of the run's CSV but for how long they took."""
    rows = list(csv.DictReader(io.StringIO(cells_csv(run))))
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


class Impatient(Silent):
    """Presses Ctrl-C after some cells."""

    def __init__(self, patience):
        self.patience, self.done = patience, 0

    def begin(self, stage, steps):
        self.counts = stage.startswith("reconstruct")

    def step(self, detail):
        self.done += self.counts
        if self.counts and self.done == self.patience:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(scenes, tmp_path):
    whole = a_run(scenes, tmp_path / "whole")
    whole.measure(Silent())
    expected = figures(whole)
    assert len(expected) == 3 * 3 * 3
    torn = a_run(scenes, tmp_path / "torn")
    with pytest.raises(StudyStopped, match="4 of 27 cells are kept"):
        torn.measure(Impatient(4))
    path = tmp_path / "torn" / TablesStudy.journal
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(StudyStopped, match=r"8 of 27 cells .*run the same command again"):
        a_run(scenes, tmp_path / "torn").measure(Impatient(5))
    again = a_run(scenes, tmp_path / "torn")
    again.measure(Silent())
    assert figures(again) == expected


def test_sharing_the_first_stage_changes_no_result(scenes, tmp_path):
    run = a_run(scenes, tmp_path / "out")
    results = run.measure(Silent())
    capture = CAPTURES[1]
    truth = run.scenes.light_field("shed", TINY.size)
    shots = shots_of(capture, truth, "shed", TINY.seed)
    dictionary = run.dictionary(1)
    for method in ("dict-admm", "tv-dict"):
        alone = reconstruct(
            method,
            shots.psi,
            shots.frames,
            shots.noise_sigma,
            dictionary,
            TINY.of(method, capture),
            shots.usable,
        )
        kept = results[Cell("shed", capture, method)]
        assert kept["psnr_db"] == pytest.approx(psnr_db(alone.light_field, truth), abs=1e-3)
        assert kept["status"] == alone.status


def test_patches_are_coded_by_the_papers_solver_by_default():
    for settings in (TablesSettings(), FAST):
        for method in ("dict-admm", "tv-dict"):
            assert settings.of(method, Capture("ii", 1)).sparse.solver.method == "admm"


def test_nothing_is_done_twice(scenes, tmp_path, monkeypatch):
    run = a_run(scenes, tmp_path / "out")
    first = run.measure(Silent())
    monkeypatch.setattr(tables_study, "reconstruct", None)
    monkeypatch.setattr(tables_study, "estimate_patches", None)
    monkeypatch.setattr(tables_study, "colour_scored", None)
    assert a_run(scenes, tmp_path / "out").measure(Silent()) == first


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 7},
        {"size": (20, 20)},
        {"methods": MethodSettings(tv=TVSettings(max_steps=4), sparse=TINY.methods.sparse)},
        {"dictionary": "dct"},
    ],
)
def test_changed_settings_reuse_only_cells_that_do_not_depend_on_them(scenes, tmp_path, changes):
    before = a_run(scenes, tmp_path / "out")
    after = a_run(scenes, tmp_path / "out", settings=TINY.model_copy(update=changes))
    for cell in before.cells:
        depends = {
            "seed": cell.capture.noisy,
            "size": True,
            "methods": cell.method != "dict-admm",
            "dictionary": cell.method != "tv",
        }[next(iter(changes))]
        same = digest_of(before.inputs(cell)) == digest_of(after.inputs(cell))
        assert same != depends


def test_a_changed_scene_is_done_again(scenes, tmp_path):
    for name in NAMES:
        save_hdf5(tmp_path / "copy" / f"{name}.h5", light_field(NAMES.index(name)), {})
    save_hdf5(tmp_path / "copy" / "shed.h5", light_field(99), {})
    before, after = a_run(scenes, tmp_path / "a"), a_run(tmp_path / "copy", tmp_path / "b")
    for cell in before.cells:
        same = digest_of(before.inputs(cell)) == digest_of(after.inputs(cell))
        assert same == (cell.scene != "shed")


def a_dictionary(kind="ksvd", provenance="", patch=(9, 9)):
    atoms = np.random.default_rng(0).normal(size=(4, 5, 5, *patch, 3))
    return Dictionary.normalised(atoms, kind, provenance)


@pytest.mark.parametrize(
    "reported", [["shed"], [{"name": "shed"}], ["/data/SHED.h5"], {"shed": "1f"}]
)
def test_a_dictionary_that_saw_a_scored_scene_is_refused(tmp_path, reported):
    path = tmp_path / "d.h5"
    a_dictionary(provenance=json.dumps({"scenes": reported})).save(path)
    with pytest.raises(AppError, match="was trained on 'shed'"):
        check_dictionary(Dictionary.load(path), "d.h5", NAMES, 1)
    check_dictionary(Dictionary.load(path), "d.h5", ["attic"], 1)


def test_the_papers_name_of_a_scene_is_recognised():
    reported = a_dictionary(provenance=json.dumps({"scenes": ["Dragon"]}))
    with pytest.raises(AppError, match="'dragons'"):
        check_dictionary(reported, "d.h5", ["fish", "dragons"], 1)


@pytest.mark.parametrize("provenance", ["", "{}", "no json", '{"scenes": 3}', '{"scenes": []}'])
def test_a_learned_dictionary_that_does_not_say_its_scenes_is_refused(provenance):
    with pytest.raises(AppError, match="does not say"):
        check_dictionary(a_dictionary(provenance=provenance), "d.h5", ["attic"], 1)


def test_a_dictionary_without_training_suits_every_scene():
    check_dictionary(a_dictionary("lambertian"), "d.h5", NAMES, 1)


def test_a_torn_line_is_ignored_and_the_next_one_stands_alone(tmp_path):
    with study_folder(tmp_path / "out", TablesStudy.journal, "tables") as folder:
        journal = Journal(folder / TablesStudy.journal)
    journal.add("a", {}, {"psnr_db": 1.0})
    journal.add("b", {}, {"psnr_db": 2.0})
    path = folder / TablesStudy.journal
    path.write_bytes(path.read_bytes()[:-9])
    torn = Journal(folder / TablesStudy.journal)
    assert (torn.get("a"), torn.get("b")) == ({"psnr_db": 1.0}, None)
    torn.add("c", {}, {"psnr_db": 3.0})
    assert Journal(folder / TablesStudy.journal).get("c") == {"psnr_db": 3.0}
    assert Journal(folder / TablesStudy.journal).get("a") == {"psnr_db": 1.0}


def test_a_full_disk_is_reported_and_nothing_is_lost(scenes, tmp_path, monkeypatch):
    run = a_run(scenes, tmp_path / "out")
    add, left = Journal.add, itertools.count(3, -1)

    def filling(self, *arguments):
        if next(left) == 0:
            raise OSError(28, "No space left on device")
        add(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "add", filling)
        with pytest.raises(AppError, match=r"No space left.*run the same command again"):
            run.measure(Silent())
    assert len(Journal(run.folder / TablesStudy.journal)) == 3
    assert len(run.measure(Silent())) == 27


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "cat.jpg").write_text("meow")
    for place, why in ((tmp_path, "something else"), (tmp_path / "cat.jpg", "a file of that name")):
        with pytest.raises(AppError, match=why), study_folder(place, "cells.jsonl", "tables"):
            pytest.fail("taken")
    assert [path.name for path in tmp_path.iterdir()] == ["cat.jpg"]


def test_binned_pixels_need_patches_that_they_divide(small_dictionary):
    check_dictionary(small_dictionary, "nine.h5", NAMES, 1)
    with pytest.raises(AppError, match="multiple of 2, these are 9x9"):
        check_dictionary(small_dictionary, "nine.h5", NAMES, 2)


def test_a_folder_without_scenes_is_reported(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(AppError, match="no scenes"):
        scene_specs(tmp_path / "empty")
    with pytest.raises(AppError, match="no such folder"):
        scene_specs(tmp_path / "nowhere")
    (tmp_path / "view_0_0.png").write_bytes(b"")
    with pytest.raises(AppError, match="is itself a scene"):
        scene_specs(tmp_path)


def test_scenes_too_small_or_of_other_views_are_reported(tmp_path):
    save_hdf5(tmp_path / "small.h5", light_field(0, (15, 30)), {})
    save_hdf5(tmp_path / "few.h5", light_field(0, views=(3, 3)), {})
    library = Scenes(scene_specs(tmp_path))
    with pytest.raises(AppError, match="15x30 pixels, needs 16x16"):
        library.identity("small")
    with pytest.raises(Exception, match="cannot give 5x5"):
        library.identity("few")


def test_the_middle_is_cut_to_whole_pixels():
    lf = light_field(0, (23, 25))
    np.testing.assert_array_equal(middle(lf, (10, 12)), lf[:, :, 6:16, 6:18])
    assert middle(lf, None, 2).shape[2:4] == (22, 24)
    assert middle(lf, (99, 11), 2).shape[2:4] == (22, 10)


def test_noise_depends_on_seed_and_scene_not_on_what_came_before():
    lf = light_field(0)
    noisy = Capture("ii", 1, noisy=True)
    first = shots_of(noisy, lf, "attic", 3)
    shots_of(Capture("iii", 2, noisy=True), lf, "attic", 3)
    np.testing.assert_array_equal(first.frames, shots_of(noisy, lf, "attic", 3).frames)
    assert not np.array_equal(first.frames, shots_of(noisy, lf, "shed", 3).frames)
    assert not np.array_equal(first.frames, shots_of(noisy, lf, "attic", 4).frames)


def test_the_noise_stated_is_the_noise_there_is():
    lf = light_field(0, (64, 64))
    for capture in (Capture("i", 3, noisy=True), Capture("iii", 3, noisy=True)):
        shots = shots_of(capture, lf, "attic", 0)
        spread = 10 ** (-shots.sensor_psnr_db / 20)
        assert shots.noise_sigma == pytest.approx(spread, rel=0.03)
    assert shots_of(Capture("i", 3), lf, "attic", 0).noise_sigma == 0


def test_a_demosaiced_capture_is_solved_as_three_colours():
    lf = light_field(0)
    shots = shots_of(Capture("ii", 1, demosaiced=True), lf, "attic", 0)
    assert shots.frames.shape == shots.psi.frames_shape == (3, 22, 26)


def test_demosaicing_is_exact_for_even_colours_and_for_grey_slopes():
    colours = np.array([0.2, 0.5, 0.7], np.float32)[:, None, None] * np.ones((1, 12, 14))
    y, x = np.mgrid[:12, :14] / 20
    for truth, inner in ((colours, 0), (np.repeat((x + 0.3 * y)[None], 3, axis=0), 2)):
        mosaic = np.empty((12, 14))
        for phase, colour in (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2)):
            place = slice(phase[0], None, 2), slice(phase[1], None, 2)
            mosaic[place] = truth[(colour, *place)]
        kept = (slice(None), slice(inner, 12 - inner), slice(inner, 14 - inner))
        np.testing.assert_allclose(demosaiced_rggb(mosaic)[kept], truth[kept], atol=1e-6)


def test_brightness_and_colour_share_the_error():
    truth = light_field(0)
    rng = np.random.default_rng(1)
    estimate = (truth + 0.05 * rng.normal(size=truth.shape)).astype(np.float32)
    found = colour_scored(estimate, truth)
    whole, luma, chroma = (
        10 ** (-db / 10) for db in (found.psnr_db, found.luma_psnr_db, found.chroma_psnr_db)
    )
    assert luma + 2 * chroma == pytest.approx(3 * whole, rel=1e-4)
    grey = np.repeat(truth.mean(axis=-1, keepdims=True), 3, axis=-1)
    dull = colour_scored(grey, truth)
    assert dull.chroma_share == pytest.approx(0, abs=1e-5)
    assert dull.luma_psnr_db > 100
    assert colour_scored((grey + truth) / 2, truth).chroma_share == pytest.approx(0.5, abs=1e-5)


def test_epipolar_lines_are_taken_where_views_differ():
    lf = np.zeros((5, 5, 20, 30, 3), np.float32)
    lf[:, -1, 11] = 1
    lf[-1, :, :, 17] += 0.5
    assert epipolar_lines(lf) == (11, 17)
    kept = pictures_of(lf, (11, 17))
    assert (kept.across.shape, kept.down.shape) == ((5, 30, 3), (5, 20, 3))


def test_two_runs_may_share_a_folder(scenes, tmp_path):
    one, other = (a_run(scenes, tmp_path / "out") for _ in range(2))
    first, second = one.measure(Silent()), other.measure(Silent())
    assert first == second
    assert Path(one.folder, TablesStudy.journal).read_text().count("\n") == 27
