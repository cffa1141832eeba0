"""The command ``difftetvr fit``."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.live.watching import WATCH_GROUP, WatchOptions
from difftetvr.cli.options import CAPTURE_GROUPS, CaptureOptions, TrustOptions
from difftetvr.cli.saved import SavedRun, saved_run
from difftetvr.errors import DiffTetError, FitError, counted
from difftetvr.fitting.config import CHOSEN_FOR_CAPTURE, FitConfig, Refine
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.terminal import sentence_for, waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture.capture import Capture
    from difftetvr.fitting.processes import Processes
    from difftetvr.fitting.records.result import FitResult
    from difftetvr.fitting.trainer import Trainer

_NOTICEABLY = 1.1
_BAD_INPUT = 2  # exit code


@dataclass(frozen=True)
class Fit:
    """Reconstruct a tetrahedral volume from images."""

    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """What to fit: tooth (the built-in CT scan), or the path of a volume, of photographs with their cameras
    (NeRF-synthetic, transforms.json, COLMAP, cameras.json), or of a saved capture (.npz). May be left out where
    --config names it, and with --resume."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """Folder for the model, its metrics, pictures and checkpoint."""
    config: Annotated[FitConfig, arg(name="")] = field(default_factory=FitConfig)
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    options_file: Annotated[Path | None, arg(name="config")] = None
    """Take the options that are not given, and CAPTURE, from this file: the config.json of another run, or any part of
    one."""
    resume: bool = False
    """Go on with the run in the output folder, with more --iterations beyond its end; CAPTURE and options that are not
    given are taken from it."""
    overwrite: bool = False
    """Replace the run in the output folder."""
    watch: OmitArgPrefixes[WatchOptions] = field(default_factory=WatchOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Most used": (
            *("output", "cells", "iterations", "downscale", "transfer-function"),
            *("background", "device", "config", "resume", "overwrite"),
        ),
        "Mesh": ("start", "grid", "initial-mesh", "repair", "location"),
        "Motion": ("move", "pace", "motion.*"),
        "Refinement": ("refine", "averaging", *(f"{strategy}.*" for strategy in get_args(Refine))),
        "Optimisation": (
            *("loss", "harmonics", "harmonics-rate", "density-rate", "rate", "final-rate", "betas", "batch-views"),
            *("haze-penalty", "free-space", "sparsity", "initial-color", "initial-density", "seed", "deterministic"),
        ),
        "Cameras that are not known well": ("refine-poses", "refine-intrinsics", "cameras.*"),
        **CAPTURE_GROUPS,
        "Output": ("evaluate-every", "checkpoint-seconds", *WATCH_GROUP),
    }

    def run(self, console: Console) -> None:
        """Fits, and fills the output folder; of several processes the first does so, and alone says anything."""
        from difftetvr.fitting.processes import Processes

        # First of all: it chooses the GPU.
        with Processes.joined() as processes, _said_once(processes):
            if processes.is_first:
                self._fit(console, processes)
            else:
                self._take_part(console, processes)

    def _fit(self, console: Console, processes: Processes) -> None:
        from difftetvr.view.report import write_report

        folder = RunFolder(self.output)
        with folder.claimed(), _undisturbed(processes):
            self.watch.require()
            self._require_same_run(folder)
            folder.require_free(resume=self.resume, overwrite=self.overwrite)
            views_of = self.views_of.sized_for(self.capture, self.config.device, console)
            capture = views_of.load(self.capture, console)
            with waiting(console, "Reading the checkpoint" if self.resume else "Making the mesh to begin with"):
                trainer = self._prepare(capture, folder, processes)
            chosen = dataclasses.replace(self, config=trainer.config, views_of=views_of)
            _print_processes(console, trainer)
            if capture.encoding == "srgb":
                _print_choices(console, self.config, trainer.config)
            if self.config.initial_mesh is not None:
                _print_start(console, self.config.initial_mesh, trainer)
            elif self.config.grid is None:
                _print_excess(console, trainer)
            # Only now: what cannot even start costs no run that is to be replaced.
            options = chosen.to_json() | ({"repair": trainer.repair} if trainer.repair else {})
            occupied = folder.occupied(options, overwrite=self.overwrite, begun=lambda: trainer.iteration > 0)
            with occupied, _undisturbed(processes):
                result = self._optimise(trainer, folder, console)
            with waiting(console, f"Drawing pictures into {self.output}"):
                write_report(folder, result, capture)
        _print_summary(console, result.metrics, folder)

    def _take_part(self, console: Console, processes: Processes) -> None:
        """What all processes but the first do: their share of the work, in silence."""
        from difftetvr.fitting.loop import optimise

        console.quiet = True
        warnings.simplefilter("ignore")
        folder = RunFolder(self.output)
        self._require_same_run(folder)
        capture = self.views_of.sized_for(self.capture, self.config.device, console).load(self.capture, console)
        optimise(self._prepare(capture, folder, processes), folder.checkpoint)

    def _prepare(self, capture: Capture, folder: RunFolder, processes: Processes) -> Trainer:
        from difftetvr.fitting.loop import prepare

        resume_from = folder.checkpoint if self.resume else None
        return prepare(capture, self.config, resume_from=resume_from, processes=processes)

    def _optimise(self, trainer: Trainer, folder: RunFolder, console: Console) -> FitResult:
        from difftetvr.fitting.loop import optimise

        with self.watch.telling(folder, console, trainer.capture) as tell:
            return optimise(trainer, folder.checkpoint, tell)

    def to_json(self) -> dict[str, Any]:
        """The options that make the run what it is."""
        return {"capture": self.capture, "capture_options": self.views_of.given(), "fit": self.config.to_json()}

    @staticmethod
    def variant(args: Sequence[str]) -> type:
        """This command, or that for projections or for scalars, where the arguments ask for one."""
        from difftetvr.cli.inverse.fit_scalar import FitScalar, fits_scalar  # most fits are of colours and densities
        from difftetvr.cli.inverse.fit_scan import FitScan, fits_scan

        return FitScalar if fits_scalar(args) else FitScan if fits_scan(args) else Fit

    @staticmethod
    def defaults(args: Sequence[str]) -> Fit | None:
        """The command with the options that ``args`` need not give, ``tyro.MISSING`` where it must; None: as declared.

        Raises:
            FitError: They cannot be read.
        """
        saved = saved_run(args)
        if saved is None:
            return None
        capture = tyro.MISSING if saved.capture is None else saved.capture
        return Fit(capture=capture, output=tyro.MISSING, config=saved.fit, views_of=saved.capture_options)

    def _require_same_run(self, folder: RunFolder) -> None:
        saved = SavedRun.in_folder(folder) if self.resume else None
        if saved is None:
            return
        if not saved.is_of(self.capture):
            raise FitError(
                f"The run in {self.output} fits '{saved.capture}', not '{self.capture}'; "
                "resume with the same capture or choose another folder."
            )
        if saved.capture_options != self.views_of:
            raise FitError(f"The run in {self.output} has other views; resume with the same options for them.")
        saved.fit.require_same_run(self.config)


@contextlib.contextmanager
def _said_once(processes: Processes) -> Iterator[None]:
    """Context in which an error is raised by the first process alone that meets with one; others leave in silence."""
    try:
        with _undisturbed(processes):
            yield
    except BaseException as end:
        if processes.count == 1:
            raise
        said_first = processes.speaks_first()
        cause = _mendable(end)
        if cause is None:
            raise
        if said_first:
            raise cause from None
        raise SystemExit(_BAD_INPUT) from end


@contextlib.contextmanager
def _undisturbed(processes: Processes) -> Iterator[None]:
    """Context that errors leave without being asked to end: a launcher asks all processes once one of them has left.

    They do end, but first tidy up and say why.
    """
    try:
        yield
    except BaseException:
        if processes.count > 1:
            with contextlib.suppress(ValueError):  # of threads, to which no signals come
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise


def _mendable(end: BaseException) -> Exception | None:
    """The error with a sentence for the user: this one, or that on whose way out an interrupt came."""
    if isinstance(end, Exception):
        return end if sentence_for(end) is not None else None
    before, found = end.__context__, []
    while before is not None:
        found += [before] if isinstance(before, Exception) and sentence_for(before) is not None else []
        before = before.__context__
    # Ours say most; of others the earliest, for the later ones are of tidying up.
    return next((error for error in found if isinstance(error, DiffTetError)), found[-1] if found else None)


def _print_processes(console: Console, trainer: Trainer) -> None:
    """Says how the work is shared, where it is."""
    count, batch = trainer.processes.count, trainer.config.batch
    if count > 1:
        idle = f", so that {counted(count - batch, 'process', 'processes')} will wait" if batch < count else ""
        console.print(f"{count} processes, {counted(batch, 'view')} an iteration{idle}", highlight=False)


def _print_choices(console: Console, given: FitConfig, chosen: FitConfig) -> None:
    """Says what was chosen for photographs where the options left it open."""
    unused = {"start"} if given.initial_mesh else set()
    if (given.initial_mesh or given.grid) and given.refine != "grow":
        unused.add("cells")
    left_open = [name for name in CHOSEN_FOR_CAPTURE if getattr(given, name) is None and name not in unused]
    choices = [f"--{name.replace('_', '-')} {getattr(chosen, name)}" for name in left_open]
    if choices:
        console.print(f"Chosen for these images: {', '.join(choices)}", highlight=False)


def _print_start(console: Console, path: str, trainer: Trainer) -> None:
    if trainer.repair:
        console.print(f"Repaired {path}: {trainer.repair}")
    if not trainer.iteration:
        values = "its own colours and densities" if trainer.starts_from_field else "uniform colour and density"
        console.print(f"Beginning with {path}: {counted(trainer.mesh.num_cells, 'cell')}, {values}")


def _print_excess(console: Console, trainer: Trainer) -> None:
    """Says that the mesh exceeds its budget, where that is noticeable: only some numbers of cells fill a box."""
    cells, budget = trainer.mesh.num_cells, trainer.config.budget
    if not trainer.iteration and cells > _NOTICEABLY * budget:
        console.print(
            f"Beginning with {counted(cells, 'cell')}, more than --cells {budget}: this is the nearest in size of "
            "all meshes to begin with."
        )


def _print_summary(console: Console, metrics: dict[str, Any], folder: RunFolder) -> None:
    quality = f"PSNR {metrics['psnr']:.2f} dB" if metrics["psnr"] is not None else "no held-out views"
    if metrics["ssim"] is not None:
        quality += f", SSIM {metrics['ssim']:.4f}"
    size = counted(metrics["cells"], "cell")
    lines = [
        f"Held out: {quality} over {counted(len(metrics['views']), 'view')}",
        f"{size}, {counted(metrics['iterations'], 'iteration')} in {metrics['seconds']:.1f} s",
        f"Model:    {folder.model}",
        f"Pictures: {folder.comparison} and {folder.views}",
        f"Curves:   {folder.curves}",
    ]
    console.print("\n".join(lines))
