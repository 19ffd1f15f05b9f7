"""The program, run in this process as the shell would."""

import io
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest

from emmc_rig import cli


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
