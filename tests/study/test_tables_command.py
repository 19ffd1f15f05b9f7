"""`emmc-rig tables` end to end: every file it writes, what it prints, and how it fails."""

import csv
import html.parser
import json
import re
from functools import partial

import cv2
import numpy as np
import pytest
from rich.console import Console

from emmc_rig.model.lightfield import save_hdf5
from emmc_rig.pages.pictures import detailed_pieces
from emmc_rig.progress import Silent
from emmc_rig.study.tables import tables_page, tables_study
from emmc_rig.study.tables.cells import PARTS, cells_of
from emmc_rig.study.tables.grids import MEAN
from emmc_rig.study.tables.tables_page import COLUMNS, run_tables, shown
from emmc_rig.study.tables.tables_study import TablesSettings, TablesStudy
from reconstruction.bpdn import BPDNSettings
from reconstruction.dictionary import Dictionary, dct_dictionary
from reconstruction.methods import MethodSettings
from reconstruction.sparse import SparseSettings
from reconstruction.tv import TVSettings

NAMES = ("attic", "dragons")
QUICK = TablesSettings(
    size=(16, 18),
    binned_size=(16, 18),
    methods=MethodSettings(
        tv=TVSettings(max_steps=2),
        sparse=SparseSettings(stride=8, solver=BPDNSettings(method="admm", max_steps=3, rtol=0.5)),
    ),
    binned_stride=8,
)


def quick(dictionary):
    return QUICK.model_copy(update={"dictionary": dictionary})


def save_scenes(folder):
    for seed, name in enumerate(NAMES):
        rng = np.random.default_rng(seed)
        picture = np.clip(0.5 + cv2.GaussianBlur(rng.random((24, 26, 3)) - 0.5, (0, 0), 1), 0, 1)
        views = [[picture[v : v + 20, u : u + 22] for u in range(5)] for v in range(5)]
        save_hdf5(folder / f"{name}.h5", np.asarray(views, np.float32), {})
    return folder


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return save_scenes(tmp_path_factory.mktemp("scenes"))


@pytest.fixture(scope="module")
def small_dictionary(tmp_path_factory):
    path = tmp_path_factory.mktemp("dictionary") / "small.h5"
    dct_dictionary((5, 5), (8, 8), (1, 1, 3, 3), (1, 1, 1, 1)).save(path)
    return str(path)


@pytest.fixture(scope="module")
def whole(scenes, small_dictionary, tmp_path_factory):
    """All tables and figures of two tiny scenes."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    outcome = run_tables(scenes, folder, None, quick(small_dictionary), Silent())
    return folder, outcome


@pytest.fixture
def run(run):
    """Run `emmc-rig tables` in this process: exit code, standard output and standard error."""
    return partial(run, "tables")


def one_line(text):
    lines = [line for line in text.strip().splitlines() if line.startswith("emmc-rig:")]
    assert len(lines) == 1, text
    assert "Traceback" not in text
    return lines[0]


def test_every_cell_is_one_row_of_the_csv(whole):
    folder, _ = whole
    with open(folder / "tables.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    cells = {cell for part in PARTS.values() for cell in cells_of(part, list(NAMES))}
    assert len(rows) == len(cells) == 18 + 21 + 36 + (12 - 3) + 1
    assert tuple(rows[0]) == COLUMNS
    shared = [row for row in rows if "figure8" in row["tables"] and "table2" in row["tables"]]
    assert [row["mask"] for row in shared] == ["rgbw"] * 3
    printed = [row for row in rows if row["paper_psnr_db"]]
    assert {row["scene"] for row in printed} == {"dragons"}
    row = next(r for r in printed if (r["scenario"], r["method"]) == ("i", "tv-dict"))
    assert (row["paper_psnr_db"], row["shots"], row["noise"]) == ("30.2200", "3", "no")
    for row in rows:
        assert float(row["psnr_db"]) > 0
        assert float(row["replicate_psnr_db"]) > 0
        assert (row["rows"], row["columns"]) == ("16", "18")
        assert bool(row["dictionary"]) == (row["method"] != "tv")
        assert bool(row["sensor_psnr_db"]) == (row["noise"] == "yes")


class Links(html.parser.HTMLParser):
    """Collects what a page refers to."""

    def __init__(self):
        super().__init__()
        self.targets, self.anchors, self.pictures = [], set(), 0

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.anchors.add(found.get("id"))
        self.pictures += tag == "img"
        self.targets += [found[key] for key in ("href", "src") if key in found]


def test_the_page_is_whole_and_asks_for_nothing(whole):
    folder, outcome = whole
    assert outcome.page == folder / "tables.html"
    text = outcome.page.read_text()
    assert "{{" not in text
    links = Links()
    links.feed(text)
    for target in links.targets:
        assert target.startswith(("data:", "#"))
        if target.startswith("#"):
            assert target[1:] in links.anchors
    assert not re.search(r"https?://", re.sub(r'"data:[^"]*"', "", text))
    for part in PARTS.values():
        assert part.title.partition(":")[0] in text
    assert "30.22" in text


def test_the_metrics_tell_the_findings(whole):
    folder, outcome = whole
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["cells"] == 85
    reported = {finding["name"]: finding for finding in metrics["findings"]}
    for finding in outcome.findings:
        assert reported[finding.claim.name]["verdict"] == finding.verdict
        assert finding.verdict != "not measured"
    assert reported["cfa-noise"]["paper_db"] == pytest.approx(1.2725)


def test_grids_hold_means_and_the_papers_numbers(whole):
    _, outcome = whole
    table_2, table_3, table_4, _, figure_8 = outcome.grids
    line = next(x for x in table_2.lines if x.heads == ("dragons", "noise-free", "TV-Dict"))
    assert [pair.paper for pair in line.pairs] == [30.22, 27.98, 30.52]
    assert all(pair.ours is not None for pair in line.pairs)
    theirs = next(x for x in table_3.lines if x.heads == ("paper's 7", "TV-Dict"))
    assert theirs.pairs[0].ours is None
    assert theirs.pairs[0].paper == pytest.approx(35.62, abs=0.006)
    assert len(table_4.lines[0].pairs) == 4
    assert figure_8.columns == ("RGBW", "random binary", "uniform colour", "Gaussian colour")
    assert not any(line.heads[0] == MEAN for line in table_3.lines)


@pytest.mark.parametrize("width", [80, 160])
def test_the_console_shows_all_without_cutting_numbers(whole, width):
    _, outcome = whole
    console = Console(width=width, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        for part in shown(outcome.grids, outcome.findings):
            console.print(part)
    text = console.export_text()
    assert "…" not in text
    assert "30.22" in text
    assert "aperture variant" in " ".join(text.split())


def test_a_second_run_does_nothing_again_and_leaves_foreign_files(
    whole, scenes, small_dictionary, monkeypatch
):
    folder, outcome = whole
    (folder / "mine.txt").write_text("keep")
    before = (folder / "tables.csv").read_bytes(), (folder / "cells.jsonl").read_bytes()
    monkeypatch.setattr(tables_study, "reconstruct", None)
    again = run_tables(scenes, folder, None, quick(small_dictionary), Silent())
    assert again.grids == outcome.grids
    assert before == ((folder / "tables.csv").read_bytes(), (folder / "cells.jsonl").read_bytes())
    assert (folder / "mine.txt").read_text() == "keep"
    assert not [path for path in folder.rglob("*") if ".part" in path.name]


@pytest.mark.slow
def test_a_part_alone_is_done_from_the_command_line(run, scenes):
    code, out, _ = run("--scenes", scenes, "--only", "figure6", "--fast", "--out", "r")
    assert code == 0
    assert "open r/tables.html" in out


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["--only", "figure7"], "did you mean 'figure"),
        (["--scenes", "nowhere"], "no such folder"),
        (["--scenes", "."], "no scenes"),
        (["--dictionary", "nothing.h5"], "no such file"),
        (["--out", "taken"], "holds something else"),
        (["--out", "taken/cat.jpg"], "a file of that name"),
        (["--out", "/proc/tables"], "cannot be written"),
    ],
)
def test_faults_are_one_line(run, tmp_path, arguments, reported):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "cat.jpg").write_text("meow")
    code, _, err = run(*arguments)
    assert code == 1
    assert reported in one_line(err)
    assert (tmp_path / "taken" / "cat.jpg").read_text() == "meow"


def test_a_dictionary_that_saw_the_scene_is_refused(run, scenes, tmp_path):
    atoms = np.random.default_rng(0).normal(size=(4, 5, 5, 8, 8, 3))
    provenance = json.dumps({"scenes": ["attic"]})
    Dictionary.normalised(atoms, "ksvd", provenance).save(tmp_path / "d.h5")
    code, _, err = run("--scenes", scenes, "--only", "table3", "--dictionary", "d.h5")
    assert (code, "was trained on 'attic'" in one_line(err)) == (1, True)


@pytest.mark.slow
def test_ctrl_c_is_reported_with_how_to_go_on(run, scenes, monkeypatch):
    def interrupted(*arguments, **named):
        raise KeyboardInterrupt

    for place, stage in ((TablesStudy, "measure"), (tables_page, "grids")):
        with monkeypatch.context() as patch:
            patch.setattr(place, stage, interrupted)
            code, _, err = run("--scenes", scenes, "--only", "figure6", "--fast")
        assert code == 130
        assert "run the same command again" in one_line(err)


@pytest.mark.slow
def test_a_full_disk_is_one_line(run, scenes, monkeypatch):
    def full(*arguments, **named):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tables_page, "grids", full)
    code, _, err = run("--scenes", scenes, "--only", "figure6", "--fast")
    assert (code, "No space left" in one_line(err)) == (1, True)


def test_the_most_telling_piece_is_where_the_texture_is():
    picture = np.full((60, 80, 3), 0.5, np.float32)
    picture[30:42, 50:62] = np.random.default_rng(0).random((12, 12, 3))
    (piece,) = detailed_pieces(picture, 16)
    assert 26 <= piece.y <= 32
    assert 46 <= piece.x <= 52
