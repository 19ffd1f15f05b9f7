"""Several stages as one."""

import pytest

from emmc_rig.drivers.combined import CombinedStage
from emmc_rig.drivers.errors import LimitExceededError, NotHomedError, UnknownAxisError
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.still import StillStage


class Recorded(StillStage):
    """Keeps which axes were stopped, and may fail to move."""

    def __init__(self, *axes, fails=False):
        super().__init__(axes, ManualClock())
        self.fails, self.stopped, self.closed = fails, [], False

    def move_to_um(self, targets_um):
        if self.fails:
            raise NotHomedError(self.axes[0])
        return super().move_to_um(targets_um)

    def stop(self, axes=None):
        self.stopped.append(tuple(axes or ()))

    def close(self):
        self.closed = True


def test_each_axis_is_that_of_its_stage():
    mask, plate = Recorded("mask_x", "mask_y"), Recorded("aperture_x")
    both = CombinedStage([mask, plate])
    assert both.axes == ("mask_x", "mask_y", "aperture_x")
    both.home()
    assert both.move_to_um({"mask_y": 5.0, "aperture_x": 7.0}) == {"mask_y": 5.0, "aperture_x": 7.0}
    assert (mask.position_um("mask_y"), plate.position_um("aperture_x")) == (5.0, 7.0)
    assert both.move_by_um({"aperture_x": 1.0}) == {"aperture_x": 8.0}
    both.close()
    assert mask.closed
    assert plate.closed


def test_a_target_beyond_a_limit_moves_no_stage():
    mask, plate = Recorded("mask_x"), Recorded("aperture_x")
    both = CombinedStage([mask, plate])
    both.home()
    with pytest.raises(LimitExceededError):
        both.move_to_um({"mask_x": 5.0, "aperture_x": -7.0})
    assert mask.position_um("mask_x") == 0.0


def test_a_stage_that_fails_stops_the_others():
    mask, plate = Recorded("mask_x"), Recorded("aperture_x", fails=True)
    both = CombinedStage([mask, plate])
    both.home()
    with pytest.raises(NotHomedError):
        both.move_to_um({"mask_x": 5.0, "aperture_x": 7.0})
    assert mask.stopped == [("mask_x",)]
    assert plate.stopped == [("aperture_x",)]


def test_an_axis_is_one_stages_alone_and_known():
    with pytest.raises(ValueError, match="two stages have an axis x"):
        CombinedStage([Recorded("x"), Recorded("x")])
    with pytest.raises(UnknownAxisError):
        CombinedStage([Recorded("x")]).position_um("y")
    assert CombinedStage([]).axes == ()
