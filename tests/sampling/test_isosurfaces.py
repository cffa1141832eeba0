"""Surfaces of a level: closed, oriented, where they belong, and differentiable."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from difftetvr import isosurface, probe
from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.sampling.isosurfaces import at_vertices, crossed_edges


def sides(triangles: Tensor) -> Counter[tuple[int, int]]:
    """Directed sides of triangles, which appear once each where the surface is oriented."""
    return Counter((int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3))


@given(seed=st.integers(0, 2**31), levels=st.sampled_from([2, 3, 5, 1000]))
@examples(30)
def test_surfaces_are_closed_but_at_the_boundary_and_oriented(seed: int, levels: int) -> None:
    """Also where scalars are at the level, in whole regions."""
    generator = torch.Generator().manual_seed(seed)
    mesh = TetMesh.delaunay(torch.rand(40, 3, generator=generator, dtype=torch.float64))
    scalar = torch.randint(levels, (mesh.num_vertices,), generator=generator).double()
    level = float(levels // 2)
    places, triangles = isosurface(mesh, scalar, level)
    found = sides(triangles)
    assert all(count == 1 for count in found.values())
    boundary = mesh.topology.boundary_faces.long()
    rim = [side for side in found if side[::-1] not in found]
    for begin, end in rim:
        middle = 0.5 * (places[begin] + places[end])
        corners = mesh.vertices[boundary]
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        distance = (((middle - corners[:, 0]) * normals).sum(1) / normals.norm(dim=1)).abs()
        assert float(distance.min()) < 1e-9
    if len(places):
        assert int(triangles.max()) == len(places) - 1
        values = probe(mesh, scalar, places, outside=level)
        assert float((values - level).abs().max()) < 1e-6


def test_a_sphere_has_the_area_of_one_and_looks_where_the_scalar_is_low() -> None:
    mesh = TetMesh.grid((24, 24, 24), (-1, -1, -1), (1, 1, 1))
    places, triangles = isosurface(mesh, -mesh.vertices.norm(dim=1), -0.7)
    a, b, c = (places[triangles[:, k]] for k in range(3))
    normals = torch.linalg.cross(b - a, c - a)
    assert float(0.5 * normals.norm(dim=1).sum()) == pytest.approx(4 * math.pi * 0.49, rel=5e-3)
    assert bool(((normals * (a + b + c)).sum(1) > 0).all())
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert volume == pytest.approx(4 / 3 * math.pi * 0.343, rel=1e-2)


def test_derivatives_by_finite_differences() -> None:
    generator = torch.Generator().manual_seed(2)
    mesh = TetMesh.delaunay(torch.rand(20, 3, generator=generator, dtype=torch.float64))
    scalar = torch.randn(mesh.num_vertices, generator=generator, dtype=torch.float64)

    def places(vertices: Tensor, scalar: Tensor, level: Tensor) -> Tensor:
        return isosurface(mesh.with_vertices(vertices), scalar, level)[0]

    level = torch.tensor(0.1, dtype=torch.float64)
    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, scalar, level)]
    assert torch.autograd.gradcheck(places, leaves)


def test_places_are_in_world_space() -> None:
    local = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    shift = torch.tensor([4.2e5, 5.4e6, 300.0], dtype=torch.float64)
    mesh = TetMesh(local.vertices + shift, local.tets).to(dtype=torch.float32)
    scalar = local.vertices.sum(1)
    near, far = isosurface(local, scalar, 1.4)[0], isosurface(mesh, scalar, 1.4)[0]
    assert far.dtype == torch.float64
    assert float((far - shift - near).abs().max()) < 1e-5


def test_levels_out_of_reach_have_no_surface() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    places, triangles = isosurface(mesh, mesh.vertices[:, 0], 2.0)
    assert places.shape == (0, 3)
    assert triangles.shape == (0, 3)


def test_differences_of_values_do_not_overflow() -> None:
    mesh = TetMesh.grid((1, 1, 1))
    signs = torch.where(torch.arange(8) % 2 == 0, 1.0, -1.0)
    assert torch.equal(isosurface(mesh, 3e38 * signs, 0.0)[0], isosurface(mesh, signs, 0.0)[0])


def test_other_values_on_a_surface_are_those_of_probes() -> None:
    generator = torch.Generator().manual_seed(3)
    mesh = TetMesh.delaunay(torch.rand(40, 3, generator=generator, dtype=torch.float64))
    scalar = torch.rand(mesh.num_vertices, generator=generator, dtype=torch.float64)
    colors = torch.rand(mesh.num_vertices, 3, generator=generator, dtype=torch.float64)
    edges = crossed_edges(mesh, scalar, 0.5)
    assert torch.equal(edges.interpolated(mesh.vertices), isosurface(mesh, scalar, 0.5)[0])
    assert float((edges.interpolated(scalar) - 0.5).abs().max()) < 1e-12
    expected = probe(mesh, colors, edges.interpolated(mesh.vertices))
    assert float((edges.interpolated(colors) - expected).abs().max()) < 1e-9


def test_means_at_vertices_are_weighted_by_volume() -> None:
    generator = torch.Generator().manual_seed(4)
    mesh = TetMesh.delaunay(torch.rand(20, 3, generator=generator, dtype=torch.float64))
    values = torch.rand(mesh.num_cells, 2, generator=generator, dtype=torch.float64)
    found = at_vertices(mesh, values)
    for vertex in range(mesh.num_vertices):
        around = (mesh.tets == vertex).any(1)
        volumes = mesh.volumes()[around, None]
        assert torch.allclose(found[vertex], (volumes * values[around]).sum(0) / volumes.sum())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.rand(27, 3), 0.5), "3 values for each vertex"),
        ((torch.rand(48), 0.5), "needs 27"),
        ((torch.full((27,), math.nan), 0.5), "scalar is not finite"),
        ((torch.rand(27), math.inf), "level is inf"),
        ((torch.rand(27), "half"), "level is 'half'"),
    ],
)
def test_mistakes_get_one_sentence(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(MeshError, match=message) as error:
        isosurface(TetMesh.grid((2, 2, 2)), *arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("level", [torch.tensor([[0.5]], dtype=torch.float64), torch.tensor([0.5]), 0.5])
def test_levels_are_one_number_and_leave_the_precision(level) -> None:
    mesh = TetMesh.grid((2, 2, 2))
    places, triangles = isosurface(mesh, mesh.vertices[:, 0] + 0.1, level)
    assert places.dtype == torch.float32 and len(triangles)
    assert torch.equal(places, isosurface(mesh, mesh.vertices[:, 0] + 0.1, 0.5)[0])


@pytest.mark.parametrize(
    "level", [torch.tensor(0.5 + 0j), torch.tensor([0.1, 0.2]), torch.tensor(float("nan")), "high"]
)
def test_other_levels_are_refused(level) -> None:
    mesh = TetMesh.grid((2, 2, 2))
    with pytest.raises(MeshError, match="level is"):
        isosurface(mesh, mesh.vertices[:, 0], level)
