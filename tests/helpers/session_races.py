"""A server that lets two programs meet at one session, at an offset in time.

Started as a program, it reads a line `OFFSET_S FOLDER` for each meeting and forks a process for
each command line in FOLDER/commands.json: a second one OFFSET_S after the first. They run in
FOLDER, on a rig without time or light, and write their output to 0.log and 1.log. The answer is a
line of JSON: their process ids, their exit codes, and the seconds until all of them had ended.
"""

import json
import os
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import typer
from capture_rigs import still_rig

from emmc_rig import cli
from emmc_rig.captures import run
from emmc_rig.errors import AppError
from emmc_rig.process import session_calibration as calibrate_session
from emmc_rig.report import session_sheet
from emmc_rig.session import export
from emmc_rig.session.board_sets import whiteboards

LOADED_BEFORE = (session_sheet, export)
FAILED = 99


@contextmanager
def quick_rig(description, camera, ask):
    """Stand in for `opened_rig`."""
    yield still_rig()


def read_whiteboards(session, *rest):
    """Stand in for `session_outcome`: read all that it reads, and stop before the fit."""
    count = len([frame.frame for frame in whiteboards(session).frames])
    raise AppError(f"{count} pinholes read")


def _child(arguments, name, wait_s):
    log = os.open(f"{name}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    run.opened_rig = quick_rig
    calibrate_session.session_outcome = read_whiteboards
    sys.argv = ["emmc-rig", *arguments]
    time.sleep(wait_s)
    cli.main()


def _forked(arguments, folder, name, wait_s):
    process = os.fork()
    if process == 0:
        code = FAILED
        try:
            os.chdir(folder)
            _child(arguments, name, wait_s)
        except SystemExit as stop:
            code = int(stop.code or 0)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    return process


def main():
    """Serve until the input ends."""
    # The command is built once: building it takes longer than the commands themselves.
    cli.app = typer.main.get_command(cli.app)  # type: ignore[assignment]
    for request in sys.stdin:
        offset, folder = request.split(maxsplit=1)
        folder, offset_s = Path(folder.strip()), float(offset)
        began = time.monotonic()
        processes = [
            _forked(arguments, folder, place, place * offset_s)
            for place, arguments in enumerate(json.loads((folder / "commands.json").read_text()))
        ]
        codes = [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes]
        took_s = time.monotonic() - began
        print(json.dumps({"pids": processes, "codes": codes, "seconds": took_s}), flush=True)


if __name__ == "__main__":
    main()
