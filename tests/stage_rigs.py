"""Stages for tests: each protocol's simulated firmware on each kind of wire, or a real one."""

from typing import Any, ClassVar

from drivers import grbl_codec as codec
from drivers.apt import AptAxis, AptStage
from drivers.apt_codec import Id
from drivers.grbl import GrblStage
from drivers.zaber import ZaberStage
from emmc_rig.conformance.rigs import StageRig
from simulators.apt import AptController
from simulators.grbl import GrblController
from simulators.zaber import AxisSpec, ZaberChain

QUICK_HOMING = {codec.HOMING_SEEK: 6000, codec.HOMING_FEED: 600}
"""mm/min; Grbl is silent while it homes, and on a real wire silence really takes time."""


class ZaberRig(StageRig):
    replies_are_numbered = True
    axes = ("mask_x", "mask_y")
    addresses: ClassVar = {"mask_x": (1, 1), "mask_y": (2, 1)}
    spec = AxisSpec()

    def make_device(self) -> Any:
        return ZaberChain(self.clock, dict.fromkeys(self.addresses.values(), self.spec))

    def make_from(self, settings):
        return ZaberStage(
            self.transport, self.addresses, self.spec.microstep_um, self.clock, settings
        )

    def true_um(self, axis):
        return self.device.position_um(*self.addresses[axis])

    def is_move(self, occasion):
        return b" move " in occasion.command

    def is_question(self, occasion):
        return b" get pos" in occasion.command


class GrblRig(StageRig):
    axes = ("mask_x", "mask_y")
    letters: ClassVar = {"mask_x": "X", "mask_y": "Y"}
    senses_stalls = False

    def make_device(self) -> Any:
        return GrblController(self.clock, settings=QUICK_HOMING)

    def make_from(self, settings):
        return GrblStage(self.transport, self.letters, self.clock, settings)

    def true_um(self, axis):
        letter = self.letters[axis]
        return self.device.position_um(letter) - self.device.axes[letter].travel_um

    def is_move(self, occasion):
        return b"$J=" in occasion.command

    def is_question(self, occasion):
        return b"?" in occasion.command


class AptRig(StageRig):
    axes = ("mask_x",)

    def make_device(self) -> Any:
        return AptController(self.clock)

    def make_from(self, settings):
        return AptStage({"mask_x": AptAxis(self.transport)}, self.clock, settings)

    def true_um(self, axis):
        return self.device.position_um()

    def is_move(self, occasion):
        return occasion.command[:2] == Id.MOT_MOVE_ABSOLUTE.to_bytes(2, "little")

    def is_question(self, occasion):
        return occasion.command[:2] == Id.MOT_REQ_DCSTATUSUPDATE.to_bytes(2, "little")


RIGS = {"zaber": ZaberRig, "grbl": GrblRig, "apt": AptRig}
