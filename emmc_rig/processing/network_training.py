"""Train an unrolled network: random worlds or scenes, random masks, noise, steps, checkpoints."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError, StoppedError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.folders import new_file
from emmc_rig.files.results import command_line, versions
from emmc_rig.model.camera import Camera
from emmc_rig.processing.training import Source, check_new_file, checkpoint_path, find_sources
from emmc_rig.progress import Watcher
from reconstruction.methods.unrolled import with_torch
from reconstruction.training_patches import cut_patches
from reconstruction.unrolled.weights import Architecture, NetworkWeights
from simulators.random_worlds import random_world
from simulators.raycaster import tabulated
from simulators.scenes import rendered

if TYPE_CHECKING:
    from reconstruction.unrolled.learning import Learner

WORLD_SIZE = 128, 160
"""Rows and columns at which worlds are rendered: then their disparities are 5/8 of those quoted."""
STEPS_A_WORLD, WORLDS = 8, 32
"""Steps after which the oldest of the worlds at hand goes and a new one is rendered."""
CROPS = 6
NOISE = 0.001, 0.02
"""Range from which the readings' deviation is drawn, log-uniformly; white is 1."""
DARKEST = 0.3
"""Least factor, drawn log-uniformly up to 1, on a world's light."""
FROM_SCENES = 0.75
"""Share of the steps that see a scene, where scenes are given; the others see random worlds."""
_CHECKPOINT_EVERY_S = 60.0


@dataclass(frozen=True)
class NetworkTraining:
    """What to train, and where to write it.

    scenes, leave_out: see `training.find_sources`; without any, random worlds alone. crop: rows and
    columns of what a step sees.
    """

    out: Path
    cameras: tuple[str, ...]
    architecture: Architecture
    steps: int
    scenes: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    minutes: float | None = None
    crop: int = 48
    seed: int = 0
    resume: bool = False

    def __post_init__(self) -> None:
        if self.leave_out and not self.scenes:
            raise AppError("--leave-out names scenes of --scenes, which is not given")

    def sources(self) -> list[Source]:
        """Return the scenes to train on; raises AppError as `find_sources` does."""
        return find_sources(self.scenes, self.leave_out) if self.scenes else []

    def purpose(self) -> dict[str, object]:
        """Return what makes two trainings the same, but for their length."""
        scenes = sorted({source.name for source in self.sources()})
        return {
            **({"scenes": scenes} if scenes else {}),
            "cameras": list(self.cameras),
            "architecture": self.architecture.model_dump(mode="json"),
            "crop": self.crop,
            "seed": self.seed,
        }


@lru_cache(maxsize=2 * WORLDS)
def world(seed: int, number: int, views: tuple[int, int]) -> NDArray[np.float32]:
    """Return the light field of a random world (v, u, y, x, c), of WORLD_SIZE pixels."""
    rng = np.random.default_rng([seed, 0, number])
    return rendered(tabulated(random_world(rng)), views, WORLD_SIZE).light_field


def drawn_masks(camera: Camera, rng: np.random.Generator) -> Camera:
    """Return a camera with other random patterns of the same kinds; made ones stay as they are."""
    for name, mask in camera.masks.items():
        if hasattr(mask.pattern, "seed"):
            camera = camera.with_pattern(name, seed=int(rng.integers(2**31)))
    return camera


def _detail(picture: NDArray[np.float32]) -> float:
    """Return the root mean square difference of neighbouring samples, over the brightness."""
    across, down = np.diff(picture, axis=1), np.diff(picture, axis=0)
    square = float(np.mean(np.square(across)) + np.mean(np.square(down)))
    return square**0.5 / max(float(picture.mean()), 1e-3)


def opened_scenes(training: NetworkTraining, watcher: Watcher) -> list[NDArray[np.float32]]:
    """Return the scenes' light fields (v, u, y, x, c); raises AppError for those too small."""
    sources = training.sources()
    watcher.begin("reading scenes", len(sources))
    found = []
    for source in sources:
        light_field = source.open(training.architecture.views)
        if min(light_field.shape[2:4]) < training.crop:
            raise AppError(
                f"{source.spec}: views of {light_field.shape[2]}x{light_field.shape[3]} pixels, "
                f"training takes crops of {training.crop}x{training.crop}"
            )
        found.append(light_field)
        watcher.step(source.name)
    return found


def example(
    training: NetworkTraining,
    cameras: list[Camera],
    step: int,
    scenes: Sequence[NDArray[np.float32]] = (),
):
    """Return what the network sees in a step, and the true light field (view, colour, y, x).

    scenes: light fields (v, u, y, x, c) to take crops of, in FROM_SCENES of the steps.
    """
    import torch  # pyright: ignore[reportMissingImports]

    from reconstruction.unrolled.network import captured

    rng = np.random.default_rng([training.seed, 1, step])
    number = step // STEPS_A_WORLD + int(rng.integers(WORLDS))
    if scenes and rng.random() < FROM_SCENES:
        light_field = scenes[int(rng.integers(len(scenes)))]
    else:
        light_field = world(training.seed, number, training.architecture.views)
    # Of a few crops the one of most contrast: most of a world is even, which teaches little.
    size = np.array(light_field.shape[2:4])
    corners = rng.integers(size - training.crop + 1, size=(CROPS, 2))
    side = training.crop
    middle = light_field[light_field.shape[0] // 2, light_field.shape[1] // 2]
    corner = max(
        corners, key=lambda at: _detail(middle[at[0] : at[0] + side, at[1] : at[1] + side])
    )
    symmetry = rng.integers(8 if light_field.shape[0] == light_field.shape[1] else 4, size=1)
    (truth,) = cut_patches(light_field, corner[None], symmetry, (side, side))
    light = np.exp(rng.uniform(np.log(DARKEST), 0))
    truth = np.ascontiguousarray(light * truth[..., rng.permutation(3)], np.float32)
    psi = drawn_masks(cameras[rng.integers(len(cameras))], rng).psi((side, side))
    if psi.is_colour_blind:
        truth = np.broadcast_to(truth.mean(axis=-1, keepdims=True), truth.shape).copy()
    sigma = np.exp(rng.uniform(*np.log(NOISE)))
    frames = psi.forward(truth)
    frames += sigma * rng.standard_normal(frames.shape, dtype=np.float32)
    usable = np.ones(frames.shape, bool)
    capture = captured(psi, frames, np.full(frames.shape, sigma**2, np.float32), usable)
    return capture, torch.from_numpy(truth).flatten(0, 1).permute(0, 3, 1, 2)


def train_network(
    training: NetworkTraining, watcher: Watcher, clock: Callable[[], float] = time.perf_counter
) -> tuple[NetworkWeights, Learner]:
    """Train, and write the weights to `training.out`.

    A checkpoint is written every minute, and when training is interrupted or its minutes are over;
    it goes when all steps are done. Raises AppError for wrong settings or files in the way,
    StoppedError by Ctrl-C, ReconstructionError without PyTorch or for another checkpoint.
    """
    out, kept = training.out, checkpoint_path(training.out).with_suffix(".pt")
    check_new_file(out, "a network's")
    if kept.exists() != training.resume:
        raise AppError(
            f"{kept}: an earlier training stopped there; give --resume to go on, or delete it"
            if kept.exists()
            else f"{kept}: no checkpoint to resume from; train without --resume"
        )
    cameras = [find_camera(name) for name in training.cameras]
    views = training.architecture.views
    for camera, name in zip(cameras, training.cameras, strict=True):
        if camera.views != views:
            raise AppError(
                f"--camera {name}: {camera.views[0]}x{camera.views[1]} views, the network has "
                f"{views[0]}x{views[1]}"
            )
    learning, purpose = with_torch("learning"), training.purpose()
    scenes = opened_scenes(training, watcher)
    learner = learning.Learner(training.architecture, training.seed)
    if training.resume:
        learner.load(kept, purpose)
    started = saved = clock()
    watcher.begin("learning", training.steps)
    for _ in range(learner.steps):
        watcher.step("resumed")
    try:
        while learner.steps < training.steps:
            capture, truth = example(training, cameras, learner.steps, scenes)
            watcher.step(f"{learner.step(capture, truth):.1f} dB")
            if training.minutes is not None and clock() - started > 60 * training.minutes:
                break
            if clock() - saved > _CHECKPOINT_EVERY_S:
                learner.save(kept, purpose)
                saved = clock()
    except KeyboardInterrupt:
        learner.save(kept, purpose)
        raise StoppedError(
            f"stopped by Ctrl-C after step {learner.steps} of {training.steps}, which {kept} "
            "keeps; the same command with --resume goes on"
        ) from None
    provenance = {
        **purpose,
        "steps": learner.steps,
        "mean_psnr_db": [
            float(np.mean(part)) for part in np.array_split(learner.losses_db, 20) if len(part)
        ],
        "seconds": clock() - started,
        "command": command_line(),
        "versions": versions(),
    }
    weights = learner.weights(json.dumps(provenance, indent=1))
    with new_file(out) as written:
        weights.save(written)
    if learner.steps < training.steps:
        learner.save(kept, purpose)
    else:
        kept.unlink(missing_ok=True)
    return weights, learner
