"""Which cells meet at which face: the one sort that all topology follows from."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, constant, put, sort_keys, true_indices

LOCAL_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
"""Local vertices of the face opposite local vertex k, counter-clockwise seen from outside a positive cell."""

_KEY_BITS = 63
_HASH_FACTORS = (-7046029254386353131, -4417276706812531889)
_LOCAL_FACE_BITS = 2


@dataclass(frozen=True)
class FaceMatching:
    """Cells paired across their faces.

    A half-face is 4 * cell + k, the face opposite local vertex k as that cell sees it.

    Attributes:
        cell_adjacency: (T, 4) int32, the cell across the face opposite local vertex k, or -1 on the boundary.
        crowded: (N,) int64 half-faces of faces that more than two cells share; empty in a valid mesh.
        folded: (N, 2) int64 pairs of half-faces with the same winding: both cells lie on the same side; empty in a
            valid mesh of positive cells.
    """

    cell_adjacency: torch.Tensor
    crowded: torch.Tensor
    folded: torch.Tensor


def match_faces(tets: torch.Tensor, num_vertices: int) -> FaceMatching:
    """Pair cells across shared faces.

    Half-faces are sorted by one 63-bit key each: smallest vertex, a hash of the two others, the half-face itself. The
    vertices are compared before two half-faces are paired, so the result is exact whatever the hash does.

    Args:
        tets: (T, 4) int32 vertex indices, all in range.
        num_vertices: Number of vertices V.

    Returns:
        The adjacency and everything that is wrong with it.
    """
    id_bits = max((4 * tets.shape[0] - 1).bit_length(), 1)
    keys = sort_keys(_half_face_keys(tets, num_vertices, id_bits))
    _separate_hash_collisions(keys, tets, id_bits)

    adjacency = torch.full((tets.shape[0], 4), -1, dtype=torch.int32, device=tets.device)
    flat_adjacency = adjacency.view(-1)
    crowded, folded = [], []
    id_mask = (1 << id_bits) - 1
    for part in chunks(keys.shape[0], tets.device):
        # Two more than the chunk: a pair may straddle its end, and so may three equal faces.
        half_faces = keys[part.start : part.stop + 2] & id_mask
        face, odd = _sorted_faces(tets, half_faces)
        equal = torch.ones_like(odd[1:])
        for vertex in face:
            equal &= vertex[1:] == vertex[:-1]
        size = part.stop - part.start
        three = equal[1:] & equal[:-1]
        if three.any():
            first = true_indices(three)
            crowded.append(half_faces[torch.stack((first, first + 1, first + 2))].flatten())
        left = true_indices(equal[:size])
        same_winding = odd.index_select(0, left) == odd.index_select(0, left + 1)
        left, right = half_faces.index_select(0, left), half_faces.index_select(0, left + 1)
        if same_winding.any():
            folded.append(torch.stack((left[same_winding], right[same_winding]), 1))
        put(flat_adjacency, left, (right >> _LOCAL_FACE_BITS).int())
        put(flat_adjacency, right, (left >> _LOCAL_FACE_BITS).int())
    none = keys.new_empty(0)
    return FaceMatching(
        adjacency,
        torch.unique(torch.cat(crowded)) if crowded else none,
        torch.cat(folded) if folded else none.view(0, 2),
    )


def check_matching(matching: FaceMatching, tets: torch.Tensor) -> None:
    """Refuse faces that more than two cells share and neighbours that overlap.

    Args:
        matching: What `match_faces` found.
        tets: (T, 4) int32, the cells it was found for.

    Raises:
        MeshError: Names the first offending cell, those it is in conflict with and the face they share.
    """
    if matching.crowded.numel():
        first = matching.crowded.min()
        sharing = matching.crowded[_same_face(tets, matching.crowded, first)]
        cells = ", ".join(str(c) for c in (sharing >> _LOCAL_FACE_BITS).tolist()[:8])
        raise MeshError(
            f"Cell {int(first) >> _LOCAL_FACE_BITS}: its face {_face_text(tets, first)} is shared by {sharing.numel()} "
            f"cells ({cells}), but at most two cells can meet at a face; remove duplicate or overlapping cells."
        )
    if matching.folded.numel():
        pair = matching.folded[matching.folded.min(1).values.argmin()]
        one, other = sorted((pair >> _LOCAL_FACE_BITS).tolist())
        raise MeshError(
            f"Cell {one}: it overlaps its neighbour, cell {other}, which lies on the same side of their common face "
            f"{_face_text(tets, pair[0])}; remove one of the cells or unfold the mesh there."
        )


def face_vertices(tets: torch.Tensor, half_faces: torch.Tensor) -> torch.Tensor:
    """Vertices of half-faces, counter-clockwise seen from outside their (positive) cells.

    Args:
        tets: (T, 4) int32.
        half_faces: (N,) int64, 4 * cell + k for the face opposite local vertex k.

    Returns:
        (N, 3) vertex indices of tets' dtype.
    """
    return torch.stack(_face_columns(tets, half_faces), 1)


def _half_face_keys(tets: torch.Tensor, num_vertices: int, id_bits: int) -> torch.Tensor:
    vertex_bits = max((num_vertices - 1).bit_length(), 1)
    hash_bits = _KEY_BITS - vertex_bits - id_bits
    hash_mask = (1 << hash_bits) - 1
    keys = torch.empty((4, tets.shape[0]), dtype=torch.int64, device=tets.device)
    for part in chunks(tets.shape[0], tets.device):
        corners = [column.contiguous() for column in tets[part].unbind(1)]
        first_half_face = torch.arange(4 * part.start, 4 * part.stop, 4, device=tets.device)
        for k, local in enumerate(LOCAL_FACES):
            (low, middle, high), _ = _sort_three(*(corners[i] for i in local))
            mixed = middle.long().mul_(_HASH_FACTORS[0]).add_(high.long().mul_(_HASH_FACTORS[1]))
            hashed = mixed.bitwise_right_shift_(64 - hash_bits).bitwise_and_(hash_mask)
            key = low.long().bitwise_left_shift_(hash_bits).bitwise_or_(hashed).bitwise_left_shift_(id_bits)
            keys[k, part] = key.bitwise_or_(first_half_face + k)
    return keys.view(-1)


def _separate_hash_collisions(keys: torch.Tensor, tets: torch.Tensor, id_bits: int) -> None:
    """Reorder sorted keys in place so that equal faces are consecutive where three or more half-faces have one hash."""
    members = []
    for part in chunks(keys.shape[0], keys.device):
        group = keys[part.start : part.stop + 2] >> id_bits
        starts = true_indices(group[2:] == group[:-2]) + part.start
        members.append(torch.cat((starts, starts + 1, starts + 2)))
    positions = torch.unique(torch.cat(members))
    if not positions.numel():
        return
    suspects = keys[positions]
    (_, middle, high), _ = _sorted_faces(tets, suspects & ((1 << id_bits) - 1))
    by_face = torch.argsort((middle.long() << 31) | high.long(), stable=True)
    by_group = torch.argsort((suspects >> id_bits)[by_face], stable=True)
    keys[positions] = suspects[by_face[by_group]]


def _face_columns(tets: torch.Tensor, half_faces: torch.Tensor) -> list[torch.Tensor]:
    opposite = half_faces & 3
    first = half_faces - opposite
    flat = tets.view(-1)
    corners = constant(LOCAL_FACES, tets.device).t().contiguous()
    places = [column.index_select(0, opposite).add_(first) for column in corners]
    return [flat.index_select(0, place) for place in places]


def _sorted_faces(tets: torch.Tensor, half_faces: torch.Tensor) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
    """Ascending vertices of half-faces, and whether sorting them took an odd permutation."""
    return _sort_three(*_face_columns(tets, half_faces))


def _sort_three(
    x: torch.Tensor, y: torch.Tensor, z: torch.Tensor
) -> tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]:
    low, high = torch.minimum(x, y), torch.maximum(x, y)
    middle = torch.maximum(low, torch.minimum(high, z))
    odd = (x > y) ^ ((z > low) & (z < high))
    return (torch.minimum(low, z), middle, torch.maximum(high, z)), odd


def _same_face(tets: torch.Tensor, half_faces: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    faces, _ = _sorted_faces(tets, half_faces)
    target, _ = _sorted_faces(tets, wanted.view(1))
    return (faces[0] == target[0]) & (faces[1] == target[1]) & (faces[2] == target[2])


def _face_text(tets: torch.Tensor, half_face: torch.Tensor) -> str:
    return "(" + ", ".join(str(v) for v in face_vertices(tets, half_face.view(1))[0].tolist()) + ")"
