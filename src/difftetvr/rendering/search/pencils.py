"""What neighbouring rays of a bundle may meet, looked for once for all of them (Dr.Jit).

Rays that follow each other in a bundle mostly run close together: pixels of a lens, of a detector. Some at a time are a
pencil: a box of origins and one of directions, which goes through a hierarchy as a ray does, with so much wider tests
(Reshetov et al. 2005, "Multi-level ray tracing algorithm"). Its rays then try the few items that it met. A pencil that
meets too many, as one of rays that have nothing in common does, leaves its rays to the hierarchy itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.mesh.shapes import cross
from difftetvr.rendering.search.beams import Beam, Spread
from difftetvr.rendering.search.hierarchy import Hierarchy
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.rays import Lanes, largest_coordinate

Seen = Callable[[Any], tuple[Lanes, Any, Any]]
"""Rays of lanes, and the distances between which they are looked at."""

RAYS = 16
"""Of a pencil."""

ROOM_FOR_BLOCKS = 64
"""For blocks of items whose boxes a pencil may cross."""

ROOM = 96
"""For items that a pencil may meet; to try more would take each ray as long as a search of its own."""

_FARTHEST = 1e12
"""Greatest coordinate of a pencil's origins: products of such, as float32, do not overflow."""


@dataclass
class Pencils:
    """What each of some pencils may meet.

    Attributes:
        items: Flat (P, ROOM) items of a hierarchy, in any order.
        count: (P,) how many; more than there is room for where they are not all.
    """

    items: Any
    count: Any

    @staticmethod
    def number_of(rays: int) -> int:
        """How many pencils so many rays make."""
        return -(-rays // RAYS)

    @staticmethod
    def through(scene: Scene, hierarchy: Hierarchy, pencil: Any, number: int, seen: Seen) -> Pencils:
        """Look for the half-faces through which they may enter; may be recorded.

        Args:
            scene: Cells in the space of the rays.
            hierarchy: Of half-faces.
            pencil: Numbers of the pencils.
            number: How many.
            seen: Rays of lanes, and the distances between which they are looked at.
        """
        uint, block = scene.backend.UInt, hierarchy.block
        blocks, items = (dr.empty(uint, room * number) for room in (ROOM_FOR_BLOCKS, ROOM))
        beam = _beam(scene.backend, pencil, seen)

        def at_block(number: Any, count: Any) -> Any:
            dr.scatter(blocks, number, ROOM_FOR_BLOCKS * pencil + count, count < ROOM_FOR_BLOCKS)
            return count + 1

        is_wide = beam.valid & ~(largest_coordinate([list(beam.farthest)]) <= _FARTHEST)
        beam.valid &= ~is_wide
        met = hierarchy.meet_blocks(beam, at_block, dr.zeros(uint, number), lambda count: count > ROOM_FOR_BLOCKS)
        dr.eval(blocks, met, is_wide)
        is_many = is_wide | (met > ROOM_FOR_BLOCKS)
        end, entry = dr.select(is_many, 0, block * met), _Entry.of(scene, beam, hierarchy)

        def body(place: Any, count: Any) -> tuple[Any, Any]:
            number = dr.gather(uint, blocks, ROOM_FOR_BLOCKS * pencil + place // block)
            item, is_there = hierarchy.item(block * number + place % block)
            is_met = is_there & entry.may_be(item)
            dr.scatter(items, item, ROOM * pencil + count, is_met & (count < ROOM))
            return place + 1, count + dr.select(is_met, uint(1), uint(0))

        _, count = dr.while_loop((dr.zeros(uint, number), dr.zeros(uint, number)), lambda place, _: place < end, body)
        count = dr.select(is_many, ROOM + 1, count)
        dr.eval(items, count)
        return Pencils(items, count)

    def for_each(self, lane: Any, active: Any, visit: Callable[[Any, Any, Any], Any], state: Any) -> Any:
        """Visit the items that the pencils of some lanes met, as :meth:`Hierarchy.meet_lines` does.

        Returns:
            Which lanes have pencils that met too many, and visited none.
        """
        uint = type(lane)
        pencil = lane // RAYS
        count = dr.gather(uint, self.count, pencil, active)
        is_many = active & (count > ROOM)
        count = dr.select(active & ~is_many, count, 0)

        def body(place: Any, state: Any) -> tuple[Any, Any]:
            item = dr.gather(uint, self.items, ROOM * pencil + place)
            return place + 1, visit(item, dr.mask_t(lane)(True), state)

        dr.while_loop((dr.zeros(uint, dr.width(lane)), state), lambda place, _: place < count, body)
        return is_many


@dataclass
class _Entry:
    """Whether rays of beams may enter through half-faces: be left of all edges, as seen along the ray.

    For the ray of origin o and direction d, the edge from p to q has the sign of d . ((p - o) x (q - o)). By how much
    that may differ in a beam is linear in how much d and o do; signs of rays are those of rounded places, hence the
    margin.

    Attributes:
        scene: The cells.
        beam: The rays.
        spread: By how much they differ.
        margin: By how much rounding may move places.
    """

    scene: Scene
    beam: Beam
    spread: Spread
    margin: Any

    @staticmethod
    def of(scene: Scene, beam: Beam, hierarchy: Hierarchy) -> _Entry:
        """Of half-faces in a hierarchy."""
        assert beam.spread is not None
        return _Entry(scene, beam, beam.spread, hierarchy.margin(beam.farthest))

    def may_be(self, half_face: Any) -> Any:
        """Whether some ray of each beam may do so."""
        corners = [self.scene.point(vertex) for vertex in self.scene.indices_and_apex(half_face)[:3]]
        places = [[x - o for x, o in zip(corner, self.beam.origin, strict=True)] for corner in corners]
        is_met, rounding = dr.mask_t(self.margin)(True), 0.0
        for p, q in zip(places, places[1:] + places[:1], strict=True):
            is_met &= self._may_be_left(p, q)
            rounding += self.margin * (_length(p) + _length(q))
        outward = cross(_between(places[0], places[1]), _between(places[0], places[2]))
        facing = rounding
        for d, turn, part in zip(self.beam.direction, self.spread.direction, outward, strict=True):
            facing = dr.fma(d, part, dr.fma(turn, dr.abs(part), facing))
        return is_met & (facing >= 0.0)

    def _may_be_left(self, p: list[Any], q: list[Any]) -> Any:
        d, ways, turns = self.beam.direction, self.spread.origin, self.spread.direction
        edge, normal = _between(p, q), cross(p, q)
        across, most = cross(edge, list(d)), self.margin * (_length(p) + _length(q))
        for axis, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            swing = dr.fma(dr.abs(edge[j]), turns[k], dr.abs(edge[k]) * turns[j])
            most = dr.fma(d[axis], normal[axis], dr.fma(turns[axis], dr.abs(normal[axis]), most))
            most = dr.fma(ways[axis], dr.abs(across[axis]) + swing, most)
        return most >= 0.0


def _between(p: list[Any], q: list[Any]) -> list[Any]:
    return [b - a for a, b in zip(p, q, strict=True)]


def _length(p: list[Any]) -> Any:
    """A bound of it that costs little."""
    return dr.abs(p[0]) + dr.abs(p[1]) + dr.abs(p[2])


def _beam(backend: Backend, pencil: Any, seen: Seen) -> Beam:
    """The boxes that hold the rays of pencils, as far as these are looked at."""
    ends = [backend.Float(dr.inf) for _ in range(14)]

    def body(k: Any, ends: list[Any]) -> tuple[Any, list[Any]]:
        rays, near, far = seen(RAYS * pencil + k)
        is_seen = rays.valid & (near < far)
        assert rays.frame.origin is not None
        parts = (*rays.frame.origin, *rays.frame.direction)
        values = (*parts, *(-part for part in parts), near, -far)
        return k + 1, [dr.select(is_seen, dr.fmin(a, b), a) for a, b in zip(ends, values, strict=True)]

    start = dr.zeros(backend.UInt, dr.width(pencil))
    _, ends = dr.while_loop((start, ends), lambda k, _: k < RAYS, body)
    lows, highs, (near, far) = ends[:6], [-value for value in ends[6:12]], ends[12:]
    middles = [0.5 * (low + high) for low, high in zip(lows, highs, strict=True)]
    halves = [dr.fmax(high - m, m - low) for low, high, m in zip(lows, highs, middles, strict=True)]
    spread = Spread((halves[0], halves[1], halves[2]), (halves[3], halves[4], halves[5]))
    origin, direction = (middles[0], middles[1], middles[2]), (middles[3], middles[4], middles[5])
    return Beam(origin, direction, near, -far, lows[0] <= highs[0], spread)
