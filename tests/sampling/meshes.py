"""Meshes whose values are asked for."""

from __future__ import annotations

import torch

from difftetvr.mesh import TetMesh


def bent_mesh(seed: int = 0, dtype: torch.dtype = torch.float64) -> TetMesh:
    """A Delaunay mesh of random points without a third of its cells."""
    generator = torch.Generator().manual_seed(seed)
    mesh = TetMesh.delaunay(torch.rand(60, 3, generator=generator, dtype=torch.float64))
    kept = torch.rand(mesh.num_cells, generator=generator) > 0.33
    return TetMesh(mesh.vertices, mesh.tets[kept]).to(dtype=dtype)
