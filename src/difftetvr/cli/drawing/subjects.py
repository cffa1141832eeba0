"""What is drawn: a mesh with what it holds, or a volume, as something that a camera can look at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from difftetvr.cli.drawing.scalars import Shown, ShownVolume
from difftetvr.errors import CaptureError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.io import Defects
from difftetvr.rendering import Camera, RenderedImage, render, render_shading
from difftetvr.view.blank import why_blank
from difftetvr.view.frames import AxesBox

Color3 = tuple[float, float, float]

_SHOULDER = (-0.5, -0.7, -1.0)  # where the usual light is, seen from the camera: behind it, to the left, above


@dataclass(frozen=True)
class Drawing:
    """How meshes are drawn.

    Attributes:
        renderer: How crossings are found and ordered.
        clip: Half-space that is seen; None: all.
        is_shaded: Whether a light falls on what is seen.
        light: Direction to it, in world space; None: over the camera's left shoulder.
    """

    renderer: str
    clip: tuple[float, float, float, float] | None = None
    is_shaded: bool = False
    light: Color3 | None = None


def renderer_for(mesh: TetMesh, defects: Defects, asked: str | None) -> str:
    """How crossings with the cells of a mesh are found and ordered.

    Args:
        mesh: The mesh.
        defects: What is wrong with it.
        asked: What the command line says.
    """
    # From cell to cell, marching would leave what another cell fills as well.
    overlaps = not mesh.is_conforming or defects.doubled_places > 0
    return asked or ("linked-list" if overlaps else "marching")


class MeshSubject:
    """A mesh with what it holds, on the device where it is rendered."""

    def __init__(self, shown: Shown, drawing: Drawing, device: torch.device) -> None:
        self.name, self.scale, self.density, self._drawing = shown.name, shown.scale, shown.density, drawing
        self._mesh, self._field = shown.mesh.to(device=device), shown.field.to(device=device)

    @property
    def bounds(self) -> torch.Tensor:
        """(2, 3) float64 lower and upper corner, on the CPU."""
        return self._mesh.bounds().double().cpu()

    def axes(self, unit: str) -> AxesBox:
        """Axes around it, in a unit of length that is given."""
        return AxesBox(self.bounds, None, unit)

    def seen_by(self, camera: Camera) -> RenderedImage:
        """What a camera sees, over black."""
        drawing = self._drawing
        with torch.no_grad():
            image = render(self._mesh, self._field, camera, renderer=drawing.renderer, clip_plane=drawing.clip)
            if not drawing.is_shaded:
                return image
            light = drawing.light or _over_shoulder(camera)
            shade = render_shading(
                self._mesh, self._field, camera, light, renderer=drawing.renderer, clip_plane=drawing.clip
            )
            return replace(image, color=image.color * shade[..., None])

    def why_blank(self, camera: Camera, image: RenderedImage, background: Color3) -> str | None:
        """Why nothing of it is seen over a background; None where something is."""
        drawing = self._drawing
        return why_blank(self._mesh, self._field, camera, image, background, drawing.renderer, drawing.clip)


class VolumeSubject:
    """A volume on its grid."""

    def __init__(self, shown: ShownVolume, device: torch.device) -> None:
        from difftetvr.capture import VolumeRenderer

        self.name, self.scale, self.density = None, shown.scale, shown.density
        self._volume = shown.volume
        self._renderer = VolumeRenderer(shown.volume, shown.function, shown.density, device=device)

    @property
    def bounds(self) -> torch.Tensor:
        """(2, 3) float64 lower and upper corner; the longest side is 1."""
        return self._volume.bounds.double()

    def axes(self, unit: str) -> AxesBox:
        """Axes around it, which count from the first sample as the file does."""
        samples = torch.tensor(self._volume.resolution, dtype=torch.float64)
        extent = (samples - 1.0) * torch.tensor(self._volume.spacing, dtype=torch.float64)
        return AxesBox(self.bounds, torch.stack((torch.zeros_like(extent), extent)), unit)

    def seen_by(self, camera: Camera) -> RenderedImage:
        """What a camera sees, over black."""
        if type(camera) is not Camera:
            raise CaptureError("Volumes are drawn for pinhole cameras alone; choose another camera.")
        images, alphas = self._renderer.render([camera])
        empty = torch.zeros_like(alphas[0])
        return RenderedImage(images[0], alphas[0], empty, empty)

    def why_blank(self, camera: Camera, image: RenderedImage, background: Color3) -> str | None:
        """Why nothing of it is seen over a background; None where something is."""
        least = 0.5 / 255.0
        if float((image.color - torch.tensor(background)).abs().max()) >= least:
            return None
        if float(image.alpha.max()) >= least:
            return "The picture shows nothing: what it shows has the colour of the background; choose another one."
        return (
            "The picture shows nothing: the camera looks past the volume, or the transfer function is transparent for "
            "its values; change --eye and --target, or --transfer-function and --value-range."
        )


def over(image: RenderedImage, background: Color3) -> RenderedImage:
    """An image that was rendered over black, over another background."""
    behind = torch.tensor(background).to(image.color)
    return replace(image, color=image.color + (1.0 - image.alpha[..., None]) * behind)


def _over_shoulder(camera: Camera) -> Color3:
    """Direction to the usual light in world space."""
    pose = camera.world_to_camera.detach().cpu().double()
    x, y, z = (pose[:3, :3].T @ torch.tensor(_SHOULDER, dtype=torch.float64)).tolist()
    return x, y, z
