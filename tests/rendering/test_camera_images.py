"""Images of all kinds of cameras are the reference's, ray by ray."""

from __future__ import annotations

import pytest
import torch
from oracle.oracle import render_oracle
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, Detector, LensCamera, PanoramicCamera, ParallelCamera, RaySource, render


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def along(origin: Tensor, direction: Tensor) -> Camera:
    """A pinhole camera of one pixel that looks along a ray."""
    forward = direction / direction.norm()
    right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())])
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.cat([rotation, -(rotation @ origin)[:, None]], dim=1)
    return Camera(torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])]), 1.0, 1.0, 0.5, 0.5, 1, 1)


POSE = along(vector(2.0, 1.7, 1.4), vector(-1.5, -1.2, -0.9)).world_to_camera
PINHOLE = (POSE, 9.0, 8.0, 3.4, 3.1, 7, 6)
BEHIND = 10.0
"""From where lines without a beginning are looked along, in front of their origins."""


CAMERAS: dict[str, RaySource] = {
    "pinhole": Camera(*PINHOLE),
    "focal length as a tensor": Camera(POSE, torch.tensor(9.0, requires_grad=True), *PINHOLE[2:]),  # type: ignore[arg-type]
    "opencv": LensCamera(
        *PINHOLE,
        model="opencv",
        coefficients=[0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003, 0.01, 0.005, -0.01, 0.004],  # type: ignore[arg-type]
    ),
    "fisheye": LensCamera(*PINHOLE, model="fisheye", coefficients=vector(0.1, -0.05, 0.01, 0.02)),
    "thin prism": LensCamera(
        *PINHOLE, model="thin-prism-fisheye", coefficients=vector(0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003)
    ),
    "parallel": ParallelCamera(POSE, [0.25, 0.3], 7, 6),  # type: ignore[arg-type]
    "panorama from inside": PanoramicCamera.look_at((0.4, 0.6, 0.55), (1.0, 0.6, 0.55), width=8, height=4),
    "detector of parallel rays": Detector(
        vector(-1.0, -1.0, -0.8),
        vector(0.1, -0.2, 0.0),
        vector(0.0, 0.01, 0.3),
        7,
        6,
        direction=vector(-2.0, -1.7, -1.4),
    ),
    "detector of a source": Detector(
        vector(-1.0, -1.0, -0.8), vector(0.2, -0.3, 0.0), vector(0.0, 0.02, 0.4), 7, 6, source=vector(2.03, 1.72, 1.41)
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_every_camera_sees_what_the_reference_sees_along_its_rays(name: str) -> None:
    generator = torch.Generator().manual_seed(3)
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    shaken = 0.03 * torch.rand(mesh.vertices.shape, generator=generator, dtype=torch.float64)
    mesh = mesh.with_vertices(mesh.vertices + shaken)
    color, density = (torch.rand(27, count, generator=generator, dtype=torch.float64) for count in (3, 1))
    field, camera = Field(color, 4.0 * density[:, 0]), CAMERAS[name]
    image, rays = render(mesh, field, camera), camera.rays()
    origins, directions = (part.detach().reshape(-1, 3) for part in (rays.origins, rays.directions))
    seen = torch.cat([image.color, image.alpha[..., None], image.depth[..., None]], -1).detach().reshape(-1, 5)
    is_line = bool((rays.ends[0] < 0).all())
    hits = 0
    for ray in range(0, len(origins), 3):
        origin = origins[ray] - is_line * BEHIND * directions[ray] / directions[ray].norm()
        true = render_oracle(mesh.vertices, mesh.tets, field.color, field.density, along(origin, directions[ray]))
        depth = true.depth.reshape(1) - is_line * BEHIND * (true.alpha > 0).reshape(1)
        expected = torch.cat([true.color.reshape(3), true.alpha.reshape(1), depth])
        assert float((seen[ray] - expected).abs().max()) < 1e-10
        hits += bool(true.alpha > 0)
    assert hits >= 4
