"""Makes the weights of the method `unrolled`: what learning buys, from random worlds and scenes.

    python benchmarks/train_network.py --steps 1999 --out net.h5
    python benchmarks/train_network.py --scene SCENES/dice --camera rgbw-mono --out mine.h5

Every step draws a world or a scene, masks of a camera's kinds, light and noise. Adam descends on
the root mean square error; a running average of the weights, over the last tenth or so of the
steps, is what is written, so that a training may end at any step. Ctrl-C leaves a checkpoint, and
the same line goes on.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from random_worlds import DARKEST, WORLDS_AT_HAND, with_pattern, world
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent / "unrolled_plugin"))
from emmc_rig_unrolled.network import Capture, Unrolled, captured
from emmc_rig_unrolled.weights import Architecture, NetworkWeights
from training_patches import cut_patches

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import Camera
from emmc_rig.model.files import whole_file
from emmc_rig.store.folders import new_file
from emmc_rig.store.results import command_line, versions

CAMERAS = "scenario-ii-cfa", "rgbw-bayer-1shot", "rgbw-bayer-3shots", "rgbw-mono"
VIEWS = 5, 5
STEPS_A_WORLD = 8
"""Steps after which the oldest of the worlds at hand goes and a new one is rendered."""
CROPS = 6
NOISE = 0.001, 0.02
"""Range from which the readings' deviation is drawn, log-uniformly; white is 1."""
FROM_SCENES = 0.75
"""Share of the steps that see a scene, where scenes are given."""
CHECKPOINT_INTERVAL_S = 60.0
RATE = 2e-3
"""Of Adam, after WARM_UP steps; it falls as 1 / sqrt(1 + step / SETTLED)."""
WARM_UP, SETTLED = 20, 1000
AVERAGED = 10.0
"""The average's share of a step is AVERAGED / (step + AVERAGED)."""
EARLIER = 0.1
"""Weight of the loss of the stages before the last, together."""
STEEPEST = 1.0
"""Norm to which gradients are cut."""


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("network.h5"))
    parser.add_argument("--scene", action="append", default=[], help="besides random worlds")
    parser.add_argument("--camera", action="append", help=f"default: {', '.join(CAMERAS)}")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--crop", type=int, default=48, help="rows and columns of a step's crop")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smallest", action="store_true", help="two steps of a small network")
    options = parser.parse_args()
    architecture = Architecture(views=VIEWS)
    if options.smallest:
        options.steps, options.crop, options.camera = 2, 20, ["rgbw-mono"]
        architecture = Architecture(views=VIEWS, channels=4, blocks=1, stages=2)
    data = TrainingData.opened(options.camera or CAMERAS, options.scene, options.crop, options.seed)
    train(options.out, data, architecture, options.steps)


@dataclass(frozen=True)
class TrainingData:
    """What a training draws its examples from. scenes: light fields (v, u, y, x, c) by name."""

    cameras: dict[str, Camera]
    scenes: dict[str, NDArray[np.float32]]
    crop: int
    seed: int

    @classmethod
    def opened(cls, cameras, scenes, crop: int, seed: int) -> TrainingData:
        """Open cameras and scenes; raises AppError for other views, or scenes below a crop."""
        known = {name: find_camera(name) for name in cameras}
        for name, camera in known.items():
            if camera.views != VIEWS:
                raise AppError(f"--camera {name}: its views are not {VIEWS[0]}x{VIEWS[1]}")
        opened = {spec: open_scene(spec, views=VIEWS).light_field for spec in scenes}
        for spec, light_field in opened.items():
            if min(light_field.shape[2:4]) < crop:
                raise AppError(f"--scene {spec}: views smaller than crops of {crop}x{crop}")
        return cls(known, opened, crop, seed)

    def example(self, step: int) -> tuple[Capture, Tensor]:
        """Return what the network sees in a step, and the true light field (view, colour, y, x)."""
        rng, side = np.random.default_rng([self.seed, 1, step]), self.crop
        number = step // STEPS_A_WORLD + int(rng.integers(WORLDS_AT_HAND))
        if self.scenes and rng.random() < FROM_SCENES:
            light_field = list(self.scenes.values())[int(rng.integers(len(self.scenes)))]
        else:
            light_field = world(self.seed, number, VIEWS)
        # Of a few crops the one of most contrast: most of a world is even, which teaches little.
        corners = rng.integers(np.array(light_field.shape[2:4]) - side + 1, size=(CROPS, 2))
        middle = light_field[VIEWS[0] // 2, VIEWS[1] // 2]
        corner = max(corners, key=lambda c: contrast(middle[c[0] :, c[1] :][:side, :side]))
        (truth,) = cut_patches(light_field, corner[None], rng.integers(8, size=1), (side, side))
        light = np.exp(rng.uniform(np.log(DARKEST), 0))
        truth = np.ascontiguousarray(light * truth[..., rng.permutation(3)], np.float32)
        cameras = list(self.cameras.values())
        psi = with_drawn_masks(cameras[rng.integers(len(cameras))], rng).psi((side, side))
        if psi.colour is None and not np.ptp(psi.weights, axis=4).any():  # no colour is seen
            truth = np.broadcast_to(truth.mean(axis=-1, keepdims=True), truth.shape).copy()
        sigma = np.exp(rng.uniform(*np.log(NOISE)))
        frames = psi.forward(truth)
        frames += sigma * rng.standard_normal(frames.shape, dtype=np.float32)
        variance = np.full(frames.shape, sigma**2, np.float32)
        capture = captured(psi, frames, variance, np.ones(frames.shape, bool))
        return capture, torch.from_numpy(truth).flatten(0, 1).permute(0, 3, 1, 2)


def contrast(picture: NDArray[np.float32]) -> float:
    """Return the root mean square difference of neighbouring samples, over the brightness."""
    square = sum(float(np.mean(np.square(np.diff(picture, axis=axis)))) for axis in (0, 1))
    return square**0.5 / max(float(picture.mean()), 1e-3)


def with_drawn_masks(camera: Camera, rng: np.random.Generator) -> Camera:
    """Return a camera with new seeds of its random patterns; other patterns stay."""
    for name, mask in camera.masks.items():
        if hasattr(mask.pattern, "seed"):
            camera = with_pattern(camera, name, seed=int(rng.integers(2**31)))
    return camera


class Learner:
    """A network in training. losses_db: the PSNR of each step's example."""

    def __init__(self, architecture: Architecture, seed: int) -> None:
        torch.manual_seed(seed)
        self.network = Unrolled(architecture)
        self.average = {k: v.detach().clone() for k, v in self.network.named_parameters()}
        self.adam = torch.optim.Adam(self.network.parameters(), RATE)
        self.losses_db: list[float] = []

    def step(self, capture: Capture, truth: Tensor) -> float:
        """Learn from one capture of a light field (view, colour, y, x); return its PSNR, dB."""
        steps = len(self.losses_db)
        rate = RATE * min(1, (steps + 1) / WARM_UP) / (1 + steps / SETTLED) ** 0.5
        for group in self.adam.param_groups:
            group["lr"] = rate
        *earlier, last = [
            (estimate - truth / capture.brightness).square().mean().sqrt()
            for estimate in self.network(capture)
        ]
        loss = last + EARLIER * sum(earlier) / max(1, len(earlier))
        self.adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), STEEPEST)
        self.adam.step()
        with torch.no_grad():
            for name, now in self.network.named_parameters():
                self.average[name].lerp_(now, AVERAGED / (steps + AVERAGED))
        self.losses_db.append(-20 * math.log10(capture.brightness * float(last.detach())))
        return self.losses_db[-1]

    def save(self, path: Path, recipe: str) -> None:
        """Write a checkpoint of the training that a recipe describes."""
        state = {
            "recipe": recipe, "network": self.network.state_dict(), "average": self.average,
            "adam": self.adam.state_dict(), "losses_db": self.losses_db,
        }  # fmt: skip
        with whole_file(path) as partial:
            torch.save(state, partial)

    def load(self, path: Path, recipe: str) -> None:
        """Go on from a checkpoint; raises AppError for the checkpoint of another training."""
        state = torch.load(path, weights_only=True)
        if state["recipe"] != recipe:
            raise AppError(f"{path}: of a training with other settings; give the same or delete it")
        self.network.load_state_dict(state["network"])
        self.adam.load_state_dict(state["adam"])
        self.average, self.losses_db = state["average"], state["losses_db"]


def train(out: Path, data: TrainingData, architecture: Architecture, steps: int) -> NetworkWeights:
    """Write the weights after so many steps in all to `out`; return them."""
    if out.exists():
        raise AppError(f"{out}: exists already; choose another name")
    kept = out.with_suffix(".checkpoint.pt")
    recipe = {
        "cameras": list(data.cameras), "scenes": list(data.scenes), "crop": data.crop,
        "seed": data.seed, "architecture": architecture.model_dump(mode="json"),
    }  # fmt: skip
    learner, text = Learner(architecture, data.seed), json.dumps(recipe)
    if kept.exists():
        learner.load(kept, text)
    saved_at = time.perf_counter()
    try:
        while (step := len(learner.losses_db)) < steps:
            psnr_db = learner.step(*data.example(step))
            print(f"step {step + 1} of {steps}: {psnr_db:.1f} dB")
            if time.perf_counter() - saved_at > CHECKPOINT_INTERVAL_S:
                learner.save(kept, text)
                saved_at = time.perf_counter()
    except KeyboardInterrupt:
        learner.save(kept, text)
        sys.exit(f"stopped by Ctrl-C; the same command goes on from {kept}")
    twentieths = np.array_split(learner.losses_db, 20)
    provenance = {
        **recipe,
        "steps": steps,
        "mean_psnr_db": [float(np.mean(part)) for part in twentieths if len(part)],
        "command": command_line(),
        "versions": versions(),
    }
    arrays = {name: values.numpy() for name, values in learner.average.items()}
    weights = NetworkWeights(architecture, arrays, json.dumps(provenance, indent=1))
    with new_file(out) as written:
        weights.save(written)
    kept.unlink(missing_ok=True)
    print(f"wrote {out}: {provenance['mean_psnr_db'][-1]:.2f} dB in the last twentieth of steps")
    return weights


if __name__ == "__main__":
    try:
        main()
    except ERRORS as fault:
        sys.exit(str(fault))
