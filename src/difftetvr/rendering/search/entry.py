"""Where rays enter the mesh: per-ray lists of the half-faces that start a walk, nearest first (Dr.Jit).

Boundary faces get into the lists by the same exact rule as the walk: a camera's are rasterised, those of other rays
are looked for in a hierarchy. Where a ray starts inside the mesh, the cell that holds its origin comes first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.plan import Counts, Search, Told
from difftetvr.rendering.search.scene import Scene


@dataclass(frozen=True)
class EntryLists:
    """Per-ray lists of half-faces through which a ray enters the mesh, or the cell it starts in.

    Attributes:
        offset: (N,) start of each ray's list in ``half_faces``.
        count: (N,) length of each ray's list.
        half_faces: Each ray's nearest first.
        has_starts: Whether some walks start behind the origin and must be clipped there.
        is_simple: Whether no ray has more than one entry.
    """

    offset: Any
    count: Any
    half_faces: Any
    has_starts: bool
    is_simple: bool


def count_entries(search: Search, rays: int) -> Counts:
    """Count the entries of N rays, for :func:`difftetvr.recording.replayed`."""
    uint = search.scene.backend.UInt
    count, half_faces = dr.zeros(uint, rays), dr.zeros(uint, rays)

    def visit(hit: Hit) -> None:
        dr.scatter_add(count, uint(1), hit.pixel, hit.is_hit)
        dr.scatter(half_faces, hit.half_face, hit.pixel, hit.is_hit)

    search.for_each(visit, lambda: dr.eval(count, half_faces))
    return Counts.of(count, half_faces)


def list_entries(search: Search, counts: Counts, told: Told, has_starts: bool) -> EntryLists:
    """Entry lists of every ray of a view.

    Args:
        search: Finds them.
        counts: How many there are.
        told: What the host knows of that.
        has_starts: Whether rays may start inside the mesh.
    """
    rays = search.scene.rays.count
    if told.most <= 1:
        return EntryLists(search.scene.backend.lanes(rays), counts.count, counts.half_faces, has_starts, True)
    offset, half_faces = replayed(_fill, search, counts.count, few_lengths(told.total), rays)
    return EntryLists(offset, counts.count, half_faces, has_starts, False)


def _fill(search: Search, count: Any, total: int, rays: int) -> tuple[Any, Any]:
    """Where each ray's list starts, and the lists."""
    uint, real = search.scene.backend.UInt, search.scene.backend.Float
    offset = dr.prefix_sum(count)
    half_faces, depths, used = dr.zeros(uint, total), dr.zeros(real, total), dr.zeros(uint, rays)

    def visit(hit: Hit) -> None:
        slot = dr.gather(uint, offset, hit.pixel, hit.is_hit) + dr.scatter_inc(used, hit.pixel, hit.is_hit)
        dr.scatter(half_faces, hit.half_face, slot, hit.is_hit)
        dr.scatter(depths, hit.depth, slot, hit.is_hit)

    dr.eval(offset, half_faces, depths, used)
    search.for_each(visit, lambda: dr.eval(half_faces, depths, used))
    return offset, _sorted(search.scene, offset, count, half_faces, depths)


def _sorted(scene: Scene, offset: Any, count: Any, half_faces: Any, depths: Any) -> Any:
    """Each ray's entries by (depth, half-face): the place of one is the number of smaller ones, for lists are short."""
    uint, real = scene.backend.UInt, scene.backend.Float
    end = offset + count
    ordered = dr.zeros(uint, dr.width(half_faces))

    def place(position: Any) -> tuple[Any]:
        face, depth = dr.gather(uint, half_faces, position), dr.gather(real, depths, position)

        def compare(other: Any, rank: Any) -> tuple[Any, Any]:
            other_face, other_depth = dr.gather(uint, half_faces, other), dr.gather(real, depths, other)
            smaller = (other_depth < depth) | ((other_depth == depth) & (other_face < face))
            return other + 1, rank + dr.select(smaller, uint(1), uint(0))

        _, rank = dr.while_loop((uint(offset), dr.zeros(uint, 1)), lambda other, rank: other < end, compare)
        dr.scatter(ordered, face, offset + rank)
        return (position + 1,)

    dr.while_loop((uint(offset),), lambda position: position < end, place)
    dr.eval(ordered)
    return ordered
