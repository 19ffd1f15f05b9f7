"""Imports by names of versions before 0.5: a line states the new name, until version 0.6."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "calibration": "emmc_rig.calibration",
    "drivers": "emmc_rig.drivers",
    "reconstruction": "emmc_rig.reconstruction",
    "simulators": "emmc_rig.simulators",
    "emmc_rig.acquisition": "emmc_rig.captures",
    "emmc_rig.conformance": "emmc_rig.bench.conformance",
    "emmc_rig.files": "emmc_rig.formats or emmc_rig.store",
    "emmc_rig.pages": "emmc_rig.report",
    "emmc_rig.processing": "emmc_rig.process",
}
"""The old name of each package that plug-ins and notebooks import, and its name since 0.5."""


class _MovedPackages(MetaPathFinder, Loader):
    """Finds the old names after everything else, so that a user's own modules come first."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        name = spec.name
        raise ModuleNotFoundError(f"import {MOVED[name]}, its name since 0.5", name=name)

    def exec_module(self, module: ModuleType) -> None:
        """Never called: `create_module` raises."""


sys.meta_path.append(_MovedPackages())
