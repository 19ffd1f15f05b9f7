"""The paper's findings are tested on cells: by how much, in which scenes, either way."""

from dataclasses import replace

import pytest

from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import METHODS, PARTS, Capture, Cell, cells_of
from emmc_rig.study.tables.findings import CLAIMS, findings_from, printed_figures

SCENES = ["dragons", "dice", "buttercup", "tulip"]
FLAT = 25.0


def flat_cells():
    """Every cell of every part at the same figures."""
    return {
        cell: {"psnr_db": FLAT, "chroma_psnr_db": FLAT}
        for part in PARTS.values()
        for cell in cells_of(part, SCENES)
    }


def changed(cells, choose, **gains):
    """The cells with gains added where `choose(cell)`."""
    return {
        cell: {key: value + gains.get(key, 0) for key, value in figures.items()}
        if choose(cell)
        else figures
        for cell, figures in cells.items()
    }


def found(cells, name):
    return {finding.claim.name: finding for finding in findings_from(cells, SCENES)}[name]


def test_a_tie_does_not_hold():
    for finding in findings_from(flat_cells(), SCENES):
        assert finding.verdict == "does not hold"
        assert finding.spread is not None
        assert finding.spread.mean_db == 0


def test_without_cells_nothing_is_claimed():
    for finding in findings_from({}, SCENES):
        assert finding.verdict == "not measured"
        assert finding.ours == {}


CFA, MONO = Capture("ii", 1), Capture("iii", 1)
CASES = {
    "tv-dict-noise-free": lambda c: c.method == "tv-dict" and not c.capture.noisy,
    "tv-dict-noisy": lambda c: c.method == "tv-dict" and c.capture.noisy,
    "tv-dict-real": lambda c: c.method == "tv-dict",
    "tv-dict-quarter": lambda c: c.method == "tv-dict" and c.capture.binning == 2,
    "rgb-per-acquisition": lambda c: c.capture.scenario == "i",
    "mono-per-reading": lambda c: c.capture.scenario == "iii" and c.capture.shots == 3,
    "cfa-noise": lambda c: c.capture == replace(CFA, noisy=True),
    "mono-colour": lambda c: c.capture != MONO,
    "mono-colour-recovered": lambda c: c.capture == Capture("iii", 2),
    "masks": lambda c: c.capture.mask in ("rgbw", "binary"),
    "joint-demosaicing": lambda c: not c.capture.demosaiced,
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("gain_db", [1.5, -1.5])
def test_a_finding_holds_or_not_by_what_was_measured(name, gain_db):
    cells = changed(flat_cells(), CASES[name], psnr_db=gain_db, chroma_psnr_db=gain_db)
    finding = found(cells, name)
    assert finding.spread is not None
    assert finding.spread.mean_db == pytest.approx(gain_db)
    assert finding.verdict == ("holds" if gain_db > 0 else "does not hold")
    assert finding.spread.holding == (finding.spread.scenes if gain_db > 0 else 0)


@pytest.mark.parametrize("scenario", ["i", "ii", "iii"])
def test_more_shots_are_by_method_the_smallest_step(scenario):
    cells = flat_cells()
    step = {"i": 3}.get(scenario, 1)
    for cell in cells:
        if cell.capture.binning == 2 and cell.capture.scenario == scenario:
            rises = (0, 3.0, 3.5, 5.0)[cell.capture.shots // step - 1]
            cells[cell] = {"psnr_db": FLAT + rises}
    spread = found(cells, f"shots-{scenario}").spread
    assert spread is not None
    assert spread.mean_db == pytest.approx(0.5)
    for cell in cells:
        if cell.capture == Capture(scenario, 4 * step, 2):
            cells[cell] = {"psnr_db": FLAT}
    assert found(cells, f"shots-{scenario}").verdict == "does not hold"


def test_the_mean_and_the_range_are_over_scenes():
    cells = changed(flat_cells(), lambda c: c.capture.scenario == "i", psnr_db=2.0)
    cells = changed(cells, lambda c: c.capture.scenario == "i" and c.scene == "tulip", psnr_db=-3.0)
    spread = found(cells, "rgb-per-acquisition").spread
    assert spread is not None
    assert (spread.mean_db, spread.low_db, spread.high_db) == pytest.approx((0.5, -1.0, 2.0))
    assert (spread.holding, spread.scenes) == (1, 2)
    assert str(spread) == "+0.50 (-1.00 to +2.00)"


def test_the_other_methods_are_tested_beside():
    cells = changed(
        flat_cells(), lambda c: c.capture.scenario == "i" and c.method == "tv", psnr_db=4.0
    )
    finding = found(cells, "rgb-per-acquisition")
    assert finding.ours["tv"].mean_db == pytest.approx(4)
    assert finding.verdict == "does not hold"
    assert set(finding.ours) == set(METHODS)


def test_a_scene_that_lacks_a_cell_is_left_out():
    cells = flat_cells()
    del cells[Cell("tulip", Capture("iii", 1), "tv-dict")]
    spread = found(cells, "rgb-per-acquisition").spread
    assert spread is not None
    assert spread.scenes == 1


def test_an_infinite_figure_leaves_its_scene_out():
    cells = changed(flat_cells(), lambda c: False)
    cells[Cell("tulip", Capture("iii", 1), "tv-dict")] = {"psnr_db": None}
    spread = found(cells, "rgb-per-acquisition").spread
    assert spread is not None
    assert spread.scenes == 1


def test_the_papers_own_numbers_hold_by_what_its_tables_say():
    findings = {f.claim.name: f for f in findings_from(printed_figures(), list(paper.TITLES))}
    noise = findings["cfa-noise"].printed
    # Dragon: min(30.22 - 28.40, 30.52 - 26.68) - (27.98 - 27.82) = 1.66; Fish 0.06.
    assert noise is not None
    assert noise.mean_db == pytest.approx((1.66 + 1.67 + 0.06 + 1.70) / 4)
    assert noise.low_db == pytest.approx(0.06)
    rgb = findings["rgb-per-acquisition"].printed
    # Buttercup: 33.60 - max(29.64, 28.06) is not the least; Tulip's 44.52 - 40.83 is.
    assert rgb is not None
    assert rgb.low_db == pytest.approx(44.52 - 40.83)
    assert all(f.printed.holds for f in findings.values() if f.printed is not None)


def test_every_claim_says_what_it_compares_and_where_the_paper_says_so():
    names = [claim.name for claim in CLAIMS]
    assert len(names) == len(set(names))
    for claim in CLAIMS:
        assert claim.by_method in claim.methods
        assert claim.part in PARTS
        assert claim.sentence
        assert claim.compares
