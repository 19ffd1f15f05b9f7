"""No command deletes or overwrites the files of others: every command against every bad place.

WRITERS holds the smallest arguments of each writing command, READERS the commands without files.
A command in neither fails the first test.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from placed import files_of, listed
from programs import done, program

from emmc_rig import cli
from emmc_rig.commands import output
from emmc_rig.model.lightfield import save_hdf5
from emmc_rig.store.folders import result_folder

SIZE, SHAPE = ("--size", "24x32"), (24, 32)
RIG = ("--rig", "simulated", "--scene", "near-planar", *SIZE)
ONE_FILE = {
    "capture --new",
    "mask",
    "session export",
}
WRITERS = {
    "cameras": ("rgbw-mono",),
    "capture": ("other.yaml", *RIG),
    "capture --new": ("rgbw-mono",),
    "calibrate SESSION": ("made-session",),
    "calibrate --drift": ("frames", "--known", "frames"),
    "calibrate --plan": (*SIZE,),
    "chart": ("--fast",),
    "demo": (*SIZE,),
    "design": (),
    "devices snap": ("--rig", "simulated"),
    "export": ("scene.h5", "--format", "png8"),
    "figure": ("scene.h5",),
    "import": ("--shots", "shot.npy", "--camera", "rgbw-bayer-1shot"),
    "mask": ("taken.png", "--cells", "8x8", "--cell-um", "24"),
    "reconstruct": ("frames",),
    "reconstruct SESSION": ("made-session",),
    "session export": ("made-session",),
    "session sheet": ("made-session",),
    "simulate": (*SIZE,),
    "stability": ("--fast",),
    "tables": ("--fast",),
}  # fmt: skip
READERS = {
    "devices camera", "devices check", "devices conform", "devices free", "devices home",
    "devices info", "devices jog", "devices lights", "devices list", "devices probe",
    "devices udev-rule", "live", "session list", "session show", "session verify",
}  # fmt: skip
JOURNALS = {
    "chart": "points.jsonl",
    "design": "simulations.jsonl",
    "stability": "points.jsonl",
    "tables": "cells.jsonl",
}
"""What lies in a folder that a study goes on with."""


def commands(group, path=()):
    """Yield name and parameters of every command."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (
                " ".join((*path, name)),
                [opt for parameter in command.params for opt in parameter.opts],
            )


def test_every_command_is_known_here_and_those_that_name_a_place_to_write_are_tried():
    known = {typed.partition(" --")[0].removesuffix(" SESSION") for typed in WRITERS}
    for name, options in commands(typer.main.get_command(cli.app)):
        writes = {"--out", "--link"} & set(options)
        assert name in known or name in READERS, f"give `{name}` its smallest arguments in WRITERS"
        assert not (writes and name in READERS), f"`{name}` has {writes}: move it to WRITERS"


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder as somebody has it: a session, results, frames, a thesis."""
    folder = tmp_path_factory.mktemp("world")
    shots = {"camera": "rgbw-bayer-1shot", "shots": [{}], "whiteboards": None, "darks": None}
    (folder / "plan.yaml").write_text(yaml.safe_dump(shots))
    (folder / "other.yaml").write_text(yaml.safe_dump({**shots, "camera": "rgbw-mono"}))
    (folder / "held").mkdir()
    done(program("capture", folder / "plan.yaml", *RIG, "--out", folder / "held/session"))
    shutil.copytree(folder / "held/session", folder / "made-session")
    (folder / "link").symlink_to(folder / "held/session")
    done(program("simulate", *SIZE, "--scene", "near-planar", "--out", folder / "frames"))
    field = np.random.default_rng(0).uniform(0, 1, (5, 5, 16, 16, 3)).astype(np.float32)
    save_hdf5(folder / "scene.h5", field, {})
    np.save(folder / "shot.npy", np.random.default_rng(1).integers(256, 9000, SHAPE, np.uint16))
    (folder / "foreign").mkdir()
    (folder / "foreign/thesis.txt").write_text("years of work")
    (folder / "taken.h5").write_text("years of work")
    (folder / "taken.png").write_text("years of work")
    return folder


def edited(folder, typed):
    """Make a result of the command that somebody edited."""
    command = typed.removesuffix(" SESSION").replace(" --theory", "")
    with result_folder(folder, command, belongs_to=folder, adds=True) as new:
        for name in ("metrics.json", "report.html"):
            (new / name).write_text("{}")
    if typed in JOURNALS:
        (folder / JOURNALS[typed]).touch()
    (folder / "metrics.json").write_text('{"mine": true}')
    return folder


def place(world, situation, typed):
    """Return what --out names."""
    new = "new.h5" if typed in ONE_FILE else "new"
    if situation == "an edited result":
        folder = world / ("edited-" + typed.replace(" ", ""))
        return edited(folder, typed) / ("metrics.json" if typed in ONE_FILE else "")
    return {
        "a session": world / "held/session",
        "its parent": world / "held",
        "inside it": world / "held/session" / new,
        "its frames": world / "held/session/frames",
        "a link to it": world / "link",
        "beyond the link": world / "link" / new,
        "a foreign folder": world / "foreign" / (new if typed in ONE_FILE else ""),
        "a file": world / "taken.h5",
    }[situation]


ALLOWED = {
    # New files of names that are free, beside what is there.
    "a foreign folder": {*ONE_FILE, "devices snap"},
    "its parent": {"devices snap"},
    "an edited result": {"devices snap"},
}
SITUATIONS = (
    "a session", "its parent", "inside it", "its frames", "a link to it", "beyond the link",
    "a foreign folder", "an edited result", "a file",
)  # fmt: skip


def called(typed, *more):
    """Run a command by its name here; returns exit code and standard error."""
    name, dashes, mode = typed.removesuffix(" SESSION").partition(" --")
    first = (f"{dashes.strip()}{mode}",) if mode else ()
    code, _, err = program(*name.split(), *first, *WRITERS[typed], *more)
    return code, err


@pytest.mark.slow
@pytest.mark.parametrize("typed", WRITERS)
def test_nothing_is_lost_wherever_out_leads(world, monkeypatch, typed):
    monkeypatch.chdir(world)
    monkeypatch.setattr("time.sleep", lambda seconds: (_ for _ in ()).throw(KeyboardInterrupt))
    for situation in SITUATIONS:
        out = place(world, situation, typed)
        before, ours = files_of(world), listed(world)
        code, err = called(typed, "--out", out)
        after = files_of(world)
        lost = [path for path in before if after.get(path) != before[path]]
        assert all(ours.get(path) == before[path] for path in lost), (situation, lost)
        hidden = [path.name for path in world.rglob(".*") if path not in before]
        assert not hidden, situation
        if typed not in ALLOWED.get(situation, ()):
            assert code in (1, 2), (situation, err)
            assert set(after) == set(before), situation
            assert "Traceback" not in err
            assert len([line for line in err.splitlines() if line.startswith("emmc-rig:")]) == 1


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        ("calibrate SESSION", "calibration/metrics.json"),
        ("reconstruct SESSION", "reconstruction/metrics.json"),
        ("session sheet", "report.html"),
    ],
)
def test_results_in_their_place_in_a_session_are_not_replaced_once_edited(
    world, monkeypatch, typed, name
):
    monkeypatch.chdir(world)
    path = world / "made-session" / name
    if path.parent.name != "made-session":
        edited(path.parent, typed)
    path.write_text("mine")
    before = files_of(world)
    code, err = called(typed)
    assert code == 1
    assert f"{name.rpartition('/')[2]} is not what" in err
    assert files_of(world) == before


def test_a_rerun_replaces_its_own_files_and_keeps_all_others(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ("simulate", *SIZE, "--scene", "near-planar", "--out", "w")
    assert program(*arguments)[0] == 0
    Path("w/thesis.txt").write_text("years of work")
    first = json.loads(Path("w/metrics.json").read_text())
    assert program(*arguments, "--seed", "1")[0] == 0
    assert Path("w/thesis.txt").read_text() == "years of work"
    assert json.loads(Path("w/metrics.json").read_text()) != first
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.slow
@pytest.mark.parametrize("typed", [typed for typed in WRITERS if typed != "capture --new"])
def test_every_command_states_its_stage_before_its_work_begins(world, tmp_path, monkeypatch, typed):
    """The first event of --json is a stage; there the test stops it."""
    monkeypatch.chdir(world)
    print_event, events = output.emit, []

    def stop(event, **facts):
        print_event(event, **facts)
        events.append(event)
        if event == "stage":
            raise KeyboardInterrupt

    monkeypatch.setattr("emmc_rig.commands.output.emit", stop)
    monkeypatch.setattr("emmc_rig.commands.capture.emit", stop)
    out = tmp_path / ("new.h5" if typed in ONE_FILE else "new")
    before = files_of(world)
    code, err = called(typed, "--json", "--out", out)
    assert events[-1] == "stage", err
    assert not {"result", "error"} & set(events)
    assert code == 130
    assert files_of(world) == before


def test_a_plan_in_a_session_begins_no_session_inside_it(world, monkeypatch):
    monkeypatch.chdir(world)
    before = files_of(world)
    code, _, err = program("capture", "held/session/plan.yaml", *RIG)
    assert code == 1
    assert "lies inside the session" in err
    assert files_of(world) == before
