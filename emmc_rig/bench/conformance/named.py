"""Fixtures of the suites for a device that is opened by name: a plugin of pytest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from emmc_rig.drivers.camera import Camera
from emmc_rig.drivers.stage import Stage

pytest.register_assert_rewrite(
    "emmc_rig.bench.conformance.cameras", "emmc_rig.bench.conformance.stages"
)


class NamedStage:
    """The stage that a name opens, as `--stage` takes it, opened anew with other settings."""

    def __init__(self, spec: str) -> None:
        self._spec = spec
        self._stage: Stage | None = None

    def make_stage(self, **settings: Any) -> Stage:
        """Open the stage; one opened before is closed first."""
        from emmc_rig.bench.hardware import open_stage

        self.close()
        self._stage = open_stage(self._spec, settings=settings)
        return self._stage

    def close(self) -> None:
        """Close the stage."""
        if self._stage is not None:
            self._stage.close()
            self._stage = None


def pytest_addoption(parser: pytest.Parser) -> None:
    """Take the device's name."""
    parser.addoption("--device", required=True, help="as --stage or --camera of emmc-rig take it")


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[NamedStage]:
    """The stage of that name."""
    with closing(NamedStage(str(request.config.getoption("--device")))) as named:
        yield named


@pytest.fixture
def camera(request: pytest.FixtureRequest) -> Iterator[Camera]:
    """The camera of that name."""
    from emmc_rig.bench.hardware import open_camera

    with closing(open_camera(str(request.config.getoption("--device")))) as opened:
        yield opened
