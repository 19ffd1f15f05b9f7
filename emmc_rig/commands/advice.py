"""What helps against an error, in words of the command line."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from emmc_rig.drivers.errors import AxisFaultError, NotHomedError, PositionMismatchError
from emmc_rig.model.advice import AdvisedError

WORDS = {
    "name-frame": "such as --frame 0",
    "reconstruct": "run `emmc-rig reconstruct {about}`",
    "capture": "go on with: emmc-rig capture {about}",
    "capture-edited": "an edited copy of the plan: emmc-rig capture COPY.yaml --out {about}",
    "name-rig": "such as --rig simulated",
    "other-devices": "say so by --other-devices",
    "new-plan": "`emmc-rig capture --new CAMERA` writes one",
    "plan-whiteboards": "`emmc-rig calibrate --plan` writes a plan that has them",
    "plan-open-whiteboards": "`emmc-rig calibrate --plan --skip aperture` writes such a plan",
    "list-cameras": "`emmc-rig cameras` lists the shipped ones",
    "list-sessions": "`emmc-rig session list` shows the sessions there are",
    "list-formats": "`emmc-rig export --list` marks them",
}
HOME = "home by `emmc-rig devices home {about} --stage STAGE`"
TO_HOME = (NotHomedError, AxisFaultError, PositionMismatchError)


def in_shell(fault: BaseException) -> str:
    """Return an error's line and notes, with the commands or flags that help against its cause."""
    return "; ".join([str(fault), *getattr(fault, "__notes__", ()), *dict.fromkeys(_typed(fault))])


def _typed(fault: BaseException | None) -> Iterator[str]:
    while fault is not None:
        if isinstance(fault, AdvisedError) and fault.advice is not None:
            yield WORDS[fault.advice].format(about=shlex.quote(str(fault.about)))
        if isinstance(fault, TO_HOME):
            yield HOME.format(about=fault.axis)
        fault = fault.__cause__
