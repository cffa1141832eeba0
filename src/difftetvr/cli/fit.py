"""The command ``difftetvr fit``."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.options import CaptureOptions, Output, parse
from difftetvr.fit.config import CHOSEN_FOR_CAPTURE, FitConfig
from difftetvr.fit.errors import FitError
from difftetvr.fit.folder import RunFolder
from difftetvr.fit.options import options_from_json

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.fit.result import FitResult
    from difftetvr.fit.trainer import Trainer


@dataclass(frozen=True)
class Fit:
    """Reconstruct a tetrahedral volume from images."""

    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """What to fit: tooth (the built-in CT scan), or the path of a volume, of photographs with their cameras
    (NeRF-synthetic, transforms.json, COLMAP, cameras.json), or of a saved capture (.npz)."""
    output: Output
    """Folder for the model, its metrics, pictures and checkpoint."""
    config: Annotated[FitConfig, arg(name="")] = field(default_factory=FitConfig)
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    resume: bool = False
    """Go on with the run in the output folder; options that are not given are taken from it."""
    overwrite: bool = False
    """Replace the run in the output folder."""

    def run(self, console: Console) -> None:
        """Fits, and fills the output folder."""
        from difftetvr.fit.loop import prepare
        from difftetvr.view.report import write_report

        folder = RunFolder(self.output)
        self._require_same_run(folder)
        folder.require_free(resume=self.resume, overwrite=self.overwrite)
        capture = self.views_of.load(self.capture, console)
        trainer = prepare(capture, self.config, resume_from=folder.checkpoint if self.resume else None)
        if capture.encoding == "srgb":
            _print_choices(console, self.config, trainer.config)
        if self.config.initial_mesh is not None:
            _print_start(console, self.config.initial_mesh, trainer)
        # Only now: what cannot even start neither leaves a folder behind nor costs the run that is to be replaced.
        chosen = dataclasses.replace(self, config=trainer.config)
        options = chosen.to_json() | ({"repair": trainer.repair} if trainer.repair else {})
        with folder.occupied(options, overwrite=self.overwrite, begun=lambda: trainer.iteration > 0):
            result = self._optimise(trainer, folder, console)
        write_report(folder, result, capture)
        _print_summary(console, result.metrics, folder)

    def _optimise(self, trainer: Trainer, folder: RunFolder, console: Console) -> FitResult:
        from difftetvr.fit.loop import optimise
        from difftetvr.fit.progress import ProgressDisplay

        try:
            with ProgressDisplay(console) as display:
                return optimise(trainer, folder.checkpoint, display)
        except KeyboardInterrupt:
            command = shlex.join(["difftetvr", "fit", self.capture, "-o", str(self.output), "--resume"])
            console.print(f"Interrupted; continue with: {command}")
            raise

    def to_json(self) -> dict[str, Any]:
        """The options that make the run what it is."""
        views_of = {name: value for name, value in dataclasses.asdict(self.views_of).items() if value is not None}
        return {"capture": self.capture, "capture_options": views_of, "fit": self.config.to_json()}

    def with_saved_options(self, args: Sequence[str]) -> Fit:
        """This command with the options of the run in the folder wherever ``args`` gives none."""
        saved = _saved_options(RunFolder(self.output)) if self.resume else None
        if saved is None:
            return self
        return parse(Fit, args, dataclasses.replace(self, resume=False, overwrite=False, **saved))

    def _require_same_run(self, folder: RunFolder) -> None:
        saved = _saved_options(folder) if self.resume else None
        if saved is None:
            return
        if saved["capture"] != self.capture:
            raise FitError(
                f"The run in {self.output} fits '{saved['capture']}', not '{self.capture}'; "
                "resume with the same capture or choose another folder."
            )
        if saved["views_of"] != self.views_of:
            raise FitError(f"The run in {self.output} has other views; resume with the same options for them.")
        saved["config"].require_same_run(self.config)


def _print_choices(console: Console, given: FitConfig, chosen: FitConfig) -> None:
    """Says what was chosen for photographs where the options left it open."""
    open_options = [item.name for item in dataclasses.fields(given) if item.name in CHOSEN_FOR_CAPTURE]
    choices = [f"--{name} {getattr(chosen, name)}" for name in open_options if getattr(given, name) is None]
    if choices:
        console.print(f"Chosen for these images: {', '.join(choices)}", highlight=False)


def _print_start(console: Console, path: str, trainer: Trainer) -> None:
    if trainer.repair:
        console.print(f"Repaired {path}: {trainer.repair}")
    if not trainer.iteration:
        values = "its own colours and densities" if trainer.starts_from_field else "uniform colour and density"
        console.print(f"Beginning with {path}: {trainer.mesh.num_cells:,} cells, {values}")


def _print_summary(console: Console, metrics: dict[str, Any], folder: RunFolder) -> None:
    quality = f"PSNR {metrics['psnr']:.2f} dB" if metrics["psnr"] is not None else "no held-out views"
    if metrics["ssim"] is not None:
        quality += f", SSIM {metrics['ssim']:.4f}"
    lines = [
        f"Held out: {quality} over {len(metrics['views'])} views",
        f"{metrics['cells']:,} cells, {metrics['iterations']} iterations in {metrics['seconds']:.1f} s",
        f"Model:    {folder.model}",
        f"Pictures: {folder.comparison} and {folder.views}",
        f"Curves:   {folder.curves}",
    ]
    console.print("\n".join(lines))


def _saved_options(folder: RunFolder) -> dict[str, Any] | None:
    """Fields of :class:`Fit` from the options that the run in a folder was started with; None if there is none."""
    saved = folder.read_config()
    if saved is None:
        return None
    try:
        if not isinstance(saved["capture"], str):
            raise FitError("The name of the capture is no text; start anew with --overwrite.")
        return {
            "capture": saved["capture"],
            "config": FitConfig.from_json(saved["fit"]),
            "views_of": options_from_json(CaptureOptions, saved["capture_options"]),
        }
    except (FitError, KeyError) as error:
        reason = f"It lacks {error}; start anew with --overwrite." if isinstance(error, KeyError) else str(error)
        raise FitError(f"{folder.config} is damaged, so --resume cannot use it: {reason}") from error
