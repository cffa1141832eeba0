"""What every change of a mesh must hold, and meshes to change."""

import numpy as np
import torch
from hypothesis import strategies as st

from difftetvr.mesh import TetMesh

SEEDS = st.integers(0, 2**32 - 1)


def random_mesh(seed, dtype=torch.float64):
    """A jittered grid or a Delaunay mesh of a few hundred cells, some far from the origin or in other units."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:
        mesh = TetMesh.grid(tuple(rng.integers(2, 5, 3).tolist()), upper=(1.0, 1.3, 0.8), dtype=torch.float64)
        step = 0.1 * mesh.vertex_altitudes()[:, None] * torch.from_numpy(rng.uniform(-1, 1, (mesh.num_vertices, 3)))
        mesh = mesh.with_vertices(mesh.vertices + step)
    else:
        mesh = TetMesh.delaunay(torch.from_numpy(rng.random((int(rng.integers(10, 80)), 3))))
    unit = float(rng.choice([1.0, 1.0, 1e-3, 1e6]))
    return mesh.with_vertices((mesh.vertices + rng.choice([0.0, 2.0])) * unit).to(dtype=dtype)


def boundary_area(mesh):
    a, b, c = mesh.vertices.double()[mesh.topology.boundary_faces.long()].unbind(1)
    return 0.5 * torch.linalg.vector_norm(torch.linalg.cross(b - a, c - a), dim=1).sum()


def cells_of(mesh):
    """Cells as a set of sorted vertex tuples."""
    return {tuple(sorted(cell)) for cell in mesh.tets.tolist()}


def check_change(old, change, *, keeps_cells=True):
    """Valid, conforming, oriented, of the same volume and boundary, and exact for linear fields.

    `keeps_cells`: every new cell lies inside its parent, and together they fill it.
    """
    new = change.mesh
    rebuilt = TetMesh(new.vertices, new.tets)  # full validation; swaps vertices of cells that are not positive
    assert torch.equal(rebuilt.tets, new.tets)
    assert torch.equal(rebuilt.topology.cell_adjacency, new.topology.cell_adjacency)
    assert new.tets.unique().numel() == new.num_vertices or old.tets.unique().numel() < old.num_vertices
    assert new.vertices.dtype == old.vertices.dtype and not new.vertices.requires_grad

    # Faces that fail to match would count as boundary: the same area means that none hangs.
    accuracy = 1e-9 if old.vertices.dtype == torch.float64 else 1e-4
    torch.testing.assert_close(boundary_area(new), boundary_area(old), rtol=accuracy, atol=0.0)
    volumes, old_volumes = new.volumes().double(), old.volumes().double()
    torch.testing.assert_close(volumes.sum(), old_volumes.sum(), rtol=accuracy, atol=0.0)
    if keeps_cells:
        inside = torch.zeros_like(old_volumes).index_add_(0, change.cell_parents, volumes)
        scale = old.bounds().diff(dim=0).abs().max().double() ** 3
        assert ((inside - old_volumes).abs() <= accuracy * (old_volumes + 1e-3 * scale)).all()

    assert change.parents.dtype == change.cell_parents.dtype == new.tets.dtype == torch.int32
    assert change.weight.dtype == torch.float32
    assert torch.equal(change.carry(old.vertices), new.vertices)
    matrix = torch.tensor([[1.0, 2.0], [-3.0, 0.5], [0.25, 4.0]], dtype=torch.float64)
    carried = change.carry(old.vertices.double() @ matrix)
    exact = new.vertices.double() @ matrix
    assert (carried - exact).abs().max() <= (1e-12 if accuracy < 1e-6 else 1e-5) * exact.abs().max()
    kept = ~change.is_new
    assert torch.equal(change.parents[kept, 0].unique(), change.parents[kept, 0])  # ascending, each once
