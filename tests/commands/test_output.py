"""What commands show: progress on a terminal only, and with --json lines of JSON alone."""

import io
import json

import pytest
import typer
from programs import done, program
from rich.console import Console
from rich.progress import Progress

from emmc_rig import cli
from emmc_rig.commands import output

SIZE = ("--size", "24x32")
SIMULATE = ("simulate", "--scene", "near-planar", *SIZE, "--out", "frames")
RESULTS = {
    "simulate": SIMULATE,
    "cameras": ("cameras",),
    "cameras NAME": ("cameras", "rgbw-mono", "--out", "sheet"),
    "reconstruct": ("reconstruct", "frames", "--method", "tv", "--out", "result"),
    "reconstruct --list": ("reconstruct", "--list"),
    "export": ("export", "near-planar", "--format", "png8", "--out", "views"),
    "export --list": ("export", "--list"),
    "stability --list": ("stability", "--list"),
    "devices info": ("devices", "info", "--rig", "simulated"),
    "devices home": ("devices", "home", "--rig", "simulated"),
    "devices snap": ("devices", "snap", "--rig", "simulated", "--out", "snaps"),
    "capture": (
        "capture", "plan.yaml", "--rig", "simulated", "--scene", "near-planar", *SIZE,
        "--out", "session",
    ),
    "session show": ("session", "show", "session"),
    "session verify": ("session", "verify", "session"),
    "session export": ("session", "export", "session", "--out", "session.h5"),
    "session sheet": ("session", "sheet", "session"),
    "session list": ("session", "list"),
}  # fmt: skip
PLAN = "camera: rgbw-bayer-1shot\nshots: [{}]\nwhiteboards: null\ndarks: null\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a plan, and what the commands before leave in it."""
    folder = tmp_path_factory.mktemp("shown")
    (folder / "plan.yaml").write_text(PLAN)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in ("simulate", "capture"):
            done(program(*RESULTS[command]))
    return folder


def test_every_command_takes_json():
    def all_of(group):
        for command in group.commands.values():
            yield from all_of(command) if hasattr(command, "commands") else [command]

    for command in all_of(typer.main.get_command(cli.app)):
        assert "--json" in [name for parameter in command.params for name in parameter.opts], (
            command.name
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", RESULTS)
def test_with_json_every_line_is_an_event_and_the_last_one_the_result(folder, monkeypatch, name):
    monkeypatch.chdir(folder)
    code, out, err = program(*RESULTS[name], "--json")
    assert code == 0, err
    assert err == ""
    events = [json.loads(line) for line in out.splitlines()]
    assert [event["event"] for event in events].index("result") == len(events) - 1
    assert len(events[-1]) > 1
    metrics = folder / str(events[-1].get("out")) / "metrics.json"
    if metrics.exists():
        assert events[-1]["metrics"] == json.loads(metrics.read_text())


def test_with_json_what_fails_says_so_in_an_event_and_in_the_exit_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = program("session", "show", "nowhere", "--json")
    (event,) = map(json.loads, out.splitlines())
    assert code == 1
    assert event["event"] == "error"
    assert event["text"] in err


def test_steps_of_a_solver_are_events_that_count_to_the_last(folder, monkeypatch):
    monkeypatch.chdir(folder)
    _, out, _ = program(*RESULTS["reconstruct"], "--json")
    steps = [event for event in map(json.loads, out.splitlines()) if event["event"] == "step"]
    counted = [step["done"] for step in steps]
    assert counted == sorted(counted)
    assert {step["stage"] for step in steps} == {"tv"}


@pytest.mark.parametrize("terminal", [False, True])
def test_progress_is_drawn_on_a_terminal_and_nowhere_else(folder, monkeypatch, terminal):
    monkeypatch.chdir(folder)
    drawn = io.StringIO()
    monkeypatch.setattr(output, "console", Console(file=drawn, force_terminal=terminal, width=100))
    code, out, err = program(*RESULTS["simulate"])
    assert code == 0
    assert "sensor PSNR" in out
    assert err == ""
    assert ("simulate" in drawn.getvalue()) is terminal


def test_a_bar_shows_the_time_left_while_it_is_known():
    clock_s = [0.0]
    progress = Progress(get_time=lambda: clock_s[-1], disable=True)
    progress.add_task("cells", total=4)
    task = progress.tasks[0]
    words = [output.TimeLeft().render(task).plain]
    for _ in range(4):
        clock_s.append(clock_s[-1] + 10)
        progress.advance(task.id)
        words.append(output.TimeLeft().render(task).plain)
    assert words == ["", "", "0:00:20 left", "0:00:10 left", ""]
