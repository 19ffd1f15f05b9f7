"""Whiteboards of a simulated bench in memory, without a session: what the calibration is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import BoardFrame, BoardSet, channels_of
from emmc_rig.calibration.frames import MeanFrame, average, before_and_after
from emmc_rig.calibration.levels import Check, check_of
from emmc_rig.calibration.openings import CENTRED, Window, views_open, window_place_um
from emmc_rig.calibration.whiteboard import LAMP_COLOURS
from emmc_rig.model.camera import Camera, psi_layout
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.sensing import Psi
from emmc_rig.simulators.bench import Bench, MountingErrors, window_side_um
from emmc_rig.simulators.effects import ORDINARY, Flaws, flawed
from emmc_rig.simulators.flaws import OpticsFlaws, SensorFlaws

Array = NDArray[np.floating]
DARK_REPEATS = 2
"""Before all whiteboards, and after them."""
REFERENCE_REPEATS = 4
CHECK_EVERY = 5
"""Whiteboards between two looks at the same one, which show how the lamp drifts."""
SERIES_SHARES = (0.25, 0.5, 0.75)
"""Of a reference's exposure: they show whether the response is linear."""
FRAME_S = 0.5
"""Between two frames, for stage and readout."""
COLOUR_REPEATS = 2
BOARD_LEVEL = 0.7
RAYS_PER_VIEW = 512
ORDINARY_BENCH = flawed(Flaws(), [ORDINARY])


@dataclass(frozen=True)
class Setting:
    """One whiteboard to take: how the bench stands, and how many frames.

    stage_um: beyond the shot's own offset of the mask. board_turn_deg: how the white board is
    turned. window: by how many cells the plate's window is moved.
    """

    shot: int = 0
    pinhole: tuple[int, int] | None = None
    lamp: str = "white"
    stage_um: tuple[float, float] = (0.0, 0.0)
    repeats: int = 2
    board_turn_deg: float = 0.0
    window: Window = CENTRED

    def views_open(self, views: tuple[int, int]) -> NDArray[np.bool_]:
        """Return which views (v, u) it opens."""
        return views_open(views, self.pinhole, self.window)


@dataclass(frozen=True)
class BenchTruth(Flaws):
    """What is wrong with the simulated bench, and how finely its rays are traced."""

    mounting: MountingErrors = ORDINARY_BENCH.mounting
    optics: OpticsFlaws = ORDINARY_BENCH.optics
    sensor: SensorFlaws = ORDINARY_BENCH.sensor
    rays_per_view: int = RAYS_PER_VIEW


@dataclass
class WhiteboardBench:
    """A simulated bench before a white board; `scene` lets it look at a light field too."""

    camera: Camera
    size: tuple[int, int]
    truth: BenchTruth = field(default_factory=BenchTruth)
    seed: int = 0
    scene: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        rows, columns = self.size
        names = ("mask_x", "mask_y", "aperture_x", "aperture_y")
        self._at_um: dict[str, float] = dict.fromkeys(names, 0.0)
        self._window_um = 2 * max(self.camera.views) * self.camera.lens.aperture_cell_um
        shape = (*self.camera.views, rows, columns, 3)
        scene = np.ones(shape, np.float32) if self.scene is None else self.scene
        self.bench = Bench(
            self.camera,
            scene,
            self.size,
            lambda: self._at_um,
            self._window_um,
            np.random.default_rng(self.seed),
            self.truth.mounting,
            self.truth.rays_per_view,
            self.truth.optics,
            self.truth.sensor,
            self.truth.board,
            self.truth.lamp,
            lambda: self.seconds,
        )
        self.bench.target = "whiteboard"
        self.seconds = 0.0
        self._channels = channels_of(psi_layout(self.camera, self.size))

    def reading(self, setting: Setting, masks_in: bool = True) -> Array:
        """Return the noise-free reading of a setting now, (pixel_y, pixel_x), the falloff in it."""
        self._stand(setting, masks_in)
        return self.bench.readings()

    def _stand(self, setting: Setting, masks_in: bool) -> None:
        self._at_um["mask_x"], self._at_um["mask_y"] = self.sent_um(setting)
        if setting.pinhole is None:
            lens = self.camera.lens
            side_um = window_side_um(self.camera.views, lens.aperture_cell_um)
            x_um, y_um = window_place_um(
                setting.window, self.camera.views, lens.aperture_cell_um, side_um
            )
            self._at_um["aperture_x"] = self._window_um + x_um
            self._at_um["aperture_y"] = y_um
        else:
            cell_um = self.camera.lens.aperture_cell_um
            v, u = setting.pinhole
            self._at_um["aperture_y"] = float(centred_grid(self.camera.views[0], cell_um)[v])
            self._at_um["aperture_x"] = float(centred_grid(self.camera.views[1], cell_um)[u])
        self.bench.shot, self.bench.lamp = setting.shot, setting.lamp
        self.bench.masks_in = masks_in
        self.bench.board_turn_deg = setting.board_turn_deg

    def board_exposure_s(self) -> float:
        """Return the exposure that fills BOARD_LEVEL of the range without masks."""
        noise = self.camera.sensor.noise
        range_electrons = (noise.white_level_dn - noise.black_level_dn) / noise.gain_dn_per_electron
        well = self.truth.sensor.full_well_electrons or range_electrons
        light = 3 * self.camera.sensor.binning**2 if self.camera.sensor.cfa_name == "mono" else 1
        return BOARD_LEVEL * min(well, range_electrons) / (noise.electrons_per_s * light)

    def _frames(
        self, setting: Setting, exposure_s: float, masks_in: bool, count: int, what: str
    ) -> MeanFrame:
        noise = self.camera.sensor.noise
        began_s = self.seconds
        frames = (self._exposed(setting, exposure_s, masks_in) for _ in range(count))
        lit = setting.lamp != "off"
        mean = average(frames, exposure_s, noise.white_level_dn, what, lit=lit)
        return replace(mean, taken_s=(began_s + self.seconds) / 2)

    def _exposed(self, setting: Setting, exposure_s: float, masks_in: bool) -> NDArray[np.uint16]:
        self.seconds += exposure_s + FRAME_S
        return self.truth.sensor.expose_dn(
            self.camera.sensor.noise,
            self.reading(setting, masks_in),
            exposure_s,
            self.bench.light(setting.shot),
            self.bench.rng,
            self.seconds,
        )

    def capture(self, settings: Sequence[Setting]) -> BoardSet:
        """Return dark frames, references, and the whiteboards asked for, in their order.

        Between them the first whiteboard of the open aperture is looked at again, and without masks
        at several exposures before and at one after: the checks.
        """
        board_s = self.board_exposure_s()
        views = self.camera.views

        def exposed_s(setting: Setting) -> float:
            return board_s * float(np.prod(views) / setting.views_open(views).sum())

        exposures = {exposed_s(setting) for setting in settings}
        series = [board_s * share for share in SERIES_SHARES]
        darks = {t: self._dark(t) for t in sorted({board_s, *exposures, *series})}
        checks: list[Check] = []

        turn = settings[0].board_turn_deg

        def seen_again(masks_in: bool, frame: MeanFrame) -> None:
            dark = darks[frame.exposure_s].mean_dn
            checks.append(check_of(frame, masks_in, dark, self._channels, turn))

        references = self._references(settings, board_s)
        lamp = settings[0].lamp
        plain = Setting(lamp=lamp, board_turn_deg=turn)
        for exposure_s in [*series, board_s]:
            frame = self._frames(plain, exposure_s, False, 2, "response")
            seen_again(False, frame)
        frames = []
        again = Setting(lamp=lamp, repeats=1, board_turn_deg=turn)
        for place, setting in enumerate(settings):
            if place % CHECK_EVERY == 0:
                seen_again(True, self._frames(again, board_s, True, 1, "the lamp's level"))
            exposure_s = exposed_s(setting)
            label = f"whiteboard, shot {setting.shot + 1}, {setting.pinhole or 'open aperture'}"
            frame = self._frames(setting, exposure_s, True, setting.repeats, label)
            sent = self.sent_um(setting)
            frames.append(
                BoardFrame.held(
                    frame, sent, setting.shot, setting.pinhole, setting.lamp, setting.window
                )
            )
        seen_again(True, self._frames(again, board_s, True, 1, "the lamp's level"))
        seen_again(False, self._frames(plain, board_s, False, 2, "reference"))
        both = tuple(before_and_after(dark, self._dark(t)) for t, dark in darks.items())
        return BoardSet(both, references, tuple(frames), tuple(checks))

    def _references(
        self, settings: Sequence[Setting], board_s: float
    ) -> dict[tuple[int, str], MeanFrame]:
        """Return the open whiteboards without masks; shots behind the same filter share one.

        Where pixels see one colour each, the coloured lamps too: what else they see.
        """
        references: dict[tuple[int, str], MeanFrame] = {}
        turn = settings[0].board_turn_deg

        def taken(shot: int, lamp: str, repeats: int) -> MeanFrame:
            label = f"reference, shot {shot + 1}, {lamp} lamp"
            setting = Setting(shot, lamp=lamp, board_turn_deg=turn)
            return self._frames(setting, board_s, False, repeats, label)

        shots = self.camera.shots
        for shot, lamp in product(
            range(len(shots)), sorted({setting.lamp for setting in settings})
        ):
            alike = [
                frame
                for (other, named), frame in references.items()
                if named == lamp and shots[other].filter == shots[shot].filter
            ]
            known = alike[0] if alike else taken(shot, lamp, REFERENCE_REPEATS)
            references[shot, lamp] = known
        if self._channels.max() < len(LAMP_COLOURS) and turn == 0:
            for lamp in LAMP_COLOURS:
                if (0, lamp) not in references:
                    references[0, lamp] = taken(0, lamp, COLOUR_REPEATS)
        return references

    def sent_um(self, setting: Setting) -> tuple[float, float]:
        """Return where a setting sends the mask stage: the shot's offset and what is beyond."""
        moving = [
            self.camera.shots[setting.shot].offset_um.get(name, (0.0, 0.0))
            for name in self.camera.moving_masks
        ]
        x, y = moving[0] if moving else (0.0, 0.0)
        return (x + setting.stage_um[0], y + setting.stage_um[1])

    def _dark(self, exposure_s: float) -> MeanFrame:
        return self._frames(Setting(lamp="off"), exposure_s, False, DARK_REPEATS, "dark frame")

    def true_psi(self) -> NDArray[np.float32]:
        """Return `Bench.true_psi` of every shot, (shot, v, u, y, colour, x)."""
        found = []
        for shot in range(len(self.camera.shots)):
            self._stand(Setting(shot), True)
            found.append(self.bench.true_psi(shot))
        return np.stack(found)

    def exact_psi(self, design: Psi) -> Psi:
        """Return the true Psi in the form of a design: of each pixel's own colour, or all."""
        true = self.true_psi()
        if design.colour is not None:
            own = design.colour[:, None, None, :, None, :].astype(np.int64)
            true = np.take_along_axis(true, own, axis=4)
        return replace(design, weights=np.ascontiguousarray(true))

    def capture_scene(self) -> tuple[NDArray[np.uint16], NDArray[np.float64]]:
        """Return the shots of the scene, (shot, pixel_y, pixel_x) in DN, and their exposures."""
        exposures_s = self.camera.exposures_s()
        frames = []
        self.bench.target = "scene"
        try:
            for shot, exposure_s in enumerate(exposures_s):
                self._stand(Setting(shot), True)
                frames.append(self.bench.expose(float(exposure_s)))
        finally:
            self.bench.target = "whiteboard"
        return np.stack(frames), exposures_s


def moved_truth(truth: BenchTruth, x_um: float, y_um: float) -> BenchTruth:
    """Return the bench with its mask moved."""
    x, y = truth.mounting.offset_um
    return replace(truth, mounting=replace(truth.mounting, offset_um=(x + x_um, y + y_um)))
