"""Values at points: against brute force in float64, exact for linear fields, with holes and loose cells."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from sampling.meshes import bent_mesh
from torch import Tensor

from difftetvr import probe
from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, render


def brute_force(mesh: TetMesh, points: Tensor) -> tuple[Tensor, Tensor]:
    """(P, T, 4) barycentric weights by solving for them, and (P,) which points are well inside or well outside."""
    corners = mesh.vertices.double()[mesh.tets.long()]
    matrix = torch.cat([corners.transpose(1, 2), torch.ones(len(corners), 1, 4, dtype=torch.float64)], dim=1)
    right = torch.cat([points.double(), torch.ones(len(points), 1, dtype=torch.float64)], dim=1)
    weights = torch.linalg.solve(matrix[None], right[:, None, :, None])[..., 0]
    return weights, (weights.amin(2).abs() > 1e-9).all(1)


def test_values_are_those_of_brute_force() -> None:
    mesh = bent_mesh()
    generator = torch.Generator().manual_seed(7)
    points = torch.rand(3000, 3, generator=generator, dtype=torch.float64)
    values = torch.rand(mesh.num_vertices, 3, generator=generator, dtype=torch.float64)
    weights, clear = brute_force(mesh, points)
    inside = weights.amin(2) >= 0
    best = inside.int().argmax(1)
    expected = (weights[torch.arange(len(points)), best][..., None] * values[mesh.tets.long()][best]).sum(1)
    found = probe(mesh, values, points)
    holds = inside.any(1)
    assert 500 < int(holds.sum()) < 2500
    assert bool((torch.isnan(found[:, 0]) == ~holds)[clear].all())
    assert float((found - expected)[holds].abs().max()) < 1e-9
    per_cell = torch.arange(mesh.num_cells, dtype=torch.float64)
    owner = probe(mesh, per_cell, points, outside=-1.0)
    assert torch.equal(owner[clear], torch.where(holds, best, -1)[clear].double())


@given(
    seed=st.integers(0, 2**31),
    scale=st.sampled_from([1e-6, 1.0, 1e6]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@examples(25)
def test_linear_fields_are_exact_everywhere_in_a_mesh(seed: int, scale: float, dtype: torch.dtype) -> None:
    """On vertices, edges and faces, too."""
    generator = torch.Generator().manual_seed(seed)
    grid = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    # No slivers, whose weights rounding moves by what they are thin.
    bent = grid.vertices + 0.1 * (torch.rand(grid.num_vertices, 3, generator=generator, dtype=torch.float64) - 0.5)
    mesh = grid.with_vertices(scale * bent).to(dtype=dtype)
    corners = mesh.vertices[mesh.tets.long()]
    places = [corners[:, 0], corners[:, :2].mean(1), corners[:, :3].mean(1), corners.mean(1)]
    direction = torch.randn(3, generator=generator, dtype=torch.float64).to(dtype)
    for place in places:
        found = probe(mesh, (mesh.vertices * direction).sum(1), place)
        assert float((found - (place * direction).sum(1)).abs().max()) < 100 * torch.finfo(dtype).eps * scale


def test_derivatives_by_finite_differences() -> None:
    mesh = bent_mesh()
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(25, 3, generator=generator, dtype=torch.float64)
    values = torch.randn(mesh.num_vertices, 2, generator=generator, dtype=torch.float64)

    def found(vertices: Tensor, values: Tensor, points: Tensor) -> Tensor:
        return probe(mesh.with_vertices(vertices), values, points, outside=0.5)

    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, values, points)]
    assert torch.autograd.gradcheck(found, leaves, nondet_tol=1e-12)


def test_places_are_in_world_space() -> None:
    local = bent_mesh()
    shift = torch.tensor([4.2e5, 5.4e6, 300.0], dtype=torch.float64)
    mesh = TetMesh(local.vertices + shift, local.tets).to(dtype=torch.float32)
    assert any(mesh.origin)
    points = local.vertices[local.tets.long()].mean(1)
    values = torch.rand(local.num_vertices, dtype=torch.float64)
    found = probe(mesh, values, points + shift)
    assert found.dtype == torch.float32
    assert float((found.double() - probe(local, values, points)).abs().max()) < 1e-4


def test_loose_cells_and_shapes() -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    corners = mesh.vertices[mesh.tets.long()]
    loose = TetMesh(corners.reshape(-1, 3), torch.arange(4 * mesh.num_cells).reshape(-1, 4), conforming=False)
    points = torch.rand(2, 5, 3, dtype=torch.float64)
    tensors = torch.rand(mesh.num_vertices, 3, 3, dtype=torch.float64)
    found = probe(mesh, tensors, points)
    assert found.shape == (2, 5, 3, 3)
    assert torch.allclose(probe(loose, tensors[mesh.tets.long()].reshape(-1, 3, 3), points), found)
    assert probe(mesh, tensors[:, 0, 0], points[0, 0]).shape == ()
    assert probe(mesh, tensors, torch.zeros(0, 3)).shape == (0, 3, 3)
    assert probe(mesh, torch.rand(mesh.num_vertices, 0), points).shape == (2, 5, 0)


def test_rays_see_what_probes_find() -> None:
    """The optical depth of a ray is the integral of the density that is probed along it."""
    mesh = bent_mesh()
    density = torch.rand(mesh.num_vertices, dtype=torch.float64)
    camera = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), fov_y=0.5, width=6, height=5)
    rays = camera.rays()
    t = torch.linspace(0.5, 4.0, 20001, dtype=torch.float64)
    along = probe(mesh, density, rays.at(t[:, None, None]), outside=0.0)
    depth = render(mesh, Field(torch.zeros(mesh.num_vertices, 0), density), rays).optical_depth
    assert float((torch.trapezoid(along, t, dim=0) - depth).abs().max()) < 1e-3
    assert float(depth.max()) > 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": torch.rand(7)}, "There are 7 values, but this mesh needs"),
        ({"values": torch.tensor(1.0)}, "pass one for each vertex or cell"),
        ({"values": "density"}, "The values is 'density'"),
        ({"values": Field(torch.rand(27, 3), torch.rand(27))}, r"values is a Field; .*field\.density"),
        ({"points": torch.rand(5, 2)}, r"points have shape \(5, 2\)"),
        ({"points": torch.full((2, 3), math.nan)}, "point is not finite"),
        ({"mesh": None}, "mesh is None"),
        ({"location": "face"}, "location"),
        ({"outside": "black"}, "outside is 'black'"),
    ],
)
def test_mistakes_get_one_sentence(change: dict[str, Any], message: str) -> None:
    mesh = TetMesh.grid((2, 2, 2))
    with pytest.raises(MeshError, match=message) as error:
        probe(**{"mesh": mesh, "values": torch.rand(27), "points": torch.rand(4, 3), **change})
    assert "\n" not in str(error.value)


@pytest.mark.gpu
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 5e-6), (torch.float64, 1e-12)])
def test_values_and_derivatives_on_a_gpu(dtype: torch.dtype, tolerance: float) -> None:
    generator = torch.Generator().manual_seed(11)
    points = torch.rand(500, 3, generator=generator, dtype=torch.float64).to(dtype)
    values = torch.rand(60, 2, generator=generator, dtype=torch.float64).to(dtype)
    found = []
    for device in ("cpu", "cuda"):
        mesh = bent_mesh(dtype=dtype).to(device)
        leaves = [part.to(device).requires_grad_() for part in (mesh.vertices.detach(), values, points)]
        at_points = probe(mesh.with_vertices(leaves[0]), leaves[1], leaves[2], outside=0.0)
        gradients = torch.autograd.grad((at_points * at_points.detach().cos()).sum(), leaves)
        found.append([part.detach().cpu() for part in (at_points, *gradients)])
    for on_cpu, on_gpu in zip(*found, strict=True):
        assert float((on_cpu - on_gpu).norm()) <= tolerance * float(on_cpu.norm())
