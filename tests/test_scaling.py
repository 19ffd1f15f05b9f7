"""Tuned constants of modules, found and scaled."""

from types import ModuleType

import pytest

from emmc_rig.study.scaling import Constant, scaled, scaled_value
from emmc_rig.study.sweep import NotApplicableError
from reconstruction.verdict import shots
from reconstruction.verdict.rules import Limits


@pytest.mark.parametrize(
    ("name", "value", "doubled", "halved"),
    [
        ("STRENGTH", 0.3, 0.6, 0.15),
        ("STEPS", 3, 6, 2),
        ("WINDOW_PX", 9, 17, 5),
        ("NEAR_PX", 2, 4, 1),
        ("EACH", (1, 2.0), (2, 4.0), (1, 1.0)),
        ("LIMITS", Limits(1.0, 2.0), Limits(2.0, 4.0), Limits(0.5, 1.0)),
    ],
)
def test_numbers_are_scaled_and_windows_stay_odd(name, value, doubled, halved):
    constant = Constant("module", name, value)
    assert scaled_value(constant, 2.0) == doubled
    assert scaled_value(constant, 0.5) == halved


def test_what_cannot_get_less_is_not_applicable():
    with pytest.raises(NotApplicableError, match="FEWEST stays 1"):
        scaled_value(Constant("module", "FEWEST", 1), 0.5)


def test_every_module_that_uses_a_constant_has_it_scaled_until_the_block_ends():
    home, user = ModuleType("package.home"), ModuleType("package.user")
    vars(home)["STRENGTH"] = vars(user)["STRENGTH"] = strength = 0.3
    with scaled([home, user], Constant("home", "STRENGTH", strength), 2.0):
        assert vars(home)["STRENGTH"] == vars(user)["STRENGTH"] == 0.6
    assert vars(home)["STRENGTH"] == vars(user)["STRENGTH"] == 0.3


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_the_median_of_outliers_has_a_window_that_opencv_takes(factor):
    width = scaled_value(Constant("shots", "OUTLIERS_PX", shots.OUTLIERS_PX), factor)
    assert isinstance(width, int)
    assert width % 2 == 1
