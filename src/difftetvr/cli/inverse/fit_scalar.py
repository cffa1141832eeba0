"""The command ``difftetvr fit`` for the scalars behind a transfer function."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, get_args

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.inverse.run_command import Begun, RunCommand
from difftetvr.cli.live.watching import WATCH_GROUP, WatchOptions
from difftetvr.cli.options import CAPTURE_GROUPS, CaptureOptions, TrustOptions, is_volume
from difftetvr.cli.saved import goes_on_with, options_to_resume, saved_options
from difftetvr.errors import FitError, counted
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.inverse.scalars.config import Refine, ScalarConfig

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.inverse.scalars.loop import ScalarImages, ScalarResult
    from difftetvr.mesh import TetMesh

_UNKNOWN = "--unknown"


@dataclass(frozen=True)
class SavedScalarRun:
    """What the config.json of such a run holds.

    Attributes:
        capture: Name of the images.
        capture_options: How they are read, and the transfer function.
        scalars: How the scalars are reconstructed.
    """

    capture: str
    capture_options: CaptureOptions
    scalars: ScalarConfig


@dataclass(frozen=True)
class FitScalar(RunCommand):
    """Reconstruct the scalars of a tetrahedral volume from images through a transfer function."""

    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """Images: tooth, a volume, whose views are rendered, photographs with their cameras, or a saved capture (.npz). May
    be left out with --resume."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """Folder for the model, the transfer function, metrics, pictures and checkpoint."""
    config: Annotated[ScalarConfig, arg(name="")] = field(default_factory=ScalarConfig)
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    resume: bool = False
    """Go on with the run in the output folder, with more --iterations beyond its end; CAPTURE and options that are not
    given are taken from it."""
    overwrite: bool = False
    """Replace the run in the output folder."""
    watch: OmitArgPrefixes[WatchOptions] = field(default_factory=WatchOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Most used": (
            *("output", "unknown", "transfer-function", "attenuation", "cells", "iterations"),
            *("downscale", "device", "resume", "overwrite"),
        ),
        "Motion": ("move", "motion.*"),
        "Refinement": ("refine", *(f"{strategy}.*" for strategy in get_args(Refine))),
        "Optimisation": (
            *("colors-first", "rate", "final-rate", "betas", "batch-views"),
            *("knots", "function-rate", "seed", "deterministic"),
        ),
        **CAPTURE_GROUPS,
        "Output": ("evaluate-every", "checkpoint-seconds", *WATCH_GROUP),
    }

    def begin(self, console: Console, checkpoint: Path | None) -> Begun:
        """See `RunCommand.begin`."""
        from difftetvr.fitting.records.progress import ProgressDisplay
        from difftetvr.inverse.scalars.loop import optimise, prepare
        from difftetvr.view.scalar_report import write_scalar_report

        views_of = self.views_of.sized_for(self.capture, self.config.device, console)
        images = self._images(views_of, console)
        steps = self.config.color_steps
        if steps and not (checkpoint is not None and checkpoint.exists()):
            console.print(f"Colours and densities first, {counted(steps, 'iteration')}", highlight=False)
        with ProgressDisplay(console) as display:
            run = prepare(images, self.config, None, checkpoint, display)

        def report(folder: RunFolder, result: ScalarResult) -> list[str]:
            write_scalar_report(folder, result, images.capture)
            return self._outcome(result, folder)

        options = {"capture": self.capture, "capture_options": views_of.given(), "scalars": run.config.to_json()}
        return Begun(
            lambda: run.iteration,
            options,
            lambda path, display: optimise(run, path, display),
            report,
            images.capture,
        )

    def require_same_run(self, folder: RunFolder) -> None:
        """See `RunCommand.require_same_run`."""
        saved = saved_options(folder, SavedScalarRun)
        if saved is None:
            return
        if Path(saved.capture).resolve() != Path(self.capture).resolve():
            raise FitError(
                f"The run in {self.output} fits '{saved.capture}', not '{self.capture}'; resume with the same capture "
                "or choose another folder."
            )
        if saved.capture_options != self.views_of:
            raise FitError(f"The run in {self.output} has other views; resume with the same options for them.")
        saved.scalars.require_same_run(self.config)

    @staticmethod
    def defaults(args: Sequence[str]) -> FitScalar | None:
        """The command with the options of the run to go on with; None: as declared.

        Raises:
            FitError: They cannot be read.
        """
        saved = options_to_resume(args, SavedScalarRun)
        if saved is None:
            return None
        return FitScalar(saved.capture, tyro.MISSING, saved.scalars, saved.capture_options)

    def _images(self, views_of: CaptureOptions, console: Console) -> ScalarImages:
        """The images, and the function that they are seen through, as far as it is known."""
        from difftetvr.capture.volumes.volume_capture import TOOTH, VolumeCapture
        from difftetvr.inverse.scalars.loop import ScalarImages
        from difftetvr.optics.transfer_function import TransferFunction

        path, attenuation = views_of.transfer_function, views_of.attenuation
        function = TransferFunction.load(path) if path is not None else None
        if self.capture == TOOTH and function is None:
            _, function = VolumeCapture().load_volume()
        capture = views_of.for_images(self.capture).load(self.capture, console)
        if is_volume(self.capture):
            # Where both are looked for, the function has made the views, and is not known.
            return ScalarImages(capture, None if self.config.unknown == "both" else function)
        if attenuation is not None:
            attenuation /= float((capture.bounds[1] - capture.bounds[0]).max())
        return ScalarImages(capture, function, attenuation)

    def _outcome(self, result: ScalarResult, folder: RunFolder) -> list[str]:
        """Lines that say what came of it, and how to look at it."""
        metrics = result.metrics
        quality = f"PSNR {metrics['psnr']:.2f} dB" if metrics["psnr"] is not None else "no held-out views"
        words = [str(folder.model), "--transfer-function", str(folder.transfer_function), "--value-range", "0", "1"]
        words += ["--attenuation", f"{result.field.attenuation * _longest_side(result.mesh):.6g}", "-o", "picture.png"]
        return [
            f"Held out: {quality} over {counted(len(metrics['views']), 'view')}",
            f"{counted(metrics['cells'], 'cell')}, {counted(metrics['iterations'], 'iteration')} in "
            f"{metrics['seconds']:.1f} s",
            f"Model:    {folder.model}",
            f"Function: {folder.transfer_function}",
            f"Pictures: {folder.comparison} and {folder.views}",
            f"Curves:   {folder.curves}",
            f"See it:   {shlex.join(['difftetvr', 'render', *words])}",
        ]


def fits_scalar(args: Sequence[str]) -> bool:
    """Whether arguments of ``difftetvr fit`` ask for scalars, or for a run to go on with that is of some."""
    return any(word.split("=")[0] == _UNKNOWN for word in args) or goes_on_with("scalars", args)


def _longest_side(mesh: TetMesh) -> float:
    lower, upper = mesh.bounds()
    return float((upper - lower).max())
