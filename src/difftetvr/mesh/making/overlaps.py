"""Do cells fill the same space that are no neighbours, as two bodies in one file do that were pushed into each other?

How many cells hold a point changes only at faces that belong to one cell alone. So wherever cells of a mesh whose
neighbours lie on opposite sides of their faces overlap, a cell at its boundary does.
"""

from __future__ import annotations

import itertools
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
_SEARCHES_AT_ONCE = 100_000


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
    positions, tets = _arrays(mesh)
    half_faces = np.flatnonzero(mesh.topology.cell_adjacency.cpu().numpy().ravel() < 0)
    generator = np.random.default_rng(0)
    if len(half_faces) > samples:
        half_faces = generator.choice(half_faces, samples, replace=False)
    owners, local = half_faces >> 2, half_faces & 3
    faces = positions[np.take_along_axis(tets[owners], np.array(LOCAL_FACES)[local], 1)]
    weights = generator.dirichlet((1.0, 1.0, 1.0), len(faces))
    places = (1 - _INWARDS) * (weights[:, :, None] * faces).sum(1) + _INWARDS * positions[tets[owners, local]]
    doubled = np.zeros(len(places), bool)
    for cells, at in _pairs_with_places(*_boxes(positions, tets), places):
        other = cells != owners[at]
        cells, at = cells[other], at[other]
        doubled[at[_weights(positions[tets[cells]], places[at]).min(1) > _TOLERANCE]] = True
    if not doubled.any():
        return None
    x, y, z = (places[doubled.argmax()] + np.array(mesh.origin)).tolist()
    return Overlap(float(doubled.mean()), (x, y, z))


def overlapping_cells(mesh: TetMesh) -> torch.Tensor:
    """Cells at the boundary that share more than their surface with another cell, and those others.

    Every pair of cells of which one is at the boundary is looked at; cells that only touch, to within a millionth of
    their width, do not count. Cells that share a face from the same side, or with more than one other cell, do.

    Args:
        mesh: The mesh; loose cells may be anything.

    Returns:
        (T,) bool.
    """
    positions, tets = _arrays(mesh)
    matching = match_faces(mesh.tets.cpu(), mesh.num_vertices)
    outer = (matching.cell_adjacency < 0).any(1).numpy()
    for half_faces in (matching.crowded, matching.folded.flatten()):
        outer[(half_faces >> 2).numpy()] = True
    outer = np.flatnonzero(outer)
    low, high = _boxes(positions, tets)
    found = np.zeros(len(tets), bool)
    for cells, at in _box_pairs((low, high), (low[outer], high[outer])):
        others = outer[at]
        proper = cells != others
        for part in np.array_split(np.flatnonzero(proper), max(1, int(proper.sum()) // _PAIRS_AT_ONCE)):
            one, other = cells[part], others[part]
            both = _intersect(positions[tets[one]], positions[tets[other]])
            found[one[both]] = found[other[both]] = True
    return torch.from_numpy(found)


def _arrays(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices.detach().double().cpu().numpy(), mesh.tets.cpu().numpy().astype(np.int64)


def _boxes(positions: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = [positions[tets[:, k]] for k in range(4)]
    return np.minimum.reduce(corners), np.maximum.reduce(corners)


def _weights(corners: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(N, 4) barycentric coordinates of a place in each cell."""
    a, b, c, d = (corners[:, k] - places for k in range(4))
    ab, cd = np.cross(a, b), np.cross(c, d)
    volumes = np.stack([(b * cd).sum(1), -(a * cd).sum(1), (d * ab).sum(1), -(c * ab).sum(1)], 1)
    total = volumes.sum(1, keepdims=True)
    return volumes / np.where(total == 0, 1.0, total)


def _intersect(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) bool, whether the interiors of two cells (N, 4, 3) meet: no axis separates them."""
    middle = one.mean(1, keepdims=True)
    one, other = one - middle, other - middle
    left = np.flatnonzero(~(_face_separates(one, other) | _face_separates(other, one)))
    for i, j in LOCAL_EDGES:
        for k, m in LOCAL_EDGES:
            first, second = one[left, j] - one[left, i], other[left, m] - other[left, k]
            axis = np.cross(first, second)
            least = _PARALLEL**2 * (first * first).sum(1) * (second * second).sum(1)
            axis[(axis * axis).sum(1) <= least] = 0.0
            left = left[~_separates(axis, one[left], other[left])]
    found = np.zeros(len(one), bool)
    found[left] = True
    return found


def _face_separates(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) bool, whether the other cell lies beyond a face of the first: a weight of it is positive at no corner."""
    weights = np.stack([_weights(one, other[:, k]) for k in range(4)], 1)
    width = np.minimum(1.0, np.ptp(weights, axis=1))
    return (weights.max(1) <= _TOLERANCE * width).any(1)


def _separates(axis: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    a, b = (np.einsum("nkc,nc->nk", cell, axis) for cell in (one, other))
    depth = np.minimum(a.max(1), b.max(1)) - np.maximum(a.min(1), b.min(1))
    width = np.minimum(np.ptp(a, axis=1), np.ptp(b, axis=1))
    return (depth <= _TOLERANCE * width) & axis.any(1)


def _pairs_with_places(
    low: np.ndarray, high: np.ndarray, places: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of boxes and places in them, (N,) indices of both; the axis along which fewest share a range is swept."""
    orders = np.argsort(places, axis=0)
    ranges = [
        [np.searchsorted(places[orders[:, axis], axis], ends[:, axis]) for ends in (low, high)] for axis in range(3)
    ]
    axis = int(np.argmin([(end - begin).sum() for begin, end in ranges]))
    begin, number = ranges[axis][0], ranges[axis][1] - ranges[axis][0]
    hit = np.flatnonzero(number)
    blocks = np.cumsum(number[hit]) // _PAIRS_AT_ONCE
    for part in np.split(hit, np.flatnonzero(np.diff(blocks)) + 1):
        count = number[part]
        left = np.repeat(part, count)
        right = orders[np.arange(len(left)) - np.repeat(np.cumsum(count) - count - begin[part], count), axis]
        inside = ((low[left] <= places[right]) & (places[right] <= high[left])).all(1)
        yield left[inside], right[inside]


def _box_pairs(
    many: tuple[np.ndarray, np.ndarray], few: tuple[np.ndarray, np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of boxes that overlap: indices into both, each pair once.

    Args:
        many: Low and high corners, (N, 3) each.
        few: Low and high corners, (M, 3) each.
    """
    near = np.flatnonzero(((many[0] <= few[1].max(0)) & (many[1] >= few[0].min(0))).all(1))
    middles, reach = 0.5 * (many[0] + many[1])[near], 0.5 * (many[1] - many[0])[near].max(1)
    few_middles, few_reach = 0.5 * (few[0] + few[1]), 0.5 * (few[1] - few[0]).max(1)
    # Boxes of about one size are searched together, so that a few large ones do not make all searches wide.
    size_class = np.frexp(few_reach)[1]
    for kind in np.unique(size_class):
        members = np.flatnonzero(size_class == kind)
        tree = cKDTree(few_middles[members])
        radius = (1 + 1e-9) * (reach + few_reach[members].max())
        for part in np.array_split(np.arange(len(near)), len(near) // _SEARCHES_AT_ONCE + 1):
            lists = tree.query_ball_point(middles[part], radius[part], p=np.inf)
            counts = np.fromiter(map(len, lists), np.int64, len(part))
            left = np.repeat(near[part], counts)
            right = members[np.fromiter(itertools.chain.from_iterable(lists), np.int64, len(left))]
            low = np.maximum(many[0][left], few[0][right])
            meets = (low <= np.minimum(many[1][left], few[1][right])).all(1)
            yield left[meets], right[meets]
