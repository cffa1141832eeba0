"""Whether a mesh is convex, and whether it is Delaunay: checks of what others have built.

Positions count as rounded to float32 even if they are float64, as most were float32 once: a plane that was rotated and
rounded is a plane still. So dents and violations as small as that pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from difftetvr.mesh.arrays import chunks
from difftetvr.mesh.topology.topology import Topology

_ROUNDINGS = 8.0
"""Roundings that a coordinate may be off: some of its own, and the sum over a cell's corners."""

_PLACE_BITS = 32


def is_convex(vertices: torch.Tensor, topology: Topology) -> bool:
    """Whether a mesh fills the convex hull of its cells, up to rounding.

    Its boundary has to be one closed surface, convex or flat at every edge: such a surface is that of a convex body
    (Tietze and Nakajima, 1928). That holds for meshes that do not overlap themselves, which is not checked.

    Args:
        vertices: (V, 3) float32 or float64 positions at which all cells are positive; detached.
        topology: The cells, conforming; vertices that none of them uses do not matter.

    Returns:
        False for holes, hollows, several components, or components that meet at an edge or a vertex only.
    """
    creases = boundary_creases(topology)
    if creases is None:
        return False
    positions, noise = _centered(vertices, topology)
    a, b, c, d = positions[creases].unbind(1)
    ab, ac, ad = b - a, c - a, d - a
    heights = (torch.linalg.cross(ab, ac) * ad).sum(1)
    longest_squared = torch.stack((ab, ac, ad)).square().sum(2).amax(0)
    return bool((heights <= noise * longest_squared).all())


def is_delaunay(vertices: torch.Tensor, topology: Topology) -> bool:
    """Whether no vertex of a mesh's cells lies inside the circumsphere of a cell, and the cells fill the hull.

    Both up to rounding, so that all meshes of cospherical points pass. The neighbours' far vertices are all that is
    looked at: in a convex mesh the others follow (Delaunay, 1934).

    Args:
        vertices: (V, 3) float32 or float64 positions at which all cells are positive; detached.
        topology: The cells, conforming; vertices that none of them uses do not matter.

    Returns:
        False also for parts of a Delaunay mesh that are not convex.
    """
    if not is_convex(vertices, topology):
        return False
    positions, noise = _centered(vertices, topology)
    return all(
        _spheres_are_empty(positions, topology, part, noise)
        for part in chunks(topology.num_cells, positions.device, width=4)
    )


@dataclass(frozen=True)
class CellShape:
    """Shapes of N cells seen from their first corners. Vectors lie by coordinate, so that arithmetic runs along memory.

    Attributes:
        origin: (3, N) float64, the first corner.
        edges: Three (3, N), the other corners relative to the first.
        squares: (3, N), their squared lengths.
        normals: Three (3, N), inward normals of the faces opposite these corners, as long as twice the face's area.
        determinants: (N,) six times the volume.
    """

    origin: torch.Tensor
    edges: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    squares: torch.Tensor
    normals: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    determinants: torch.Tensor

    @staticmethod
    def of(positions: torch.Tensor, tets: torch.Tensor) -> CellShape:
        """The shapes of cells.

        Args:
            positions: (V, 3) float64.
            tets: (N, 4) int32 vertex indices.
        """
        origin, *others = (positions.index_select(0, column).t().contiguous() for column in tets.unbind(1))
        a, b, c = (corner - origin for corner in others)
        squares = torch.stack((dot(a, a), dot(b, b), dot(c, c)))
        normals = _cross(b, c), _cross(c, a), _cross(a, b)
        return CellShape(origin, (a, b, c), squares, normals, dot(a, normals[0]))

    def diameters(self) -> torch.Tensor:
        """(3, N) from the first corner through the centre of the circumsphere to its other side; not finite if flat."""
        a, b, c = (square * normal for square, normal in zip(self.squares, self.normals))
        return (a + b + c) / self.determinants


def dot(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """(N,) scalar products of vectors by coordinate, (3, N)."""
    (px, py, pz), (qx, qy, qz) = p, q
    return px * qx + py * qy + pz * qz


def _cross(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    (px, py, pz), (qx, qy, qz) = p, q
    return torch.stack((py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx))


def boundary_creases(topology: Topology) -> torch.Tensor | None:
    """(E, 4) int64 a, b, c, d for each edge (a, b) of the boundary between the faces a, b, c and b, a, d.

    None if the boundary is no single surface with two faces at every edge.
    """
    return topology.cached("delaunay_check.creases", lambda: _boundary_creases(topology))


def _boundary_creases(topology: Topology) -> torch.Tensor | None:
    faces = topology.boundary_faces.long()
    ends = torch.cat((faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]))
    keys = (ends[:, :2].amin(1) << _PLACE_BITS) | ends[:, :2].amax(1)
    keys, places = torch.sort(keys)
    if keys.shape[0] % 2 or (keys[::2] != keys[1::2]).any() or (keys[1:-1:2] == keys[2::2]).any():
        return None
    one, other = places[::2], places[1::2]
    count = faces.shape[0]
    pairs = (torch.stack((one, other)) % count).cpu().numpy()
    graph = coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(count, count))
    if connected_components(graph, directed=False, return_labels=False) != 1:
        return None
    return torch.cat((ends[one], ends[other, 2:]), 1)


def _centered(vertices: torch.Tensor, topology: Topology) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions in float64 around the origin, with a size of about 1, and by how much rounding may have moved them."""
    used = vertices.detach()[topology.boundary_faces.view(-1).long()].double()
    lower, upper = used.amin(0), used.amax(0)
    extent = (upper - lower).amax()
    coordinate = torch.maximum(lower.abs(), upper.abs()).amax() / extent
    relative = coordinate * torch.finfo(vertices.dtype).eps
    noise = _ROUNDINGS * relative.clamp_min(torch.finfo(torch.float32).eps)
    return (vertices.detach().double() - lower) / extent, noise


def _spheres_are_empty(positions: torch.Tensor, topology: Topology, part: slice, noise: torch.Tensor) -> bool:
    """Whether no sphere of a slice of the cells has a neighbour's far vertex in it by more than noise explains."""
    tets, neighbors = topology.tets[part].long(), topology.cell_adjacency[part]
    cells = CellShape.of(positions, topology.tets[part])
    diameters = cells.diameters()
    longest_squared = cells.squares.amax(0)
    # Moving corners by `noise` tilts a thin cell's planes, and with them the diameter, by this much per unit of length.
    tilt = longest_squared / cells.determinants.abs()
    size = dot(diameters, diameters).sqrt() + longest_squared.sqrt()
    # Two neighbours share all but one vertex each, so that is what the sums of their indices differ by. Where there is
    # no neighbour the cell's own vertex stands in, which is on the sphere.
    far = torch.where(neighbors < 0, tets, topology.tets[neighbors].sum(2) - tets.sum(1, keepdim=True) + tets)
    for k in range(4):
        offsets = positions.index_select(0, far[:, k]).t() - cells.origin
        squared_lengths = dot(offsets, offsets)
        lengths = squared_lengths.sqrt()
        powers = squared_lengths - dot(offsets, diameters)
        inside = powers < -noise * (size + lengths) * (1.0 + lengths * tilt)
        if inside.any():
            return False
    return True
