"""`emmc-rig devices conform`: whether a device does what every stage or camera must do."""

from __future__ import annotations

import os
import sys
from contextlib import nullcontext, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.output import give_result, json_wanted
from emmc_rig.errors import AppError

SUITES = {"stage": "stages.py", "camera": "cameras.py"}


def conform(
    device: Annotated[
        str, typer.Argument(metavar="NAME", help="as --stage or --camera takes it; or simulated")
    ],
    only: Annotated[
        str | None, typer.Option("--as", help="stage or camera, where NAME can be either")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="move the stage without asking")] = False,
) -> None:
    """Test that a stage or camera behaves as the program needs.

    Exit code 1 if not. A stage is homed several times, and moved through the middle of its travel,
    after a question; a camera is exposed some twenty times. Needs the extra `test`.
    """
    if find_spec("pytest") is None:
        raise AppError('conform needs pytest: pip install "emmc-rig[test]"')
    import pytest

    suites = _suites(device)
    if only is not None:
        if only not in suites:
            raise AppError(f"--as {only}: {device} is a {' or a '.join(suites)}: leave --as out")
        suites = [only]
    if "stage" in suites and not yes and not device.startswith("simulated"):
        question = (
            f"Every axis of {device} will be homed and moved through the middle of its travel. "
            "Is the way free?"
        )
        if not typer.confirm(question, err=True):
            raise AppError("nothing was moved")
    from emmc_rig.bench import conformance

    here = Path(conformance.__file__).parent
    with (
        redirect_stdout(sys.stderr) if json_wanted.get() else nullcontext(),
        pytest.MonkeyPatch.context() as patch,
    ):
        # Plug-ins of pytest that other packages brought take longer to load than a suite to run.
        patch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
        code = pytest.main(
            [
                *(str(here / SUITES[suite]) for suite in suites),
                *("-p", "emmc_rig.bench.conformance.named", "--device", device),
                *("-c", os.devnull, "--rootdir", str(here), "-p", "no:cacheprovider"),
                *("--import-mode=importlib", "-v", "--no-header", "--tb=short"),
            ]
        )
    give_result(device=device, conforms=code == pytest.ExitCode.OK)
    if code != pytest.ExitCode.OK:
        raise AppError(
            f"{device} failed the conformance tests of a {' and a '.join(suites)}: see above"
        )


def _suites(device: str) -> list[str]:
    """Return the test suites of a device's name; raises AppError for an unknown name."""
    from emmc_rig.bench.device_config import DRIVER_KEYS, stage_protocols
    from emmc_rig.bench.hardware import camera_drivers
    from emmc_rig.model.reading import read_yaml

    if device.endswith((".yaml", ".yml")):
        read = read_yaml(Path(device), AppError)
        settings = read if isinstance(read, dict) else {}
        named = {"stage": ("protocol",), "camera": DRIVER_KEYS}
        found = [suite for suite, keys in named.items() if settings.keys() & set(keys)]
    else:
        name = device.partition(":")[0]
        stages = {*stage_protocols(), "simulated"}
        known = {"stage": stages, "camera": camera_drivers()}
        found = [suite for suite, names in known.items() if name in names]
        if device.startswith("simulated:"):
            found = ["stage"]
    if not found:
        raise AppError(
            f"{device}: name a stage or a camera as --stage and --camera take it, such as "
            "zaber:/dev/ttyUSB0, or a YAML file with its protocol or driver"
        )
    return found
