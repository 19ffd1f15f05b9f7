"""Programs of the lab that are run without a shell, within a time limit."""

import subprocess
from collections.abc import Sequence
from contextlib import suppress


def run_program(words: str | Sequence[str], limit_s: float) -> str:
    """Run a program, the arguments behind its name, and return what it prints.

    words: on Windows also a line, as it is typed there.

    Raises `TimeoutError` after `limit_s`, `ValueError` for an exit code other than 0, and `OSError`
    for a program that cannot be started.
    """
    import psutil

    with subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        # Ctrl-C is the capture's: in a session of its own (POSIX), or a group (Windows).
        start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    ) as process:
        try:
            text, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired as fault:
            with suppress(psutil.NoSuchProcess):
                for started in psutil.Process(process.pid).children(recursive=True):
                    started.kill()
            process.kill()
            raise TimeoutError(f"gave no answer within {limit_s:g} s") from fault
    if process.returncode:
        printed = " ".join(text.split()) or "no output"
        raise ValueError(f"exit code {process.returncode}: {printed}")
    return text
