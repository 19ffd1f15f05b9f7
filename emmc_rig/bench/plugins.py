"""Stages and cameras that other packages bring, by entry point; see `docs/plugins.md`.

A package names a factory in the group `emmc_rig.stages` or `emmc_rig.cameras`; its name then goes
wherever ours do: `NAME:ADDRESS`, or a YAML file with more settings.

    stage factory(address, settings: StageSettings, clock: Clock, **options) -> drivers.stage.Stage
    camera factory(address, clock: Clock, **options) -> drivers.camera.Camera
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from emmc_rig.drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.model.reading import one_line

STAGES, CAMERAS = "emmc_rig.stages", "emmc_rig.cameras"


def plug_ins(group: str) -> set[str]:
    """Return the names of a group's plug-ins."""
    return set(entry_points(group=group).names)


def open_plug_in(group: str, name: str, *arguments: object, **options: Any) -> Any:
    """Return the device that a plug-in's factory opens; it must be closed.

    Raises AppError with one line for a plug-in that cannot be loaded, does not take the options,
    or fails, and for a name that two packages use; a `DriverError` of its own passes.
    """
    entry, *others = entry_points(group=group, name=name)
    if others:
        packages = " and ".join(map(_package, (entry, *others)))
        raise AppError(f"plug-in {name} is in {packages}: uninstall all but one")
    package = f"plug-in {name} ({_package(entry)})"
    try:
        factory = entry.load()
    except (ImportError, AttributeError) as fault:
        raise AppError(f"{package} cannot be loaded: {fault}") from fault
    try:
        return factory(*arguments, **options)
    except (DriverError, AppError):
        raise
    except Exception as fault:
        text = one_line(fault) or type(fault).__name__
        raise AppError(f"{package} could not open its device: {text}") from fault


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
