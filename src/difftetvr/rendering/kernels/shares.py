"""Sums over rays in a certain order, on several threads (Dr.Jit).

Additions of several threads have no order, and so no certain last bits. For sums that are the same in every run lanes
are dealt out to some copies of what they add to, and the copies are added up one after the other. Dr.Jit gives threads
blocks of lanes: two blocks for each thread, of equal size, as long as these have no more than 16384 lanes. So with 1, 2
and 4 threads, up to half of the copies, no two add to the same copy, and all numbers of threads come to the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.traversal.crossing import Tracer

COPIES = 8
"""Twice the threads that take part: more copies would let more of them, but take longer to add up."""

_LANES_OF_A_LAUNCH = 2 * 2 * 16384  # so that two threads have no more than Dr.Jit's blocks
_WIDEST_PACKET = 16
_MOST_LAUNCHES = 64
_MOST_FLOATS = 1 << 22  # of vertex records: the copies of what refinements are predicted from then take some 2 GB


@dataclass
class Deal:
    """How the lanes of a kernel are dealt out to copies of what it adds to.

    Attributes:
        copies: Number of copies.
        lane: Numbers of the lanes of one launch; None where all lanes add to one copy.
        lanes_of_a_copy: How many of them add to each copy.
        starts: The first lane of each launch.
    """

    copies: int
    lane: Any | None
    lanes_of_a_copy: Any | None
    starts: list[Any]

    @staticmethod
    def of(tracer: Tracer, in_order: bool) -> Deal:
        """One copy for all lanes; several for sums in order, on as many threads as :func:`threads_in_order` says."""
        lane_count = tracer.view.rays.lane_count
        if not in_order or not _is_dealt_out(tracer):
            return Deal(1, None, None, [])
        backend, packets = tracer.view.backend, -(-lane_count // (COPIES * _WIDEST_PACKET))
        lanes = min(_LANES_OF_A_LAUNCH // COPIES, packets * _WIDEST_PACKET)
        starts = [backend.constant(start) for start in range(0, lane_count, COPIES * lanes)]
        return Deal(COPIES, backend.lanes(COPIES * lanes), backend.constant(lanes), starts)

    def trace(self, tracer: Tracer, run: Callable[[Tracer, Any | None], None]) -> None:
        """Run a kernel on all lanes.

        Args:
            tracer: What crosses the mesh.
            run: Takes it, perhaps for some of its lanes alone, and which copy each of them adds to.
        """
        if self.lane is None:
            run(tracer, None)
            return
        for start in self.starts:
            part = tracer.on_lanes(self.lane + start)
            assert part is not None
            run(part, self.lane // self.lanes_of_a_copy)


def threads_in_order(tracer: Tracer) -> int:
    """Threads for kernels whose sums shall have an order: a power of two, and one where lanes cannot be dealt out."""
    if not _is_dealt_out(tracer):
        return 1
    return 1 << (min(dr.thread_count(), COPIES // 2).bit_length() - 1)


def _is_dealt_out(tracer: Tracer) -> bool:
    view = tracer.view
    if view.backend.name != "llvm" or tracer.on_lanes(view.lane) is None:
        return False
    return view.rays.lane_count <= _MOST_LAUNCHES * _LANES_OF_A_LAUNCH and dr.width(view.vertices) <= _MOST_FLOATS
