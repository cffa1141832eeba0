"""Bundles of rays as kernels take them: counted from near the mesh, in the unit of kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from difftetvr.mesh import TetMesh
from difftetvr.rendering.clip_plane import clip_rays
from difftetvr.rendering.rays import Rays, unit_vectors

KNOW_FLOAT64 = ("cpu", "cuda")
"""Devices that compute in float64."""


@dataclass(frozen=True)
class PreparedRays:
    """A bundle of rays, each counted from where it is nearest to the mesh's centre: there, float32 resolves most.

    Attributes:
        lines: (N, 6) origins and unit directions, the origins in the unit of kernels.
        shift: (N,) how far these origins are from the true ones, in world units.
        near, far: (N,) distances from the true origins between which rays are looked at, in world units.
        sees_all: Whether no ray starts or ends near the mesh, a bool where the rays are; on the host, once it is known.
        origins: (N, 3) the true origins, relative to that of the mesh.
        directions: (N, 3) unit directions.
    """

    lines: torch.Tensor
    shift: torch.Tensor
    near: torch.Tensor
    far: torch.Tensor
    sees_all: torch.Tensor
    origins: torch.Tensor
    directions: torch.Tensor

    @staticmethod
    def of(rays: Rays, mesh: TetMesh) -> PreparedRays:
        """Count rays anew from near a mesh; differentiable in them."""
        device = mesh.vertices.device
        dtype = torch.float64 if device.type in KNOW_FLOAT64 else mesh.vertices.dtype
        rays = rays.relative_to(mesh.origin)
        directions = rays.directions.reshape(-1, 3).to(device, dtype)
        # One origin of all is one on the device, too.
        eye = rays.eye
        origins = (rays.origins.reshape(-1, 3) if eye is None else eye).to(device, dtype).expand_as(directions)
        near, far = (end.reshape(-1).to(device, dtype) for end in rays.ends)
        directions = unit_vectors(directions)
        low, high = torch.aminmax(mesh.vertices.detach().to(dtype), dim=0)
        center, radius = 0.5 * (low + high), 0.5 * (high - low).square().sum().sqrt()
        shift = ((center - origins.detach()) * directions.detach()).sum(1)
        lines = torch.cat((origins + shift[:, None] * directions, directions), dim=1)
        beyond = (shift.abs() + radius).mul(1.0 + 1e-5)
        sees_all = ((near <= shift - 1.001 * radius) & (far >= beyond)).all()
        if near.requires_grad or far.requires_grad:
            sees_all = torch.tensor(False)
        return PreparedRays(lines, shift, near, far, sees_all, origins, directions)

    def limits(self, clip_plane: Any, origin: Sequence[float], unit: float) -> torch.Tensor | None:
        """(N, 2) distances from these origins in the unit of kernels; None where nothing is cut off."""
        if clip_plane is None and self.sees_all:
            return None
        near, far = self.near, self.far
        if clip_plane is not None:
            first, last = clip_rays(clip_plane, self.origins, self.directions, origin)
            near, far = torch.maximum(near, first), torch.minimum(far, last)
        return torch.stack((near - self.shift, far - self.shift), dim=1) / unit

    def in_unit(self, unit: float, dtype: torch.dtype) -> PreparedRays:
        """The same with origins in a unit of kernels, in world units, and at their precision."""
        lines = self.lines
        if unit != 1.0:
            lines = lines * lines.new_tensor([1.0 / unit] * 3 + [1.0] * 3)
        return replace(self, lines=lines.to(dtype))
