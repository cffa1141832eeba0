"""A mesh with a field, cameras outside and inside of it, and rays through it, for tests of bundles."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, RenderedImage


def exact(camera: Camera) -> Camera:
    """The same view with a rotation that is one in float64."""
    pose = camera.world_to_camera.double()
    left, _, right = torch.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    return camera.with_pose(pose)


OUTSIDE = exact(Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=23, height=19))
INSIDE = exact(Camera.look_at((0.6, 0.55, 0.4), (0.5, 0.9, 0.5), fov_y=1.4, width=23, height=19))


def scene(dtype: torch.dtype = torch.float64, channels: int = 3, size: int = 4) -> tuple[TetMesh, Field]:
    generator = torch.Generator().manual_seed(5)
    mesh = TetMesh.grid((size, size, size), dtype=dtype)
    noise = torch.rand(mesh.num_vertices, 3, generator=generator, dtype=dtype)
    mesh = mesh.with_vertices(mesh.vertices + 0.2 / size * (noise - 0.5))
    color, density = (torch.rand(mesh.num_vertices, count, generator=generator, dtype=dtype) for count in (channels, 1))
    return mesh, Field(color, 4.0 * density[:, 0])


def random_rays(count: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Origins, half of them inside the unit cube, and directions towards points inside it."""
    generator = torch.Generator().manual_seed(count)
    origins, targets = (torch.rand(count, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    origins[: count // 2] = 4.0 * origins[: count // 2] - 1.5
    return origins.to(dtype), (targets - origins).to(dtype)


def flat(image: RenderedImage | Any) -> Tensor:
    parts = (image.color, image.alpha, image.depth, image.optical_depth)
    return torch.cat([part.reshape(-1) for part in parts])


def assert_same(one: RenderedImage, other: RenderedImage, tolerance: float) -> None:
    assert one.color.shape == other.color.shape
    assert float((flat(one) - flat(other)).abs().max()) < tolerance
