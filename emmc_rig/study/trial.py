"""One simulated capture: a scene, a camera, noise and what is wrong with it -> what a method gets.

Frames are made with Psi on the grid of the reconstruction, an inverse crime that `emmc-rig demo`
avoids; where mask, lens or shots are at fault, the method is given the Psi of the design.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import Scene, zoomed_scene
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.errors import CameraError
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.dictionary import Dictionary, open_dictionary
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, reconstruct
from emmc_rig.reconstruction.result import Reconstruction
from emmc_rig.simulators.raycaster import World
from emmc_rig.simulators.scenes import SCENES
from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.rows import dictionary_identity, machine

Array = NDArray[np.floating]
open_dictionary_once = lru_cache(maxsize=4)(open_dictionary)


@dataclass(frozen=True)
class Capture:
    """A scene through a camera. scene: see `open_scene`. camera: described, or found by its name.

    size: rows and columns; None takes all of a measured scene. zoom: a built-in scene is rendered
    so many times larger, and cut, which makes its disparities as many times larger. seed: of the
    noise, of what is random in a fault, and of a built-in scene. shots, views: None takes the
    camera's own. noise: deviation of the readings' white noise, instead of the sensor's.
    """

    scene: str
    camera: Camera | str
    size: tuple[int, int] | None = None
    seed: int = 0
    zoom: int = 1
    shots: int | None = None
    views: tuple[int, int] | None = None
    noise: float | None = None

    def __hash__(self) -> int:
        # A camera holds dictionaries, which have no hash.
        return hash((self.scene, self.size, self.seed, self.zoom, self.shots, self.noise))

    @property
    def scene_name(self) -> str:
        """The scene as tables call it."""
        return Path(self.scene).stem

    @property
    def camera_name(self) -> str:
        """The camera as tables call it."""
        return Path(self.camera).stem if isinstance(self.camera, str) else self.camera.title

    @cached_property
    def described(self) -> Camera:
        """The camera; raises what `find_camera` and `with_shots` do."""
        camera = find_camera(self.camera) if isinstance(self.camera, str) else self.camera
        if self.views is not None:
            camera = camera.model_copy(update={"views": self.views})
        return camera if self.shots is None else with_shots(camera, self.shots)

    @property
    def is_built_in(self) -> bool:
        """Whether the scene is a built-in one, which can be changed."""
        return self.scene in SCENES

    def need_built_in(self) -> None:
        """Raise NotApplicableError for a measured scene."""
        if not self.is_built_in:
            raise NotApplicableError(
                "needs a built-in scene: a measured one cannot be changed in this way"
            )

    def scene_seen(
        self, views: tuple[int, int] | None = None, change: Callable[[World], World] | None = None
    ) -> Scene:
        """Return the scene in the camera's views, or in other views; change: of a built-in scene.

        Raises what `zoomed_scene` does.
        """
        views = views or self.described.views
        if change is None:
            return _opened(self.scene, self.size, views, self.seed, self.zoom)
        return zoomed_scene(self.scene, self.size, views, self.seed, self.zoom, change)

    def psi(self) -> Psi:
        """Return the Psi of the camera as designed, for the scene's size."""
        truth = self.scene_seen().light_field
        return build_imaging_matrix(self.described, (truth.shape[2], truth.shape[3]))

    def identity(self) -> dict[str, object]:
        """Return what its frames depend on, as plain data; of a measured scene its sums as well."""
        content = None
        if not self.is_built_in:
            content = _sums(self.scene, self.size, self.described.views, self.seed, self.zoom)
        return {
            "scene": self.scene_name,
            "content": content,
            "camera": self.described.model_dump(mode="json"),
            **{name: getattr(self, name) for name in ("size", "zoom", "seed", "noise")},
        }

    def with_camera(self, **changed: object) -> Capture:
        """Return the capture with some fields of the camera replaced."""
        camera = self.described.model_copy(update=changed)
        return dataclasses.replace(self, camera=camera, shots=None, views=None)


def method_inputs(name: str, dictionary: str | None) -> dict[str, object]:
    """Return what any method's figures depend on: machine, method, dictionary.

    Raises NotApplicableError for a method that is not installed.
    """
    method = METHODS[name]
    if not method.installed:
        raise NotApplicableError(f"{method.name} needs {method.package}, which is not installed")
    return {
        "machine": machine(),
        "method": method.name,
        "dictionary": dictionary_identity(dictionary) if method.needs_dictionary else None,
    }


def with_shots(camera: Camera, count: int) -> Camera:
    """Return a camera of `count` shots; raises NotApplicableError where it has no rule for more."""
    try:
        return camera.with_shots(count)
    except CameraError as why:
        raise NotApplicableError(str(why)) from why


@lru_cache
def _sums(
    spec: str, size: tuple[int, int] | None, views: tuple[int, int], seed: int, zoom: int
) -> list[float]:
    seen = _opened(spec, size, views, seed, zoom).light_field
    return [float(np.sum(item, dtype=np.float64)) for item in (seen, np.square(seen))]


@lru_cache(maxsize=4)
def _opened(
    spec: str, size: tuple[int, int] | None, views: tuple[int, int], seed: int, zoom: int
) -> Scene:
    return zoomed_scene(spec, size, views, seed, zoom)


@dataclass(frozen=True, eq=False)
class Trial:
    """What a method gets, and the truth.

    psi, readings, noise_sigma, usable: the method's inputs; `psi` is the assumed one. true_psi: the
    one that made the readings. truth: (v, u, y, x, c); disparity_px: (y, x), None where it is
    unknown. peak: of the PSNR; below 1 where the scene has less contrast.
    """

    psi: Psi
    readings: NDArray[np.float32]
    noise_sigma: float
    usable: NDArray[np.bool_]
    truth: Array
    disparity_px: Array | None
    true_psi: Psi
    peak: float = 1.0

    def dictionary(self, method: str, spec: str | None = None) -> Dictionary | None:
        """Return the dictionary of a method that needs one; spec: what `open_dictionary` takes."""
        if not METHODS[method].needs_dictionary:
            return None
        return open_dictionary_once(spec, self.psi.light_field_shape[:2], self.psi.binning)

    def solved(
        self, method: str, settings: MethodSettings | None = None, dictionary: str | None = None
    ) -> Reconstruction:
        """Return a method's reconstruction; raises what it does."""
        atoms = self.dictionary(method, dictionary)
        return reconstruct(method, self.psi, self.frames, atoms, settings)

    @property
    def frames(self) -> Frames:
        """The readings with their deviation, and which are usable."""
        return even_frames(self.readings, self.noise_sigma, self.usable)

    def psnr_db(self, light_field: Array) -> float:
        """Return the PSNR of a light field against the truth."""
        return psnr_db(light_field, self.truth) + 20 * math.log10(self.peak)


def trial_of(
    capture: Capture,
    *,
    scene: Scene | None = None,
    true_psi: Psi | None = None,
    shot_scenes: list[Array] | None = None,
    change_clean: Callable[[Array], Array] | None = None,
    unusable: NDArray[np.bool_] | None = None,
) -> Trial:
    """Return the trial of a capture; the method assumes the Psi of its camera.

    scene: instead of the capture's. true_psi: makes the readings, instead of the assumed one.
    shot_scenes: the light field before each shot, where it changes. change_clean: what becomes of
    the noise-free readings (shot, pixel_y, pixel_x). unusable: pixels marked as such.
    """
    scene = scene or capture.scene_seen()
    truth = scene.light_field
    size = (truth.shape[2], truth.shape[3])
    psi = build_imaging_matrix(capture.described, size)
    real = true_psi or psi
    if shot_scenes is None:
        clean = real.forward(truth)
    else:
        clean = np.stack([real.forward(seen)[shot] for shot, seen in enumerate(shot_scenes)])
    if change_clean is not None:
        clean = change_clean(clean)
    if capture.noise is not None:
        noise = np.random.default_rng(capture.seed).normal(0, capture.noise, clean.shape)
        every, readings = np.ones(clean.shape, bool), (clean + noise).astype(np.float32)
        return Trial(psi, readings, capture.noise, every, truth, scene.disparity_px, real)
    # A Psi measured or fitted may have coefficients a rounding below 0; light has not.
    clean = np.maximum(clean, 0)
    shots = capture.described.read_out(clean, capture.seed)
    usable, readings = shots.usable, shots.readings
    if unusable is not None:
        # What a pixel reads that is known to be bad says nothing, not even how much at least.
        usable, readings = usable & ~unusable, np.where(unusable, 0, readings)
    return Trial(psi, readings, shots.noise_sigma, usable, truth, scene.disparity_px, real)
