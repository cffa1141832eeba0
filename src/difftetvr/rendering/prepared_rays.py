"""Bundles of rays as kernels take them: counted from near the mesh, in the unit of kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from difftetvr.mesh import TetMesh
from difftetvr.rendering.clip_plane import clip_rays
from difftetvr.rendering.rays import Rays, are_one, short_unit_vectors, unit_vectors

KNOW_FLOAT64 = ("cpu", "cuda")
"""Devices that compute in float64."""


@dataclass(frozen=True)
class PreparedRays:
    """A bundle of rays, each counted from where it is nearest to the mesh's centre: there, float32 resolves most.

    Attributes:
        lines: (N, 6) origins and unit directions, the origins in the unit of kernels.
        shift: (N,) how far these origins are from the true ones, in world units.
        near, far: (N,) distances from the true origins between which rays are looked at, in world units.
        sees_all: Whether no ray starts or ends near the mesh; a tensor where the host would have to wait for it.
        begins_at_point: Whether all rays are known to be looked at from one point on.
    """

    lines: torch.Tensor
    shift: torch.Tensor
    near: torch.Tensor
    far: torch.Tensor
    sees_all: bool | torch.Tensor
    begins_at_point: bool

    @staticmethod
    def of(rays: Rays, mesh: TetMesh, clip_plane: Any) -> PreparedRays:
        """Count rays, before a plane if there is one, anew from near a mesh; differentiable in them."""
        device = mesh.vertices.device
        dtype = torch.float64 if device.type in KNOW_FLOAT64 else mesh.vertices.dtype
        rays = rays.relative_to(mesh.origin)
        directions = rays.directions.reshape(-1, 3).to(device, dtype)
        # One origin of all is one on the device, too.
        eye = rays.eye
        origins = (rays.origins.reshape(-1, 3) if eye is None else eye).to(device, dtype).expand_as(directions)
        near, far = (end.reshape(-1).to(device, dtype) for end in rays.ends)
        is_narrow = rays.directions.dtype != torch.float64 and dtype == torch.float64
        directions = short_unit_vectors(directions) if is_narrow else unit_vectors(directions)
        vertices = mesh.vertices.detach()
        low, high = vertices.amin(0).to(dtype), vertices.amax(0).to(dtype)
        center, radius = torch.lerp(low, high, 0.5), 0.5 * torch.linalg.vector_norm(high - low)
        shift = ((center - origins.detach()) * directions.detach()).sum(1)
        lines = torch.cat((torch.addcmul(origins, shift[:, None], directions), directions), dim=1)
        if clip_plane is not None:
            first, last = clip_rays(clip_plane, origins, directions, mesh.origin)
            near, far = torch.maximum(near, first), torch.minimum(far, last)
        sees_all: bool | torch.Tensor = False
        if clip_plane is None and not (near.requires_grad or far.requires_grad):
            # How far from the centre rays begin and end, at least: they see all where that is beyond the mesh.
            away = torch.minimum(shift - near, far - (1.0 + 1e-5) * shift.abs())
            sees_all = away.amin() >= 1.001 * radius if len(away) else away.new_ones((), dtype=torch.bool)
            sees_all = bool(sees_all) if device.type == "cpu" else sees_all
        may_begin_inside = device.type == "cpu" and not sees_all
        begins_at_point = may_begin_inside and are_one(origins.detach() + (near[:, None] * directions).detach())
        return PreparedRays(lines, shift, near, far, sees_all, begins_at_point)

    def limits(self, unit: float) -> torch.Tensor | None:
        """(N, 2) distances from these origins in the unit of kernels; None where nothing is known to be cut off."""
        if self.sees_all is True:
            return None
        return torch.stack((self.near - self.shift, self.far - self.shift), dim=1) / unit

    def in_unit(self, unit: float, dtype: torch.dtype) -> PreparedRays:
        """The same with origins in a unit of kernels, in world units, and at their precision."""
        lines = self.lines
        if unit != 1.0:
            lines = lines * lines.new_tensor([1.0 / unit] * 3 + [1.0] * 3)
        return replace(self, lines=lines.to(dtype))
