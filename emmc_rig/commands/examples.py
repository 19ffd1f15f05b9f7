"""Two examples of each command, which end its help."""

from __future__ import annotations

EXAMPLES = """
live --rig simulated
live --rig bench.yaml --plan plan.yaml
capture --new rgbw-bayer-1shot
capture plan.yaml --rig simulated
calibrate --plan
calibrate plan-session
mask photo.png --cells 52x102 --cell-um 36 --out mask.png
mask photo.dng --cells 52x102 --cell-um 36 --ordered ordered.png --out mask.png
import table.csv --camera my-camera.yaml
import --camera my-camera.yaml --shots "frames/*.tif" --darks "darks/*.tif"
demo
demo --scene near-planar --camera rgbw-bayer-1shot
reconstruct plan-session
reconstruct emmc-frames --budget 30s
export near-planar
export emmc-demo --format hci
figure emmc-demo
figure emmc-demo other-result --view 0,0
simulate --camera scenario-ii-cfa
simulate --scene views --camera my-camera.yaml --out frames
cameras
cameras rgbw-bayer-1shot
chart --fast
chart --method adaptive --method tv --size 64x80
stability --list
stability --fault read-noise --method adaptive
tables --fast
tables --scenes light-fields
design bench.yaml
design bench.yaml --scene near-planar --out designs
devices camera --rig simulated
devices camera --camera u3v:
devices snap --rig simulated
devices snap --camera u3v: --exposure 0.02 --count 4 --out frames
devices conform simulated --as camera
devices conform grbl:/dev/ttyUSB0
devices list
devices list --rig simulated
devices probe
devices probe /dev/ttyUSB0
devices check simulated
devices check bench.yaml
devices lights --rig simulated
devices lights white --rig simulated
devices info --rig simulated
devices info --stage zaber:/dev/ttyUSB0
devices home --rig simulated
devices home x --stage bench.yaml
devices jog mask_x 500 --home --rig simulated
devices jog x --to 12000 --stage bench.yaml
devices free x --stage grbl:/dev/ttyUSB0
devices free x --direction up --stage bench.yaml
devices udev-rule
devices udev-rule | sudo tee /etc/udev/rules.d/99-emmc-rig.rules
session list
session list captures
session show plan-session
session show plan-session --json
session verify plan-session
session verify plan-session --json
session export plan-session --out session.h5
session export plan-session --dng --out frames
session sheet plan-session
session sheet plan-session --out sheet
""".strip().splitlines()


def examples_of(command: str) -> str:
    """Return the examples of a command, such as `devices jog`, as the end of its help."""
    words = command.split()
    found = [line for line in EXAMPLES if line.split()[: len(words)] == words]
    return "\n\n".join(["Examples:", *(f"  emmc-rig {line}" for line in found)])
