"""Delaunay meshes of point sets, made valid where points are cospherical or the hull has flat cells."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.quality import quality
from difftetvr.mesh.topology.faces import face_vertices, match_faces
from difftetvr.mesh.validation import as_vertices, orientations

_FLATNESS = (0.0, 1e-12, 1e-9)
"""Qualities up to which a cell on the hull counts as flat, tried in order; the last is rounding in float64."""

_TIE_BREAK = 1e-6
"""Perturbation of a point's squared norm, in units of the squared mean spacing of the points."""

_ATTEMPTS = 3


def delaunay(points: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangulate the convex hull of points such that no point lies inside a cell's circumsphere.

    Qhull returns flat cells where points are coplanar or cospherical. On the hull they are peeled off: cells of zero
    volume, and only if the rest is no valid mesh then also cells that are flat up to rounding (quality below 1e-12,
    then 1e-9). Nothing is ever dropped from the interior. If flat cells, overlaps or mismatched diagonals remain there,
    as in regular lattices, the points are triangulated anew with the ties broken: squared norms in the lifting are
    shifted by at most 1e-6 of the squared point spacing, which makes no flat cells and violates the Delaunay property
    by no more than that. Positions never move.

    Args:
        points: (V, 3) positions, array-like, not all in one plane; a float32 or float64 tensor is kept as it is.

    Returns:
        The points as (V, 3) vertices, and positive cells (T, 4) int32. Duplicate points stay as unused vertices.

    Raises:
        MeshError: Fewer than four points, points not finite or in one plane, or no valid mesh was found.
    """
    vertices = as_vertices(points)
    positions = vertices.detach().double().cpu().numpy()
    not_finite = np.flatnonzero(~np.isfinite(positions).all(1))
    if not_finite.size:
        raise MeshError(f"Point {not_finite[0]} is at {positions[not_finite[0]].tolist()}; pass finite positions.")
    if len(positions) < 4:
        raise MeshError(
            f"No tetrahedron has {counted(len(positions), 'point')}; pass at least 4 that are not in one plane."
        )
    lower, upper = positions.min(0), positions.max(0)
    extent = (upper / 2 - lower / 2).max()
    if not extent > 0:
        raise MeshError("All points coincide; pass at least 4 that are not in one plane.")
    normalised = (positions / 2 - lower / 4 - upper / 4) / extent

    try:
        candidates = [_qhull(normalised)]
    except QhullError as error:
        raise MeshError("The points lie in one plane or nearly so; pass points that span a volume.") from error
    for candidate in itertools.chain(candidates, _with_broken_ties(normalised)):
        for flat_below in _FLATNESS:
            tets = _peel(vertices, torch.from_numpy(candidate).to(vertices.device), flat_below)
            if tets is not None:
                return vertices, tets
    raise MeshError(
        "The Delaunay mesh of the points has flat or overlapping cells inside, as many points lie on common planes or "
        "spheres; move the points by a small random amount."
    )


def _qhull(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return Delaunay(points).simplices.astype(np.int32)


def _with_broken_ties(points: NDArray[np.float64]) -> Iterator[NDArray[np.int32]]:
    """Lower hulls of the lifted points with noise: regular triangulations, whose cells all have volume."""
    spacing = 2.0 / len(points) ** (1.0 / 3.0)
    squares = (points**2).sum(1)
    for seed in range(_ATTEMPTS):
        noise = np.random.default_rng(seed).random(len(points))
        try:
            hull = ConvexHull(np.column_stack((points, squares + _TIE_BREAK * spacing**2 * noise)))
        except QhullError:
            continue
        yield hull.simplices[hull.equations[:, 3] < 0].astype(np.int32)


def _peel(vertices: torch.Tensor, tets: torch.Tensor, flat_below: float) -> torch.Tensor | None:
    """Drop flat cells from the hull inwards and orient the others; None where the rest is no valid mesh."""
    flat = quality(vertices.detach(), tets).abs() <= flat_below
    while flat.any():
        on_hull = (match_faces(tets, vertices.shape[0]).cell_adjacency < 0).any(1)
        kept = ~(flat & on_hull)
        if kept.all():
            break
        tets, flat = tets[kept], flat[kept]
    if not tets.shape[0]:
        return None

    # Flat cells that are left lie inside. They may stay if the stored positions give them a volume after all.
    signs = orientations(vertices, tets)
    tets = torch.where((signs < 0)[:, None], tets[:, [0, 1, 3, 2]], tets).contiguous()
    matching = match_faces(tets, vertices.shape[0])
    positive = (quality(vertices.detach(), tets) > 0).all() and (signs != 0).all()
    matched = not matching.crowded.numel() and not matching.folded.numel()
    return tets if positive and matched and _bounds_a_ball(tets, matching.cell_adjacency) else None


def _bounds_a_ball(tets: torch.Tensor, cell_adjacency: torch.Tensor) -> bool:
    """Whether the boundary is one closed surface of Euler characteristic 2.

    Faces that fail to match inside a mesh, such as those with crossed diagonals, would be boundary faces of their own.
    """
    faces = face_vertices(tets, true_indices((cell_adjacency < 0).view(-1))).long()
    ends = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).sort(1).values
    edges, uses = torch.unique((ends[:, 0] << 32) | ends[:, 1], return_counts=True)
    characteristic = torch.unique(faces).numel() - edges.numel() + faces.shape[0]
    return bool((uses == 2).all()) and characteristic == 2
