"""What is read beside frames: sources answer in their own time, fail, and hold nothing up."""

import json
import os
import time
from pathlib import Path

import pytest

import emmc_rig as emmc
from emmc_rig.bench.environment import Source, SourceConfig, read_all
from emmc_rig.model.settings import validated
from emmc_rig.session.journal import RunEntry, SourceEntry, of_kind


def read(**config):
    """Return value and fault of a source, asked once."""
    with Source(SourceConfig(name="x", **config)) as source:
        return source.read()


def test_the_first_number_of_a_file_counts_scaled(tmp_path):
    (tmp_path / "temp").write_text("T1=21500 mC\n")
    assert read(file=str(tmp_path / "temp"), scale=1e-3) == (pytest.approx(21.5), "")


@pytest.mark.parametrize(
    ("config", "fault"),
    [
        ({"file": "/nowhere/at/all"}, "No such file"),
        ({"file": os.devnull}, "no number in ''"),
        ({"command": "echo 1e999"}, "no number in '1e999'"),
        ({"command": "echo sensor2 lost"}, "no number in 'sensor2 lost'"),
        ({"command": "sh -c 'echo gone >&2; exit 3'"}, "exit code 3: gone"),
        ({"command": "no-such-program"}, "No such file"),
        ({"command": "sleep 60", "limit_s": 0.2}, "gave no answer within 0.2 s"),
        ({"command": "sh -c 'sleep 60 | cat'", "limit_s": 0.2}, "gave no answer within 0.2 s"),
        ({"serial": "/dev/no-such-port"}, "no-such-port"),
        ({"serial": "loop://", "limit_s": 0.1}, " within 0.1 s"),
    ],
)
def test_a_source_that_fails_says_why_and_nothing_is_raised(config, fault):
    began_s = time.monotonic()
    assert fault in read(**config)[1]
    assert time.monotonic() - began_s < 3


def test_a_command_that_takes_too_long_ends_with_what_it_started(tmp_path):
    pid = tmp_path / "pid"
    read(command=f"sh -c 'sleep 60 & echo $! > {pid}; wait'", limit_s=1)
    stat = Path("/proc", pid.read_text().strip(), "stat")
    until_s = time.monotonic() + 5
    while stat.exists() and stat.read_text().split()[2] != "Z":
        assert time.monotonic() < until_s


def test_a_file_that_never_opens_is_given_up_in_its_time(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    began_s = time.monotonic()
    with Source(SourceConfig(name="x", file=str(tmp_path / "fifo"), limit_s=0.5)) as source:
        # It is waited for once, not for every frame.
        for _ in range(20):
            assert source.read()[1] == "gave no answer within 0.5 s"
    assert time.monotonic() - began_s < 4


def test_a_serial_port_is_asked_and_answers_with_a_line():
    # What is sent over a loop comes back: the question is the answer.
    assert read(serial="loop://", ask="+2.15e1 C\n") == (21.5, "")


def test_a_command_is_asked_again_and_its_newest_number_counts(tmp_path):
    (tmp_path / "log").write_text("1")
    config = SourceConfig(name="lab", command=f"cat {tmp_path / 'log'}", every_s=0.01)
    with Source(config) as source:
        assert read_all([source]) == ({"lab": 1.0}, {})
        (tmp_path / "log").write_text("2")
        until_s = time.monotonic() + 10
        while source.read()[0] != 2.0:
            assert time.monotonic() < until_s
        (tmp_path / "log").unlink()
        while not source.read()[1]:
            assert time.monotonic() < until_s
    assert "lab" in read_all([source])[1]


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"name": "a"}, "write one of file:, command: and serial:"),
        ({"name": "a", "file": "x", "command": "y"}, "write one of"),
        ({"name": "a", "file": "x", "limit_s": 0}, "greater than 0"),
        ({"name": "a", "file": "x", "limits": 1}, "did you mean 'limit_s'"),
    ],
)
def test_a_source_that_is_none_is_refused_in_one_line(config, says):
    with pytest.raises(ValueError, match=says):
        validated(SourceConfig, config, "rig.yaml", ValueError)


PLAN = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.05, repeats: 3}]
whiteboards: null
darks: null
"""


def captured(folder, environment, **more):
    (folder / "plan.yaml").write_text(PLAN)
    (folder / "rig.yaml").write_text(f"kind: simulated\nenvironment: {json.dumps(environment)}\n")
    rig = emmc.rig(folder / "rig.yaml", scene="near-planar", size=(24, 32), rays=16)
    return emmc.capture(folder / "plan.yaml", rig, **more)


def test_every_frame_keeps_what_was_read_beside_it_and_when(tmp_path):
    (tmp_path / "temp").write_text("21.5")
    session = captured(
        tmp_path,
        [
            {"name": "lab", "file": str(tmp_path / "temp"), "unit": "C"},
            {"name": "lost", "file": str(tmp_path / "nothing")},
        ],
    )
    (run,) = of_kind(session.journal.entries, RunEntry)
    assert run.environment == {"lab": "C", "lost": ""}
    assert run.stage["mask_x"]["identity"]["maker"] == "Zaber"
    assert run.stage["mask_x"]["identity"]["serial"]
    times = []
    for entry in session.stored.values():
        assert entry.environment == {"lab": 21.5}
        assert entry.temperatures_c == {"stage device 1": 31.4, "stage device 2": 31.4}
        assert entry.wall[19] == "."
        times.append(entry.monotonic_s)
    assert times == sorted(set(times))
    # Noted once, not for every frame.
    (silent,) = of_kind(session.journal.entries, SourceEntry)
    assert silent.name == "lost"
    assert "No such file" in silent.fault


def test_two_sources_of_one_name_are_refused(tmp_path):
    source = {"name": "lab", "file": "x"}
    with pytest.raises(emmc.ERRORS, match="two sources are named lab"):
        captured(tmp_path, [source, source])
