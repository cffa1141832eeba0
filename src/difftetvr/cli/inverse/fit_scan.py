"""The command ``difftetvr fit`` for projections of a tomograph."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.capture.projections.naming import is_projection_source
from difftetvr.cli.arguments import Groups
from difftetvr.cli.inverse.run_command import Begun, RunCommand
from difftetvr.cli.live.watching import WATCH_GROUP, WatchOptions
from difftetvr.cli.options import TRUST_GROUPS, TrustOptions, saying
from difftetvr.cli.saved import goes_on_with, options_to_resume, saved_options
from difftetvr.errors import FitError, counted
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.inverse.tomography.config import TomographyConfig
from difftetvr.terminal import waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture.projections.projection_capture import ProjectionCapture
    from difftetvr.inverse.tomography.loop import TomographyResult
    from difftetvr.inverse.tomography.reconstruction import Reconstruction

_HELD_OUT_EVERY = 10


@dataclass(frozen=True)
class ScanReading:
    """How projections are read."""

    holdout_every: int | None = None
    """One of so many views is held out, besides those that the file holds out; 0: none. Default: 10, of fewer views
    none."""
    geometry: str | None = None
    """File with the geometry of a .npy; default: the .json of the same name."""
    center: float | None = None
    """Where the axis is seen in a row of a Data Exchange file, in pixels from the left edge; default: the middle."""
    pixel_size: float | None = None
    """Distance of pixels of a Data Exchange file; default: 1."""
    unit: str | None = None
    """Of that distance, such as mm."""
    gaussian: float = 0.0
    """Standard deviation of the electronics' noise in counts."""

    def load(self, path: str) -> ProjectionCapture:
        """The projections.

        Raises:
            CaptureError: They cannot be read.
        """
        from difftetvr.capture.projections.projection_capture import ProjectionCapture

        options = dataclasses.asdict(self)
        every = options.pop("holdout_every")
        capture = ProjectionCapture.load(path, every, **options)
        if every is not None or capture.geometry.num_views < _HELD_OUT_EVERY:
            return capture
        held_out = ProjectionCapture.held_out(_HELD_OUT_EVERY, capture.geometry.num_views)
        return dataclasses.replace(capture, test=capture.test | held_out)


@dataclass(frozen=True)
class SavedScanRun:
    """What the config.json of such a run holds.

    Attributes:
        capture: Path of the projections.
        scan_options: How they are read.
        tomography: How they are reconstructed from.
    """

    capture: str
    scan_options: ScanReading
    tomography: TomographyConfig


@dataclass(frozen=True)
class FitScan(RunCommand):
    """Reconstruct the densities of a tetrahedral volume from projections of a tomograph."""

    capture: Annotated[str, Positional, arg(metavar="SCAN")]
    """Projections: .h5 or .npz of difftetvr project, Data Exchange .h5, .npy with its geometry as .json, or a folder
    with meta_data.json (R2-Gaussian, SAX-NeRF). May be left out with --resume."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """Folder for the model, its metrics, pictures and checkpoint."""
    config: Annotated[TomographyConfig, arg(name="")] = field(default_factory=TomographyConfig)
    reading: OmitArgPrefixes[ScanReading] = field(default_factory=ScanReading)
    truth: Path | None = None
    """Volume that the projections are of: its slices are shown beside those found, and compared with; nothing is
    learned from it."""
    resume: bool = False
    """Go on with the run in the output folder, with more --iterations beyond its end; SCAN and options that are not
    given are taken from it."""
    overwrite: bool = False
    """Replace the run in the output folder."""
    watch: OmitArgPrefixes[WatchOptions] = field(default_factory=WatchOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Most used": (
            *("output", "cells", "iterations", "total-variation", "holdout-every", "truth"),
            *("device", "resume", "overwrite"),
        ),
        "Objective": ("likelihood", "tikhonov", "rays", "batch-views", "solve-steps", "solve-rays"),
        "Geometry": ("align", "align-rate", "support"),
        "Motion": ("move", "motion.*"),
        "Refinement": ("refine", "exchange.*", "grow.*"),
        "Optimisation": ("rate", "final-rate", "betas", "seed", "deterministic"),
        "How SCAN is read": ("geometry", "center", "pixel-size", "unit", "gaussian"),
        **TRUST_GROUPS,
        "Output": ("evaluate-every", "checkpoint-seconds", *WATCH_GROUP),
    }

    def begin(self, console: Console, checkpoint: Path | None) -> Begun:
        """See `RunCommand.begin`."""
        from difftetvr.inverse.tomography.loop import optimise, prepare
        from difftetvr.view.scan_report import read_truth, write_scan_report

        with saying(console), waiting(console, f"Reading {self.capture}"):
            capture = self.reading.load(self.capture)
        truth = None if self.truth is None else read_truth(self.truth)
        with waiting(console, "Reading the checkpoint" if checkpoint else "Making the mesh to begin with"):
            run = prepare(capture, self.config, None, checkpoint)
        _say_choices(console, self.config, run, capture)
        saved = SavedScanRun(self.capture, self.reading, run.config)

        def on_solve(done: int) -> None:
            if not console.is_terminal:
                console.print(f"Solving for densities: {done} of {run.config.solve_steps} steps", highlight=False)

        def report(folder: RunFolder, result: TomographyResult) -> list[str]:
            return _outcome(result, write_scan_report(folder, result, run.measurements, truth), folder)

        return Begun(
            lambda: run.iteration,
            {**dataclasses.asdict(saved), "tomography": run.config.to_json()},
            lambda path, display: optimise(run, path, display, on_solve),
            report,
        )

    def require_same_run(self, folder: RunFolder) -> None:
        """See `RunCommand.require_same_run`."""
        saved = saved_options(folder, SavedScanRun)
        if saved is None:
            return
        if Path(saved.capture).resolve() != Path(self.capture).resolve():
            raise FitError(
                f"The run in {self.output} is of '{saved.capture}', not '{self.capture}'; resume with the same "
                "projections or choose another folder."
            )
        if saved.scan_options != self.reading:
            raise FitError(f"The run in {self.output} reads its projections otherwise; resume with the same options.")
        saved.tomography.require_same_run(self.config)

    @staticmethod
    def defaults(args: Sequence[str]) -> FitScan | None:
        """The command with the options of the run to go on with; None: as declared.

        Raises:
            FitError: They cannot be read.
        """
        saved = options_to_resume(args, SavedScanRun)
        if saved is None:
            return None
        return FitScan(saved.capture, tyro.MISSING, saved.tomography, saved.scan_options)


def fits_scan(args: Sequence[str]) -> bool:
    """Whether arguments of ``difftetvr fit`` name projections, or a run to go on with that is of some."""
    options = {"-o", "--output", "--config", "--initial-mesh", "--transfer-function", "--truth", "--geometry"}
    words = [word for before, word in zip(["", *args], args) if not word.startswith("-") and before not in options]
    try:
        if any(is_projection_source(word) for word in words):
            return True
    except (OSError, ValueError):
        pass  # What is wrong with names is said when they are read.
    return goes_on_with("tomography", args)


def _say_choices(console: Console, given: TomographyConfig, run: Reconstruction, capture: ProjectionCapture) -> None:
    """Says what there is, and what was chosen for it."""
    scan, unit = run.measurements, capture.geometry.unit
    _, height, width = capture.geometry.shape
    per = f" per {unit}" if unit else ""
    noise = "" if capture.variance is not None else ", noise estimated"
    console.print(
        f"{counted(len(scan.train), 'view')} to learn from and {len(scan.test)} held out, {width} x {height} pixels, "
        f"line integrals up to {scan.peak:.4g}, mean density {scan.density_unit:.4g}{per}{noise}",
        highlight=False,
    )
    chosen = {"--cells": (given.cells, run.config.cells), "--batch-views": (given.batch_views, run.config.batch_views)}
    words = [f"{option} {value}" for option, (asked, value) in chosen.items() if asked is None]
    if words:
        console.print(f"Chosen for these projections: {' '.join(words)}", highlight=False)


def _outcome(result: TomographyResult, compared: dict[str, Any], folder: RunFolder) -> list[str]:
    """Lines that say what came of it."""
    metrics = result.metrics
    held_out = "no held-out views"
    if result.score.views:
        held_out = (
            f"PSNR {result.score.mean_psnr:.2f} dB, residuals {result.score.mean_noise:.2f} times the noise, over "
            f"{counted(len(result.score.views), 'view')}"
        )
    lines = [f"Held out: {held_out}"]
    if compared:
        lines.append(f"Against the truth: PSNR {compared['volume_psnr']:.2f} dB at the voxels' centres")
    if result.alignment.is_learned:
        found = result.alignment.to_json()
        tilt = f", tilted by {found['axis_tilt_degrees']:+.3f} degrees" if "axis_tilt_degrees" in found else ""
        lines.append(f"Axis: seen {found['axis_shift_pixels']:+.2f} pixels beside where it was said to be{tilt}")
    lines += [
        f"{counted(metrics['cells'], 'cell')}, {counted(metrics['iterations'], 'iteration')} in "
        f"{metrics['seconds']:.1f} s",
        f"Model:    {folder.model}",
        f"Slices:   {folder.cut}",
        f"Views:    {folder.comparison}",
        f"Curves:   {folder.curves}",
    ]
    return lines
