"""Meshes that a reconstruction begins with where no file gives one: made for what the images show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from difftetvr.capture.capture import Capture
from difftetvr.capture.hull import VisualHull
from difftetvr.capture.viewing import Floats
from difftetvr.errors import FitError
from difftetvr.fitting.beginning.requirements import require_memory_for
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.refinement import Strategy
from difftetvr.mesh.limits import CELLS_PER_CUBE
from difftetvr.mesh.making.generators import grid_cubes, grid_with_shell, shell_has_room, without_pinches
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import Topology

_GROWTH = 1.6  # of the cubes from one layer of a shell to the next
_MOST_OVER = 1.2  # times the budget
_CLOSE_ENOUGH = 0.03  # of the budget
_ATTEMPTS, _FINEST = 8, 32
_CELLS_PER_POINT = 6.7  # of the Delaunay mesh of random points
_POINTS_SHARE = 0.5
_LATTICE_POINTS_PER_CUBE = 2
_CROWDED = 0.5  # of the spacing: where points of the scene are that near, those of the lattice give way


def starting_mesh(capture: Capture, config: FitConfig, strategy: Strategy | None) -> TetMesh:
    """The mesh that the options ask for, on the CPU.

    Args:
        capture: Images, cameras and where the scene is.
        config: Options, chosen for the capture.
        strategy: How the mesh is refined; says how many of the budget's cells to begin with.

    Raises:
        FitError: The images lack what the options ask for, or the memory does not suffice for the mesh.
        MeshError: The mesh would be too large.
    """
    cells = strategy.initial_cells(config.budget) if strategy else config.budget
    require_memory_for(config.budget if config.grid is None else _cells_of(config.grid), config, strategy)
    if config.start == "hull":
        return _hull_mesh(capture, config.grid, cells)
    if config.start == "points":
        return _point_mesh(capture, cells)
    return _grid_mesh(capture, config.grid, cells)


def _cells_of(cubes: Sequence[int]) -> int:
    return CELLS_PER_CUBE * math.prod(cubes)


def _grid_mesh(capture: Capture, cubes: Sequence[int] | None, cells: int) -> TetMesh:
    """The Kuhn grid over the bounds; where there are surroundings, with a shell of growing cubes around it."""
    growth, sides = capture.surroundings, _sides(capture)
    # As many layers as grow that fast, fewer where there are only cells for thick ones.
    for layers in range(math.ceil(math.log(growth) / math.log(_GROWTH)), 0, -1):
        shape = cubes or grid_cubes(cells, sides, layers)
        count = CELLS_PER_CUBE * math.prod(n + 2 * layers for n in shape)
        if shell_has_room(shape, layers, growth) and (layers == 1 or cubes or count <= _MOST_OVER * cells):
            vertices, tets = grid_with_shell(shape, layers, capture.bounds.tolist(), growth)
            return TetMesh.from_valid(vertices, Topology(tets, vertices.shape[0]))
    # Without surroundings, or where these are thinner than a cube.
    return TetMesh.grid(cubes or grid_cubes(cells, sides), *capture.outer_bounds.tolist())


def _hull_mesh(capture: Capture, cubes: Sequence[int] | None, cells: int) -> TetMesh:
    """The grid without the cubes that silhouettes rule out, as fine as makes the rest fill the budget."""
    masks = capture.silhouettes
    if masks is None:
        raise FitError(
            f"Nothing tells the object of '{capture.name}' from its background, as the start from its hull needs; use "
            "--start grid."
        )
    train = capture.train_indices.tolist()
    hull = VisualHull.of([capture.cameras[view] for view in train], masks)
    fine, best = cells, None
    for _ in range(_ATTEMPTS):
        shape = cubes or grid_cubes(fine, _sides(capture))
        kept = _kept_cubes(hull, capture, shape)
        found = CELLS_PER_CUBE * int(kept.sum())
        if best is None or abs(found - cells) < best[0]:
            best = abs(found - cells), shape, kept
        # A hull that fills next to nothing of its bounds begins with fewer cells; refinement adds the others.
        finer = min(round(fine * cells / max(found, 1)), _FINEST * cells)
        if best[0] <= _CLOSE_ENOUGH * cells or finer in (0, fine) or cubes:
            break
        fine = finer
    assert best is not None
    if not best[2].any():
        raise FitError(
            f"No place in the bounds of '{capture.name}' lies within the silhouettes of all training views; check the "
            "bounds and the cameras' poses, or use --start grid."
        )
    return _carved(capture, *best[1:])


def _kept_cubes(hull: VisualHull, capture: Capture, shape: Sequence[int]) -> NDArray[np.bool_]:
    """(nz, ny, nx), the cubes of a grid over the bounds that the hull meets, and those next to them."""
    lower, upper = capture.bounds.double().numpy()
    axes = [lower[a] + (upper[a] - lower[a]) * (np.arange(shape[a]) + 0.5) / shape[a] for a in range(3)]
    z, y, x = np.meshgrid(*reversed(axes), indexing="ij")
    side = float(((upper - lower) / shape).max())
    kept = hull.keeps(np.stack((x, y, z), axis=-1).reshape(-1, 3), side, 1.0 / len(hull.cameras)).reshape(x.shape)
    # One more layer all around, so that the object's surface is free to move.
    return without_pinches(ndimage.binary_dilation(kept, np.ones((3, 3, 3), dtype=bool)))


def _carved(capture: Capture, shape: Sequence[int], kept: NDArray[np.bool_]) -> TetMesh:
    mesh = TetMesh.grid(shape, *capture.bounds.tolist())
    tets = mesh.tets[torch.from_numpy(kept.reshape(-1)).repeat_interleave(CELLS_PER_CUBE)]
    used, tets = torch.unique(tets, return_inverse=True)
    return TetMesh.from_valid(mesh.vertices[used.long()], Topology(tets.int(), used.shape[0]))


def _point_mesh(capture: Capture, cells: int) -> TetMesh:
    """The Delaunay mesh of the scene's points, thinned where they are too many, and of a lattice that fills the rest.

    The lattice is body-centred cubic, whose Delaunay cells are the best that fill space alike. It grows coarser
    through the surroundings as the grid's shell does.
    """
    if capture.scene_points is None:
        raise FitError(f"'{capture.name}' has no points within its bounds to start from; use --start grid.")
    count = cells / _CELLS_PER_POINT
    edge = float(((capture.bounds[1] - capture.bounds[0]).prod() / count) ** (1 / 3))
    points = _thinned(capture.scene_points.double().numpy(), max(1, round(_POINTS_SHARE * count)), _CROWDED * edge)
    cubes = max(1, round((count - len(points)) / _LATTICE_POINTS_PER_CUBE))
    grid = _grid_mesh(capture, None, CELLS_PER_CUBE * cubes)
    corners = grid.vertices.double().numpy()
    centers = corners[grid.tets.view(-1, CELLS_PER_CUBE * 4).numpy()].mean(1)
    lattice = np.concatenate((corners, centers))
    spacing = cKDTree(lattice).query(lattice, 2)[0][:, 1]
    is_kept = cKDTree(points).query(lattice)[0] > _CROWDED * spacing
    # The outer box keeps its shape.
    is_kept[: len(corners)] |= (corners <= corners.min(0)).any(1) | (corners >= corners.max(0)).any(1)
    return TetMesh.delaunay(torch.from_numpy(np.concatenate((lattice[is_kept], points)).astype(np.float32)))


def _thinned(points: Floats, most: int, apart: float) -> Floats:
    """One point of each of equal boxes, whose sides are so long that there are at most so many."""
    while True:
        boxes = ((points - points.min(0)) / apart).astype(np.int64)
        first = np.unique(np.ravel_multi_index(tuple(boxes.T), boxes.max(0) + 1), return_index=True)[1]
        points = points[np.sort(first)]
        if len(points) <= most:
            return points
        apart *= 1.1


def _sides(capture: Capture) -> list[float]:
    return (capture.bounds[1] - capture.bounds[0]).tolist()
