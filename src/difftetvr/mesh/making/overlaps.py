"""Do cells fill the same space that are no neighbours, as two bodies in one file do that were pushed into each other?

How many cells hold a point changes only at faces that belong to one cell alone. So wherever cells of a mesh whose
neighbours lie on opposite sides of their faces overlap, a cell at its boundary does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.faces import LOCAL_FACES, match_faces
from difftetvr.mesh.topology.topology import LOCAL_EDGES

_SAMPLES = 1024
_INWARDS = 0.02  # of the way from a face to the opposite vertex
_TOLERANCE = 1e-6  # of a cell's width, up to which cells only touch
_PARALLEL = 1e-6  # sine of the angle between edges
_PAIRS_AT_ONCE = 200_000
_BOXES_AT_ONCE = 50_000

Boxes = tuple[np.ndarray, np.ndarray]
"""Low and high corners, (N, 3) each."""


@dataclass(frozen=True)
class Overlap:
    """A sample of places that lie in two cells.

    Attributes:
        share: Share of the places looked at, all of them just inside the boundary.
        place: (3,) one of them, in world space.
    """

    share: float
    place: tuple[float, float, float]


def sampled_overlap(mesh: TetMesh, samples: int = _SAMPLES) -> Overlap | None:
    """Look at places just inside the boundary: quick, but overlaps of a few cells among many may be missed.

    Args:
        mesh: The mesh; conforming.
        samples: Number of places at most.

    Returns:
        What was found; None where no place lies in two cells.
    """
    positions, tets, unit = _arrays(mesh)
    half_faces = np.flatnonzero(mesh.topology.cell_adjacency.cpu().numpy().ravel() < 0)
    generator = np.random.default_rng(0)
    if len(half_faces) > samples:
        half_faces = generator.choice(half_faces, samples, replace=False)
    owners, local = half_faces >> 2, half_faces & 3
    faces = positions[np.take_along_axis(tets[owners], np.array(LOCAL_FACES)[local], 1)]
    weights = generator.dirichlet((1.0, 1.0, 1.0), len(faces))
    places = (1 - _INWARDS) * (weights[:, :, None] * faces).sum(1) + _INWARDS * positions[tets[owners, local]]
    doubled = np.zeros(len(places), bool)
    for cells, at in _box_pairs(_boxes(positions, tets), (places, places)):
        other = cells != owners[at]
        cells, at = cells[other], at[other]
        doubled[at[_weights(positions[tets[cells]], places[at]).min(1) > _TOLERANCE]] = True
    if not doubled.any():
        return None
    x, y, z = (unit * places[doubled.argmax()] + np.array(mesh.origin)).tolist()
    return Overlap(float(doubled.mean()), (x, y, z))


def overlapping_cells(mesh: TetMesh) -> torch.Tensor:
    """Cells that share more than their surface with another cell.

    Every pair of cells of which one is at the boundary is looked at, and where some overlap, every pair in the box that
    holds them. Cells that only touch, to within a millionth of their width, do not count.

    Args:
        mesh: The mesh; loose cells may be anything.

    Returns:
        (T,) bool.
    """
    positions, tets, _ = _arrays(mesh)
    matching = match_faces(mesh.tets.cpu(), mesh.num_vertices)
    outer = (matching.cell_adjacency < 0).any(1).numpy()
    for half_faces in (matching.crowded, matching.folded.flatten()):
        outer[(half_faces >> 2).numpy()] = True
    low, high = _boxes(positions, tets)
    everything = np.arange(len(tets))
    found = _overlapping(positions, tets, everything, np.flatnonzero(outer))
    if found.any():
        # What is filled twice is bounded by faces at which it begins, so it lies among these cells.
        lower, upper = low[found].min(0), high[found].max(0)
        near = np.flatnonzero(((low <= upper) & (high >= lower)).all(1))
        found |= _overlapping(positions, tets, near, near)
    return torch.from_numpy(found)


def _overlapping(positions: np.ndarray, tets: np.ndarray, many: np.ndarray, few: np.ndarray) -> np.ndarray:
    """(T,) bool, cells in pairs of one of the many and one of the few that overlap."""
    low, high = _boxes(positions, tets)
    found = np.zeros(len(tets), bool)
    for left, right in _box_pairs((low[many], high[many]), (low[few], high[few])):
        cells, others = many[left], few[right]
        proper = np.flatnonzero((cells < others) if many is few else (cells != others))
        for part in np.array_split(proper, max(1, len(proper) // _PAIRS_AT_ONCE)):
            one, other = cells[part], others[part]
            both = _intersect(positions, tets[one], tets[other])
            found[one[both]] = found[other[both]] = True
    return found


def _arrays(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray, float]:
    """Positions in a unit, a power of two, in which products of them do not overflow; cells; and the unit."""
    positions = mesh.vertices.detach().double().cpu().numpy()
    unit = 2.0 ** min(int(np.frexp(np.abs(positions).max())[1]), 1000)
    return positions / unit, mesh.tets.cpu().numpy().astype(np.int64), unit


def _boxes(positions: np.ndarray, tets: np.ndarray) -> Boxes:
    corners = [positions[tets[:, k]] for k in range(4)]
    return np.minimum.reduce(corners), np.maximum.reduce(corners)


def _weights(corners: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(N, 4) barycentric coordinates of a place in each cell."""
    a, b, c, d = (corners[:, k] - places for k in range(4))
    ab, cd = np.cross(a, b), np.cross(c, d)
    volumes = np.stack([(b * cd).sum(1), -(a * cd).sum(1), (d * ab).sum(1), -(c * ab).sum(1)], 1)
    total = volumes.sum(1, keepdims=True)
    # Slivers give huge weights, and none where rounding leaves them no volume: neither lies around a place for certain.
    with np.errstate(all="ignore"):
        return volumes / np.where(total == 0, 1.0, total)


def _intersect(positions: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) bool, whether the interiors of two cells (N, 4) meet: no plane separates them.

    It would be that of a face, or lie along an edge of either. Cells that share two vertices are wedges around the edge
    between them as far as that is concerned: two of their faces separate them if anything does. Such pairs are most.
    """
    shared = np.stack([(one == other[:, [k]]).any(1) for k in range(4)]).sum(0)
    middle = positions[one[:, 0]][:, None]
    one, other = positions[one] - middle, positions[other] - middle
    found = ~_face_separates(one, other)
    rest = np.flatnonzero(found)
    found[rest] = ~_face_separates(other[rest], one[rest])
    left = np.flatnonzero(found & (shared < 2))
    found[left] = False
    for i, j in LOCAL_EDGES:
        for k, m in LOCAL_EDGES:
            first, second = one[left, j] - one[left, i], other[left, m] - other[left, k]
            axis = np.cross(first, second)
            least = _PARALLEL**2 * (first * first).sum(1) * (second * second).sum(1)
            axis[(axis * axis).sum(1) <= least] = 0.0
            left = left[~_separates(axis, one[left], other[left])]
    found[left] = True
    return found


def _face_separates(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) bool, whether the other cell lies beyond a face of the first, to within a part of the width of either."""
    origin = one[:, 0]
    a, b, c = (one[:, k] - origin for k in (1, 2, 3))
    normals = np.stack((np.cross(b, c), np.cross(c, a), np.cross(a, b)), 2)
    volume = (a * normals[:, :, 0]).sum(1)
    with np.errstate(all="ignore"):  # of slivers that rounding leaves no volume
        weights = (other - origin[:, None]) @ normals / volume[:, None, None]
    beyond = np.concatenate((weights, 1.0 - weights.sum(2, keepdims=True)), 2)
    width = np.minimum(1.0, np.ptp(beyond, axis=1))
    return (beyond.max(1) <= _TOLERANCE * width).any(1)


def _separates(axis: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    a, b = (np.einsum("nkc,nc->nk", cell, axis) for cell in (one, other))
    depth = np.minimum(a.max(1), b.max(1)) - np.maximum(a.min(1), b.min(1))
    width = np.minimum(np.ptp(a, axis=1), np.ptp(b, axis=1))
    return (depth <= _TOLERANCE * width) & axis.any(1)


def _box_pairs(many: Boxes, few: Boxes) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of boxes that overlap or touch, (N,) indices of both: the many go down a tree of the few."""
    order, levels = _tree(few)
    for start in range(0, len(many[0]), _BOXES_AT_ONCE):
        left = np.arange(start, min(start + _BOXES_AT_ONCE, len(many[0])))
        node = np.zeros(len(left), np.int64)
        for low, high in levels:
            meets = ((many[0][left] <= high[node]) & (low[node] <= many[1][left])).all(1)
            left, node = left[meets], node[meets]
            if len(low) < len(order):
                left, node = np.repeat(left, 2), np.repeat(2 * node, 2)
                node[1::2] += 1
        yield left, order[node]


def _tree(boxes: Boxes) -> tuple[np.ndarray, list[Boxes]]:
    """Numbers of boxes so that neighbours in space are neighbours, and what bounds 2^k such numbers, the root first.

    There are a power of two of them; those that stand for no box have no extent and meet nothing.
    """
    count = len(boxes[0])
    order = cKDTree(0.5 * (boxes[0] + boxes[1]), leafsize=1).indices
    padding = 2 ** max(count - 1, 0).bit_length() - count
    low = np.concatenate((boxes[0][order], np.full((padding, 3), np.inf)))
    high = np.concatenate((boxes[1][order], np.full((padding, 3), -np.inf)))
    levels = [(low, high)]
    while len(low) > 1:
        low, high = np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])
        levels.append((low, high))
    return np.concatenate((order, np.zeros(padding, order.dtype))), levels[::-1]
