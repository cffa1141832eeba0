"""Meshes made from nothing but sizes or points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.errors import MeshError, shown
from difftetvr.mesh.limits import CELLS_PER_CUBE, MAX_CELLS

"""Tetrahedra of a cube in Kuhn's subdivision."""

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
        raise MeshError(f"The grid's shape is {shown(shape)}; pass three numbers of cubes, each at least 1.")
    if len(lower) != 3 or len(upper) != 3:
        raise MeshError(
            f"The grid's box goes from {shown(lower)} to {shown(upper)}; pass three coordinates for each corner."
        )
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


def grid_cubes(cells: int, extent: Sequence[float], layers: int = 0) -> tuple[int, int, int]:
    """Cubes along each axis of the Kuhn grid whose number of tetrahedra is nearest to a budget.

    Only grids whose boxes are nearly cubes compete: those that come from dividing each side of the box by one edge
    length and rounding.

    Args:
        cells: Budget of tetrahedra, >= 1.
        extent: (3,) sides of the box, in any unit, > 0.
        layers: Layers of cubes around the box that count, too.
    """
    sides = np.asarray(extent, dtype=np.float64)
    edge = (sides.prod() * CELLS_PER_CUBE / cells) ** (1 / 3)
    # With a shell the box has fewer cubes, down to a single one.
    edges = edge * np.exp(np.linspace(-0.5, 0.5 if layers == 0 else math.log(sides.max() / edge) + 0.5, 2001))
    candidates = np.maximum(1, np.rint(sides / edges[:, None])).astype(np.int64)
    counts = (candidates + 2 * layers).prod(axis=1) * CELLS_PER_CUBE
    error = np.where(counts <= MAX_CELLS, np.abs(counts - cells), np.inf)
    # Among equals the one whose edge is closest to that of exact cubes.
    best = np.lexsort((np.abs(np.log(edges / edge)), error))[0]
    nx, ny, nz = (int(n) for n in candidates[best])
    return nx, ny, nz


def grid_with_shell(
    shape: Sequence[int],
    layers: int,
    bounds: Sequence[Sequence[float]],
    growth: float,
    dtype: torch.dtype = torch.float32,
) -> tuple[torch.Tensor, torch.Tensor]:
    """A grid over a box and, around it, layers of cubes that grow by equal factors, from the box to a larger one.

    Args:
        shape: Numbers of cubes (nx, ny, nz) in the box, each >= 1.
        layers: Number of layers, >= 1.
        bounds: (2, 3) corners of the box.
        growth: How many times as large the box with its shell is, around the same centre; so large that no layer is
            thinner than a cube.
        dtype: torch.float32 or torch.float64.

    Returns:
        Vertices and cells as those of :func:`grid` with 2 ``layers`` more cubes on each axis.

    Raises:
        MeshError: See :func:`grid`; or a layer would be thinner than a cube.
    """
    if not shell_has_room(shape, layers, growth):
        raise MeshError(
            f"{layers} layers around {tuple(shape)} cubes are thinner than these if they grow by {growth:g} in all; "
            "pass fewer layers, more cubes or a larger growth."
        )
    cubes = torch.tensor(list(shape), dtype=torch.float64)
    # In units of cubes, with the corner of the box at 0.
    steps, tets = grid([n + 2 * layers for n in shape], [-layers] * 3, [n + layers for n in shape], torch.float64)
    layer = torch.maximum(-steps, steps - cubes).amax(1, keepdim=True).clamp_min(0.0)
    # Layer k bounds the box of growth^(k / layers) times the size.
    scale = growth ** (layer / layers) * cubes / (cubes + 2.0 * layer)
    lower, upper = (torch.tensor(list(corner), dtype=torch.float64) for corner in bounds)
    vertices = 0.5 * (lower + upper) + scale * (steps / cubes - 0.5) * (upper - lower)
    return vertices.to(dtype), tets


def shell_has_room(shape: Sequence[int], layers: int, growth: float) -> bool:
    """Whether no layer of :func:`grid_with_shell` would be thinner than a cube, so that all cells are positive."""
    return (growth ** (1.0 / layers) - 1.0) * min(shape) >= 2.0


def without_pinches(keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cubes of a grid, and as few others as make the surface around them a manifold.

    Where cubes, or gaps between them, touch only along an edge or in a corner, the block of eight around the corner is
    filled, until there is no such place.

    Args:
        keep: (nz, ny, nx) cubes to keep.

    Returns:
        Of the same shape; ``keep`` and those that were added.
    """
    filled = np.pad(keep, 1)
    inside = np.pad(np.ones_like(keep), 1)
    pinched = _pinched_blocks()
    corners = list(itertools.product((0, 1), repeat=3))
    shape = np.array(filled.shape) - 1
    while True:
        windows = [tuple(slice(c, c + n) for c, n in zip(corner, shape, strict=True)) for corner in corners]
        codes = sum(filled[window].astype(np.int64) << bit for bit, window in enumerate(windows))
        wrong = pinched[codes]
        before = int(filled.sum())
        for window in windows:
            filled[window] |= wrong & inside[window]
        if int(filled.sum()) == before:
            return filled[1:-1, 1:-1, 1:-1]


def _pinched_blocks() -> NDArray[np.bool_]:
    """(256,) which sets of the eight cubes around a corner, or their complements, do not hang together by faces."""

    def hangs_together(cubes: set[int]) -> bool:
        reached = set(list(cubes)[:1])
        while True:
            more = {cube ^ step for cube in reached for step in (1, 2, 4)} & cubes
            if more <= reached:
                return reached == cubes
            reached |= more

    everything = set(range(8))
    sets = [{cube for cube in everything if code >> cube & 1} for code in range(256)]
    return np.array([not (hangs_together(s) and hangs_together(everything - s)) for s in sets])
