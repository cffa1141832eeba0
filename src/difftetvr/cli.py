"""The command line: ``difftetvr fit | render | eval | info | export``."""

from __future__ import annotations

import dataclasses
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg, subcommand

from difftetvr.errors import CameraError, CaptureError, MeshError
from difftetvr.files import require_writable
from difftetvr.fit.config import FitConfig
from difftetvr.fit.errors import FitError
from difftetvr.fit.folder import RunFolder, write_json
from difftetvr.fit.options import options_from_json
from difftetvr.terminal import console, sentence_for, waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture.capture import Capture
    from difftetvr.fit.loop import Trainer
    from difftetvr.fit.result import FitResult
    from difftetvr.mesh.field import Field
    from difftetvr.mesh.tetmesh import TetMesh
    from difftetvr.render.camera import Camera

_USAGE_ERROR = 2
_INTERRUPTED = 130
_PROGRAM = "difftetvr"
# Where the default camera stands, seen from the mesh: in front, to the right, a little above.
_DEFAULT_DIRECTION = (0.45, -1.0, 0.35)

Output = Annotated[Path, arg(aliases=["-o"])]


@dataclass(frozen=True)
class CaptureOptions:
    """Views of a volume, for tooth and volume files; what is not given is as in the Tooth benchmark."""

    transfer_function: str | None = None
    """Transfer function of a volume, .json or .xml."""
    shape: tuple[int, int, int] | None = None
    """Samples along x, y and z of a .raw volume without a header."""
    dtype: str | None = None
    """NumPy type of a .raw volume without a header, such as uint8."""
    spacing: tuple[float, float, float] | None = None
    """Distances of samples along x, y and z; default: the file's."""
    attenuation: float | None = None
    """Density of opacity 1, where the box's longest side is 1."""
    views: int | None = None
    """Number of views."""
    width: int | None = None
    """Pixels of a view."""
    height: int | None = None
    """Pixels of a view."""
    radius: float | None = None
    """Distance of the cameras from the centre."""
    orbit: Literal["fibonacci", "random"] | None = None
    """Cameras on a spiral over the sphere, or at random places of it."""
    test_every: int | None = None
    """One of so many views is held out; 0: none."""

    def load(self, name: str, console: Console) -> Capture:
        """Reads or renders the capture of that name."""
        from difftetvr.capture import load_capture

        with waiting(console, f"Preparing the views of {name}"):
            return load_capture(name, **dataclasses.asdict(self))


@dataclass(frozen=True)
class Fit:
    """Reconstruct a tetrahedral volume from images."""

    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """What to fit: tooth (the built-in CT scan), or the path of a volume or of a saved capture (.npz)."""
    output: Output
    """Folder for the model, its metrics, pictures and checkpoint."""
    config: OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)
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
        # Only now: what cannot even start neither leaves a folder behind nor costs the run that is to be replaced.
        with folder.occupied(self.to_json(), overwrite=self.overwrite, begun=lambda: trainer.iteration > 0):
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
        return _parse(Fit, args, dataclasses.replace(self, resume=False, overwrite=False, **saved))

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


@dataclass(frozen=True)
class Render:
    """Render a picture of a reconstructed volume."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh with color and density: .vtu, .vtk, .msh, .npz."""
    output: Output
    """The picture, .png."""
    eye: tuple[float, float, float] | None = None
    """Position of the camera; default: far enough away that the whole mesh is seen."""
    target: tuple[float, float, float] | None = None
    """Point in the middle of the picture; default: the centre of the mesh."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points upwards in the picture."""
    fov: float = 53.13
    """Vertical field of view in degrees."""
    width: int = 512
    """Pixels."""
    height: int = 512
    """Pixels."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Linear R G B behind the volume."""
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""

    def run(self, console: Console) -> None:
        """Renders and writes the picture."""
        from difftetvr.render import render
        from difftetvr.view.pictures import require_png, save_png

        require_png(self.output)
        require_writable(self.output, CaptureError)
        self._require_valid_camera()
        mesh, field_on_mesh = _load_model(self.model, self.device)
        with torch.no_grad():
            image = render(mesh, field_on_mesh, self._camera(mesh), background=torch.tensor(self.background))
        save_png(self.output, image.color)
        console.print(f"Wrote {self.output} ({self.width} x {self.height})")

    def _require_valid_camera(self) -> None:
        if not 0.0 < self.fov < 180.0:
            raise CameraError(f"--fov is {self.fov:g} degrees; it must lie between 0 and 180.")
        for name in ("eye", "target", "up", "background"):
            values = getattr(self, name)
            if values is not None and not all(math.isfinite(v) for v in values):
                given = " ".join(f"{v:g}" for v in values)
                raise CameraError(f"--{name} is {given}; give three finite numbers.")

    def _camera(self, mesh: TetMesh) -> Camera:
        from difftetvr.render.camera import Camera

        lower, upper = mesh.bounds().double().cpu()
        target = torch.tensor(self.target, dtype=torch.float64) if self.target else 0.5 * (lower + upper)
        eye = torch.tensor(self.eye, dtype=torch.float64) if self.eye else None
        fov_y = math.radians(self.fov)
        if eye is None:
            direction = torch.tensor(_DEFAULT_DIRECTION, dtype=torch.float64)
            narrow = 2.0 * math.atan(math.tan(0.5 * fov_y) * min(1.0, self.width / max(self.height, 1)))
            radius = 0.5 * (upper - lower).norm()
            eye = target + radius / max(math.sin(0.5 * narrow), 1e-6) * direction / direction.norm()
        return Camera.look_at(eye, target, self.up, fov_y, self.width, self.height)


@dataclass(frozen=True)
class Eval:
    """Compare a reconstructed volume with the held-out views of a capture."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh with color and density."""
    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """tooth, or the path of a volume or of a saved capture (.npz)."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """File to write the numbers to, JSON."""
    all_views: bool = False
    """Compare with the training views, too."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Linear R G B behind the volume."""
    device: str | None = None
    """Where to render."""
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)

    def run(self, console: Console) -> None:
        """Renders the views and prints PSNR and SSIM of each."""
        from difftetvr.fit.evaluation import evaluate
        from difftetvr.view.describe import evaluation_table

        if self.output is not None:
            require_writable(self.output, FitError)
        mesh, field_on_mesh = _load_model(self.model, self.device)
        capture = self.views_of.load(self.capture, console)
        views = list(range(len(capture.cameras))) if self.all_views else capture.test_indices.tolist()
        if not views:
            raise FitError(f"'{capture.name}' holds out no views; compare with all of them with --all-views.")
        evaluation = evaluate(mesh, field_on_mesh, capture, views, self.background)
        console.print(evaluation_table(evaluation))
        if self.output is not None:
            write_json(self.output, evaluation.to_json())


@dataclass(frozen=True)
class Info:
    """Describe a mesh or a capture."""

    file: Annotated[str, Positional, arg(metavar="FILE")]
    """A mesh (.vtu, .vtk, .msh, .mesh, .xdmf, .npz), a volume, a saved capture (.npz), or tooth."""
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)

    def run(self, console: Console) -> None:
        """Prints tables."""
        from difftetvr.view.describe import capture_table, mesh_tables

        path = Path(self.file)
        if _is_capture(path):
            console.print(capture_table(self.file, self.views_of.load(self.file, console)))
            return
        from difftetvr.mesh.io import load_with_optional_field

        for table in mesh_tables(self.file, *load_with_optional_field(path)):
            console.print(table)


@dataclass(frozen=True)
class Export:
    """Write a reconstructed volume in another format."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh with color and density."""
    output: Annotated[Path, Positional, arg(metavar="OUT")]
    """File to write: .vtu, .vtk, .msh or .npz."""

    def run(self, console: Console) -> None:
        """Reads and writes."""
        from difftetvr.mesh.io import load, require_writable_format, save

        require_writable_format(self.output)
        require_writable(self.output, MeshError)
        mesh, field_on_mesh = load(self.model)
        save(self.output, mesh, field_on_mesh)
        console.print(f"Wrote {self.output} ({mesh.num_cells:,} cells)")


Command = (
    Annotated[Fit, subcommand("fit")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Eval, subcommand("eval")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Export, subcommand("export")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Runs a command.

    Args:
        args: Arguments after the program's name; default: those of the process.

    Returns:
        The exit code: 0, 2 for bad input (one sentence on standard error), 130 when interrupted.
    """
    given = list(sys.argv[1:] if args is None else args)
    try:
        command: Any = _parse(Command, given)
        if isinstance(command, Fit):
            command = command.with_saved_options(given[1:])
        command.run(console())
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else _USAGE_ERROR
    except KeyboardInterrupt:
        return _INTERRUPTED
    except Exception as error:
        sentence = sentence_for(error)
        if sentence is None:
            raise
        print(f"difftetvr: {sentence}", file=sys.stderr)
        return _USAGE_ERROR
    return 0


def _parse(command: Any, args: Sequence[str], default: Any = tyro.MISSING) -> Any:
    return tyro.cli(command, prog=_PROGRAM, args=args, default=default, config=(FlagCreatePairsOff,))


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


def _load_model(path: Path, device: str | None) -> tuple[TetMesh, Field]:
    from difftetvr.fit.loop import resolve_device
    from difftetvr.mesh.io import load

    mesh, field_on_mesh = load(path)
    target = resolve_device(device)
    return mesh.to(device=target), field_on_mesh.to(device=target)


def _is_capture(path: Path) -> bool:
    from difftetvr.capture.volume import is_volume_file
    from difftetvr.capture.volume_capture import TOOTH
    from difftetvr.mesh.io import is_mesh_archive

    is_saved_capture = path.suffix.lower() == ".npz" and path.is_file() and not is_mesh_archive(path)
    return str(path) == TOOTH or is_volume_file(path) or is_saved_capture


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


if __name__ == "__main__":
    sys.exit(main())
