"""A reconstruction with its verdict: arrays, one line, a picture, and the files of a folder."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.files.exports import LIGHT_FIELD, save_maps
from emmc_rig.files.formats.format import Export
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import (
    BACK_TO_FRONT,
    export_pictures,
    psnr_db,
    replicate_centre,
    save_hdf5,
    ssim,
)
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.view_axes import ATTRIBUTE, grid_name, stored_as
from emmc_rig.store.folders import result_folder
from reconstruction.result import Reconstruction
from reconstruction.verdict.kept import missed_readings
from reconstruction.verdict.rules import Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from emmc_rig.pages.result_figure import FigureSettings


def compared(light_field: Any, truth: NDArray) -> dict[str, float]:
    """Return how near a light field, an array or a dataset, is to the truth (v, u, y, x, c)."""
    return {
        "psnr_db": psnr_db(light_field, truth),
        "ssim": ssim(light_field, truth),
        "replicate_psnr_db": psnr_db(replicate_centre(truth), truth),
    }


def estimates_of(frames: Frames) -> dict[str, list[str]]:
    """Return what of raw frames was estimated, in words, as metrics.json has it."""
    found = getattr(frames, "estimates", ())
    return {"estimated_from_frames": list(found)} if found else {}


def figures(solved: Reconstruction, verdict: Verdict, frames: Frames) -> dict[str, Any]:
    """Return what metrics.json has of a reconstruction, its verdict and its frames."""
    return {
        "method": solved.method,
        "status": solved.status,
        "advice": solved.advice,
        "screening": list(solved.screening),
        "verdict": verdict.as_dict(),
        "steps": solved.steps,
        "seconds": solved.seconds,
        "parameters": solved.parameters,
        "noise_sigma": frames.noise_sigma,
        "usable_share": float(frames.usable.mean()),
        **estimates_of(frames),
        "command": command_line(),
        "versions": versions(),
    }


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What `emmc_rig.reconstruct` returns.

    solved: what the method returned. verdict: whether to trust it, with reasons and remedies.
    psi, frames: what it was given. dictionary: the kind of dictionary used; None without one.
    """

    solved: Reconstruction
    verdict: Verdict
    psi: ImagingMatrix
    frames: Frames
    dictionary: str | None = None

    @property
    def light_field(self) -> NDArray[np.float32]:
        """The estimate, (v, u, y, x, c) float32 in [0, 1]."""
        return self.solved.light_field

    @property
    def maps(self) -> Mapping[str, NDArray]:
        """What the method estimated beside the light field, by name; none for most methods."""
        return self.solved.maps

    @property
    def sigma(self) -> NDArray[np.floating] | None:
        """Standard deviation of the light field, (v, u, y, x); None where the method has none."""
        return self.maps.get("sigma")

    @property
    def stated_db(self) -> float | None:
        """The PSNR that the method states, dB; None where it has no `sigma`."""
        return self.solved.stated["stated_db"]

    @property
    def stated_interval_db(self) -> list[float] | None:
        """Lowest and highest PSNR, dB: the true one lies between them in 9 of 10 captures."""
        return self.solved.stated["stated_interval_db"]

    @property
    def disparity(self) -> NDArray[np.floating] | None:
        """Disparity (y, x) of the centre view, pixels per view step; None without an estimate.

        None where views are bands or times: `maps` has a `shift` then, pixels from one to the next.
        """
        return self.maps.get("disparity")

    @cached_property
    def misfit(self) -> NDArray[np.float32]:
        """How far readings are missed around each place (y, x), in deviations: about 1 is right."""
        psi, frames, count = self.psi, self.frames, self.psi.shots
        if "moved_px" in self.solved.parameters and count > 1:
            # The scene moved: it is the light field of the first shot's time.
            psi, count = psi.of_shots([0]), 1
        readings, usable = frames.readings[:count], frames.usable[:count]
        return missed_readings(psi, self.light_field, readings, frames.noise_sigma, usable)

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.solved.method

    @property
    def status(self) -> str:
        """How the solver ended; "converged", or what `advice` has a remedy for."""
        return self.solved.status

    @property
    def advice(self) -> str:
        """What to do where the solver did not converge; empty where it did."""
        return self.solved.advice

    @property
    def seconds(self) -> float:
        """How long the method took."""
        return self.solved.seconds

    def compare(self, truth: ArrayLike) -> dict[str, float]:
        """Return how near the estimate is to the true light field (v, u, y, x, c).

        psnr_db, ssim: of all views and colours, peak 1. replicate_psnr_db: that of the true centre
        view copied to all views, which a light field has to beat.
        """
        return compared(self.light_field, np.asarray(truth))

    def metrics(self) -> dict[str, Any]:
        """Return the figures of the reconstruction, as metrics.json has them."""
        return {
            **figures(self.solved, self.verdict, self.frames),
            **self.solved.stated,
            "shots": self.psi.shots,
            "size": list(self.psi.size),
            "view_axes": list(self.psi.view_axes),
            "psi_sha256": self.psi.checksum(),
            "dictionary": self.dictionary,
        }

    def save(self, out: str | Path) -> None:
        """Write the result as a folder: light field, pictures, maps and metrics.

        An earlier result of that name is replaced; raises AppError where something else is there.
        """
        with result_folder(Path(out), "reconstruct") as folder:
            self.write(folder, self.metrics())
            self.draw(folder)

    def write(self, folder: Path, metrics: Mapping[str, Any]) -> None:
        """Write light_field.h5, maps.h5 and metrics.json into an existing folder."""
        axes = self.psi.view_axes
        facts = {"method": self.method, ATTRIBUTE: stored_as(axes)}
        save_hdf5(folder / LIGHT_FIELD, self.light_field, facts)
        save_maps(folder, {**self.maps, "misfit": self.misfit}, axes)
        write_metrics(folder, metrics)

    def draw(self, folder: Path) -> None:
        """Write pictures/ into an existing folder."""
        focus = None
        if self.disparity is not None:
            back, middle, front = np.percentile(self.disparity, BACK_TO_FRONT)
            focus = float(back), float(middle), float(front)
        axes = self.psi.view_axes
        export_pictures(folder / "pictures", self.light_field, focus, axes)

    def figure(
        self,
        *others: Result,
        truth: ArrayLike | None = None,
        settings: FigureSettings | None = None,
    ) -> Figure:
        """Draw view, close-ups, epipolar image, error and maps, beside other results' of one scene.

        truth: the true light field (v, u, y, x, c). settings: what is shown of each.
        """
        from emmc_rig.pages.result_figure import draw_results  # matplotlib loads for a second

        results = [self._export(truth), *(other._export() for other in others)]
        return draw_results(results, settings).figure

    def show(self) -> Figure:
        """Return `figure()`, in a window where matplotlib has one; notebooks show it themselves."""
        from matplotlib import pyplot

        from emmc_rig.pages.result_figure import draw_results

        figure = draw_results([self._export()], figure=pyplot.figure()).figure
        if getattr(type(figure.canvas), "required_interactive_framework", None):
            pyplot.show()
        return figure

    def __repr__(self) -> str:
        (v, u, rows, columns, _), level = self.light_field.shape, self.verdict.level
        pictures = grid_name(self.psi.view_axes, (v, u))
        return (
            f"Result({self.method}, {pictures} of {rows}x{columns}, {self.status} in "
            f"{self.seconds:.1f} s, verdict: {level})"
        )

    def viewer(self, truth: ArrayLike | None = None) -> str:
        """Return a page to turn, focus and look into: one HTML file that opens offline.

        truth: the true light field, to wipe against.
        """
        from emmc_rig.pages.viewer import render_viewer  # as its templates are

        return render_viewer(self._export(truth))

    def _export(self, truth: ArrayLike | None = None) -> Export:
        return Export(
            self.method, self.verdict.words, self.light_field,
            None if truth is None else np.asarray(truth), self.disparity, self.sigma,
            self.misfit, self.metrics(), view_axes=self.psi.view_axes,
        )  # fmt: skip

    @cached_property
    def _embedded(self) -> str:
        return html.escape(self.viewer())

    def _repr_html_(self) -> str:
        return (
            f'<figure><iframe title="viewer of the light field" srcdoc="{self._embedded}" '
            f'style="width:100%;height:640px;border:0" allow="fullscreen"></iframe><figcaption>'
            f"{html.escape(repr(self))}<br>{html.escape(self.verdict.words)}</figcaption></figure>"
        )
