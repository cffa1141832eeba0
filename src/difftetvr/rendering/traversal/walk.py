"""One step of the walk from cell to cell along a ray (Dr.Jit).

A face holds the ray when its corners A, B, C, seen in the ray's plane, have three positive edge functions. The cell
behind it adds one vertex, the apex. The ray leaves through the face in which the apex replaces exactly one corner, and
three signs say which. Along a ray every cell has no or two faces that hold it, so a walk neither branches nor loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh.topology.topology import Topology
from difftetvr.rendering.traversal.rays import edge_function, is_left

BOUNDARY = 0xFFFFFFFF


@dataclass
class Corner:
    """A vertex as one ray sees it.

    Attributes:
        vertex: Index of the vertex.
        a: Offset from the ray's line along the frame's first axis.
        b: Offset along the second axis.
        values: Quantities interpolated linearly over faces; the first is the distance t along the ray.
        adjoints: Accumulated derivatives that belong to this vertex, scattered when the walk drops it.
    """

    vertex: Any
    a: Any
    b: Any
    values: list[Any]
    adjoints: list[Any]


@dataclass
class Face:
    """A face that holds the ray: corners counter-clockwise in the ray's plane and their edge functions."""

    corners: list[Corner]
    edges: list[Any]  # edge k is opposite corner k: (k + 1) -> (k + 2)

    def inverse_area(self) -> Any:
        """One over twice the signed area of the face in the ray's plane, 0 where there is none."""
        total = self.edges[0] + self.edges[1] + self.edges[2]
        return dr.select(total != 0, 1.0 / total, 0.0)

    def weights(self) -> list[Any]:
        """Barycentric weights of the ray's crossing; the edges share one sign, so nothing cancels."""
        inverse = self.inverse_area()
        return [edge * inverse for edge in self.edges]


def interpolate(face: Face) -> list[Any]:
    """Values of the face's corners at the ray's crossing."""
    weights = face.weights()
    return [
        dr.fma(weights[0], v0, dr.fma(weights[1], v1, weights[2] * v2))
        for v0, v1, v2 in zip(*(corner.values for corner in face.corners), strict=True)
    ]


def make_face(corners: list[Corner]) -> Face:
    """Face of three corners with its edge functions."""
    edges = []
    for k in range(3):
        p, q = corners[(k + 1) % 3], corners[(k + 2) % 3]
        edges.append(edge_function(p.a, p.b, q.a, q.b))
    return Face(corners, edges)


def holds_ray(face: Face) -> Any:
    """Whether the ray, moved by the tie rule, lies inside the face seen counter-clockwise."""
    inside = None
    for k, edge in enumerate(face.edges):
        p, q = face.corners[(k + 1) % 3], face.corners[(k + 2) % 3]
        left = is_left(edge, p.a, p.b, q.a, q.b)
        inside = left if inside is None else inside & left
    return inside


def crossing_depth(face: Face) -> Any:
    """Distance t of the ray's crossing, the same to the last bit from both sides of the face and in every kernel.

    Corners are taken in the order of their vertices. The sign of this value decides whether a face lies in front of
    the camera, so a path of cells either enters there, or has a cell that spans the camera, never both or neither.
    """
    corners = [(c.vertex, c.a, c.b, c.values[0]) for c in face.corners]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        swap = corners[i][0] > corners[j][0]
        first = tuple(dr.select(swap, y, x) for x, y in zip(corners[i], corners[j], strict=True))
        second = tuple(dr.select(swap, x, y) for x, y in zip(corners[i], corners[j], strict=True))
        corners[i], corners[j] = first, second
    ordered = make_face([Corner(vertex, a, b, [t], []) for vertex, a, b, t in corners])
    return interpolate(ordered)[0]


@dataclass
class Exit:
    """How a ray leaves a cell: which corner the apex replaces, and the edge functions of the face it leaves through."""

    dropped: list[Any]  # three masks, exactly one of them set
    edges: list[Any]

    def vertex(self, face: Face) -> Any:
        """Index of the vertex that the walk drops."""
        return self.pick([corner.vertex for corner in face.corners])

    def pick(self, items: list[Any]) -> Any:
        """The dropped corner's item out of three."""
        return dr.select(self.dropped[0], items[0], dr.select(self.dropped[1], items[1], items[2]))

    def face(self, face: Face, apex: Corner) -> Face:
        """The face in which the apex takes the dropped corner's place, without adjoints."""
        corners = []
        for mask, old in zip(self.dropped, face.corners, strict=True):
            corners.append(
                Corner(
                    dr.select(mask, apex.vertex, old.vertex),
                    dr.select(mask, apex.a, old.a),
                    dr.select(mask, apex.b, old.b),
                    [dr.select(mask, new, value) for new, value in zip(apex.values, old.values, strict=True)],
                    [],
                )
            )
        return Face(corners, self.edges)

    def carry_adjoints(self, face: Face, next_face: Face) -> None:
        """Hand the kept corners' adjoints on to the next face; the apex starts at zero."""
        for mask, old, new in zip(self.dropped, face.corners, next_face.corners, strict=True):
            new.adjoints = [dr.select(mask, 0.0, value) for value in old.adjoints]


def find_exit(face: Face, apex: Corner) -> Exit:
    """Face through which a ray that entered through ``face`` leaves the cell with that apex."""
    towards, left = [], []
    for corner in face.corners:
        edge = edge_function(corner.a, corner.b, apex.a, apex.b)
        towards.append(edge)
        left.append(is_left(edge, corner.a, corner.b, apex.a, apex.b))
    # Corner k goes when the ray lies left of (k + 2) -> apex and right of (k + 1) -> apex.
    dropped = [left[2] & ~left[1], left[0] & ~left[2], left[1] & ~left[0]]
    edges = []
    for k in range(3):
        previous, following = (k + 2) % 3, (k + 1) % 3
        # Edge k joins corners k + 1 and k + 2; when one of them is replaced, the apex stands at that end.
        replaced_start = dr.select(dropped[following], -towards[previous], face.edges[k])
        edges.append(dr.select(dropped[previous], towards[following], replaced_start))
    return Exit(dropped, edges)


def walk_table(topology: Topology) -> torch.Tensor:
    """(4 T, 2) int32 table of the walk: entry 4 c + r holds what lies behind the face opposite cell c's r-th vertex.

    The vertices of a cell are ranked by index, so a kernel finds r from the four indices alone. An entry is (next
    cell, its vertex that is not on the face); at the boundary the next cell is -1.
    """

    def build() -> torch.Tensor:
        tets, adjacency = topology.tets, topology.cell_adjacency
        order = tets.argsort(dim=1)
        ranked = torch.gather(tets, 1, order)
        neighbors = torch.gather(adjacency, 1, order)
        # The sum of four int32 indices may exceed int32 for huge meshes only in between: wrap-around cancels.
        total = tets.sum(dim=1, dtype=torch.int32)
        across = total[neighbors.clamp(min=0).long()] - (total[:, None] - ranked)
        table = torch.stack([neighbors, torch.where(neighbors >= 0, across, 0)], dim=2)
        return table.to(torch.int32).reshape(-1, 2).contiguous()

    return topology.cached("walk_table", build)


def table_row(cell: Any, dropped: Any, face: Face, apex: Corner) -> Any:
    """Row of the walk table: the rank of the dropped vertex among its cell's four."""
    uint = type(cell)
    rank = uint(0)
    for vertex in (*(corner.vertex for corner in face.corners), apex.vertex):
        rank += dr.select(vertex < dropped, uint(1), uint(0))
    return 4 * cell + rank
