"""Sums over rays in a certain order, on several threads (Dr.Jit).

Additions of several threads have no order, and so no certain last bits. For sums that are the same in every run rays
are dealt out to some copies of what they add to, and the copies are added up one after the other. Dr.Jit gives threads
blocks of lanes: two blocks for each thread, of equal size, as long as these have no more than 16384 lanes. So a kernel
has no more lanes than that allows for two threads, each of which takes several rays in turn, and with 1, 2 and 4
threads, up to half of the copies, no two add to the same copy: all numbers of threads come to the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.traversal.crossing import Tracer

COPIES = 8
"""Twice the threads that take part: more copies would let more of them, but take longer to add up."""

_MOST_LANES = 2 * 2 * 16384
_WIDEST_PACKET = 16
_MOST_FLOATS = 1 << 22  # of vertex records: the copies of what refinements are predicted from then take some 2 GB


@dataclass
class Deal:
    """How rays are dealt out to the lanes of a kernel, and these to copies of what they add to.

    Attributes:
        copies: Number of copies.
        lane: Numbers of the kernel's lanes; None where each ray has its own, and all add to one copy.
        lanes_of_a_copy: How many of them add to each copy.
        turns: Rays that a lane takes, one after the other.
    """

    copies: int
    lane: Any | None
    lanes_of_a_copy: Any | None
    turns: Any | None

    @staticmethod
    def of(tracer: Tracer, in_order: bool) -> Deal:
        """One copy for all rays; several for sums in order, on as many threads as :func:`threads_in_order` says."""
        ray_count = tracer.view.rays.lane_count
        if not in_order or not _is_dealt_out(tracer):
            return Deal(1, None, None, None)
        backend, packets = tracer.view.backend, -(-ray_count // (COPIES * _WIDEST_PACKET))
        lanes = min(_MOST_LANES // COPIES, packets * _WIDEST_PACKET)
        turns = -(-ray_count // (COPIES * lanes))
        return Deal(COPIES, backend.lanes(COPIES * lanes), backend.constant(lanes), backend.constant(turns))

    def trace(self, tracer: Tracer, run: Callable[[Tracer, Any | None], None]) -> None:
        """Run a kernel on all rays.

        Args:
            tracer: What crosses the mesh.
            run: Takes it, perhaps for some of its rays alone, and which copy each of them adds to.
        """
        if self.lane is None:
            run(tracer, None)
            return
        copy, place = self.lane // self.lanes_of_a_copy, self.lane % _WIDEST_PACKET
        # Neighbouring rays in turn, because they cross the same cells.
        first = dr.fma(self.lane - place, self.turns, place)

        def take(turn: Any) -> tuple[Any]:
            part = tracer.on_lanes(dr.fma(turn, _WIDEST_PACKET, first))
            assert part is not None
            run(part, copy)
            return (turn + 1,)

        dr.while_loop((dr.zeros_like(first),), lambda turn: turn < self.turns, take)


def threads_in_order(tracer: Tracer) -> int:
    """Threads for kernels whose sums shall have an order: a power of two, and one where rays cannot be dealt out."""
    if not _is_dealt_out(tracer):
        return 1
    return 1 << (min(dr.thread_count(), COPIES // 2).bit_length() - 1)


def _is_dealt_out(tracer: Tracer) -> bool:
    view = tracer.view
    if view.backend.name != "llvm" or tracer.on_lanes(view.lane) is None:
        return False
    return dr.width(view.vertices) <= _MOST_FLOATS
