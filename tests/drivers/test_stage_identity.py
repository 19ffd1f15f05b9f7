"""Who made the controller of each axis, and how warm it is, as the controllers themselves say."""

import pytest

from emmc_rig.bench.hardware import open_simulated
from emmc_rig.drivers.apt import identify
from emmc_rig.drivers.combined import CombinedStage
from emmc_rig.drivers.errors import UnknownAxisError
from emmc_rig.drivers.stage import StageIdentity
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.still import StillStage


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
