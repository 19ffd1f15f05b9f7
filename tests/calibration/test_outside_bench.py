"""The outside bench's pinholes, glare and filters follow their physics."""

import numpy as np
import pytest
from outside_bench import Bench, Course, Optics, Sensor, _diffracted

CELLS = (np.random.default_rng(0).random((60, 70, 3)) < 0.5).astype(float)
SIZE = (8, 10)
CORNERS = (0, 0), (0, 4), (4, 0), (4, 4)


def bench(course=None, sensor=None, behind=None, **optics):
    optics, sensor, course = Optics(**optics), Sensor(**(sensor or {})), Course(**(course or {}))
    return Bench(CELLS, SIZE, optics, sensor, course, behind=behind)


def uncovered(bench, view):
    """Return what of an open camera's light every pixel gets through the pinhole, (y, x)."""
    return bench._seen(view, (0.0, 0.0), 0.0, None, (1.0, 1.0, 1.0))


def test_a_plate_that_is_moved_by_a_cell_uncovers_the_neighbour():
    moved = bench(plate_at_um=(1500.0, 0.0))
    assert uncovered(moved, (2, 2)) == pytest.approx(uncovered(bench(), (2, 3)), rel=1e-12)
    assert not moved._hole((2, 4))


def test_holes_beside_each_other_uncover_a_row_of_the_aperture_once():
    right, left = (bench(plate_at_um=(by, 0.0)) for by in (750.0, -750.0))
    row = sum(uncovered(right, (2, u)) for u in range(5)) + uncovered(left, (2, 0))
    assert row == pytest.approx(sum(uncovered(bench(), (2, u)) for u in range(5)), rel=1e-3)


def test_a_plate_turned_about_the_axis_loses_light_at_the_corners_alone():
    turned = bench(plate_turn_deg=2.0)
    left = [uncovered(turned, view).mean() / uncovered(bench(), view).mean() for view in CORNERS]
    lost_um = np.deg2rad(2.0) * 3000 + (1 - np.cos(np.deg2rad(2.0))) * 3000
    assert left == pytest.approx([1 - lost_um / 1500] * 4, abs=0.02)
    assert uncovered(turned, (2, 2)) == pytest.approx(uncovered(bench(), (2, 2)), rel=1e-12)


def test_hands_put_the_pinhole_elsewhere_for_every_board_and_repeats_share_it():
    by_hand = bench({"hands_um": 200.0})
    places = []
    for view in ((2, 2), (2, 2), (2, 1), (2, 2)):
        by_hand.take(1.0, view)
        places.append(by_hand.hand_um)
    assert places[0] == places[1]
    assert len(set(places)) == 3
    assert np.hypot(*np.transpose(places)) == pytest.approx([200.0] * 4)


def test_a_pinhole_in_the_hole_beside_shows_the_view_beside():
    beside = bench({"beside": ((2, 2), (2, 3))})
    assert uncovered(beside, (2, 2)) == pytest.approx(uncovered(bench(), (2, 3)), rel=1e-12)
    assert uncovered(beside, (2, 3)) == pytest.approx(uncovered(bench(), (2, 3)), rel=1e-12)


@pytest.mark.parametrize(
    ("glare", "shares"),
    [({"glare": 0.01}, [0.01] * 3), ({"glare_after": 0.01}, [0.0118, 0.0083, 0.0137])],
)
def test_glare_adds_light_where_the_mask_is_black_more_where_a_filter_passes_little(glare, shares):
    cells = np.zeros((60, 70, 3))
    cells[:, 35:] = 1
    half = Bench(cells, (32, 40), Optics(offset_um=(0, 0), rotation_rad=0, **glare))
    total = half.psi().sum((0, 1))
    dark = [total[:, :4][half.colour[:, :4] == colour].mean() for colour in range(3)]
    # Of what passes on the bright half: the picture's mean is 1 / 2; after the filters that is of
    # the mean of the filters 0.7, 1, 0.6, which is 0.825.
    assert dark == pytest.approx(np.multiply(shares, 0.5), rel=0.04)


def test_parts_of_psi_by_colour_add_up_and_crosstalk_is_their_share():
    mixed = bench(sensor={"crosstalk": 0.05})
    parts = np.stack([mixed.psi_of(0, 0, lamp) for lamp in ("red", "green", "blue")])
    assert parts.sum(0) == pytest.approx(mixed.psi(), abs=1e-12)
    clear = Bench(np.ones((60, 70, 3)), SIZE, sensor=Sensor(crosstalk=0.05))
    assert clear.psi_of(0, 0, "red").sum((0, 1))[clear.colour == 1] == pytest.approx(0.025)


def test_diffraction_keeps_light_and_spreads_an_edge_by_fresnel():
    edge = np.zeros((400, 400, 1))
    edge[:, 200:] = 1
    behind = _diffracted(edge, 1.0, 1000.0)[200, :, 0]
    assert behind[100:300].mean() == pytest.approx(0.5, abs=0.02)
    # Behind the geometrical edge a quarter of the light (Fresnel), and more than all of it beyond.
    assert behind[199:201].mean() == pytest.approx(0.25, abs=0.03)
    assert behind[200 + 20] > 1.2


def test_a_second_mask_behind_takes_its_own_share_of_every_ray():
    dark = np.full((60, 70, 1), 0.25)
    two = bench(behind=dark)
    single = Bench(CELLS, SIZE)
    assert two.psi() == pytest.approx(0.25 * single.psi(), abs=5e-4)


def test_a_mask_that_creeps_and_a_lens_that_warms_change_every_frame():
    creeping = bench({"creep_um": 0.5})
    creeping.taken = 4
    assert creeping._stands(0.0) == pytest.approx(2.0)
    warming = bench({"focus_um": 10.0, "soften_um": 0.1})
    warming.taken = 5
    assert (warming._now().lens_um, warming._now().blur_um) == pytest.approx((50_050, 1.3))


def test_a_board_on_the_lamp_turns_with_it_or_not_at_all():
    both, neither = (bench(turns=how, lamp_side=0.1, board=0.1) for how in ("both", "neither"))
    assert both.radiance(180.0) == pytest.approx(both.radiance()[:, ::-1])
    assert neither.radiance(180.0) == pytest.approx(neither.radiance())
