"""The program, run in this process as the shell would, and servers that answer line by line."""

import io
import subprocess
import sys
import time
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from emmc_rig import cli

PROGRAM = (sys.executable, "-c", "from emmc_rig.cli import main; main()")
"""Begins a command of the program in a process of its own."""


def exit_code(*arguments):
    """Run the program and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["emmc-rig", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    return stop.value.code or 0


def program(*arguments):
    """Run the program; returns exit code, standard output and standard error.

    For fixtures of a whole module; a test takes `run` of conftest.
    """
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = exit_code(*arguments)
    return code, out.getvalue(), err.getvalue()


def one_line(text):
    """Return the single line with an error on standard error."""
    lines = [line for line in text.strip().splitlines() if line.startswith("emmc-rig:")]
    assert len(lines) == 1, text
    assert "Traceback" not in text
    return lines[0]


def done(ended):
    """Return the standard output of a run, (code, out, err), that succeeded."""
    code, out, err = ended
    assert code == 0, err
    return out


def refused(ended, code=1):
    """Return the one line of a run that ended with an exit code other than 0."""
    assert ended[0] == code, ended
    return one_line(ended[2])


def contents(folder):
    """Return every file and folder below a folder by its path, with the bytes of files."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def wait_until(condition, limit_s=20.0):
    """Wait until another process or thread makes the condition true."""
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


@contextmanager
def line_server(script):
    """Start a script beside this file; yield a function from a line to the line that answers."""
    program = [sys.executable, str(Path(__file__).with_name(script))]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        lines, answers = server.stdin, server.stdout
        assert lines is not None
        assert answers is not None

        def call(line):
            print(line, file=lines, flush=True)
            return answers.readline()

        yield call
        lines.close()
