"""A server that runs captures in processes of their own and lets them kill themselves.

Started as a program, it reads a line `KIND NUMBER FOLDER` for each capture, forks, and answers with
how the child ended. The child sends itself SIGKILL at the NUMBER-th event of that KIND: "step", a
step of the sequence begins; "line", a line of the storage, journal or session code is about to
run, in whichever thread. With NUMBER 0 it lives, and answers how many events there were. A folder
whose name ends with "hooked" is captured with a hook in the plan, hands moving the pinhole.
"""

import os
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path

from capture_rigs import begun, plan_and_camera, still_rig

from emmc_rig.captures import recorder
from emmc_rig.captures.between import Between
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.errors import AppError
from emmc_rig.model import files
from emmc_rig.progress import Watcher
from emmc_rig.session import journal, lock, session
from emmc_rig.session.lock import held
from emmc_rig.session.session import Session
from emmc_rig.simulators.still import StillStage
from emmc_rig.store import journal as lines

PLAN = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.01}]
whiteboards: {views: [[2, 2]], repeats: 1, references: 2, exposure_s: 0.02}
darks: null
settle_s: 0.1
checks: {places_by_hand: false}
"""
HOOKED = "hooked"


def hook(rig, frame, note):
    """Move the mask away, and note something."""
    rig.stage.move_by_um({"mask_x": 50.0})
    note(power_w=0.5, frame=None if frame is None else frame.id)


WATCHED = frozenset(module.__file__ for module in (files, lines, journal, lock, session, recorder))


class Countdown(Watcher):
    """Counts events, and kills the process at one of them."""

    def __init__(self, number):
        self.number, self.count = number, 0

    def count_down(self):
        self.count += 1
        if self.count == self.number:
            os.kill(os.getpid(), signal.SIGKILL)


class Steps(Countdown):
    """Counts the steps of the sequence, and their ends."""

    def event(self, event):
        if event.name in ("step", "frame.taken", "frame.written"):
            self.count_down()


class Lines(Countdown):
    """Counts lines of the code that stores."""

    def watch(self):
        threading.settrace(self._trace)
        sys.settrace(self._trace)

    def _trace(self, frame, event, argument):
        if frame.f_code.co_filename not in WATCHED:
            return None
        if event == "line":
            self.count_down()
        return self._trace


def capture_into(folder, watcher=None):
    """Begin a session in a folder, or go on with the one there, as a new program would."""
    rig, between = still_rig(), None
    if folder.name.endswith(HOOKED):
        between = Between("capture_kills:hook", hook)
        stage = StillStage(("mask_x", "mask_y"), rig.clock)
        rig = replace(rig, stage=stage, hands=frozenset(("aperture_x", "aperture_y")))
    with held(folder / "s"):
        try:
            opened, plan = Session(folder / "s"), plan_and_camera(PLAN)[0]
        except AppError:
            opened, plan = begun(folder, files.SYSTEM_DISK, rig, PLAN)
        Sequencer(opened, plan, rig, watcher, between=between).run()
    return opened


def _child(kind, number, folder, answer):
    watcher = {"step": Steps, "line": Lines}[kind](number)
    if kind == "line":
        watcher.watch()
    capture_into(folder, watcher)
    os.write(answer, str(watcher.count).encode())
    os._exit(0)


def main():
    """Serve until the input ends."""
    for request in sys.stdin:
        kind, number, folder = request.split(maxsplit=2)
        reader, answer = os.pipe()
        process = os.fork()
        if process == 0:
            try:
                _child(kind, int(number), Path(folder.strip()), answer)
            finally:
                os._exit(1)
        os.close(answer)
        _, status = os.waitpid(process, 0)
        print(os.waitstatus_to_exitcode(status), os.read(reader, 32).decode() or 0, flush=True)
        os.close(reader)


if __name__ == "__main__":
    main()
