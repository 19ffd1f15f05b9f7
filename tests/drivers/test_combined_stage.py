"""Several stages as one; maker, serial number and temperature as each controller states them."""

import pytest

from emmc_rig.bench.hardware import open_simulated
from emmc_rig.drivers.apt import identify
from emmc_rig.drivers.combined import CombinedStage
from emmc_rig.drivers.errors import LimitExceededError, NotHomedError, UnknownAxisError
from emmc_rig.drivers.stage import StageIdentity
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


@pytest.mark.parametrize("protocol", ["zaber", "grbl", "apt"])
def test_a_controller_says_its_model_and_firmware_at_rest_and_after_a_move(protocol):
    stage, _ = open_simulated(protocol)
    with stage:
        axis = stage.axes[0]
        before = stage.identity(axis)
        assert before.model
        assert before.firmware
        stage.home()
        assert stage.identity(axis) == before
        with pytest.raises(UnknownAxisError):
            stage.identity("elsewhere")


def test_axes_of_two_zaber_devices_have_their_own_serial_numbers():
    stage, _ = open_simulated("zaber")
    with stage:
        serials = {axis: stage.identity(axis).serial for axis in stage.axes}
        assert serials["mask_x"] == serials["mask_y"] != serials["aperture_x"]
        assert stage.identity("mask_x").maker == "Zaber"
        assert stage.temperatures_c() == {"device 1": 31.4, "device 2": 31.4}


def test_a_thorlabs_controller_says_its_serial_number_as_probing_it_does():
    stage, firmware = open_simulated("apt")
    with stage:
        own = stage.identity(stage.axes[0])
    told = identify(firmware.transport(), ManualClock())
    assert (own.maker, own.model) == ("Thorlabs", told.model)
    assert own.serial == str(told.serial_number)


def test_several_stages_in_one_ask_the_one_that_has_the_axis():
    zaber, _ = open_simulated("zaber")
    grbl, _ = open_simulated("grbl")
    still = StillStage(("still",), ManualClock())
    with CombinedStage([zaber, grbl, still]) as stage:
        assert stage.identity("mask_x") == zaber.identity("mask_x")
        assert stage.identity(grbl.axes[0]).model == "Grbl"
        # A stage without an identity, as a plug-in's may be.
        assert stage.identity("still") == StageIdentity()
        assert stage.temperatures_c() == {"stage 1 device 1": 31.4, "stage 1 device 2": 31.4}
