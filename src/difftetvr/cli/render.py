"""The command ``difftetvr render``."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.options import TRUST_GROUPS, Color, MeshOptions, Output, TrustOptions, color_of
from difftetvr.errors import CameraError, CaptureError, MeshError, counted
from difftetvr.files import require_writable

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from difftetvr.mesh import Field, TetMesh
    from difftetvr.mesh.io import Defects, MeshData
    from difftetvr.rendering import Camera, ScalarField

# Where the default camera stands, seen from the mesh: in front, to the right, a little above.
_DEFAULT_DIRECTION = (0.45, -1.0, 0.35)
_DEFAULT_UP, _DEFAULT_FOV, _DEFAULT_SIZE = (0.0, 0.0, 1.0), 53.13, 512
_WORST_SHOWN = 1e-3
_LEAST_SIZE, _MOST_SIZE = 1e-150, 1e150  # of meshes, so that squares of lengths are numbers


@dataclass(frozen=True)
class ScalarOptions:
    """What scalars of a simulation look like, for meshes without color and density, or where a scalar is named."""

    scalar: str | None = None
    """Name of the point or cell data to show, with a component if wanted (velocity:x, stress:von-mises); default: color
    and density, or the only data there are."""
    transfer_function: Path | None = None
    """Colour and opacity of the scalar, .json or .xml; default: blue over white to red, the more opaque the greater."""
    value_range: tuple[float, float] | None = None
    """Scalars at the transfer function's 0 and 1; default: the least and the greatest."""
    attenuation: float = 25.0
    """Density of opacity 1, where the mesh's longest side is 1."""

    def apply(self, data: MeshData, path: Path) -> Shown:
        """What to render of a file.

        Raises:
            MeshError: There is no such scalar, it is the same everywhere, or an option is out of range.
        """
        if self.scalar is None and data.field is not None:
            return Shown(data.mesh, data.field)
        import torch

        from difftetvr.mesh.io import missing_note, scalar_of
        from difftetvr.optics.transfer_function import TransferFunction
        from difftetvr.rendering import ScalarField

        if not (math.isfinite(self.attenuation) and self.attenuation >= 0):
            raise MeshError(f"--attenuation is {self.attenuation:g}; it must be finite and not negative.")
        try:
            scalar = scalar_of(data, self.scalar)
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from error
        low, high = (float(v) for v in torch.aminmax(scalar.values))
        if low == high and self.value_range is None:
            value = low + scalar.offset
            raise MeshError(
                f"The scalar '{scalar.name}' of {path} is {value:g} everywhere; name another, or give --value-range."
            )
        if self.transfer_function is None:
            function = TransferFunction.default()
        else:
            function = TransferFunction.load(self.transfer_function)
        lower, upper = data.mesh.bounds()
        density = self.attenuation / float((upper - lower).max())
        value_range = self.value_range
        if value_range is not None:
            value_range = (scalar.counted_from_offset(value_range[0]), scalar.counted_from_offset(value_range[1]))
        field = ScalarField(scalar.values, function, density, value_range, scalar.location)
        return Shown(scalar.mesh, field, scalar.name, missing_note(scalar))


@dataclass(frozen=True)
class Shown:
    """What is rendered: a mesh, what it holds, the name of the scalar if that is one, and what to say of it."""

    mesh: TetMesh
    field: Field | ScalarField
    name: str | None = None
    note: str | None = None


@dataclass(frozen=True)
class Render:
    """Render a picture of a volume: a reconstruction, or a simulation's scalars through a transfer function."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh (.vtu, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node) with color and density, or with scalars."""
    output: Output
    """The picture, .png."""
    camera: Path | None = None
    """File of the camera, .json, such as viewpoint writes it, instead of the following options; with --width its
    picture in that size."""
    eye: tuple[float, float, float] | None = None
    """Position of the camera; default: far enough away that the whole mesh is seen."""
    target: tuple[float, float, float] | None = None
    """Point in the middle of the picture; default: the centre of the mesh."""
    up: tuple[float, float, float] | None = None
    """Direction that points upwards in the picture; default: 0 0 1."""
    fov: float | None = None
    """Vertical field of view in degrees; default: 53.13."""
    width: int | None = None
    """Pixels; default: 512, or as the camera's file says."""
    height: int | None = None
    """Pixels; default: likewise."""
    background: Color = "black"
    """Behind the volume: black, white or linear R G B."""
    clip: tuple[float, float, float, float] | None = None
    """A B C D: show only what lies in the half-space A x + B y + C z + D >= 0."""
    show: Literal["image", "depth-complexity", "cell-quality"] = "image"
    """The image; or how many cells each ray crosses; or the worst quality among them, from 0 (flat) to 1 (regular)."""
    renderer: Literal["marching", "linked-list", "projected"] | None = None
    """How the cells along a ray are found and ordered; default: marching, or linked-list where cells overlap."""
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""
    scalars: OmitArgPrefixes[ScalarOptions] = field(default_factory=ScalarOptions)
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Camera": ("camera", "eye", "target", "up", "fov", "width", "height"),
        "Scalars of a simulation": ("scalar", "transfer-function", "value-range", "attenuation"),
        "How it is drawn": ("background", "clip", "show", "renderer", "split", "step", "device"),
        **TRUST_GROUPS,
    }

    def run(self, console: Console) -> None:
        """Renders and writes the picture."""
        from difftetvr.fitting.beginning.requirements import resolve_device
        from difftetvr.rendering import OrderWarning
        from difftetvr.view.pictures import require_png

        require_png(self.output)
        require_writable(self.output, CaptureError)
        self._require_valid_camera()
        color_of(self.background)
        data = self.mesh.load(self.model, console)
        device = resolve_device(self.device)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", OrderWarning)
            if self.show == "image":
                self._draw_image(self.scalars.apply(data, self.model), data.defects, device, console)
            else:
                self._draw_statistics(data.mesh.to(device=device), data.defects, console)
        for warning in caught:
            console.print(str(warning.message), highlight=False)

    def _draw_image(self, shown: Shown, defects: Defects, device: torch.device, console: Console) -> None:
        import torch

        from difftetvr.rendering import render
        from difftetvr.view.blank import why_blank
        from difftetvr.view.pictures import save_png

        if shown.note is not None:
            console.print(shown.note)
        mesh, content = shown.mesh.to(device=device), shown.field.to(device=device)
        background, renderer = color_of(self.background), self._renderer_for(mesh, defects)
        camera = self._camera(mesh)
        with torch.no_grad():
            image = render(mesh, content, camera, torch.tensor(background), renderer=renderer, clip_plane=self.clip)
        save_png(self.output, image.color)
        if (reason := why_blank(mesh, content, camera, image, background, renderer, self.clip)) is not None:
            console.print(reason, highlight=False)
        what = "" if shown.name is None else f", {shown.name}"
        console.print(f"Wrote {self.output} ({camera.width} x {camera.height}{what})", highlight=False)

    def _draw_statistics(self, mesh: TetMesh, defects: Defects, console: Console) -> None:
        from difftetvr.rendering.inspection import inspect_rays
        from difftetvr.view.heatmap import Scale, save_heatmap

        statistics = inspect_rays(mesh, self._camera(mesh), self._renderer_for(mesh, defects), self.clip)
        if self.show == "depth-complexity":
            values = statistics.depth_complexity.float()
            most, mean = int(values.max()), float(values.mean())
            save_heatmap(self.output, values, Scale("cells crossed", 0.0, max(most, 1)))
            found = f"up to {counted(most, 'cell')} a ray, {mean:.1f} on average"
        else:
            values = statistics.worst_quality
            save_heatmap(self.output, values, Scale("worst quality Q", _WORST_SHOWN, 1.0, is_logarithmic=True))
            seen = values[~values.isnan()]
            found = f"worst quality seen {float(seen.min()):.3g}" if seen.numel() else "no cell in sight"
        console.print(f"Wrote {self.output} ({found})", highlight=False)

    def _renderer_for(self, mesh: TetMesh, defects: Defects) -> str:
        # From cell to cell, marching would leave what another cell fills as well.
        overlaps = not mesh.is_conforming or defects.doubled_places > 0
        return self.renderer or ("linked-list" if overlaps else "marching")

    def _require_valid_camera(self) -> None:
        if self.fov is not None and not 0.0 < self.fov < 180.0:
            raise CameraError(f"--fov is {self.fov:g} degrees; it must lie between 0 and 180.")
        for name in ("eye", "target", "up"):
            values = getattr(self, name)
            if values is not None and not all(math.isfinite(v) for v in values):
                given = " ".join(f"{v:g}" for v in values)
                raise CameraError(f"--{name} is {given}; give three finite numbers.")
        placed = [name for name in ("eye", "target", "up", "fov") if getattr(self, name) is not None]
        if self.camera is not None and placed:
            raise CameraError(f"--camera {self.camera} says where the camera is; leave out --{placed[0]}.")

    def _camera(self, mesh: TetMesh) -> Camera:
        from difftetvr.rendering.cameras.camera_file import load_camera

        if self.camera is not None:
            return self._resized(load_camera(self.camera))
        return self._placed(mesh)

    def _resized(self, camera: Camera) -> Camera:
        """A camera from a file, in the size that is asked for."""
        if self.width is None and self.height is None:
            return camera
        width = self.width or round(camera.width * (self.height or 0) / camera.height)
        height = self.height or round(camera.height * width / camera.width)
        # To a pixel: other proportions would squeeze the picture.
        if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
            raise CameraError(
                f"The camera {self.camera} takes pictures of {camera.width} x {camera.height} pixels, which "
                f"{width} x {height} would squeeze; give one of --width and --height."
            )
        return camera.with_size(width, height)

    def _placed(self, mesh: TetMesh) -> Camera:
        import torch

        from difftetvr.rendering.cameras.pinhole import Camera

        lower, upper = mesh.bounds().double().cpu()
        size = float((upper - lower).max())
        if not _LEAST_SIZE < size < _MOST_SIZE:
            raise MeshError(
                f"{self.model} is {size:.3g} across, of which no picture can be computed; scale its positions."
            )
        width, height = (_DEFAULT_SIZE if pixels is None else pixels for pixels in (self.width, self.height))
        target = torch.tensor(self.target, dtype=torch.float64) if self.target else 0.5 * (lower + upper)
        eye = torch.tensor(self.eye, dtype=torch.float64) if self.eye else None
        fov_y = math.radians(_DEFAULT_FOV if self.fov is None else self.fov)
        if eye is None:
            direction = torch.tensor(_DEFAULT_DIRECTION, dtype=torch.float64)
            narrow = 2.0 * math.atan(math.tan(0.5 * fov_y) * min(1.0, width / max(height, 1)))
            radius = 0.5 * (upper - lower).norm()
            eye = target + radius / max(math.sin(0.5 * narrow), 1e-6) * direction / direction.norm()
        return Camera.look_at(eye, target, self.up or _DEFAULT_UP, fov_y, width, height)
