"""What all tests share: options, and which optional checks this machine can run."""

import os
from pathlib import Path

import pytest


def pytest_addoption(parser):
    parser.addoption("--fuzz-cases", type=int, default=2000, help="random cases of each fuzz test")
    parser.addoption(
        "--stage",
        default="",
        help="stage of the tests marked hardware: zaber:/dev/ttyUSB0, or a YAML file",
    )


def pytest_collection_modifyitems(config, items):
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    lightfields = bool(folder) and Path(folder).is_dir()
    stage = bool(config.getoption("--stage"))
    for item in items:
        if "real_data" in item.keywords and not lightfields:
            reason = "EMMC_LIGHTFIELDS does not name a folder of real light fields"
            item.add_marker(pytest.mark.skip(reason=reason))
        if "hardware" in item.keywords and "rig" in item.fixturenames and not stage:
            item.add_marker(pytest.mark.skip(reason="--stage names no stage"))
