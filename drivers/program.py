"""Programs of the lab that are run without a shell, within a time limit."""

import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress


def run_program(words: Sequence[str], limit_s: float) -> str:
    """Run a program, the arguments behind its name, and return what it prints.

    Raises `TimeoutError` after `limit_s`, `ValueError` for an exit code other than 0, and `OSError`
    for a program that cannot be started.
    """
    with subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,  # Ctrl-C is the capture's; what it started ends with it
    ) as process:
        try:
            text, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired as fault:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            raise TimeoutError(f"gave no answer within {limit_s:g} s") from fault
    if process.returncode:
        printed = " ".join(text.split()) or "no output"
        raise ValueError(f"exit code {process.returncode}: {printed}")
    return text
