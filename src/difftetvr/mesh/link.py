"""The link condition: whether merging two vertices of an edge leaves the same manifold."""

from __future__ import annotations

import torch

from difftetvr.mesh.arrays import sort_keys, true_indices
from difftetvr.mesh.incidence import stars
from difftetvr.mesh.topology import Topology

_PAIRS_AT_ONCE = 2**16
_VERTEX_BITS = 32
_RANK_BITS = 13
_PAIRS_OF_THREE = ((0, 1), (0, 2), (1, 2))


def link_condition(topology: Topology, pairs: torch.Tensor) -> torch.Tensor:
    """Whether Lk(u) ∩ Lk(v) = Lk(uv) for edges uv: then, and only then, contracting uv keeps the manifold.

    The link of a simplex is what its cells have opposite to it. The boundary is closed by cells that join each boundary
    face to one vertex outside (Dey, Edelsbrunner, Guha, Nekhayev: Topology preserving edge contraction, 1999), so an
    inner edge between two boundary vertices never satisfies the condition.

    Args:
        topology: The cells.
        pairs: (N, 2) int64 vertices that share an edge.

    Returns:
        (N,) bool. False also for an edge with more than 8192 vertices around it.
    """
    closed = topology.cached("link.closed", lambda: _closed(topology))
    parts = [_condition(closed, part) for part in pairs.split(_PAIRS_AT_ONCE)]
    return torch.cat(parts) if parts else torch.ones(0, dtype=torch.bool, device=pairs.device)


def _closed(topology: Topology) -> Topology:
    faces = topology.boundary_faces
    outside = torch.full_like(faces[:, :1], topology.num_vertices)
    return Topology(torch.cat((topology.tets, torch.cat((faces, outside), 1))), topology.num_vertices + 1)


def _condition(closed: Topology, pairs: torch.Tensor) -> torch.Tensor:
    first, other = pairs.unbind(1)
    owner, faces = _link_faces(closed, first)
    other_owner, other_faces = _link_faces(closed, other)
    # Cells around the edge: faces of the one link that contain the other vertex; what they have besides is Lk(uv).
    shared = (faces == other[owner, None]).any(1)
    ring = faces[shared][faces[shared] != other[owner[shared], None]].view(-1, 2)
    ring_owner = owner[shared]
    apart = ~(other_faces == first[other_owner, None]).any(1)

    ring_keys = _distinct(_vertex_keys(ring_owner, ring))
    common = _common(_vertex_keys(owner, faces), _vertex_keys(other_owner, other_faces))
    count = pairs.shape[0]
    holds = _per_owner(common >> _VERTEX_BITS, count) == _per_owner(ring_keys >> _VERTEX_BITS, count)

    # With all common vertices on the ring, common edges and triangles have all their corners there.
    sizes = _per_owner(ring_keys >> _VERTEX_BITS, count)
    holds &= sizes <= 2**_RANK_BITS
    starts = sizes.cumsum(0) - sizes
    ring_edges = _simplices(ring_owner, _ranks(ring_keys, starts, ring_owner, ring), ((0, 1),))
    mine = owner[~shared], _ranks(ring_keys, starts, owner[~shared], faces[~shared])
    others = other_owner[apart], _ranks(ring_keys, starts, other_owner[apart], other_faces[apart])
    edges = _common(_simplices(*mine, _PAIRS_OF_THREE), _simplices(*others, _PAIRS_OF_THREE))
    triangles = _common(_simplices(*mine, ((0, 1, 2),)), _simplices(*others, ((0, 1, 2),)))
    holds[edges[~torch.isin(edges, ring_edges)] >> (3 * _RANK_BITS)] = False
    holds[triangles >> (3 * _RANK_BITS)] = False
    return holds


def _ranks(ring_keys: torch.Tensor, starts: torch.Tensor, owner: torch.Tensor, vertices: torch.Tensor) -> torch.Tensor:
    """Number of each vertex among those around its owner's edge, from 0, and -1 elsewhere, ascending in each row.

    With these small numbers a simplex and its owner fit one integer.
    """
    if not ring_keys.numel():
        return torch.full_like(vertices, -1)
    wanted = _vertex_keys(owner, vertices).view(vertices.shape)
    place = torch.searchsorted(ring_keys, wanted).clamp_max_(ring_keys.shape[0] - 1)
    rank = torch.where(ring_keys[place] == wanted, place - starts[owner, None], -1)
    return rank.sort(1).values


def _simplices(owner: torch.Tensor, ranks: torch.Tensor, corners: tuple[tuple[int, ...], ...]) -> torch.Tensor:
    """Keys of those simplices, given as columns of `ranks`, whose corners are all around their owner's edge."""
    keys = []
    for columns in corners:
        # Ranks ascend in a row, so the first corner tells for all.
        rows = true_indices(ranks[:, columns[0]] >= 0)
        key = owner[rows]
        for k in range(3):
            key = (key << _RANK_BITS) | (ranks[rows, columns[k]] if k < len(columns) else 0)
        keys.append(key)
    return torch.cat(keys)


def _link_faces(closed: Topology, vertices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Faces opposite vertices in the cells around them: owner (M,), the row of `vertices`, and (M, 3) corners."""
    owner, cells = stars(closed, vertices)
    tets = closed.tets[cells].long()
    return owner, tets[tets != vertices[owner, None]].view(-1, 3)


def _vertex_keys(owner: torch.Tensor, vertices: torch.Tensor) -> torch.Tensor:
    return ((owner[:, None] << _VERTEX_BITS) | vertices).view(-1)


def _common(keys: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Keys in both lists, each once."""
    both = sort_keys(torch.cat((_distinct(keys), _distinct(others))))
    return both[1:][both[1:] == both[:-1]]


def _distinct(keys: torch.Tensor) -> torch.Tensor:
    """Each key once, ascending; the list itself may be sorted."""
    return torch.unique_consecutive(sort_keys(keys))


def _per_owner(owner: torch.Tensor, count: int) -> torch.Tensor:
    return torch.bincount(owner, minlength=count)
