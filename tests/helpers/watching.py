"""Watchers of a test: one acts at events, the other keeps what a run makes known."""

from collections.abc import Callable

from emmc_rig.progress import Event, Watcher


class Acting(Watcher):
    """Calls a function at every event of a name; names have underscores for dots and spaces."""

    def __init__(self, **actions: Callable[[Event], object]) -> None:
        self.actions = actions

    def event(self, event):
        action = self.actions.get(event.name.replace(".", "_").replace(" ", "_"))
        if action is not None:
            action(event)


class Recorder(Watcher):
    """Keeps stages, steps, notes and events; after so many steps done in a stage it calls `act`."""

    def __init__(self, steps: int = -1, act: Callable[[], object] = lambda: None) -> None:
        self.stages, self.details, self.notes, self.events = [], [], [], []
        self.steps, self.act = steps, act

    def begin(self, stage, steps=None):
        self.stages.append(stage)

    def step(self, detail=""):
        self.details.append(detail)

    def at(self, done, steps, detail=""):
        if done == self.steps:
            self.act()

    def tell(self, message):
        self.notes.append(message)

    def event(self, event):
        self.events.append(event)
