"""Every stage of this package against what every stage does, on every wire; and a real one.

`pytest -m hardware --stage zaber:/dev/ttyUSB0` runs it against a real stage, as
`emmc-rig devices conform` does.
"""

import pytest
from stage_rigs import SIMULATED, opened, simulated_rig  # noqa: F401

from emmc_rig.bench.conformance.named import NamedStage
from emmc_rig.bench.conformance.stages import *  # noqa: F403


@pytest.fixture(params=[*SIMULATED, pytest.param("hardware", marks=pytest.mark.hardware)])
def rig(request, opened, tmp_path):  # noqa: F811
    """Every kind of stage, a real one too."""
    if request.param != "hardware":
        return simulated_rig(request.param, opened, tmp_path)
    real = NamedStage(request.config.getoption("--stage"))
    opened.callback(real.close)
    return real
