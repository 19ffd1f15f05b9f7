"""A reconstruction with its verdict: arrays, one line, a picture, and the files of a folder."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.errors import AppError
from emmc_rig.formats.format import Export
from emmc_rig.formats.light_field_array import LightFieldArray
from emmc_rig.model.arguments import path_of
from emmc_rig.model.camera import Camera, camera_of, psi_of_shot
from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import Frames
from emmc_rig.model.json_text import one_line
from emmc_rig.model.lightfield import psnr_db, replicate_centre, ssim
from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import Settings
from emmc_rig.model.view_axes import ViewAxes, grid_name
from emmc_rig.reconstruction.result import Reconstruction, Status
from emmc_rig.reconstruction.verdict.kept import missed_readings
from emmc_rig.reconstruction.verdict.rules import Verdict
from emmc_rig.store.folders import result_folder
from emmc_rig.store.psi import FRAMES, PSI, StoredPsi, holds_frames, psi_places, read_frames
from emmc_rig.store.result_files import (
    AGAIN,
    REPORT,
    SavedResult,
    camera_of_result,
    read_metrics,
    read_result,
    result_in,
    write_light_field,
)
from emmc_rig.store.results import provenance, save_frames, write_metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from emmc_rig.report.result_figure import FigureSettings


def compared(
    light_field: Any, truth: NDArray, measured: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Return how near a light field, an array or a dataset, is to the truth (v, u, y, x, c).

    measured: the views (v, u) that count; None: all.
    """
    baseline = replicate_centre(truth)
    if measured is not None:
        chosen = [tuple(view) for view in np.argwhere(measured)]
        light_field, truth, baseline = (
            np.stack([views[view] for view in chosen])[np.newaxis]
            for views in (light_field, truth, baseline)
        )
    return {
        "psnr_db": psnr_db(light_field, truth),
        "ssim": ssim(light_field, truth),
        "replicate_psnr_db": psnr_db(baseline, truth),
    }


def unmeasured(measured: NDArray[np.bool_] | None) -> dict[str, list[list[int]]]:
    """Return the views that no reading says anything of, as metrics.json has them."""
    return {} if measured is None else {"views_not_measured": np.argwhere(~measured).tolist()}


def estimates_of(frames: Frames) -> dict[str, list[str]]:
    """Return what of raw frames was estimated, in words, as metrics.json has it."""
    found = getattr(frames, "estimates", ())
    return {"estimated_from_frames": list(found)} if found else {}


def figures(
    solved: Reconstruction, verdict: Verdict, frames: Frames, settings: Settings | None = None
) -> dict[str, Any]:
    """Return the entries of metrics.json on a reconstruction, its verdict and its frames."""
    compiling = {"compiling_seconds": solved.compiling_seconds} if solved.compiling_seconds else {}
    return {
        "method": solved.method,
        "status": solved.status,
        "advice": solved.advice,
        "screening": list(solved.screening),
        "verdict": verdict.as_dict(),
        "steps": solved.steps,
        "seconds": solved.seconds,
        **compiling,
        "parameters": solved.parameters,
        "noise_sigma": frames.noise_sigma,
        "usable_share": float(frames.usable.mean()),
        "frames_sha256": frames.sha256,
        **estimates_of(frames),
        **unmeasured(solved.measured),
        **provenance(settings),
    }


@dataclass(frozen=True, eq=False, repr=False)
class Result(LightFieldArray):
    """A reconstruction: the light field, its uncertainty, and a verdict on whether to trust it.

    NumPy takes a result as its light field: `np.asarray(result)`, `result[2, 2]`.

    solved: what the method returned.
    verdict: `level` ("trust", "cannot tell", "doubt" or "do not use"), `reasons`, each with its
    remedy, and `words`, all in a line.
    psi, frames: the inputs of the reconstruction.
    dictionary: the kind of dictionary used; None without one.
    settings: of the methods; None where all are defaults.
    """

    solved: Reconstruction
    verdict: Verdict
    psi: Psi
    frames: Frames
    dictionary: str | None = None
    settings: Settings | None = None

    @property
    def light_field(self) -> NDArray[np.float32]:
        """The estimate, (v, u, y, x, c) float32 in [0, 1]."""
        return self.solved.light_field

    @property
    def maps(self) -> Mapping[str, NDArray]:
        """Arrays that the method estimated beside the light field, by name; most methods have none.

        `disparity` and `disparity_sigma` (y, x), pixels per view step; `sigma` (v, u, y, x).
        """
        return self.solved.maps

    @property
    def sigma(self) -> NDArray[np.floating] | None:
        """Standard deviation of the light field, (v, u, y, x), of each colour alike.

        None where the method estimates none.
        """
        return self.maps.get("sigma")

    @property
    def stated_db(self) -> float | None:
        """Estimated PSNR, dB, peak 1; None where the method has no `sigma`."""
        return self.solved.stated["stated_db"]

    @property
    def stated_interval_db(self) -> list[float] | None:
        """Lowest and highest PSNR, dB: the true one lies between them in 9 of 10 captures.

        None where the method estimates none.
        """
        return self.solved.stated["stated_interval_db"]

    @property
    def disparity(self) -> NDArray[np.floating] | None:
        """Disparity (y, x) of the centre view, pixels per view step; None without an estimate.

        Also None where views are bands or times; `maps` may then hold `shift`, in pixels from one
        band or time to the next.
        """
        return self.maps.get("disparity")

    @cached_property
    def misfit(self) -> NDArray[np.float32]:
        """Residual of the readings around each sample (y, x), over their deviation; about 1."""
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
        """How the solver ended: a value of `Status`, such as "converged"."""
        return self.solved.status

    @property
    def advice(self) -> str:
        """What to do where the solver did not converge; empty where it did."""
        return self.solved.advice

    @property
    def seconds(self) -> float:
        """Seconds that the method took, without the compilation of its kernels."""
        return self.solved.seconds

    def compare(self, truth: ArrayLike) -> dict[str, float]:
        """Return the accuracy of the estimate against the true light field.

        Args:
            truth: a scene, or an array (v, u, y, x, c), linear RGB in [0, 1].

        Returns:
            `psnr_db` and `ssim` over all measured views and colours, peak 1; `replicate_psnr_db`,
            the PSNR of the true centre view in all places, which a light field has to beat.

        Raises:
            SceneError: a truth of another shape.
        """
        return compared(self.light_field, np.asarray(truth), self.solved.measured)

    def metrics(self) -> dict[str, Any]:
        """Return the figures of the reconstruction, with the keys of metrics.json."""
        return {
            **figures(self.solved, self.verdict, self.frames, self.settings),
            **self.solved.stated,
            "shots": self.psi.shots,
            "size": list(self.psi.size),
            "view_axes": list(self.view_axes),
            "psi_sha256": self.psi.checksum(),
            "dictionary": self.dictionary,
        }

    @property
    def view_axes(self) -> ViewAxes:
        """What rows and columns of views are."""
        return self.psi.view_axes

    def save(self, out: str | Path) -> None:
        """Write the result as a folder, which `emmc_rig.open_result` opens.

        It holds report.html, light_field.h5, maps.h5, metrics.json, and the frames and Psi that the
        result follows from, frames.h5 and psi.h5. An earlier result in the folder is replaced.

        Args:
            out: the folder; made if missing.

        Raises:
            AppError: a folder that holds anything else, or that cannot be written.
            ArgumentError: no path.
        """
        out = path_of(out, "out", "the folder to write")
        with result_folder(out, "reconstruct") as folder:
            self.write(folder, self.metrics())
            if psi := self._known("psi"):
                psi.save(folder / PSI)
            self.draw(folder, self.metrics(), source=str(out))

    def write(self, folder: Path, metrics: Mapping[str, Any], **more: NDArray) -> None:
        """Write light_field.h5, maps.h5, frames.h5 and metrics.json into an existing folder.

        more: arrays beside the readings, see `save_frames`.
        """
        maps = {**self.maps, "misfit": self.misfit}
        write_light_field(folder, self.light_field, maps, self.view_axes, method=self.method)
        if frames := self._known("frames"):
            save_frames(folder / FRAMES, frames, **more)
        write_metrics(folder, metrics)

    def draw(
        self,
        folder: Path,
        metrics: Mapping[str, Any],
        truth: NDArray | None = None,
        source: str = "",
        **shown: Any,
    ) -> None:
        """Write report.html, the page with the viewer, into an existing folder.

        metrics: as written. truth: the true light field. source: the folder, as typed. shown: what
        else there is to show, see `emmc_rig.report.report.ReportContent`.
        """
        from emmc_rig.report.report import ReportContent, write_report  # matplotlib loads for long

        frames = self._known("frames")
        captured = f" of {Path(metrics['source']).resolve().name}" if "source" in metrics else ""
        content = ReportContent(
            **{"title": f"Light field{captured} by {self.method}", **shown},
            described=self._seen_by(),
            estimate=self.light_field,
            truth=truth,
            frames=None if frames is None else frames.readings,
            metrics=metrics,
            maps={**self.maps, "misfit": self.misfit},
            source=source,
        )
        write_report(folder / REPORT, content)

    def _seen_by(self) -> Camera | None:
        psi = self._known("psi")
        return camera_of(psi) if psi and psi.camera_json else None

    def _known(self, name: str) -> Any:
        """Return `psi` or `frames`; None where a saved result is without."""
        try:
            return getattr(self, name)
        except (AppError, SensingError):
            return None

    def figure(
        self,
        *others: Result,
        truth: ArrayLike | None = None,
        settings: FigureSettings | None = None,
    ) -> Figure:
        """Return a figure of matplotlib: view, close-ups, epipolar image, error and maps.

        Args:
            others: results of the same scene, drawn beside.
            truth: the true light field (v, u, y, x, c), for the errors. None: no errors are drawn.
            settings: what is shown, see `emmc_rig.report.result_figure`. None: the defaults.
        """
        from emmc_rig.report.result_figure import draw_results  # matplotlib loads for a second

        results = [self._export(truth), *(other._export() for other in others)]
        return draw_results(results, settings).figure

    def show(self) -> Figure:
        """Return `figure()`, in a window where matplotlib has one; notebooks show it themselves."""
        from matplotlib import pyplot

        from emmc_rig.report.result_figure import draw_results

        figure = draw_results([self._export()], figure=pyplot.figure()).figure
        if getattr(type(figure.canvas), "required_interactive_framework", None):
            pyplot.show()
        return figure

    def __repr__(self) -> str:
        (v, u, rows, columns, _), level = self.light_field.shape, self.verdict.level
        pictures = grid_name(self.view_axes, (v, u))
        return (
            f"Result({self.method}, {pictures} of {rows}x{columns}, {self.status} in "
            f"{self.seconds:.1f} s, verdict: {level})"
        )

    def viewer(self, truth: ArrayLike | None = None) -> str:
        """Return the viewer as the text of an HTML page, which opens offline.

        truth: the true light field (v, u, y, x, c), to compare with. None: no comparison.
        """
        from emmc_rig.report.viewer import render_viewer  # as its templates are

        return render_viewer(self._export(truth))

    def _export(self, truth: ArrayLike | None = None) -> Export:
        return Export(
            self.method, self.verdict.words, self.light_field,
            None if truth is None else np.asarray(truth), self.disparity, self.sigma,
            self.misfit, self.metrics(), view_axes=self.view_axes, camera=self._seen_by(),
            disparity_sigma=self.maps.get("disparity_sigma"),
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


class OpenedResult(Result):
    """A result read from its folder; its Psi and frames are read when they are asked for."""

    saved: SavedResult

    def __init__(self, saved: SavedResult) -> None:
        known = saved.metrics
        took_s, compiling_s = known["seconds"], known.get("compiling_seconds", 0.0)
        if isinstance(took_s, Mapping):  # of the stages of a demo
            took_s = took_s["reconstruct"] - compiling_s
        solved = Reconstruction(
            method=known["method"],
            light_field=saved.light_field,
            status=cast(Status, known["status"]),
            advice=known["advice"],
            steps=known["steps"],
            objective=(),
            seconds=took_s,
            parameters=known["parameters"],
            maps={name: values for name, values in saved.maps.items() if name != "misfit"},
            screening=tuple(known.get("screening", ())),
            compiling_seconds=compiling_s,
            measured=_measured(known.get("views_not_measured"), saved.light_field.shape[:2]),
        )
        verdict, dictionary = Verdict.from_dict(known["verdict"]), known.get("dictionary")
        self.__dict__.update(saved=saved, solved=solved, verdict=verdict, dictionary=dictionary)

    @cached_property
    def psi(self) -> Psi:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The imaging matrix; raises AppError where it is neither in the folder nor as named."""
        folder, known = self.saved.folder.absolute(), self.saved.metrics
        for path in psi_places(folder, known):
            if path.exists():
                psi = StoredPsi(path).load()
                if "segment" in known:
                    psi = psi_of_shot(psi, known["shot"] - 1)
                if known.get("psi_sha256") in (None, psi.checksum()):
                    return psi
        raise AppError(
            f"{folder}: the Psi of this result is not there; put it beside the light field as {PSI}"
        )

    @cached_property
    def frames(self) -> Frames:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The frames; raises AppError where the result was written without them."""
        if not holds_frames(self.saved.folder):
            raise AppError(
                f"{self.saved.folder}: a result that was written without its frames, which "
                "emmc_rig.open_result opens; reconstruct it again to have them beside it"
            )
        return read_frames(self.saved.folder)

    def _seen_by(self) -> Camera | None:
        return camera_of_result(self.saved)

    @cached_property
    def misfit(self) -> NDArray[np.float32]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Result.misfit`: as it was written, else from Psi and frames."""
        stored = self.saved.maps.get("misfit")
        return super().misfit if stored is None else stored

    @property
    def view_axes(self) -> ViewAxes:
        """What rows and columns of views are."""
        return self.saved.view_axes

    def metrics(self) -> dict[str, Any]:
        """Return the figures as metrics.json of the folder has them."""
        return dict(self.saved.metrics)


def _measured(outside: Any, views: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Return which views are measured; None: all. outside: `views_not_measured` of metrics.json."""
    if not outside:
        return None
    measured = np.ones(views, dtype=bool)
    measured[tuple(np.transpose(outside))] = False
    return measured


def open_result(folder: str | Path) -> Result:
    """Return a result that `Result.save`, `emmc-rig reconstruct` or `emmc-rig demo` wrote.

    Args:
        folder: the folder of the result, of one frame of a film, or of a session with its result.

    Returns:
        The result; its Psi and frames are read when they are first used, and raise AppError where
        the folder has none (earlier versions kept no frames).

    Raises:
        AppError: the folder holds no result, or a damaged one.
        ArgumentError: no path.

    >>> import emmc_rig as emmc
    >>> psi = emmc.camera("rgbw-bayer-1shot").psi((24, 32))
    >>> result = emmc.reconstruct(psi, psi @ emmc.scene("near-planar", size=(24, 32)), "tv")
    >>> result.save("emmc-reconstruction")
    >>> bool((emmc.open_result("emmc-reconstruction").light_field == result.light_field).all())
    True
    """
    place = result_in(path_of(folder, "folder", "the folder of a result"))
    saved = read_result(place)
    try:
        return OpenedResult(saved if saved.metrics else replace(saved, metrics=read_metrics(place)))
    except (KeyError, TypeError, ValueError) as fault:
        why = f"{place}/metrics.json: not that of a result ({one_line(fault)})"
        raise AppError(f"{why}; {AGAIN}") from fault
