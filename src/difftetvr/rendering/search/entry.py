"""Where rays enter the mesh: per-ray lists of the half-faces that start a walk, nearest first (Dr.Jit).

Boundary faces get into the lists by the same exact rule as the walk: a camera's are rasterised, those of other rays
are looked for in a hierarchy. Where a ray starts inside the mesh, the cell that holds its origin comes first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.bundle_hits import BundleScene
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.rasterise import for_each_hit, work_items
from difftetvr.rendering.search.scene import Scene, boundary_half_faces
from difftetvr.rendering.search.starts import cells_around_camera, for_each_start_at_camera
from difftetvr.rendering.traversal.bundle import BundleRays

Finder = Callable[[Callable[[Hit], None]], None]


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


def find_entries(scene: Scene, mesh: TetMesh, vertices: torch.Tensor, limits: Any | None) -> EntryLists:
    """Entry lists of every ray of a view.

    Args:
        scene: The cells and the rays.
        mesh: Mesh, for its topology.
        vertices: (V, 3) vertices in the space of the rays.
        limits: (N, 2) distances between which each ray is looked at; None for all in front of it.
    """
    backend = scene.backend
    if isinstance(scene.rays, BundleRays):
        bundle = BundleScene(scene, mesh, vertices, limits)
        finders = [bundle.for_each_start] if bundle.may_start_inside else []
        has_starts = bundle.may_start_inside
        finders.append(bundle.for_each_entry)
    else:
        around = cells_around_camera(backend, mesh, vertices)
        has_starts = around is not None
        finders = [] if around is None else [partial(for_each_start_at_camera, scene, mesh, around)]
        finders.append(partial(for_each_hit, scene, work_items(scene, backend.uints(boundary_half_faces(mesh)))))
    count, half_faces = _count(scene, finders)
    is_simple = int(dr.max(count)[0]) <= 1
    if is_simple:
        offset = dr.arange(backend.UInt, scene.rays.count)
    else:
        offset = _starts(backend, count)
        half_faces = _sorted(scene, offset, count, *_fill(scene, finders, offset, count))
    return EntryLists(offset, count, half_faces, has_starts, is_simple)


def _count(scene: Scene, finders: Sequence[Finder]) -> tuple[Any, Any]:
    """Number of entries of each ray, and one of them, which is all where no ray has more."""
    uint = scene.backend.UInt
    count, half_faces = dr.zeros(uint, scene.rays.count), dr.zeros(uint, scene.rays.count)

    def visit(hit: Hit) -> None:
        dr.scatter_add(count, uint(1), hit.pixel, hit.is_hit)
        dr.scatter(half_faces, hit.half_face, hit.pixel, hit.is_hit)

    for for_each in finders:
        for_each(visit)
        scene.backend.run(count, half_faces)
    return count, half_faces


def _starts(backend: Backend, count: Any) -> Any:
    """Where each ray's list starts: the exclusive prefix sum of the lengths."""
    counts = backend.tensor(backend.Int(count))
    return backend.uints((counts.cumsum(0) - counts).to(torch.int32))


def _fill(scene: Scene, finders: Sequence[Finder], offset: Any, count: Any) -> tuple[Any, Any]:
    """Half-faces of every ray and their depths, in any order within a ray."""
    uint, real, last = scene.backend.UInt, scene.backend.Float, scene.rays.count - 1
    total = int(offset[last]) + int(count[last])
    half_faces, depths, used = dr.zeros(uint, total), dr.zeros(real, total), dr.zeros(uint, scene.rays.count)
    scene.backend.run(half_faces, depths, used)

    def visit(hit: Hit) -> None:
        slot = dr.gather(uint, offset, hit.pixel, hit.is_hit) + dr.scatter_inc(used, hit.pixel, hit.is_hit)
        dr.scatter(half_faces, hit.half_face, slot, hit.is_hit)
        dr.scatter(depths, hit.depth, slot, hit.is_hit)

    for for_each in finders:
        for_each(visit)
        scene.backend.run(half_faces, depths)
    return half_faces, depths


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
    scene.backend.run(ordered)
    return ordered
