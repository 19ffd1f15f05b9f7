"""`emmc-rig tables`: what it asks for, the paper's numbers, the cells, the files and faults."""

import csv
import json

import cv2
import numpy as np
import pytest
from pages import Page
from programs import done

from emmc_rig.errors import AppError
from emmc_rig.model.lightfield import psnr_db, save_hdf5
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.bpdn import BPDNSettings
from emmc_rig.reconstruction.dictionary import Dictionary, lambertian_dictionary
from emmc_rig.reconstruction.methods import MethodSettings, reconstruct
from emmc_rig.reconstruction.sparse import SparseSettings
from emmc_rig.reconstruction.tv import TVSettings
from emmc_rig.store.products import digest_of
from emmc_rig.study.tables import paper, tables_study
from emmc_rig.study.tables.cells import PARTS, Cell, Setup, cells_of, chosen_parts, scenes_of
from emmc_rig.study.tables.tables_study import (
    CSV,
    TablesSettings,
    TablesStudy,
    check_dictionary,
    grid_of,
    middle,
    scene_specs,
)

NAMES = ("attic", "dragons")
GIVEN = [
    "antinous", "begonia", "bikes", "buttercup", "dice", "dragons", "fish", "messerschmitt",
    "occlusions",
]  # fmt: skip
QUICK = TablesSettings(
    size=(16, 18),
    binned_size=(16, 18),
    methods=MethodSettings(
        tv=TVSettings(max_steps=2),
        sparse=SparseSettings(stride=8, solver=BPDNSettings(max_steps=3, rtol=0.5)),
    ),
    binned_stride=8,
)
TABLE_2, NOISY, TABLE_3, *TABLE_4 = PARTS
DONE = (TABLE_2, NOISY, TABLE_3, TABLE_4[1])
"""The parts that are computed: a part of Table IV stands for all three."""


@pytest.mark.parametrize(
    ("parts", "count"),
    [
        ([TABLE_2], 4 * 3 * 3),
        ([TABLE_3], 5 * 7 * 3),
        (TABLE_4, 5 * 12 * 3),
        (PARTS, 72 + 105 + 180),
    ],
)
def test_a_part_has_a_cell_for_every_scene_setup_and_method(parts, count):
    assert len({cell for part in parts for cell in cells_of(part, GIVEN)}) == count


def test_table_2_is_about_the_four_synthetic_scenes_and_the_others_about_the_rest():
    assert scenes_of(TABLE_2, GIVEN) == ["dragons", "dice", "fish", "messerschmitt"]
    assert scenes_of(TABLE_3, GIVEN) == [
        "buttercup", "antinous", "begonia", "bikes", "occlusions",
    ]  # fmt: skip
    # Either kind of scene stands in for the other.
    assert scenes_of(TABLE_2, ["cave", "attic"]) == ["attic", "cave"]
    assert scenes_of(TABLE_3, ["dice"]) == ["dice"]


def test_parts_are_chosen_by_name_in_the_papers_order():
    assert chosen_parts("table3, table2") == (TABLE_2, NOISY, TABLE_3)
    assert chosen_parts(None) == PARTS
    for only, reported in (
        ("tabel3", "did you mean 'table3'"), ("xyz", "known are table2"), (",", "no table is"),
    ):  # fmt: skip
        with pytest.raises(AppError, match=f"table.*{reported}|{reported}"):
            chosen_parts(only)


def test_every_setup_has_the_same_total_exposure_and_its_shots():
    for setup in (setup for part in PARTS for setup in part.setups):
        camera = setup.camera()
        assert camera.exposures_s().sum() == pytest.approx(0.05)
        assert len(camera.shots) == setup.shots
        assert camera.sensor.binning == setup.binning


@pytest.mark.parametrize(
    ("scene", "setup", "method", "printed"),
    [
        ("dragons", Setup("i", 3), "tv-dict", 30.22),
        ("Dragon", Setup("iii", 3, noisy=True), "dict-admm", 26.35),
        ("messerschmitt", Setup("ii", 1, noisy=True), "tv-dict", 29.75),
        ("seahorse", Setup("iii", 3), "tv-dict", 36.05),
        ("White Rose", Setup("ii", 2), "dict-admm", 33.24),
        ("buttercup", Setup("ii", 1), "dict-admm", 29.71),
        ("buttercup", Setup("i", 12, 2), "tv-dict", 34.75),
        ("tulip", Setup("iii", 4, 2), "tv-dict", 42.06),
        ("orchid", Setup("ii", 3, 2), "dict-admm", 29.28),
        ("seahorse", Setup("iii", 4, 2), "dict-admm", None),
        ("dragons", Setup("i", 3), "tv", None),
        ("attic", Setup("i", 3), "tv-dict", None),
    ],
)
def test_numbers_stand_where_the_paper_prints_them(scene, setup, method, printed):
    assert Cell(scene, setup, method).paper_psnr_db == printed


def test_the_papers_means_over_its_real_scenes_come_out():
    # Computed from the printed table by hand, Dict-ADMM and TV-Dict.
    means: dict[tuple[paper.Scenario, int], tuple[float, float]] = {
        ("i", 3): (35.12, 35.62),
        ("ii", 1): (30.09, 30.19),
        ("ii", 2): (34.18, 34.34),
        ("ii", 3): (35.32, 35.77),
        ("iii", 1): (28.62, 28.74),
        ("iii", 2): (34.02, 34.50),
        ("iii", 3): (35.93, 36.57),
    }
    real = [scene for scene in paper.TITLES if scene not in paper.SYNTHETIC]
    for (scenario, shots), expected in means.items():
        for method, mean in zip(("dict-admm", "tv-dict"), expected, strict=True):
            places = [paper.Printed(s, scenario, shots, 1, False, method) for s in real]
            assert np.mean([paper.PSNR_DB[p] for p in places]) == pytest.approx(mean, abs=0.006)
    assert len(paper.PSNR_DB) == 2 * 24 + 2 * 49 + 2 * 84 - 1


def light_field(seed, size=(20, 22), views=(5, 5)):
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


@pytest.fixture(scope="module", autouse=True)
def small_dictionary():
    """A dictionary of few atoms in place of `lambertian`, which has 1,024."""
    made = lambertian_dictionary((5, 5), (8, 8), [0])
    few = Dictionary(made.atoms[::8], made.kind)
    opened = tables_study.open_dictionary_once
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            tables_study,
            "open_dictionary_once",
            lambda spec, *more: opened(spec, *more) if spec else few,
        )
        yield few


def carried_out(scenes, folder):
    study = TablesStudy(QUICK, folder, DONE, scene_specs(scenes))
    study.carry_out(Watcher())
    return study


@pytest.fixture(scope="module")
def whole(scenes, tmp_path_factory):
    """Every table of two tiny scenes."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    return folder, carried_out(scenes, folder)


def test_every_cell_is_one_row_of_the_csv(whole):
    folder, _ = whole
    with open(folder / "tables.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    cells = {cell for part in DONE for cell in cells_of(part, list(NAMES))}
    assert len(rows) == len(cells) == 18 + 21 + 12
    assert tuple(rows[0]) == TablesStudy.columns[CSV]
    printed = [row for row in rows if row["paper_psnr_db"]]
    assert {row["scene"] for row in printed} == {"dragons"}
    row = next(r for r in printed if (r["scenario"], r["method"]) == ("i", "tv-dict"))
    assert (row["paper_psnr_db"], row["shots"], row["noise"], row["r"]) == ("30.22", "3", "no", "1")
    for row in rows:
        assert float(row["psnr_db"]) > 0
        assert float(row["replicate_psnr_db"]) > 0
        assert (row["rows"], row["columns"]) == ("16", "18")
        assert bool(row["dictionary"]) == (row["method"] != "tv")
        assert (float(row["noise_sigma"]) > 0) == (row["noise"] == "yes")


def test_the_page_is_whole_and_asks_for_nothing(whole):
    folder, _ = whole
    text = (folder / "tables.html").read_text()
    assert "{{" not in text
    assert not Page(text).foreign
    for part in DONE:
        assert part.title in text
    assert "| 30.22" in text
    assert "is best in the mean" in text


def test_grids_hold_means_and_the_papers_numbers(whole):
    _, outcome = whole
    table_2, _, table_3, table_4, *_ = outcome.grids
    ours = {name: cells for name, *cells in table_2.rows}
    printed = [cell.split(" | ")[1] for cell in ours["dragons, TV-Dict"]]
    assert printed == ["30.22", "27.98", "30.52"]
    assert " | " not in "".join(ours["dragons, TV alone"])
    # Table II is of the synthetic scene only; Table III of the other, whose paper's means are of 7.
    assert "attic, TV-Dict" not in ours
    theirs = {name: cells for name, *cells in table_3.rows}
    assert theirs["mean, TV-Dict"][0].endswith(" | 35.62")
    assert theirs["mean, TV alone"][0] == theirs["attic, TV alone"][0]
    assert len(table_4.rows[0]) == 5


def test_a_mean_is_over_the_scenes_that_were_measured():
    cells = {Cell(scene, Setup("i", 3), "tv"): {"psnr_db": db} for scene, db in
             (("attic", 20.0), ("cave", 23.0), ("den", None))}  # fmt: skip
    grid = grid_of(TABLE_3, cells, ["attic", "cave", "den", "shed"])
    rows = {name: first for name, first, *_ in grid.rows}
    assert (rows["mean, TV alone"], rows["shed, TV alone"]) == ("21.50", "–")
    assert rows["mean, Dict-ADMM"].startswith("–")


def test_a_second_run_does_nothing_again_and_leaves_foreign_files(whole, scenes, monkeypatch):
    folder, outcome = whole
    (folder / "mine.txt").write_text("keep")
    before = (folder / "tables.csv").read_bytes(), (folder / "cells.jsonl").read_bytes()
    for name in ("estimate_patches", "scored", "trial_of"):
        monkeypatch.setattr(tables_study, name, None)
    again = carried_out(scenes, folder)
    assert again.grids == outcome.grids
    assert before == ((folder / "tables.csv").read_bytes(), (folder / "cells.jsonl").read_bytes())
    assert (folder / "mine.txt").read_text() == "keep"
    assert not [path for path in folder.rglob("*") if ".part" in path.name]


def a_study(scenes, out, settings=QUICK):
    out.mkdir(exist_ok=True)
    return TablesStudy(settings, out, (NOISY,), scene_specs(scenes))


def test_sharing_the_coded_patches_changes_no_result(scenes, tmp_path):
    study = a_study(scenes, tmp_path / "out")
    study.carry_out(Watcher())
    results = study.results
    for method in ("dict-admm", "tv-dict"):
        cell = Cell("dragons", Setup("ii", 1, noisy=True), method)
        made, dictionary = study.trial(cell), study.dictionary(1)
        alone = reconstruct(method, made.psi, made.frames, dictionary, QUICK.methods)
        kept = results[cell]
        assert kept["psnr_db"] == pytest.approx(psnr_db(alone.light_field, made.truth), abs=1e-3)
        assert kept["status"] == alone.status


def test_changed_settings_and_scenes_are_other_cells(scenes, tmp_path):
    before = a_study(scenes, tmp_path / "a")
    (tmp_path / "copy").mkdir()
    save_hdf5(tmp_path / "copy" / "attic.h5", light_field(0), {})
    save_hdf5(tmp_path / "copy" / "dragons.h5", light_field(99), {})
    others = [
        a_study(scenes, tmp_path / "b", QUICK.model_copy(update=changes))
        for changes in ({"seed": 7}, {"size": (20, 20)}, {"methods": MethodSettings()})
    ]
    for after in (*others, a_study(tmp_path / "copy", tmp_path / "c")):
        for cell in before.cells:
            assert digest_of(before.inputs(cell)) != digest_of(after.inputs(cell))
    own = a_study(scenes, tmp_path / "d", QUICK.model_copy(update={"dictionary": "own.h5"}))
    same = {cell.method for cell in before.cells if before.inputs(cell) == own.inputs(cell)}
    assert same == {"tv"}


def a_dictionary(kind="ksvd", provenance="", patch=(9, 9)):
    atoms = np.random.default_rng(0).normal(size=(4, 5, 5, *patch, 3))
    return Dictionary.normalised(atoms, kind, provenance)


@pytest.mark.parametrize(
    ("reported", "scene"),
    [
        (["shed"], "shed"),
        ([{"name": "shed"}], "shed"),
        (["/data/SHED.h5"], "shed"),
        ({"shed": "1f"}, "shed"),
        (["Dragon"], "dragons"),
    ],
)
def test_a_dictionary_that_saw_a_scored_scene_is_refused(tmp_path, reported, scene):
    path = tmp_path / "d.h5"
    a_dictionary(provenance=json.dumps({"scenes": reported})).save(path)
    with pytest.raises(AppError, match=f"was trained on '{scene}'"):
        check_dictionary(Dictionary.load(path), "d.h5", ["fish", scene], 1)
    check_dictionary(Dictionary.load(path), "d.h5", ["attic"], 1)


@pytest.mark.parametrize("provenance", ["", "{}", "no json", '{"scenes": 3}', '{"scenes": []}'])
def test_a_learned_dictionary_that_does_not_say_its_scenes_is_refused(provenance):
    with pytest.raises(AppError, match="does not say"):
        check_dictionary(a_dictionary(provenance=provenance), "d.h5", ["attic"], 1)


def test_a_dictionary_without_training_suits_every_scene():
    check_dictionary(a_dictionary("lambertian"), "d.h5", NAMES, 1)
    with pytest.raises(AppError, match="multiple of 2, these are 9x9"):
        check_dictionary(a_dictionary("lambertian"), "nine.h5", NAMES, 2)


def test_a_scene_too_small_or_of_other_views_is_reported_before_anything_is_measured(tmp_path):
    for name, views, why in (
        ("small", light_field(0, (15, 30)), "15x30 pixels, needs 16x16"),
        ("few", light_field(0, views=(3, 3)), "fewer than the 5x5"),
    ):
        save_hdf5(tmp_path / name / f"{name}.h5", views, {})
        with pytest.raises(Exception, match=why):
            a_study(tmp_path / name, tmp_path / "out").check_input()


def test_the_middle_is_cut_to_whole_pixels():
    lf = light_field(0, (23, 25))
    np.testing.assert_array_equal(middle(lf, (10, 12)), lf[:, :, 6:16, 6:18])
    assert middle(lf, None, 2).shape[2:4] == (22, 24)
    assert middle(lf, (99, 11), 2).shape[2:4] == (22, 10)


def test_a_part_alone_is_done_from_the_command_line(run, scenes, monkeypatch):
    monkeypatch.setattr(tables_study, "FAST", QUICK)
    out = done(run("tables", "--scenes", scenes, "--only", "table2", "--fast", "--out", "r"))
    assert "open r/tables.html" in out
    assert "…" not in out
