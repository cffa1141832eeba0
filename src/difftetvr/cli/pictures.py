"""The commands that draw: ``difftetvr render | compare | cut``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.options import CaptureOptions, Output, load_model
from difftetvr.errors import CameraError, CaptureError
from difftetvr.files import require_writable

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.mesh.tetmesh import TetMesh
    from difftetvr.render.camera import Camera

# Where the default camera stands, seen from the mesh: in front, to the right, a little above.
_DEFAULT_DIRECTION = (0.45, -1.0, 0.35)
_MOST_PIXELS = 16384  # of a cut's side


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
        mesh, field_on_mesh = load_model(self.model, self.device)
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
class Compare:
    """Draw held-out views of a capture beside those of models, with PSNR, and a cut through each model."""

    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """tooth, or the path of a volume or of a saved capture (.npz)."""
    models: Annotated[tuple[Path, ...], Positional, arg(metavar="MODEL")]
    """Meshes with color and density."""
    output: Output
    """The picture, .png."""
    names: tuple[str, ...] = ()
    """Names of the models; default: those of their files."""
    rows: int = 1
    """Views to show."""
    normal: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction in which the cut is looked at."""
    no_cut: bool = False
    """Leave the cuts out."""
    device: str | None = None
    """Where to render."""
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)

    def run(self, console: Console) -> None:
        """Renders and writes the picture."""
        from difftetvr.view.compare import Model, compare_models
        from difftetvr.view.cut import Plane
        from difftetvr.view.pictures import require_png, save_picture

        require_png(self.output)
        require_writable(self.output, CaptureError)
        if not self.models:
            raise CaptureError("There is no model to compare with; name one or more after the capture.")
        if self.names and len(self.names) != len(self.models):
            raise CaptureError(f"There are {len(self.models)} models but {len(self.names)} --names; give one for each.")
        names = self.names or tuple(path.stem for path in self.models)
        models = [Model(name, *load_model(path, self.device)) for name, path in zip(names, self.models, strict=True)]
        capture = self.views_of.load(self.capture, console)
        plane = None if self.no_cut else Plane(self.normal)
        save_picture(self.output, compare_models(capture, models, self.rows, plane))
        console.print(f"Wrote {self.output}")


@dataclass(frozen=True)
class Cut:
    """Draw a cut through a model: what it holds, and its cells."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh with color and density."""
    output: Output
    """The picture, .png."""
    normal: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction in which the cut is looked at."""
    origin: tuple[float, float, float] | None = None
    """A point of the cut; default: the centre of the mesh."""
    size: int = 1024
    """Pixels of the longer side."""
    no_cells: bool = False
    """Leave the outlines of the cells out."""

    def run(self, console: Console) -> None:
        """Draws and writes the picture."""
        from difftetvr.mesh.io import load
        from difftetvr.view.cut import Plane, cut_picture
        from difftetvr.view.pictures import require_png, save_picture

        require_png(self.output)
        require_writable(self.output, CaptureError)
        if not 2 <= self.size <= _MOST_PIXELS:
            raise CaptureError(f"--size is {self.size}; it must lie between 2 and {_MOST_PIXELS}.")
        mesh, field_on_mesh = load(self.model)
        picture = cut_picture(mesh, field_on_mesh, Plane(self.normal, self.origin), self.size, not self.no_cells)
        save_picture(self.output, picture)
        console.print(f"Wrote {self.output} ({picture.width} x {picture.height})")
