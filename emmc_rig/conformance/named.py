"""The fixtures of the suites for devices that are opened by name: a plugin of pytest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from drivers.camera import Camera
from emmc_rig.conformance.rigs import NamedStage

pytest.register_assert_rewrite("emmc_rig.conformance.cameras", "emmc_rig.conformance.stages")

FIRMWARE_FIXTURES = {"simulated", "in_memory"}
"""Of tests that make faults in simulated firmware, which a named device has none of."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Take the device's name."""
    parser.addoption("--device", required=True, help="as --stage or --camera of emmc-rig take it")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what only simulated firmware can show."""
    items[:] = [one for one in items if not FIRMWARE_FIXTURES & set(_fixtures(one))]


def _fixtures(item: pytest.Item) -> list[str]:
    return getattr(item, "fixturenames", [])


def _device(request: pytest.FixtureRequest) -> str:
    return str(request.config.getoption("--device"))


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[NamedStage]:
    """The stage of that name."""
    with closing(NamedStage(_device(request))) as named:
        yield named


@pytest.fixture
def camera(request: pytest.FixtureRequest) -> Iterator[Camera]:
    """The camera of that name."""
    from emmc_rig.bench.hardware import open_camera

    with closing(open_camera(_device(request))) as opened:
        yield opened
