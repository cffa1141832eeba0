"""Voxels: what probes find at their sample points, means over them, and grids larger and smaller than the mesh."""

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

from difftetvr import probe, voxelise
from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.sampling.location import Lattice


@given(
    seed=st.integers(0, 2**31),
    shape=st.tuples(*[st.integers(1, 14)] * 3),
    step=st.floats(0.01, 0.4),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@examples(25)
def test_centres_have_the_values_of_probes(
    seed: int, shape: tuple[int, int, int], step: float, dtype: torch.dtype
) -> None:
    mesh = bent_mesh(seed % 5, dtype)
    generator = torch.Generator().manual_seed(seed)
    first = (1.2 * torch.rand(3, generator=generator, dtype=torch.float64) - 0.2).tolist()
    values = torch.rand(mesh.num_vertices, 2, generator=generator, dtype=torch.float64)
    found = voxelise(mesh, values, first, step, shape, outside=-1.0)
    points = Lattice(tuple(first), (step,) * 3, shape).points(torch.float64, mesh.vertices.device)
    expected = probe(mesh, values, points, outside=-1.0)
    assert found.shape == (*shape, 2)
    differs = (found - expected).abs().amax(-1) > 1e-3
    # On the boundary itself rounding decides.
    assert int(differs.sum()) <= (0 if dtype == torch.float64 else 2)


def test_points_on_vertices_edges_and_faces_belong_to_the_mesh() -> None:
    mesh = TetMesh.grid((4, 4, 4), dtype=torch.float32)
    values = mesh.vertices @ torch.tensor([1.0, 10.0, 100.0])
    grid = voxelise(mesh, values, (0, 0, 0), 0.125, (9, 9, 9), outside=math.nan)
    axis = torch.arange(9) / 8.0
    expected = axis[:, None, None] + 10.0 * axis[None, :, None] + 100.0 * axis
    assert float((grid - expected).abs().max()) < 1e-4
    cells = voxelise(mesh, torch.arange(mesh.num_cells).float(), (0, 0, 0), 0.125, (9, 9, 9), outside=-1.0)
    assert float(cells.min()) == 0.0


def test_means_over_samples() -> None:
    mesh = bent_mesh()
    values = torch.rand(mesh.num_vertices, dtype=torch.float64)
    mean = voxelise(mesh, values, (0.1, 0.2, 0.3), (0.2, 0.3, 0.1), (3, 2, 4), samples=3)
    step = torch.tensor([0.2, 0.3, 0.1], dtype=torch.float64) / 3
    first = (torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64) - step).tolist()
    fine = voxelise(mesh, values, first, step, (9, 6, 12))
    expected = fine.reshape(3, 3, 2, 3, 4, 3).mean(dim=(1, 3, 5))
    assert float((mean - expected).abs().max()) < 1e-12
    # A box that the grid's voxels cut: the share of each that lies inside.
    box = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    share = voxelise(box, torch.ones(27), (0.0, 0.5, 0.5), 0.5, (1, 1, 1), samples=8)
    assert float(share) == pytest.approx(0.5)


def test_derivatives_by_finite_differences() -> None:
    mesh = bent_mesh()
    values = torch.randn(mesh.num_vertices, dtype=torch.float64)

    def grid(vertices: Tensor, values: Tensor) -> Tensor:
        return voxelise(mesh.with_vertices(vertices), values, (0.21, 0.22, 0.23), 0.13, (4, 3, 4), samples=2)

    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, values)]
    assert torch.autograd.gradcheck(grid, leaves, nondet_tol=1e-12)


def test_large_grids_are_made_in_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bent_mesh()
    values = torch.rand(mesh.num_vertices, dtype=torch.float64)
    arguments: tuple[Any, ...] = (mesh, values, (0.0, 0.0, 0.0), 0.07, (13, 11, 12))
    whole = voxelise(*arguments)
    monkeypatch.setattr("difftetvr.sampling.voxels.AT_ONCE", 300)
    assert torch.allclose(voxelise(*arguments), whole, atol=1e-12)


def test_places_are_in_world_space() -> None:
    local = bent_mesh()
    shift = torch.tensor([4.2e5, 5.4e6, 300.0], dtype=torch.float64)
    mesh = TetMesh(local.vertices + shift, local.tets).to(dtype=torch.float32)
    values = torch.rand(local.num_vertices, dtype=torch.float64)
    first = torch.tensor([0.31, 0.32, 0.33], dtype=torch.float64)
    near, far = voxelise(local, values, first, 0.05, (4, 4, 4)), voxelise(mesh, values, first + shift, 0.05, (4, 4, 4))
    assert float((near - far.double()).abs().max()) < 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": (0.0, 0.0)}, "origin is .*three finite numbers"),
        ({"spacing": 0.0}, "spacing is 0.0; .*greater than 0"),
        ({"spacing": (1.0, math.inf, 1.0)}, "spacing is"),
        ({"shape": (4, 4)}, r"shape is \(4, 4\)"),
        ({"shape": 4}, "shape is 4"),
        ({"shape": (4, 4, 0)}, "shape is"),
        ({"shape": (4, 4.5, 4)}, "shape is 4.5"),
        ({"shape": (10**5, 10**5, 10**5)}, "at most"),
        ({"samples": 0}, "samples is 0"),
        ({"values": torch.rand(5)}, "There are 5 values"),
    ],
)
def test_mistakes_get_one_sentence(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"values": torch.rand(27), "origin": (0, 0, 0), "spacing": 0.1, "shape": (4, 4, 4)}
    with pytest.raises(MeshError, match=message) as error:
        voxelise(TetMesh.grid((2, 2, 2)), **{**arguments, **change})
    assert "\n" not in str(error.value)


@pytest.mark.gpu
@pytest.mark.parametrize("samples", [1, 2])
def test_on_a_gpu(samples: int) -> None:
    mesh = bent_mesh()
    values = torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    grid = ((0.1, 0.0, -0.1), 0.08, (9, 12, 11))
    on_cpu = voxelise(mesh, values, *grid, samples=samples, outside=-1.0)
    on_gpu = voxelise(mesh.to("cuda"), values.to("cuda"), *grid, samples=samples, outside=-1.0)
    torch.testing.assert_close(on_gpu.cpu(), on_cpu, rtol=0.0, atol=1e-12)
