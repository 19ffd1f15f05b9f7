"""Stages and cameras that other packages bring, by entry point: `docs/plugins.md` tells how.

A package names a factory in the group `emmc_rig.stages` or `emmc_rig.cameras`; its name then goes
wherever ours do: `NAME:ADDRESS`, or a YAML file with more settings.

    stage factory(address, settings: StageSettings, clock: Clock, **options) -> drivers.stage.Stage
    camera factory(address, clock: Clock, **options) -> drivers.camera.Camera
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from drivers.errors import DriverError
from emmc_rig.errors import AppError

STAGES, CAMERAS = "emmc_rig.stages", "emmc_rig.cameras"


def plug_ins(group: str) -> dict[str, EntryPoint]:
    """Return the plug-ins of a group by name; of two with one name, none.

    Which of two packages is meant cannot be known, and a wrong driver moves things.
    """
    found = list(entry_points(group=group))
    names = [one.name for one in found]
    return {one.name: one for one in found if names.count(one.name) == 1}


def open_plug_in(group: str, name: str, *arguments: object, **options: Any) -> Any:
    """Return the device that a plug-in's factory opens; it must be closed.

    Raises AppError with one line for a plug-in that cannot be loaded, does not take the options,
    or fails; a `DriverError` of its own passes.
    """
    entry = plug_ins(group)[name]
    package = f"plug-in {name} ({entry.dist.name} {entry.dist.version})" if entry.dist else name
    try:
        factory = entry.load()
    except (ImportError, AttributeError) as fault:
        raise AppError(f"{package} cannot be loaded: {fault}") from fault
    try:
        return factory(*arguments, **options)
    except (DriverError, AppError):
        raise
    except Exception as fault:
        text = " ".join(str(fault).split()) or type(fault).__name__
        raise AppError(f"{package} could not open its device: {text}") from fault
