"""Sums over rays in a certain order, on several threads (Dr.Jit).

Additions of several threads have no order, and so no certain last bits. For sums that are the same in every run each
block of lanes that a thread works through, whichever that is, adds to a copy of its own; the copies are added up one
after the other. Dr.Jit makes two blocks for each thread, as long as these have no more than 16384 lanes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.traversal.crossing import Tracer

MOST_THREADS = 8
"""Threads that take part: each means two copies of all that is added to."""

_LANES_OF_A_BLOCK = 16384
_WIDEST_PACKET = 16
_MOST_LAUNCHES = 64


@dataclass(frozen=True)
class Shares:
    """To how many copies of what they add to the lanes of a kernel are dealt out."""

    copies: int = 1


@dataclass
class Deal:
    """The same with arrays for kernels.

    Attributes:
        shares: How lanes are dealt out.
        lane: Numbers of the lanes of one launch; None where all lanes add to one copy.
        lanes_of_a_copy: How many of them add to each copy.
        starts: The first lane of each launch.
    """

    shares: Shares
    lane: Any | None
    lanes_of_a_copy: Any | None
    starts: list[Any]

    @staticmethod
    def of(tracer: Tracer, in_order: bool) -> Deal:
        """One copy for all lanes, or as many as sums in order need on the threads that there are.

        Those should be as :func:`threads_in_order` says.
        """
        backend, lane_count = tracer.view.backend, tracer.view.rays.lane_count
        if not in_order or backend.name != "llvm" or dr.thread_count() == 1:
            return Deal(Shares(), None, None, [])
        copies = 2 * dr.thread_count()
        packets = -(-lane_count // (copies * _WIDEST_PACKET))
        lanes = min(_LANES_OF_A_BLOCK, packets * _WIDEST_PACKET)
        starts = [backend.constant(start) for start in range(0, lane_count, copies * lanes)]
        return Deal(Shares(copies), backend.lanes(copies * lanes), backend.constant(lanes), starts)

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
    """Threads for kernels whose sums shall have an order: one, where lanes cannot be dealt out."""
    count = tracer.view.rays.lane_count
    if tracer.on_lanes(tracer.view.lane) is None or count > _MOST_LAUNCHES * _LANES_OF_A_BLOCK:
        return 1
    return MOST_THREADS
