"""What all tests share: which optional checks this machine can run."""

import os
from pathlib import Path

import pytest


def pytest_collection_modifyitems(items):
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    if folder and Path(folder).is_dir():
        return
    reason = "EMMC_LIGHTFIELDS does not name a folder of real light fields"
    for item in items:
        if "real_data" in item.keywords:
            item.add_marker(pytest.mark.skip(reason=reason))
