"""What is in a scene, as something that cameras can look at: a mesh with what it holds, or a volume on its grid."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
import torch

from difftetvr.capture import Volume, VolumeRenderer
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, RenderedImage, ScalarField, render
from difftetvr.rendering.inspection import RayStatistics, inspect_rays
from difftetvr.view.live.settings import Mode, ScalarLook, Settings

_DENSEST = 25.0
"""Density of the densest of what has no colours, where the longest side is 1, as that of transfer functions."""


_ORDINARY = 0.999
"""Share of the vertices that are no denser than that; the rest are outliers."""


class Content(Protocol):
    """What is in a scene."""

    @property
    def bounds(self) -> torch.Tensor:
        """(2, 3) float64 lower and upper corner, on the CPU."""
        ...

    @property
    def modes(self) -> tuple[Mode, ...]:
        """What can be shown of it, but for errors."""
        ...

    def seen_by(self, camera: Camera, settings: Settings) -> RenderedImage:
        """What a camera sees, over black."""
        ...

    def met_by(self, camera: Camera, settings: Settings) -> RayStatistics:
        """Which cells the rays of a camera meet."""
        ...


class MeshContent:
    """A mesh with what it holds.

    Args:
        mesh: The mesh, on the device where it is rendered.
        field: Colours and densities, or scalars; likewise. Densities without colours are white, and as dense as shows
            them; one channel is grey, and of more than three the first three are seen as red, green and blue.
        renderer: How crossings are found and ordered, see :func:`difftetvr.render`.
    """

    modes: tuple[Mode, ...] = ("color", "depth", "opacity", "cell quality", "depth complexity")

    def __init__(self, mesh: TetMesh, field: Field | ScalarField, renderer: str = "marching") -> None:
        self.bounds = mesh.bounds().detach().double().cpu()
        longest = float((self.bounds[1] - self.bounds[0]).max())
        field = _in_colors(field, longest) if isinstance(field, Field) else field
        self.mesh, self.field, self._renderer = mesh, field, renderer
        self._seen: tuple[ScalarLook | None, Field | ScalarField] = (None, field)

    def seen_by(self, camera: Camera, settings: Settings) -> RenderedImage:
        """What a camera sees, over black."""
        field = self._field_for(settings.look)
        return render(self.mesh, field, camera, renderer=self._renderer, clip_plane=settings.clip)

    def met_by(self, camera: Camera, settings: Settings) -> RayStatistics:
        """Which cells the rays of a camera meet."""
        return inspect_rays(self.mesh, camera, self._renderer, settings.clip)

    def _field_for(self, look: ScalarLook | None) -> Field | ScalarField:
        """The scalars with a look; the same object for the same look, so that it is prepared once."""
        if look is None or not isinstance(self.field, ScalarField):
            return self.field
        known, field = self._seen
        if known is not look:
            longest = float((self.bounds[1] - self.bounds[0]).max())
            field = dataclasses.replace(
                self.field,
                transfer_function=look.transfer_function,
                attenuation=look.density / longest,
                value_range=look.value_range,
            )
            self._seen = (look, field)
        return field


def _in_colors(field: Field, longest: float) -> Field:
    """A field with red, green and blue, for a mesh whose longest side has some length."""
    channels = field.color.shape[1]
    if channels == 3:
        return field
    if channels == 0:
        densest = float(np.quantile(field.density.detach().cpu().numpy(), _ORDINARY))
        factor = _DENSEST / (longest * densest) if densest > 0.0 else 1.0
        return Field(field.color.new_ones((len(field.color), 3)), factor * field.density, field.location)
    seen = field.color.expand(-1, 3) if channels == 1 else torch.nn.functional.pad(field.color, (0, 1))[:, :3]
    return Field(seen.contiguous(), field.density, field.location)


class VolumeContent:
    """A volume on its grid, whose longest side is 1.

    Args:
        volume: Its samples; those that stand for 0 and 1 of a look's range are those of the volume's own.
        look: What they look like at first.
        device: Where it is rendered.
    """

    modes: tuple[Mode, ...] = ("color", "opacity")

    def __init__(self, volume: Volume, look: ScalarLook, device: torch.device) -> None:
        self._volume, self._device = volume, device
        self.bounds = volume.bounds.detach().double().cpu()
        self._seen = (look, self._renderer_for(look))

    def seen_by(self, camera: Camera, settings: Settings) -> RenderedImage:
        """What a camera sees, over black; depths are not known."""
        look = settings.look
        if look is not None and look is not self._seen[0]:
            self._seen = (look, self._renderer_for(look))
        images, alphas = self._seen[1].render([camera])
        unknown = torch.zeros_like(alphas[0])
        return RenderedImage(images[0], alphas[0], unknown, unknown)

    def met_by(self, camera: Camera, settings: Settings) -> RayStatistics:
        """There are no cells to meet."""
        none = torch.zeros((camera.height, camera.width))
        return RayStatistics(none.int(), torch.full_like(none, torch.nan))

    def _renderer_for(self, look: ScalarLook) -> VolumeRenderer:
        low, high = (float(end) for end in self._volume.value_range)
        start, end = ((value - low) / (high - low) for value in look.value_range)
        values = ((self._volume.values - start) / (end - start)).clip(0.0, 1.0).astype("float32")
        shown = dataclasses.replace(self._volume, values=values, value_range=look.value_range)
        return VolumeRenderer(shown, look.transfer_function, look.density, device=self._device)
