"""Cells are done once, survive interruptions, and never meet a dictionary that saw their scene."""

import itertools
import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.model.lightfield import psnr_db, save_hdf5
from emmc_rig.pages.pictures import Pictures, epipolar_lines, pictures_of
from emmc_rig.progress import Silent
from emmc_rig.study.scores import colour_scored
from emmc_rig.study.sweep import Journal, SweepStopped, digest_of, open_folder
from emmc_rig.study.tables.cell_sweep import FAST, Forecast, TablesSettings, TablesSweep
from emmc_rig.study.tables.cells import PARTS, Capture, Cell, Part
from emmc_rig.study.tables.library import (
    Cut,
    Given,
    LeaveOneOut,
    Library,
    TrainingSettings,
    check_not_trained_on,
    middle,
    scene_specs,
    trained_on,
)
from emmc_rig.study.tables.reproducing import cells_csv
from emmc_rig.study.tables.shots import Sensors, demosaiced_rggb
from reconstruction.bpdn import BPDNSettings
from reconstruction.dictionary import Dictionary, dct_dictionary
from reconstruction.learning import LearningSettings
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.sparse import SparseSettings
from reconstruction.training_patches import PatchSettings
from reconstruction.tv import TVSettings

SIZE = (18, 20)
TINY = TablesSettings(
    cut=Cut(SIZE),
    binned_cut=Cut(SIZE, 2),
    methods=MethodSettings(
        tv=TVSettings(max_steps=5),
        sparse=SparseSettings(stride=9, solver=BPDNSettings(method="admm", max_steps=20, rtol=0.1)),
    ),
    binned_stride=8,
    training=TrainingSettings(
        cut=Cut((20, 20)),
        patches=PatchSettings(count=60, candidates_per_patch=1),
        learning=LearningSettings(atoms=24, iterations=2, sparsity=3),
    ),
)
CAPTURES = (Capture("ii", 1), Capture("ii", 1, noisy=True), Capture("iii", 2))
PART = Part("table2", "a small table", "other", CAPTURES)
NAMES = ("attic", "cellar", "shed")


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


def a_run(scenes, out, parts=(PART,), settings=TINY, source=None):
    library = Library(scene_specs(scenes), settings.cuts, settings.seed)
    folder = open_folder(out, TablesSweep.journal, "tables")
    source = source or LeaveOneOut(library, settings.training, folder / "dictionaries")
    return TablesSweep(settings, folder, tuple(parts), library, source)


def do_cells(run, watcher, clock=time.perf_counter):
    run.clock = clock
    return run.measure(watcher)


def ticking():
    """A clock that advances by one at every look: seconds become counts."""
    count = itertools.count()
    return lambda: float(next(count))


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


def test_a_run_that_was_interrupted_ends_as_one_that_was_not(scenes, tmp_path):
    whole = a_run(scenes, tmp_path / "whole")
    do_cells(whole, Silent(), ticking())
    expected = cells_csv(whole)
    assert len(expected.splitlines()) == 1 + 3 * 3 * 3
    torn = a_run(scenes, tmp_path / "torn")
    with pytest.raises(SweepStopped, match="4 of 27 cells are kept"):
        do_cells(torn, Impatient(4), ticking())
    path = tmp_path / "torn" / TablesSweep.journal
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(SweepStopped, match=r"8 of 27 cells .*run the same command again"):
        do_cells(a_run(scenes, tmp_path / "torn"), Impatient(5), ticking())
    again = a_run(scenes, tmp_path / "torn")
    do_cells(again, Silent(), ticking())
    assert cells_csv(again) == expected


def test_ctrl_c_in_the_middle_of_a_cell_keeps_those_before(scenes, tmp_path):
    run = a_run(scenes, tmp_path / "out")
    looks = itertools.count()

    def clock():
        if next(looks) == 30:
            raise KeyboardInterrupt
        return 0.0

    with pytest.raises(SweepStopped, match="cells are kept"):
        do_cells(run, Silent(), clock)
    kept = len(Journal(run.folder / TablesSweep.journal))
    assert 0 < kept < 27
    do_cells(run, Silent())
    assert len(Journal(run.folder / TablesSweep.journal)) == 27


def test_sharing_the_first_stage_changes_no_result(scenes, tmp_path):
    run = a_run(scenes, tmp_path / "out")
    results = do_cells(run, Silent())
    capture = CAPTURES[1]
    truth = run.library.light_field("shed", TINY.cut)
    shots = Sensors(TINY.seed).take(capture, truth, "shed")
    dictionary = run.source.dictionary("shed", 1, Silent())
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
    first = do_cells(run, Silent())
    from emmc_rig.study.tables import cell_sweep as module

    monkeypatch.setattr(module, "reconstruct", None)
    monkeypatch.setattr(module, "estimate_patches", None)
    monkeypatch.setattr(module, "colour_scored", None)
    assert do_cells(a_run(scenes, tmp_path / "out"), Silent()) == first


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 7},
        {"cut": Cut((20, 20))},
        {"methods": MethodSettings(tv=TVSettings(max_steps=4), sparse=TINY.methods.sparse)},
        {
            "training": TINY.training.model_copy(
                update={"learning": LearningSettings(atoms=25, iterations=2, sparsity=3)}
            )
        },
    ],
)
def test_changed_settings_reuse_only_cells_that_do_not_depend_on_them(scenes, tmp_path, changes):
    before = a_run(scenes, tmp_path / "out")
    after = a_run(scenes, tmp_path / "out", settings=TINY.model_copy(update=changes))
    for cell in before.cells:
        depends = {
            "seed": cell.capture.noisy,
            "cut": True,
            "methods": cell.method != "dict-admm",
            "training": cell.method != "tv",
        }[next(iter(changes))]
        same = digest_of(before.inputs(cell)) == digest_of(after.inputs(cell))
        # Another seed also draws other training patches where the settings say so; here not.
        assert same != depends


def test_a_changed_scene_is_done_again(scenes, tmp_path):
    for name in NAMES:
        save_hdf5(tmp_path / "copy" / f"{name}.h5", light_field(NAMES.index(name)), {})
    save_hdf5(tmp_path / "copy" / "shed.h5", light_field(99), {})
    before, after = a_run(scenes, tmp_path / "a"), a_run(tmp_path / "copy", tmp_path / "b")
    for cell in before.cells:
        same = digest_of(before.inputs(cell)) == digest_of(after.inputs(cell))
        # Those that a dictionary trained on the shed depend on it as well.
        assert same == (cell.scene != "shed" and cell.method == "tv")


def test_pictures_that_are_lost_are_made_again(scenes, tmp_path):
    part = PARTS["figure7"].__class__(
        "figure7", "", "shown other", (Capture("ii", 1),), ("tv",), ("tv",)
    )
    run = a_run(scenes, tmp_path / "out", [part])
    (cell,) = run.cells
    results = do_cells(run, Silent())
    path = run.picture(cell)
    first = Pictures.load(path)
    assert first is not None
    path.write_bytes(path.read_bytes()[:100])
    assert Pictures.load(path) is None
    assert do_cells(run, Silent())[cell]["psnr_db"] == results[cell]["psnr_db"]
    again = Pictures.load(path)
    assert again is not None
    np.testing.assert_array_equal(again.centre, first.centre)


def test_a_dictionary_is_trained_on_the_other_scenes_only(scenes, tmp_path):
    run = a_run(scenes, tmp_path / "out")
    assert isinstance(run.source, LeaveOneOut)
    run.source.dictionary("cellar", 1, Silent())
    (path,) = (tmp_path / "out" / "dictionaries").iterdir()
    loaded = Dictionary.load(path)
    assert trained_on(loaded) == ["attic", "shed"]
    assert loaded.patch_shape == (5, 5, 9, 9, 3)
    assert run.source.dictionary("attic", 2, Silent()).patch_shape == (5, 5, 8, 8, 3)


def test_a_dictionary_does_not_depend_on_the_scene_left_out(scenes, tmp_path):
    for name in NAMES:
        save_hdf5(tmp_path / "copy" / f"{name}.h5", light_field(NAMES.index(name)), {})
    save_hdf5(tmp_path / "copy" / "cellar.h5", light_field(99), {})
    one, other = (
        a_run(folder, tmp_path / out).source.dictionary("cellar", 1, Silent())
        for folder, out in ((scenes, "a"), (tmp_path / "copy", "b"))
    )
    np.testing.assert_array_equal(one.atoms, other.atoms)


def test_a_second_copy_of_the_scored_scene_is_left_out_too(tmp_path):
    for name, seed in {"dragons": 0, "Dragon": 1, "copy": 0, "shed": 2}.items():
        save_hdf5(tmp_path / "s" / f"{name}.h5", light_field(seed), {})
    source = a_run(tmp_path / "s", tmp_path / "out").source
    assert isinstance(source, LeaveOneOut)
    assert source.others("dragons") == ["shed"]
    assert source.others("shed") == ["Dragon", "copy", "dragons"]


def test_one_scene_alone_cannot_train(scenes, tmp_path):
    save_hdf5(tmp_path / "s" / "only.h5", light_field(0), {})
    with pytest.raises(AppError, match=r"no other scene.*lambertian"):
        do_cells(a_run(tmp_path / "s", tmp_path / "out"), Silent())


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
        Given.opened([str(path)], [1], NAMES)
    assert Given.opened([str(path)], [1], ["attic"]).label("attic", 1).startswith("d.h5")


def test_the_papers_name_of_a_scene_is_recognised():
    reported = a_dictionary(provenance=json.dumps({"scenes": ["Dragon"]}))
    with pytest.raises(AppError, match="'dragons'"):
        check_not_trained_on(reported, "d.h5", ["fish", "dragons"])


@pytest.mark.parametrize("provenance", ["", "{}", "no json", '{"scenes": 3}', '{"scenes": []}'])
def test_a_learned_dictionary_that_does_not_say_its_scenes_is_refused(provenance):
    with pytest.raises(AppError, match="does not say"):
        check_not_trained_on(a_dictionary(provenance=provenance), "d.h5", ["attic"])


def test_a_dictionary_without_training_suits_every_scene():
    check_not_trained_on(a_dictionary("lambertian"), "d.h5", NAMES)


def test_binned_pixels_take_the_dictionary_whose_patches_they_divide(tmp_path):
    for side in (9, 8):
        dct_dictionary((5, 5), (side, side), (1, 1, 2, 2), (1, 1, 1, 1)).save(
            tmp_path / f"{side}.h5"
        )
    nine, eight = (str(tmp_path / f"{side}.h5") for side in (9, 8))
    given = Given.opened([nine, eight], [1, 2], NAMES)
    assert given.dictionary("attic", 1, Silent()).patch_shape[2:4] == (9, 9)
    assert given.dictionary("attic", 2, Silent()).patch_shape[2:4] == (8, 8)
    with pytest.raises(AppError, match="multiple of 2"):
        Given.opened([nine], [1, 2], NAMES)


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "cat.jpg").write_text("meow")
    with pytest.raises(AppError, match="holds something else"):
        open_folder(tmp_path, TablesSweep.journal, "tables")
    with pytest.raises(AppError, match="a file of that name"):
        open_folder(tmp_path / "cat.jpg", TablesSweep.journal, "tables")
    assert [path.name for path in tmp_path.iterdir()] == ["cat.jpg"]


def test_a_torn_line_is_ignored_and_the_next_one_stands_alone(tmp_path):
    folder = open_folder(tmp_path / "out", TablesSweep.journal, "tables")
    journal = Journal(folder / TablesSweep.journal)
    journal.add("a", {}, {"psnr_db": 1.0})
    journal.add("b", {}, {"psnr_db": 2.0})
    path = folder / TablesSweep.journal
    path.write_bytes(path.read_bytes()[:-9])
    torn = Journal(folder / TablesSweep.journal)
    assert (torn.get("a"), torn.get("b")) == ({"psnr_db": 1.0}, None)
    torn.add("c", {}, {"psnr_db": 3.0})
    assert Journal(folder / TablesSweep.journal).get("c") == {"psnr_db": 3.0}
    assert Journal(folder / TablesSweep.journal).get("a") == {"psnr_db": 1.0}


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
            do_cells(run, Silent())
    assert len(Journal(run.folder / TablesSweep.journal)) == 3
    assert len(do_cells(run, Silent())) == 27


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
    library = Library(scene_specs(tmp_path), (Cut(),))
    with pytest.raises(AppError, match="15x30 pixels, needs 16x16"):
        library.digest("small")
    with pytest.raises(Exception, match="cannot give 5x5"):
        library.digest("few")


def test_the_middle_is_cut_to_whole_pixels():
    lf = light_field(0, (23, 25))
    np.testing.assert_array_equal(middle(lf, Cut((10, 12))), lf[:, :, 6:16, 6:18])
    assert middle(lf, Cut(multiple=2)).shape[2:4] == (22, 24)
    assert middle(lf, Cut((99, 11), 2)).shape[2:4] == (22, 10)


def test_noise_depends_on_seed_and_scene_not_on_what_came_before():
    lf = light_field(0)
    noisy = Capture("ii", 1, noisy=True)
    one, other = Sensors(3), Sensors(3)
    other.take(Capture("iii", 2, noisy=True), lf, "attic")
    first = one.take(noisy, lf, "attic")
    np.testing.assert_array_equal(first.frames, other.take(noisy, lf, "attic").frames)
    assert not np.array_equal(first.frames, one.take(noisy, lf, "shed").frames)


def test_the_noise_stated_is_the_noise_there_is():
    lf = light_field(0, (64, 64))
    for capture in (Capture("i", 3, noisy=True), Capture("iii", 3, noisy=True)):
        shots = Sensors(0).take(capture, lf, "attic")
        spread = 10 ** (-shots.sensor_psnr_db / 20)
        assert shots.noise_sigma == pytest.approx(spread, rel=0.03)
    assert Sensors(0).take(Capture("i", 3), lf, "attic").noise_sigma == 0


def test_a_demosaiced_capture_is_solved_as_three_colours():
    lf = light_field(0)
    shots = Sensors(0).take(Capture("ii", 1, demosaiced=True), lf, "attic")
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


def test_the_time_left_follows_from_cells_of_the_same_kind():
    quick, slow = (Cell("attic", Capture("ii", shots), "tv") for shots in (1, 3))
    more = [Cell("shed", Capture("ii", shots), "tv") for shots in (1, 3)]
    forecast = Forecast([quick, slow, *more])
    assert forecast.left() == ""
    forecast.done(quick, 2.0)
    forecast.done(slow, 50.0)
    assert forecast.left() == "about 52 s left"
    forecast.done(more[1], 50.0)
    assert forecast.left() == "about 2 s left"


def test_two_runs_may_share_a_folder(scenes, tmp_path):
    one, other = (a_run(scenes, tmp_path / "out") for _ in range(2))
    first, second = do_cells(one, Silent(), time.perf_counter), do_cells(other, Silent())
    assert first == second
    assert Path(one.folder, TablesSweep.journal).read_text().count("\n") == 27
