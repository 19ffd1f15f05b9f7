"""
Several scenes on a turntable
=============================

A plan can call a function between frames: `between: module:function`. Here the function turns a
table with an axis of its own, so that every shot shows the object from another side.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import emmc_rig as emmc

# %%
# The hook, beside the plan. It is called before every frame with the rig, the frame that comes,
# and `note`, which writes into the session's journal; and once more at the end, with no frame.
# The table is a Grbl controller, ten degrees to the millimetre; simulated here, else
# `grbl:/dev/ttyUSB1`.

HOOK = """
from emmc_rig.bench.hardware import open_stage

table = open_stage("simulated:grbl")
table.home(["x"])


def turn(rig, frame, note):
    if frame is None:
        table.close()
    elif frame.bench.target == "scene":
        side = frame.bench.shot // 2                 # two shots of every side
        reached_um = table.move_to_um({"x": -20_000 + 3_000 * side})["x"]
        note(side=side, degrees=round(200 + reached_um / 100, 1))
"""

PLAN = """
camera: rgbw-bayer-2shots
shots:
  - {camera_shot: 0, exposure_s: 0.05}
  - {camera_shot: 1, exposure_s: 0.05}
  - {camera_shot: 0, exposure_s: 0.05}
  - {camera_shot: 1, exposure_s: 0.05}
whiteboards: null
darks: null
order: as-planned
between: table:turn
"""

work = TemporaryDirectory()
folder = Path(work.name)
(folder / "table.py").write_text(HOOK)
(folder / "plan.yaml").write_text(PLAN)
rig = emmc.rig("simulated", scene="near-planar", size=(24, 32), rays=64)
session = emmc.capture(folder / "plan.yaml", rig)

# %%
# What it noted stands in the journal, by frame. A frame whose hook raised is not lost: those before
# are on the disk, and the same call goes on.

for name, notes in session.notes.items():
    print(name or "the end", notes)

turned = {name: notes["degrees"] for name, notes in session.notes.items() if "degrees" in notes}
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.step(list(turned), list(turned.values()), where="mid", marker="o")
axes.set(xlabel="frame", ylabel="turned by, degrees")

# %%
work.cleanup()
