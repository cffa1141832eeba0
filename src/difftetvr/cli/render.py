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
    from difftetvr.mesh.io import MeshData
    from difftetvr.rendering import Camera, ScalarField

# Where the default camera stands, seen from the mesh: in front, to the right, a little above.
_DEFAULT_DIRECTION = (0.45, -1.0, 0.35)
_WORST_SHOWN = 1e-3


@dataclass(frozen=True)
class ScalarOptions:
    """What scalars of a simulation look like, for meshes without color and density, or where a scalar is named."""

    scalar: str | None = None
    """Name of the point or cell data to show; default: color and density, or the only data there are."""
    transfer_function: Path | None = None
    """Colour and opacity of the scalar, .json or .xml; default: blue over white to red, the more opaque the greater."""
    value_range: tuple[float, float] | None = None
    """Scalars at the transfer function's 0 and 1; default: the least and the greatest."""
    attenuation: float = 25.0
    """Density of opacity 1, where the mesh's longest side is 1."""

    def apply(self, data: MeshData, path: Path) -> tuple[Field | ScalarField, str | None]:
        """What to render of a file, and the name of the scalar, if it is one."""
        if self.scalar is None and data.field is not None:
            return data.field, None
        import torch

        from difftetvr.optics.transfer_function import TransferFunction
        from difftetvr.rendering import ScalarField

        if not (math.isfinite(self.attenuation) and self.attenuation >= 0):
            raise MeshError(f"--attenuation is {self.attenuation:g}; it must be finite and not negative.")
        name, values, location = self._find(data, path)
        low, high = (float(v) for v in torch.aminmax(values))
        if low == high and self.value_range is None:
            raise MeshError(
                f"The scalar '{name}' of {path} is {low:g} everywhere; name another, or give --value-range."
            )
        if self.transfer_function is None:
            function = TransferFunction.default()
        else:
            function = TransferFunction.load(self.transfer_function)
        lower, upper = data.mesh.bounds()
        density = self.attenuation / float((upper - lower).max())
        return ScalarField(values, function, density, self.value_range, location), name

    def _find(self, data: MeshData, path: Path) -> tuple[str, torch.Tensor, Literal["vertex", "cell"]]:
        arrays = {name: (values, "cell") for name, values in data.cell_data.items()}
        arrays |= {name: (values, "vertex") for name, values in data.point_data.items()}
        shown = {name: item for name, item in arrays.items() if item[0].dim() == 1 or item[0].shape[1:] == (3,)}
        names = ", ".join(sorted(shown)) or "none"
        if not shown:
            raise MeshError(f"{path} has no scalars to show; add point or cell data, or color and density.")
        if self.scalar is None and len(shown) > 1:
            raise MeshError(f"{path} has several scalars ({names}); choose one with --scalar.")
        name = next(iter(shown)) if self.scalar is None else self.scalar
        if name not in shown:
            raise MeshError(f"{path} has no scalar '{name}' (found: {names}); name one of these with --scalar.")
        values, location = shown[name]
        values = values.to(data.mesh.vertices.dtype)
        if values.dim() == 2:
            name, values = f"magnitude of {name}", values.norm(dim=1)
        return name, values, "cell" if location == "cell" else "vertex"


@dataclass(frozen=True)
class Render:
    """Render a picture of a volume: a reconstruction, or a simulation's scalars through a transfer function."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh (.vtu, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node) with color and density, or with scalars."""
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
    background: Color = "black"
    """Behind the volume: black, white or linear R G B."""
    clip: tuple[float, float, float, float] | None = None
    """A B C D: show only what lies in the half-space A x + B y + C z + D >= 0."""
    show: Literal["image", "depth-complexity", "cell-quality"] = "image"
    """The image; or how many cells each ray crosses; or the worst quality among them, from 0 (flat) to 1 (regular)."""
    renderer: Literal["marching", "linked-list", "projected"] = "marching"
    """How the cells along a ray are found and ordered."""
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""
    scalars: OmitArgPrefixes[ScalarOptions] = field(default_factory=ScalarOptions)
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Camera": ("eye", "target", "up", "fov", "width", "height"),
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
        mesh = data.mesh.to(device=device)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", OrderWarning)
            if self.show == "image":
                self._draw_image(data, mesh, console)
            else:
                self._draw_statistics(mesh, console)
        for warning in caught:
            console.print(str(warning.message), highlight=False)

    def _draw_image(self, data: MeshData, mesh: TetMesh, console: Console) -> None:
        import torch

        from difftetvr.rendering import render
        from difftetvr.view.pictures import save_png

        content, name = self.scalars.apply(data, self.model)
        with torch.no_grad():
            image = render(
                mesh,
                content.to(device=mesh.vertices.device),
                self._camera(mesh),
                background=torch.tensor(color_of(self.background)),
                renderer=self.renderer,
                clip_plane=self.clip,
            )
        save_png(self.output, image.color)
        what = "" if name is None else f", {name}"
        console.print(f"Wrote {self.output} ({self.width} x {self.height}{what})", highlight=False)

    def _draw_statistics(self, mesh: TetMesh, console: Console) -> None:
        from difftetvr.rendering.inspection import inspect_rays
        from difftetvr.view.heatmap import Scale, save_heatmap

        statistics = inspect_rays(mesh, self._camera(mesh), self.renderer, self.clip)
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

    def _require_valid_camera(self) -> None:
        if not 0.0 < self.fov < 180.0:
            raise CameraError(f"--fov is {self.fov:g} degrees; it must lie between 0 and 180.")
        for name in ("eye", "target", "up"):
            values = getattr(self, name)
            if values is not None and not all(math.isfinite(v) for v in values):
                given = " ".join(f"{v:g}" for v in values)
                raise CameraError(f"--{name} is {given}; give three finite numbers.")

    def _camera(self, mesh: TetMesh) -> Camera:
        import torch

        from difftetvr.rendering.cameras.pinhole import Camera

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
