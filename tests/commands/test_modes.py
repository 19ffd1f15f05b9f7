"""An option that a command's mode would ignore is refused, in one line, before anything is done."""

import pytest
import typer
from programs import done, program

from emmc_rig import cli
from emmc_rig.commands.modes import MODES, NEEDS

COMMANDS = typer.main.get_command(cli.app).commands  # pyright: ignore[reportAttributeAccessIssue]
VALUES = {"size": "24x32", "repeats": "1", "seed": "1", "rays": "16", "target": "0.1", "tile": "8"}


def typed(parameter):
    """Return a parameter with a value, as it is typed."""
    if parameter.param_type_name == "argument":
        return ["nowhere"]
    name = max(parameter.opts, key=len)
    return [name] if parameter.is_flag else [name, VALUES.get(parameter.name, "1")]


CASES = [
    (command, mode, parameter)
    for command, modes in MODES.items()
    for mode, used in modes.items()
    for parameter in COMMANDS[command].params
    if parameter.name not in {mode, "help", "json", *used}
]


def test_every_mode_and_what_it_takes_is_a_parameter_of_its_command():
    for command, modes in MODES.items():
        names = {parameter.name for parameter in COMMANDS[command].params}
        assert names.issuperset(modes)
        assert names.issuperset(set().union(*modes.values()))


def test_no_option_of_any_command_begins_with_a_digit_so_that_minus_five_is_a_number(tmp_path):
    groups = [command for command in COMMANDS.values() if hasattr(command, "commands")]
    members = [member for group in groups for member in group.commands.values()]
    for command in [*COMMANDS.values(), *members]:
        for parameter in command.params:
            assert not any(name.lstrip("-")[:1].isdigit() for name in parameter.opts)
    for words in (["x", "-5"], ["--to", "x", "-5000"], ["x", "--", "-5"]):
        _, _, err = program("devices", "jog", "--rig", "simulated:teapot", *words)
        assert "teapot" in err
    code, _, err = program("reconstruct", "-5", "--out", tmp_path / "out")
    assert (code, " -5: " in err, "'" in err) == (1, True, False)


@pytest.mark.slow
@pytest.mark.parametrize("command", MODES)
def test_whatever_a_mode_ignores_is_refused(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    earlier: set[str] = set()
    for mode in MODES[command]:
        own = next(parameter for parameter in COMMANDS[command].params if parameter.name == mode)
        earlier.add(mode)
        for name, other, parameter in CASES:
            if (name, other) != (command, mode) or parameter.name in earlier:
                continue
            code, _, err = program(command, *typed(own), *typed(parameter))
            assert code == 2, (mode, parameter.name, err)
            assert "no effect" in err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "name"), [(command, name) for command, names in NEEDS.items() for name in names]
)
def test_an_option_without_the_one_that_it_needs_is_refused(command, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = next(parameter for parameter in COMMANDS[command].params if parameter.name == name)
    code, _, err = program(command, *typed(own))
    assert code == 2
    assert "no effect without" in err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_the_help_has_no_option_under_its_earlier_name():
    assert "--route" not in done(program("calibrate", "--help"))
