"""The command ``difftetvr fit-transfer``."""

from __future__ import annotations

import dataclasses
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.inverse.viewpoint import make_folder
from difftetvr.cli.options import CAPTURE_GROUPS, CaptureOptions, MeshOptions, TrustOptions, is_volume
from difftetvr.cli.saved import options_to_resume
from difftetvr.errors import CaptureError, FitError, counted
from difftetvr.files import require_writable
from difftetvr.fitting.records.folder import write_json

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from difftetvr.capture.capture import Capture
    from difftetvr.inverse.transfer.config import TransferConfig
    from difftetvr.inverse.transfer.fit import TransferProgress, TransferResult
    from difftetvr.mesh import TetMesh
    from difftetvr.mesh.field import Location

_FILES = ("transfer_function.json", "start.json", "report.png", "metrics.json", "config.json")
_LINE_SECONDS = 5.0
_SATURATED = 0.99  # opacities above are as great as the attenuation lets them be


@dataclass(frozen=True)
class Known:
    """The scalars: a mesh, values at its vertices or in its cells, and what they mean."""

    mesh: TetMesh
    values: torch.Tensor
    location: Location | None
    value_range: tuple[float, float] | None


@dataclass(frozen=True)
class Search:
    """What is looked for, and how."""

    scalar: str | None = None
    """Name of the point or cell data of a mesh, with a component if wanted; default: the only data there are."""
    knots: int = 32
    """Knots of the transfer function."""
    no_move: bool = False
    """Leave the knots at even distances."""
    iterations: int = 200
    """Steps of the optimiser."""
    rate: float = 0.2
    """Its learning rate at the beginning."""
    smoothness: float = 1e-3
    """Weight of the differences of neighbouring knots."""
    batch_views: int = 0
    """Views of an iteration; 0: all."""
    cells: int = 200_000
    """Tetrahedra onto which a volume is resampled."""
    seed: int = 0
    """Seed of the random values to begin with."""
    start: str | None = None
    """Transfer function to begin with, .json or .xml; default: random values."""
    truth: str | None = None
    """Transfer function that made the images, to be drawn beside; nothing is learned from it."""


@dataclass(frozen=True)
class SavedTransferRun:
    """What the config.json of such a run holds.

    Attributes:
        scalars: Name of the known scalars.
        images: Name of the images.
        search: What is looked for.
        mesh_options: How a mesh of scalars is read.
        capture_options: How images are read, and volumes.
    """

    scalars: str
    images: str
    search: Search
    mesh_options: MeshOptions
    capture_options: CaptureOptions


@dataclass(frozen=True)
class FitTransfer:
    """Find the transfer function through which known scalars look as in images."""

    scalars: Annotated[str, Positional, arg(metavar="SCALARS")]
    """The known scalars: a mesh with point or cell data, a volume, or tooth. May be left out with --resume."""
    images: Annotated[str, Positional, arg(metavar="IMAGES")]
    """The images: photographs with their cameras, a saved capture (.npz), or a volume with its --transfer-function,
    whose views are rendered; cameras are in the coordinates of the scalars. May be left out with --resume."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """Folder for transfer_function.json, which other commands take, report.png, metrics.json and the checkpoint."""
    search: OmitArgPrefixes[Search] = field(default_factory=Search)
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""
    resume: bool = False
    """Go on with the run in the output folder; SCALARS, IMAGES and options that are not given are taken from it."""
    overwrite: bool = False
    """Replace the run in the output folder."""
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Scalars": ("scalar", "value-range", "attenuation", "cells", "split", "step"),
        "Search": ("knots", "no-move", "iterations", "rate", "smoothness", "batch-views", "seed", "start"),
        "Run": ("output", "truth", "device", "resume", "overwrite"),
        **{
            title: tuple(name for name in names if name not in ("value-range", "attenuation"))
            for title, names in CAPTURE_GROUPS.items()
        },
    }

    def run(self, console: Console) -> None:
        """Fits, and fills the output folder."""
        from difftetvr.fitting.beginning.requirements import resolve_device
        from difftetvr.inverse.transfer.fit import fit_transfer
        from difftetvr.optics.transfer_function import TransferFunction

        start, truth = (
            None if file is None else TransferFunction.load(file) for file in (self.search.start, self.search.truth)
        )
        known = self._known(console)
        config = self._config(known)
        capture = self._capture(console)
        device = resolve_device(self.device)
        make_folder(self.output, _FILES)
        checkpoint = self._require_free()
        if not self.resume:
            write_json(self.output / "config.json", dataclasses.asdict(self._saved()))
        mesh, values = known.mesh.to(device=device), known.values.to(device)
        try:
            result = fit_transfer(
                mesh,
                values,
                capture,
                config,
                location=known.location,
                start=start,
                checkpoint=checkpoint,
                resume=self.resume,
                on_progress=_Display(console),
            )
        except KeyboardInterrupt:
            words = ["difftetvr", "fit-transfer", "-o", str(self.output), "--resume"]
            console.print(f"Interrupted; continue with {shlex.join(words)}")
            raise
        self._write(mesh, result, capture, truth)
        _print_summary(console, result, self.output)

    @staticmethod
    def defaults(args: Sequence[str]) -> FitTransfer | None:
        """The command with the options of the run to go on with; None: as declared.

        Raises:
            FitError: They cannot be read.
        """
        saved = options_to_resume(args, SavedTransferRun)
        if saved is None:
            return None
        command = FitTransfer(saved.scalars, saved.images, tyro.MISSING, saved.search)
        return dataclasses.replace(command, mesh=saved.mesh_options, views_of=saved.capture_options)

    def _saved(self) -> SavedTransferRun:
        return SavedTransferRun(self.scalars, self.images, self.search, self.mesh, self.views_of)

    def _known(self, console: Console) -> Known:
        from difftetvr.capture.volumes.volume import Volume
        from difftetvr.capture.volumes.volume_capture import TOOTH, VolumeCapture
        from difftetvr.inverse.transfer.volumes import volume_on_grid
        from difftetvr.mesh.io import missing_note, scalar_of

        options = self.views_of
        if is_volume(self.scalars):
            if self.scalars == TOOTH:
                volume, _ = VolumeCapture(spacing=options.spacing, value_range=options.value_range).load_volume()
            else:
                of_file = (options.shape, options.dtype, options.spacing, options.value_range)
                volume = Volume.load(self.scalars, *of_file)
            mesh, values = volume_on_grid(volume, self.search.cells)
            console.print(f"{self.scalars} on {counted(mesh.num_cells, 'tetrahedron', 'tetrahedra')}", highlight=False)
            return Known(mesh, values, "vertex", (0.0, 1.0))
        data = self.mesh.load(Path(self.scalars), console)
        scalar = scalar_of(data, self.search.scalar)
        if (note := missing_note(scalar)) is not None:
            console.print(note)
        value_range = options.value_range
        if value_range is not None:
            value_range = (scalar.counted_from_offset(value_range[0]), scalar.counted_from_offset(value_range[1]))
        return Known(scalar.mesh, scalar.values, scalar.location, value_range)

    def _config(self, known: Known) -> TransferConfig:
        from difftetvr.inverse.transfer.config import TransferConfig

        attenuation = 25.0 if self.views_of.attenuation is None else self.views_of.attenuation
        return TransferConfig(
            knots=self.search.knots,
            move_knots=not self.search.no_move,
            iterations=self.search.iterations,
            rate=self.search.rate,
            smoothness=self.search.smoothness,
            batch_views=self.search.batch_views,
            attenuation=attenuation,
            value_range=known.value_range,
            seed=self.search.seed,
        )

    def _capture(self, console: Console) -> Capture:
        options = self.views_of.for_images(self.images)
        return options.sized_for(self.images, self.device, console).load(self.images, console)

    def _require_free(self) -> Path:
        checkpoint = self.output / "checkpoint.safetensors"
        require_writable(checkpoint, CaptureError)
        if self.resume and self.overwrite:
            raise FitError("A run can go on or be replaced; give one of --resume and --overwrite.")
        if self.resume and not checkpoint.exists():
            raise FitError(f"There is no run in {self.output} to go on with; leave out --resume.")
        if checkpoint.exists() and not (self.resume or self.overwrite):
            raise FitError(f"There is a run in {self.output}; give --resume, --overwrite or another folder.")
        return checkpoint

    def _write(self, mesh: TetMesh, result: TransferResult, capture: Capture, truth: object) -> None:
        from difftetvr.view.transfer_report import save_transfer_report

        result.transfer_function.save(self.output / "transfer_function.json")
        result.start.save(self.output / "start.json")
        save_transfer_report(self.output / "report.png", mesh, result, capture, truth)  # type: ignore[arg-type]
        write_json(self.output / "metrics.json", result.metrics)


class _Display:
    """Shows where a fit stands: a line that is written anew on terminals, else a line every few seconds."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._due = 0.0

    def __call__(self, status: TransferProgress) -> None:
        now, last = time.monotonic(), status.iteration == status.iterations
        if now < self._due and not last:
            return
        self._due = now + (0.2 if self._console.is_terminal else _LINE_SECONDS)
        left = status.seconds / status.iteration * (status.iterations - status.iteration)
        text = f"{status.iteration}/{status.iterations}  {left:.0f} s left  PSNR {status.psnr:.2f} dB  "
        text += f"loss {status.loss:.2e}"
        end = "\r" if self._console.is_terminal and not last else "\n"
        self._console.print(text, end=end, highlight=False)


def _print_summary(console: Console, result: TransferResult, folder: Path) -> None:
    for name, seen in (("Training", result.training), ("Held out", result.held_out)):
        if seen.mean_psnr is None:
            continue
        similarity = "" if seen.mean_ssim is None else f", SSIM {seen.mean_ssim:.4f}"
        count = counted(len(seen.views), "view")
        console.print(f"{name}: PSNR {seen.mean_psnr:.2f} dB{similarity} over {count}", highlight=False)
    if float(result.transfer_function.opacity.max()) > _SATURATED:
        console.print("Some knots are as opaque as --attenuation lets them be; a greater one may fit better.")
    console.print(f"Wrote {folder / 'transfer_function.json'} and {folder / 'report.png'}")
