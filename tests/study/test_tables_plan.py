"""What the tables ask for, and the paper's numbers that stand beside ours."""

import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import (
    MASKS,
    PARTS,
    Capture,
    Cell,
    cells_of,
    chosen_parts,
    scenes_of,
)

GIVEN = [
    "antinous", "begonia", "bikes", "buttercup", "dice", "dragons", "fish", "messerschmitt",
    "occlusions",
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("table2", 4 * 3 * 2 * 3),
        ("table3", 5 * 7 * 3),
        ("table4", 5 * 12 * 3),
        ("figure6", 2),
        ("figure8", 4 * 4 * 3),
    ],
)
def test_a_part_has_a_cell_for_every_scene_capture_and_method(name, count):
    cells = cells_of(PARTS[name], GIVEN)
    assert len(cells) == count == len(set(cells))


def test_cells_that_parts_share_are_done_once():
    cells = {cell for part in PARTS.values() for cell in cells_of(part, GIVEN)}
    # Figure 8 shares RGBW with Table II, Figure 6 all but the demosaiced one.
    assert len(cells) == 72 + 105 + 180 + (48 - 12) + 1


def test_table_2_is_about_the_four_synthetic_scenes_and_the_others_about_the_rest():
    assert scenes_of(PARTS["table2"], GIVEN) == ["dragons", "dice", "fish", "messerschmitt"]
    assert scenes_of(PARTS["table3"], GIVEN) == [
        "buttercup", "antinous", "begonia", "bikes", "occlusions",
    ]  # fmt: skip
    assert scenes_of(PARTS["figure6"], GIVEN) == ["dragons"]


def test_either_kind_of_scene_stands_in_for_the_other():
    assert scenes_of(PARTS["table2"], ["cave", "attic"]) == ["attic", "cave"]
    assert scenes_of(PARTS["table4"], ["dice"]) == ["dice"]


def test_parts_are_chosen_by_name_in_the_papers_order():
    assert [part.name for part in chosen_parts("figure8, table2")] == ["table2", "figure8"]
    assert [part.name for part in chosen_parts(None)] == list(PARTS)


@pytest.mark.parametrize(
    ("only", "reported"),
    [("tabel3", "did you mean 'table3'"), ("xyz", "known are table2"), (",", "")],
)
def test_an_unknown_part_is_reported_with_the_nearest(only, reported):
    with pytest.raises(AppError, match="--only") as fault:
        chosen_parts(only)
    assert reported in str(fault.value)


@pytest.mark.parametrize("capture", [c for part in PARTS.values() for c in part.captures])
def test_every_capture_has_the_same_total_exposure_and_its_shots(capture):
    camera = capture.camera()
    assert camera.exposures_s().sum() == pytest.approx(0.05)
    assert len(camera.shots) == capture.shots
    assert camera.sensor.binning == capture.binning


def test_a_capture_changes_the_pattern_of_the_mask_only():
    plain, binary = (Capture("ii", 1, mask=mask).camera() for mask in ("rgbw", "binary"))
    pattern = {"pattern": plain.masks["mask"].pattern}
    assert binary.masks["mask"].model_copy(update=pattern) == plain.masks["mask"]
    assert binary.masks["mask"].pattern.kind == "random_binary"
    assert plain == Capture("ii", 1).camera()


def test_all_mask_patterns_let_about_half_of_the_light_through():
    for pattern in MASKS.values():
        assert pattern.draw(1, 90, 90, 1.0).mean() == pytest.approx(0.5, abs=0.02)


def test_numbers_stand_where_the_paper_prints_them():
    def printed(scene, capture, method):
        return Cell(scene, capture, method).paper_psnr_db

    assert printed("dragons", Capture("i", 3), "tv-dict") == 30.22
    assert printed("Dragon", Capture("iii", 3, noisy=True), "dict-admm") == 26.35
    assert printed("messerschmitt", Capture("ii", 1, noisy=True), "tv-dict") == 29.75
    assert printed("seahorse", Capture("iii", 3), "tv-dict") == 36.05
    assert printed("White Rose", Capture("ii", 2), "dict-admm") == 33.24
    assert printed("buttercup", Capture("ii", 1), "dict-admm") == 29.71
    assert printed("buttercup", Capture("i", 12, 2), "tv-dict") == 34.75
    assert printed("tulip", Capture("iii", 4, 2), "tv-dict") == 42.06
    assert printed("orchid", Capture("ii", 3, 2), "dict-admm") == 29.28


def test_nothing_stands_where_the_paper_prints_nothing():
    assert Cell("seahorse", Capture("iii", 4, 2), "dict-admm").paper_psnr_db is None
    assert Cell("dragons", Capture("i", 3), "tv").paper_psnr_db is None
    assert Cell("attic", Capture("i", 3), "tv-dict").paper_psnr_db is None
    assert (
        Cell("dragons", Capture("ii", 1, noisy=True, mask="binary"), "tv-dict").paper_psnr_db
        is None
    )
    assert Cell("dragons", Capture("ii", 1, demosaiced=True), "tv-dict").paper_psnr_db is None
    assert len(paper.PSNR_DB) == 2 * 24 + 2 * 49 + 6 + 2 * 84 - 1


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
