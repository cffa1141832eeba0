"""Colours that depend on the direction, as a camera or rays that share a viewpoint see them.

Harmonics are summed once for each vertex or cell and viewpoint: the point where rays start, or the direction of
parallel ones. What a single ray contributes to the derivative by its own origin or direction is told by an image of
the colours' derivatives by the viewpoint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from difftetvr.errors import DiffTetError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.rays import Rays, are_one, one_vector


@dataclass(frozen=True)
class Viewpoint:
    """What rays share.

    Attributes:
        vector: (3,) the point where they start, relative to the mesh's origin; or where they go.
        is_direction: Whether it is the latter.
        own: (N, 3) the same of each ray, where rays have vectors of their own that require gradients; else None.
    """

    vector: torch.Tensor
    is_direction: bool
    own: torch.Tensor | None

    @staticmethod
    def of(mesh: TetMesh, camera: Camera | Rays, is_parallel: bool = False) -> Viewpoint:
        """Of a camera, which is relative to the mesh's origin, or of rays in world space.

        Args:
            mesh: The mesh.
            camera: The camera, or the rays.
            is_parallel: Whether rays that share both, as a single one does, count as parallel.

        Raises:
            DiffTetError: They share neither.
        """
        if isinstance(camera, Camera):
            return Viewpoint(camera.position, False, None)
        rays = camera.relative_to(mesh.origin)
        if not rays.shape.numel():
            return Viewpoint(mesh.vertices.new_zeros(3), False, None)
        both = ((rays.origins, False), (rays.directions, True))
        for vectors, is_direction in both[::-1] if is_parallel else both:
            if (shared := one_vector(vectors)) is not None:
                return Viewpoint(shared, is_direction, None)
            flat = vectors.reshape(-1, 3)
            if are_one(flat):
                return Viewpoint(flat[0].detach(), is_direction, flat if flat.requires_grad else None)
        raise DiffTetError(
            "The field's colours depend on the direction (harmonics), and are known here for rays that start at one "
            "point, or go in one direction; ask for each camera by itself, or pass a field without harmonics."
        )

    def seen(self, field: Field, mesh: TetMesh) -> Field:
        """The field without harmonics that is seen so; differentiable in the vector."""
        return self._seen(field, mesh, self.vector)

    def _seen(self, field: Field, mesh: TetMesh, vector: torch.Tensor) -> Field:
        return field.seen_along(vector) if self.is_direction else field.seen_from(mesh, vector)

    def with_derivatives_of_rays(
        self, color: torch.Tensor, mesh: TetMesh, field: Field, image_of: Callable[[Field], torch.Tensor]
    ) -> torch.Tensor:
        """An image's (..., 3) colours, now also differentiable in what rays have of their own.

        A colour is linear in those of vertices or cells, so its derivative by the viewpoint is the image of theirs.

        Args:
            color: The colours.
            mesh: The mesh.
            field: The field, with harmonics.
            image_of: Takes a field of C channels and makes (N, C) of them, without derivatives.
        """
        if self.own is None:
            return color
        with torch.enable_grad():
            vectors = self.vector.repeat(len(field), 1).requires_grad_()
            seen = self._seen(field, mesh, vectors).color
        slopes = [torch.autograd.grad(seen[:, k].sum(), vectors, retain_graph=k < 2)[0] for k in range(3)]
        with torch.no_grad():
            channels = torch.cat(slopes, dim=1).to(field.color.dtype)
            image = image_of(Field(channels, field.density, field.location)).unflatten(-1, (3, 3))
        # Nothing is added but derivatives.
        nothing = ((self.own - self.own.detach()).to(color)[:, None, :] * image).sum(2)
        return color + nothing.view(color.shape)
