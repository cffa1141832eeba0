"""Meshes made from nothing but sizes or points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.faces import MAX_CELLS

_MAX_VERTICES = 2**31 - 1


def grid(
    shape: Sequence[int],
    lower: Sequence[float],
    upper: Sequence[float],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Kuhn's subdivision of a box: nx * ny * nz equal boxes ("cubes") of six tetrahedra each.

    Each cube is cut along its diagonal from lowest to highest corner, one tetrahedron for each order in which a path
    along the axes can take that diagonal. All cubes are cut alike, so neighbours agree on the diagonal of their common
    face: the mesh is conforming. All cells are positive.

    Args:
        shape: Numbers of cubes (nx, ny, nz), each >= 1.
        lower: Lowest corner of the box.
        upper: Highest corner of the box, > lower on every axis.
        dtype: torch.float32 or torch.float64.
        device: Where the mesh shall lie; None is torch's default.

    Returns:
        Vertices ((nx + 1)(ny + 1)(nz + 1), 3), x running fastest: vertex (i, j, k) is row
        i + (nx + 1)(j + (ny + 1) k); and tets (6 nx ny nz, 4) int32, the cells of cube (i, j, k) in rows 6 c to 6 c + 5
        with c = i + nx (j + ny k).

    Raises:
        MeshError: A size is no positive integer, the box is empty or not finite, the mesh would be too large, or the
            cubes are too small for the precision of dtype.
    """
    if len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
        raise MeshError(f"The grid's shape is {tuple(shape)}; pass three numbers of cubes, each at least 1.")
    if len(lower) != 3 or len(upper) != 3:
        raise MeshError(f"The grid's box goes from {lower} to {upper}; pass three coordinates for each corner.")
    nx, ny, nz = (int(n) for n in shape)
    if 6 * nx * ny * nz > MAX_CELLS or (nx + 1) * (ny + 1) * (nz + 1) > _MAX_VERTICES:
        raise MeshError(f"A grid of {nx} x {ny} x {nz} cubes has more than {MAX_CELLS} cells; pass fewer cubes.")
    counts = (nx, ny, nz)
    axes = [_axis("xyz"[i], float(lower[i]), float(upper[i]), counts[i], dtype).to(device) for i in range(3)]
    z, y, x = torch.meshgrid(*reversed(axes), indexing="ij")
    vertices = torch.stack((x, y, z), -1).view(-1, 3)

    steps = (1, nx + 1, (nx + 1) * (ny + 1))
    i, j, k = (torch.arange(n, dtype=torch.int32, device=device) * step for n, step in zip((nx, ny, nz), steps))
    corner = (k[:, None, None] + j[:, None] + i).view(-1, 1, 1)
    tets = corner + torch.tensor(_kuhn_cells(steps), dtype=torch.int32, device=device)
    return vertices, tets.view(-1, 4)


def _axis(name: str, lower: float, upper: float, count: int, dtype: torch.dtype) -> torch.Tensor:
    if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
        raise MeshError(f"The grid's box goes from {lower} to {upper} along {name}; pass finite ends, lower < upper.")
    ticks = torch.linspace(lower, upper, count + 1, dtype=torch.float64).to(dtype)
    if not (ticks[1:] > ticks[:-1]).all():
        raise MeshError(
            f"{dtype} cannot tell apart {count + 1} positions from {lower} to {upper} along {name}; pass fewer cubes, "
            "a box closer to the origin, or dtype=torch.float64."
        )
    return ticks


def _kuhn_cells(steps: tuple[int, int, int]) -> list[list[int]]:
    """Vertex indices of a cube's six positive cells relative to its lowest corner."""
    cells = []
    for first, second, _ in itertools.permutations(range(3)):
        path = [0, steps[first], steps[first] + steps[second], sum(steps)]
        is_odd = (second - first) % 3 != 1
        if is_odd:
            path[2], path[3] = path[3], path[2]
        cells.append(path)
    return cells
