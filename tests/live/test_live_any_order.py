"""A person who clicks the five steps of the page in any order, and interrupts each of them once.

By default three of the 120 orders are walked; EMMC_FUZZ multiplies that number.
"""

import json
from contextlib import suppress
from itertools import permutations
from threading import Event, Thread, current_thread

import pytest
import yaml
from fuzzing import FUZZ
from pages import order
from test_live import PATIENCE_S, until, watching

from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.live.save import Files
from emmc_rig.live.steps import LONGEST_UNASKED_S
from emmc_rig.simulators.clock import ManualClock

DESIGN, SIZE, FOCUS_UM = "rgbw-bayer-1shot", (32, 48), 9000.0
CLICKS = {
    "centre": (("centre", {}), ("stop", {})),
    "exposure": (("autoexpose", {}), ("cancel", {})),
    "align": (("look", {"target": "whiteboard"}), ("look", {"target": "scene"})),
    "focus": (("autofocus", {"span_um": 400.0}), ("stop", {})),
    "save": (("preview", {"what": ["exposure"]}), ("preview", {"what": []})),
}
"""By step: action of the button, action of an interruption."""
MOST_CLICKS = 15
ORDERS = list(permutations(CLICKS))[:: max(1, 41 // FUZZ)]


class HeldClock(ManualClock):
    """Its time stands still while it is held: the stage's thread and the camera's wait for it."""

    def __init__(self):
        super().__init__()
        self.free, self.waits = Event(), Event()
        self.free.set()

    def sleep(self, duration_s):
        if not self.free.is_set() and current_thread().name in ("live stage", "live camera"):
            self.waits.set()
            assert self.free.wait(PATIENCE_S)
        super().sleep(duration_s)


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Return a clock, the page of a dark rig, the exposures it asked for, a plan."""
    camera, clock = find_camera(DESIGN), HeldClock()
    fine = fine_scene("near-planar", 2, 2, size=SIZE, views=camera.views)
    rig, _ = simulated_rig(camera, fine.samples, SIZE, 0, clock, focus_um=FOCUS_UM)
    rig.attendant.set_lamp("white")
    rig.stage.home(["focus"])
    rig.stage.move_to_um({"focus": FOCUS_UM - 150})
    exposures_s, choose = [], rig.camera.set_exposure_s

    def chosen(exposure_s):
        exposures_s.append(exposure_s)
        choose(exposure_s)

    monkeypatch.setattr(rig.camera, "set_exposure_s", chosen)
    plan = tmp_path / "plan.yaml"
    plan.write_text(f"camera: {DESIGN}\nshots:\n  - exposure_s: auto\n")
    centre_um = {**rig.zero_um, "aperture_x": rig.zero_um["aperture_x"] + rig.window_um}
    look, targets = rig.attendant.place, ("scene", "whiteboard")
    arguments = (rig.camera, rig.stage, look, targets, centre_um, camera, None, Files(plan))
    with watching(*arguments) as watch:
        yield clock, watch, exposures_s, plan


def click(page, name, values):
    """Do what a button does, unless it is refused."""
    with suppress(AppError):
        order(page, name, **values)


def settled(watch):
    """Return the state of a picture that was taken where the stage stands now."""
    before = watch.state.snapshot()["frame"]
    return until(
        watch,
        lambda state: (
            not state["busy"]
            and state["axes"]
            and state["figures"]
            and state["figures"]["frame"] > before + 1
            and state["figures"]["moves"] is not None
            and not watch._exposing
        ),
    )


def offered(state, looked):
    """Return what a person clicks next: what the page offers of the first step not done.

    looked: whether the board was shown. So small a picture may not decide how the mask lies.
    """
    for step in state["steps"][:-1]:
        if step["done"] or (step["name"] == "align" and looked):
            continue
        if step.get("look") in state["targets"]:
            return "look", {"target": step["look"]}
        if step["name"] == "focus":
            return "autofocus", {"span_um": 400.0}
        if step["action"]:
            return step["action"], step.get("values", {})
    return None


@pytest.mark.parametrize("names", ORDERS, ids="-".join)
def test_whoever_clicks_in_any_order_and_interrupts_comes_to_a_plan_by_what_is_offered(
    bench, names
):
    clock, watch, exposures_s, plan = bench
    settled(watch)
    for name in names:
        (does, values), (interrupts, more) = CLICKS[name]
        clock.waits.clear()
        clock.free.clear()
        click(watch, does, values)
        assert clock.waits.wait(PATIENCE_S)
        interrupting = Thread(target=click, args=(watch, interrupts, more))
        interrupting.start()
        clock.free.set()
        interrupting.join(PATIENCE_S)
        state = settled(watch)
    looked = False
    for _ in range(MOST_CLICKS):
        if (next_click := offered(state, looked)) is None:
            break
        looked |= next_click[0] == "look"
        if next_click[0] == "autofocus":
            click(watch, "look", {"target": "scene"})
        click(watch, *next_click)
        state = settled(watch)
    left = {step["name"] for step in state["steps"] if not step["done"]} - {"align"}
    assert left == {"save"}, state
    assert max(exposures_s) <= LONGEST_UNASKED_S
    said = json.dumps([state["hint"], state["trouble"], state["steps"]])
    assert "dark" not in said
    assert "lamp" not in said
    click(watch, "preview", {"what": ["exposure"]})
    click(watch, "save", {})
    (shot,) = yaml.safe_load(plan.read_text())["shots"]
    assert shot["exposure_s"] == pytest.approx(state["settings"]["exposure_s"])
