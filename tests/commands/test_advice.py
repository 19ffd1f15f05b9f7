"""Errors carry their advice as data: only the command line names its commands and flags."""

import ast
import re
from functools import cache
from typing import get_args

import pytest
import typer
from words import PRODUCT, ROOT, texts

from emmc_rig import cli
from emmc_rig.commands.output import WORDS, free_command, in_shell, naming_stage, on_stage
from emmc_rig.drivers.errors import (
    ALL_AXES,
    LimitExceededError,
    LostPositionError,
    NotHomedError,
    PressedSwitchError,
    StalledError,
)
from emmc_rig.errors import AppError
from emmc_rig.model.errors import Advice

COMMANDS = typer.main.get_command(cli.app).commands  # pyright: ignore[reportAttributeAccessIssue]
OURS = ("emmc_rig/commands/", "emmc_rig/cli.py")
TYPED = re.compile(rf"emmc-rig (?:{'|'.join(COMMANDS)})\b|`emmc-rig {{|(?<![\w-])--[a-z]")
SHOWN = {
    "emmc_rig/bench/conformance/named.py": "the option is pytest's",
    "emmc_rig/store/results.py": "the flags are git's",
    "emmc_rig/report/calibration_page.py": "a report's next command",
    "emmc_rig/report/page.py": "a report's next command",
    "emmc_rig/report/session_sheet.py": "a report's next command",
    "emmc_rig/session/export.py": "what made a file is stored in it",
    "emmc_rig/study/chart/charting.py": "a report's next command",
    "emmc_rig/study/design/designing.py": "a report's next command",
    "emmc_rig/study/design/search.py": "what made a camera is stored in it",
    "emmc_rig/study/tables/tables_study.py": "a report's next command",
}
"""Files that name commands and flags, and why."""
OF_OTHERS = re.compile(r"(udevadm|systemctl|gphoto2)[a-z ]* --[a-z-]+")
"""Commands of other programs."""


@cache
def mentions():
    """Return file, line and text of strings of the library that name a command or flag."""
    found = []
    for path in (path for folder in PRODUCT for path in sorted((ROOT / folder).rglob("*.py"))):
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith(OURS):
            for line, _, text in texts(ast.parse(path.read_text(encoding="utf-8"))):
                if TYPED.search(OF_OTHERS.sub("", text)):
                    found.append((name, line, text))
    return found


def test_no_text_of_the_library_names_a_command_or_a_flag():
    found = [found for found in mentions() if found[0] not in SHOWN]
    assert not found, "\n".join(f"{name}:{line}: {text!r}" for name, line, text in found)


def test_every_file_that_may_name_commands_does():
    assert set(SHOWN) <= {name for name, _, _ in mentions()}


def test_the_command_line_words_every_advice_by_commands_and_flags_that_there_are():
    assert set(WORDS) == set(get_args(Advice))
    groups = [command for command in COMMANDS.values() if hasattr(command, "commands")]
    every = [
        *COMMANDS.values(),
        *(member for group in groups for member in group.commands.values()),
    ]
    flags = {flag for command in every for parameter in command.params for flag in parameter.opts}
    on_stages = (on_stage("home", "x", ""), free_command("x", "simulated", "up"))
    for words in (*WORDS.values(), *on_stages):
        assert set(re.findall(r"--[a-z-]+", words)) <= flags
        assert all(name in COMMANDS for name in re.findall(r"emmc-rig (\w+)", words))


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        (AppError("s: no light field yet", "reconstruct", "my s"),
         "s: no light field yet; run `emmc-rig reconstruct 'my s'`"),
        (AppError("a damaged file"), "a damaged file"),
        (LimitExceededError("mask_x", 9, (0, 1)), "mask_x cannot go to 9 um: choose 0 to 1 um"),
        (NotHomedError("mask_x"), "mask_x does not know where it is: home it first; "
         "home by `emmc-rig devices home mask_x --stage STAGE`"),
        (LostPositionError(ALL_AXES, "it restarted", "home the axes"),
         "every axis reports a fault, it restarted: home the axes; "
         "home by `emmc-rig devices home --stage STAGE`"),
        (PressedSwitchError("mask_x", "down"),
         "mask_x reports a fault, it stands on its limit switch: move it off the switch, "
         "downwards, before it is homed; "
         "free it by `emmc-rig devices free mask_x --direction down --stage STAGE`"),
    ],
)  # fmt: skip
def test_an_error_is_shown_with_what_to_type(fault, line):
    assert in_shell(fault) == line


def test_the_advice_of_an_error_is_shown_with_the_one_that_it_caused():
    caused = AppError("frame 3: the stage stopped")
    caused.__cause__ = StalledError("mask_y")
    assert in_shell(caused).endswith("`emmc-rig devices home mask_y --stage STAGE`")


def test_the_advice_names_the_stage_as_the_command_did():
    caused = AppError("the capture stopped")
    caused.__cause__ = PressedSwitchError("mask_y")
    with pytest.raises(AppError), naming_stage("my rig.yaml"):
        raise caused
    assert in_shell(caused).endswith("`emmc-rig devices free mask_y --stage 'my rig.yaml'`")
