"""Every stage of this package against what every stage does, on every wire; and a real one.

`pytest -m hardware --stage zaber:/dev/ttyUSB0` runs what needs no simulator against a real stage,
as `emmc-rig devices conform` does.
"""

from types import SimpleNamespace

import pytest
from serial.urlhandler import protocol_socket
from stage_rigs import RIGS

from emmc_rig.conformance.rigs import WIRES, NamedStage
from emmc_rig.conformance.stages import *  # noqa: F403

SIMULATED = [f"{protocol}-{wire}" for protocol in RIGS for wire in WIRES]


@pytest.fixture(params=[*SIMULATED, pytest.param("hardware", marks=pytest.mark.hardware)])
def rig(request, opened, tmp_path, monkeypatch):
    """Every kind of stage, a real one too."""
    if request.param != "hardware":
        return simulated_rig(request.param, opened, tmp_path, monkeypatch)
    real = NamedStage(request.config.getoption("--stage"))
    opened.callback(real.close)
    return real


@pytest.fixture(params=SIMULATED)
def simulated(request, opened, tmp_path, monkeypatch):
    """Every kind of stage whose truth is known, and whose faults can be made."""
    return simulated_rig(request.param, opened, tmp_path, monkeypatch)


@pytest.fixture(params=RIGS)
def in_memory(request, opened, tmp_path):
    return RIGS[request.param]("memory", opened, tmp_path)


def simulated_rig(name, opened, tmp_path, monkeypatch):
    protocol, wire = name.split("-")
    # pyserial pauses 0.3 s in the closing of a socket, for the other side's sake
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=lambda pause_s: None))
    return RIGS[protocol](wire, opened, tmp_path)
