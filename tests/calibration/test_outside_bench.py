"""The outside bench's pinholes, glare and filters follow their physics."""

import numpy as np
import pytest
from outside_bench import Bench, Course, Optics, Sensor, _diffracted

CELLS = (np.random.default_rng(0).random((60, 70, 3)) < 0.5).astype(float)
SIZE = (8, 10)


def bench(course=None, sensor=None, behind=None, **optics):
    optics, sensor, course = Optics(**optics), Sensor(**(sensor or {})), Course(**(course or {}))
    return Bench(CELLS, SIZE, optics, sensor, course, behind=behind)


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
