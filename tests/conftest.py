"""What all tests share: which optional checks this machine can run."""

import os
from pathlib import Path

import pytest


def pytest_addoption(parser):
    parser.addoption(
        "--stage", help="a real stage for tests marked hardware: zaber:/dev/ttyUSB0, or a YAML file"
    )
    parser.addoption(
        "--fuzz-cases", type=int, default=2000, help="random cases for each codec and driver"
    )


def pytest_collection_modifyitems(config, items):
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    skips = {}
    if not (folder and Path(folder).is_dir()):
        skips["real_data"] = "EMMC_LIGHTFIELDS does not name a folder of real light fields"
    if not config.getoption("--stage"):
        skips["hardware"] = "no real stage: name one with --stage"
    for item in items:
        for marker, reason in skips.items():
            if marker in item.keywords:
                item.add_marker(pytest.mark.skip(reason=reason))
