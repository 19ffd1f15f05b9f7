"""Wrong input on the command line: one clear line, the exit code, and nothing written."""

import shlex

import cv2
import numpy as np
import pytest
import yaml
from programs import done, one_line, program

RIG = "--rig simulated --scene near-planar --size 24x32"
MASK = {"distance_mm": 0.12, "cell_um": 48, "pattern": {"kind": "random_rgbw"}}
CAMERA = {
    "title": "a camera", "views": [2, 2], "sensor": {"cfa": "rggb"}, "masks": {"code": MASK},
}  # fmt: skip
CELLS = {"kind": "parameters", "cells": [[1, 0], [0, 1]]}
DARK = {"kind": "parameters", "cells": [[0, 0], [0, 0]]}
CAMERAS = {
    "good": {},
    "misspelt": {"viewss": [2, 2]},
    "cfa": {"sensor": {"cfa": "rggg"}},
    "far": {"masks": {"m": {"distance_mm": 60, "cell_um": 9, "pattern": {"kind": "open"}}}},
    "small": {"masks": {"m": {"distance_mm": 1, "cell_um": 9, "pattern": CELLS}}},
    "dark": {"masks": {"m": {"distance_mm": 50, "cell_um": 5000, "pattern": DARK}}},
    "nine": {
        "views": [3, 3], "lens": {"aperture_cell_mm": 8.0},
        "masks": {"code": {**MASK, "cell_um": 36}}, "more_shots_step_um": {"code": [270, 162]},
    },
}  # fmt: skip
"""Changes of CAMERA, by file."""
PLAN = {
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": [0.02, 0.08]}, {"repeats": 2}],
    "whiteboards": {"repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}
BOARDS = {"views": [[1, 1]], "shots": [0], "open": [{"repeats": 2}, {"validation": True}]}
SPARING = {
    **PLAN, "camera": "nine.yaml", "shots": [{"exposure_s": 0.05}] * 3, "whiteboards": BOARDS,
}  # fmt: skip
PLANS = {
    "plan": PLAN,
    "sparing": SPARING,
    "one-shot": {**SPARING, "shots": [{}]},
    "boardless": {**SPARING, "whiteboards": None},
    "darkless": {**SPARING, "darks": None},
    "closed": {**SPARING, "whiteboards": {"views": [[1, 1]]}},
    "of-one": {**SPARING, "whiteboards": {"shots": [0]}},
    "unchecked": {**SPARING, "whiteboards": {"open": [{}]}},
}
BENCH = {
    "size": [48, 64], "distances_mm": [0.12], "cells_um": [36], "families": ["random_binary"],
    "open_shares": [0.5], "stage_travel_um": [200, 200],
}  # fmt: skip
BENCHES = [
    ({"distance_mm": [0.12]}, "did you mean 'distances_mm'"),
    ({"maker": {"smalest_cell_um": 24}}, "did you mean 'smallest_cell_um'"),
    ({"cells_um": [12]}, "cannot be printed"),
    ({"cells_um": [0.036, 36]}, "cannot be printed"),
    ({"maker": {"smallest_cell_um": 24000}}, "are in um"),
    ({"distances_mm": [120]}, "distances are in mm"),
    ({"shots": 4, "stage_travel_um": [60, 60]}, "need 108 um"),
    ({"open_shares": [50]}, "shares of the mask's area"),
    ({"disparities_px": [1, -1]}, "the least, then the greatest"),
    ({"families": ["random_rgbw"], "maker": {"colours": False}}, "cannot be printed"),
    ({"sensor": {"cfa": "rggb", "binning": 2}}, "pixels of one sample"),
    ({"size": "192x256"}, "size"),
]
SETTINGS = {"mu": -1, "mu ": float("nan"), "chroma_weight": 0}
"""Of total variation, each in a file of its own."""
NO_SHOTS = "neither open whiteboards nor the pinhole"
ONE_LINE = {
    "simulate --out file": "file: ",
    "simulate --out file/inside": "file/inside: ",
    "simulate --out /proc/emmc": "/proc/emmc: ",
    "demo --scene gap": "view_0_1",
    "demo --scene mixed": "view_1_1",
    "demo --scene broken": "view_1_0",
    "demo --scene single": "1x2 views",
    "demo --scene empty": "view_",
    "demo --scene nowhere": "deep-occlusions",
    **{
        f"{command} --camera {name}.yaml": words
        for command in ("demo", "simulate")
        for name, words in {
            "misspelt": "did you mean 'views'", "cfa": "unknown CFA 'rggg'",
            "far": "further away than the lens", "small": "smaller than the beam",
            "dark": "no light reaches the sensor in shot 0",
        }.items()
    },
    "demo --camera rgbw-bayer-3shot": "rgbw-bayer-3shots",
    "demo --camera learned-aperture --shots 9": "more_shots_step_um",
    **{
        f"reconstruct taken --settings settings-{number}.yaml": f"tv.{name.strip()}"
        for number, name in enumerate(SETTINGS)
    },
    "export taken": "holds frames, no light field yet; run `emmc-rig reconstruct taken`",
    "export near-plana": "did you mean 'near-planar'?",
    "export nothing": "no folder or file 'nothing', and no built-in scene: known are",
    **{
        f"{command} nowhere": "nowhere: no such folder; "
        for command in (
            "reconstruct", "calibrate", "calibrate --drift taken --known", "session list",
            "session show", "session verify", "session sheet",
        )
    },
    f"capture nothing.yaml {RIG}": "no such file",
    "capture plan.yaml": "say which rig",
    "capture plan.yaml --rig real": "name of a YAML file of devices",
    "capture plan.yaml --rig no.yaml": "no.yaml: no such file",
    "capture plan.yaml --rig simulated --size 16x24": "use 22x22 or more",
    "capture plan.yaml --rig simulated --scene drak": "did you mean 'dark'",
    "capture --new rgbw": "did you mean",
    f"capture plan.yaml {RIG} --out occupied": "something other than a session",
    f"capture plan.yaml {RIG} --out plan.yaml": "something other than a session",
    "capture plan.yaml --rig lens.yaml --size 24x32": "no such axis, only mask_x",
    "capture plan.yaml --rig mask_x.yaml --size 24x32": "give its zero_um instead",
    "session show occupied": "no session",
    "session list occupied": "holds no session",
    "session export occupied --out x.h5": "no session",
    **{
        f"capture {plan}.yaml {RIG} --until 30": words
        for plan, words in {
            "one-shot": "one shot", "boardless": "no whiteboards", "darkless": "no darks",
            "closed": NO_SHOTS, "of-one": NO_SHOTS, "unchecked": "has `validation: true`",
        }.items()
    },
    "devices info --stage zaber:/dev/no-such-port": "does not exist",
    "devices info --stage teapot:/dev/ttyUSB0": "one of zaber, grbl, apt",
    "devices info --stage zaber:": "write PROTOCOL:PORT",
    "devices info --stage nowhere.yaml": "no such file",
    "devices info --rig simulated:teapot": "use one of zaber, grbl, apt",
    "devices jog --rig simulated mask_z 5": "use one of mask_x",
    "devices jog --rig simulated --home mask_x 1e9": "choose 10 to",
    "devices jog --rig simulated mask_x 5 --speed 0": "cannot move at 0",
    "devices probe /dev/no-such-port": "does not exist",
    "calibrate --plan --size 32x40 --target 2": "a relative error lies between 0 and 1",
    "calibrate --plan --size 32x40 --camera conventional": "one mask between lens and sensor",
    **{
        f"calibrate --camera nine.yaml --size 32x40 --plan {options}": words
        for options, words in {
            "--target 0.00001": "cannot be reached: the best is",
            "--target 0.0015 --frames 70": "cannot be reached with 70 frames: the best is",
            "--frames 12": "a plan opens each of the 9 views at least once",
        }.items()
    },
    "stability --fast --fault flikker": "fault flikker: did you mean 'flicker'?",
    "stability --fast --method tvv": "no method 'tvv': did you mean 'tv'?",
    "stability --fast --size 8x8": "size 8x8: needs 16x16 or more",
    "stability --fast --camera rgbw-mono-1": "rgbw-mono",
    "stability --fast --scene nowhere": "nowhere",
    "stability --fast --size 24x32 --method tv --fault mask-shift --camera coded-aperture-random": (
        "one mask"
    ),
    "stability --fast --scene dark --scene dark": "two scenes are called 'dark'",
    "stability --fast --method dict-admm --dictionary none.h5": "none.h5",
    "chart --fast --method tv --method tv-dic": "did you mean 'tv-dict'",
    "chart --fast --method tv --scene nowhere": "no scene 'nowhere'",
    "chart --fast --method tv --scene dark --scene ./dark": "two scenes are called 'dark'",
    "chart --fast --method tv --camera no-camera": "no-camera",
    "chart --fast --method tv --size 8x8": "needs 16x16",
    "chart --fast --method tv --out occupied": "something other than an earlier chart",
    "tables --only table7": "did you mean 'table",
    "tables --scenes nowhere": "no such folder",
    "tables --scenes occupied": "no scenes",
    "tables --scenes gap": "is itself a scene",
    "tables --dictionary nothing.h5": "no such file",
    "tables --out occupied": "holds something other",
    "tables --out occupied/thesis.txt": "a file of that name",
    "tables --out /proc/tables": "cannot be written",
    **{f"design bench-{n}.yaml": words for n, (_, words) in enumerate(BENCHES)},
    "live --camera nonsense:": "no such camera driver",
    "live --rig nowhere.yaml": "nowhere.yaml",
    "live --rig simulated --host 203.0.113.7": "cannot serve",
    "live --rig simulated --size 32x48 --psi nowhere": "no Psi",
    "calibrate --plan --leave-out hue": "skip hue: use some of lamp",
    "calibrate --plan --leave-out=hue": "skip hue: use some of lamp",
}  # fmt: skip
WRONG_USAGE = {
    "demo --sceen x": "",
    "no-such-command": "",
    "chart --repeats 0": "",
    "demo --shots 0": "",
    "demo --size tiny": "192x256",
    "demo --dictionary nothing.h5": "no effect on --method adaptive",
    "demo --method adaptive --dictionary lambertian": "--dictionary",
    "reconstruct taken --dictionary nothing.h5": "no effect on --method adaptive",
    "capture plan.yaml --rig simulated --size nan": "write ROWSxCOLUMNS",
    "capture plan.yaml --rig simulated --until nan": "write a PSNR",
    f"capture sparing.yaml {RIG} --until much": "--until much: write a PSNR",
    f"capture sparing.yaml {RIG} --until 0": "--until 0: write a PSNR",
    f"capture sparing.yaml {RIG} --until nan": "--until nan: write a PSNR",
    "capture mono.yaml --rig rig.yaml --seed 3": "--seed",
    "devices info": "",
    "devices info --rig real": "",
    "devices jog x": "",
    "calibrate --plan --size 32": "write ROWSxCOLUMNS",
    "calibrate --plan --route free": "--method: no effect with --plan",
    "chart --fast --method tv --size big": "write ROWSxCOLUMNS",
    "live --rig simulated --camera simulated": "either --rig",
    "live --camera simulated --method tv": "needs --psi",
    "live --rig rig.yaml --scene 24x32": "--scene",
    "live --rig rig.yaml --size 24x32": "--size",
    "live --camera simulated --scene near-planar": "",
    "figure near-planar --at 3": "",
    "figure near-planar --view a,b": "",
    "figure near-planar --side 2": "",
}


def views_in(folder, rows=2, columns=2):
    """Write a light field as pictures; return their folder."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for row, column in np.ndindex(rows, columns):
        picture = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"view_{row}_{column}.png"), picture)
    return folder


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder with the files that the commands name; no command may change it."""
    folder = tmp_path_factory.mktemp("world")
    done(program("simulate", "--size", "32x32", "--out", folder / "taken"))
    (views_in(folder / "gap") / "view_0_1.png").unlink()
    cv2.imwrite(str(views_in(folder / "mixed") / "view_1_1.png"), np.zeros((9, 9, 3), np.uint8))
    (views_in(folder / "broken") / "view_1_0.png").write_text("no picture")
    views_in(folder / "single", 1, 2)
    (folder / "empty").mkdir()
    (folder / "occupied").mkdir()
    (folder / "occupied" / "thesis.txt").write_text("mine")
    (folder / "file").write_text("")
    described = {
        **{name: {**CAMERA, **changes} for name, changes in CAMERAS.items()},
        **PLANS,
        **{f"bench-{n}": {**BENCH, **change} for n, (change, _) in enumerate(BENCHES)},
        **{f"settings-{n}": {"tv": {k.strip(): v}} for n, (k, v) in enumerate(SETTINGS.items())},
        **{
            axis: {"kind": "simulated", "focus_um": 9000, "stands_um": {axis: 100}}
            for axis in ("lens", "mask_x")
        },
        "rig": {"stage": "simulated", "camera": "folder:."},
        "mono": {"camera": "rgbw-mono", "shots": [{}]},
    }
    for name, values in described.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(values))
    return folder


def files_in(folder):
    """Return all files but journals of studies, which are kept for a later run."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".jsonl")


@pytest.fixture
def refused(world, monkeypatch):
    """Run a command that changes nothing; return its exit code and standard error."""
    monkeypatch.chdir(world)
    monkeypatch.setenv("COLUMNS", "250")
    before = files_in(world)

    def run(typed):
        code, _, err = program(*shlex.split(typed))
        assert files_in(world) == before
        assert "Traceback" not in err
        return code, err

    return run


@pytest.mark.parametrize("typed", ONE_LINE)
def test_wrong_input_is_one_line_that_says_what_to_do(refused, typed):
    code, err = refused(typed)
    assert code == 1, err
    assert ONE_LINE[typed] in one_line(err)
    shown = "warning:", "emmc-rig:"
    assert typed.startswith(("capture", "stability")) or all(
        line.startswith(shown) for line in err.strip().splitlines()
    )


@pytest.mark.parametrize("typed", WRONG_USAGE)
def test_wrong_usage_is_exit_code_2(refused, typed):
    code, err = refused(typed)
    assert code == 2, err
    assert WRONG_USAGE[typed] in " ".join(err.split())
