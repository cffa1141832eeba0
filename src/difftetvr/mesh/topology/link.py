"""The link condition: whether merging two vertices of an edge leaves the same manifold."""

from __future__ import annotations

import torch

from difftetvr.mesh.arrays import constant, sort_keys, true_indices
from difftetvr.mesh.topology.incidence import boundary_vertices, find_edges, shell, stars
from difftetvr.mesh.topology.lookup import is_corner
from difftetvr.mesh.topology.topology import LOCAL_FACES, Topology

_PAIRS_AT_ONCE = 2**16
_LARGEST_RING = 16
"""Most vertices around an edge for which the quick test is made; more are rare."""
_FOLLOWING = tuple(face[(face.index(j) + 1) % 3] if j in face else 0 for face in LOCAL_FACES for j in range(4))
"""For local vertices i and j at 4 i + j the k with which i, j, k and the fourth have the cell's orientation."""
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
        pairs: (N, 2) int64 vertices that share an edge; the test is quickest where the first is not on the boundary.

    Returns:
        (N,) bool. False also for an edge with more than 8192 vertices around it.
    """
    holds = torch.zeros(pairs.shape[0], dtype=torch.bool, device=pairs.device)
    doubtful = boundary_vertices(topology).index_select(0, pairs[:, 0])
    for part in true_indices(~doubtful).split(_PAIRS_AT_ONCE):
        holds[part], doubtful[part] = _simple_condition(topology, pairs[part])
    rest = true_indices(doubtful)
    # Often there are none, of which split would make a part, too.
    for part in rest.split(_PAIRS_AT_ONCE) if rest.numel() else ():
        holds[part] = _condition(topology, pairs[part])
    return holds


def _simple_condition(topology: Topology, pairs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(N,) bool, where the condition surely holds, and (N,) bool, where that takes a closer look.

    The first of each pair, v, must not be on the boundary. Only faces of Lk(v) without u are looked at. A corner that
    is a neighbour of u is a common vertex, and must be in Lk(uv). If all are, common edges have both ends in Lk(uv).
    Each edge of Lk(uv) is in one of the faces, as v is inside: if as many faces have two corners in Lk(uv) as it has
    edges, and none has three, there are no other edges that could be common.
    """
    owner, cells = stars(topology, pairs[:, 0])
    corners = topology.tets.index_select(0, cells).t().contiguous()
    first, other = (column.int().index_select(0, owner) for column in pairs.unbind(1))
    is_shared = is_corner(corners, other)
    shared, apart = true_indices(is_shared), true_indices(~is_shared)
    sizes = _per_owner(owner.index_select(0, shared), pairs.shape[0])
    ring = _rings(corners.index_select(1, shared), first[shared], other[shared], owner[shared], sizes)

    corners, first, other, owner = (values.index_select(-1, apart) for values in (corners, first, other, owner))
    on_ring = torch.zeros_like(corners, dtype=torch.bool)
    for vertex in ring:
        on_ring |= corners == vertex.index_select(0, owner)
    corners_on_ring = on_ring.sum(0, dtype=torch.uint8)
    doubtful = _per_owner(owner.index_select(0, true_indices(corners_on_ring == 2)), pairs.shape[0]) != sizes
    doubtful[owner.index_select(0, true_indices(corners_on_ring == 3))] = True

    off = true_indices((~on_ring & (corners != first)).view(-1))
    ends = torch.stack((corners.view(-1).index_select(0, off), other.repeat(4).index_select(0, off)), 1)
    neighbours = off[find_edges(topology, ends.long()) >= 0]
    fails = torch.zeros_like(doubtful)
    fails[owner.repeat(4).index_select(0, neighbours)] = True
    is_part = sizes > _LARGEST_RING
    fails &= ~is_part
    doubtful |= is_part
    return ~(fails | doubtful), doubtful & ~fails


def _rings(
    corners: torch.Tensor, first: torch.Tensor, other: torch.Tensor, owner: torch.Tensor, sizes: torch.Tensor
) -> torch.Tensor:
    """Vertices around edges (K, N), padded with -1, at most `_LARGEST_RING` of each edge.

    Args:
        corners: (4, M) of the cells around the edges, one after the other.
        first: (M,) one end of each cell's edge.
        other: (M,) the other end.
        owner: (M,) int64 ascending, the edge.
        sizes: (N,) how many cells each edge has.
    """
    # All cells have one orientation, so each vertex around the edge follows the ends in one of the cells.
    i, j = ((corners[1] == end) + 2 * (corners[2] == end) + 3 * (corners[3] == end) for end in (first, other))
    following = constant(_FOLLOWING, owner.device).index_select(0, 4 * i + j)
    vertices = corners.gather(0, following[None])[0]
    row = torch.arange(owner.shape[0], device=owner.device) - (sizes.cumsum(0) - sizes).index_select(0, owner)
    width = min(int(sizes.max()), _LARGEST_RING) if sizes.numel() else 0
    ring = corners.new_full((width, sizes.shape[0]), -1)
    fits = true_indices(row < width)
    ring[row[fits], owner[fits]] = vertices[fits]
    return ring


def _condition(topology: Topology, pairs: torch.Tensor) -> torch.Tensor:
    """(N,) bool: the condition, by sorting all that is in the links."""
    first, other = pairs.unbind(1)
    owner, faces = _link_faces(topology, first)
    other_owner, other_faces = _link_faces(topology, other)
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


def _link_faces(topology: Topology, vertices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Faces opposite vertices in the cells around them: owner (M,), the row of `vertices`, and (M, 3) corners."""
    parts = [(part.tets, *stars(part, vertices)) for part in (topology, shell(topology))]
    owner = torch.cat([owner for _, owner, _ in parts])
    tets = torch.cat([tets.index_select(0, cells) for tets, _, cells in parts]).long()
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
