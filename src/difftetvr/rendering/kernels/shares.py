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

_MOST_LANES = 2 * 2 * 16384
_WIDEST_PACKET = 16
_COPIES = 8, 4
"""Twice the threads that take part: more copies would let more of them, but take longer to add up."""
_COPIES_BUDGET = 1 << 32  # bytes; the sums of a mesh for which four copies take more have a thread to themselves
_EXPAND_BUDGET = 1 << 30  # bytes of one copy a thread; beyond it threads share one through atomics


@dataclass
class Deal:
    """How rays are dealt out to the lanes of a kernel, and these to copies of what they add to.

    Attributes:
        copies: Number of copies.
        mode: How additions to one copy are reduced.
        threads: CPU threads on which sums have their order; None: any, or there is no order.
        lane: Numbers of the kernel's lanes; None where each ray has its own, and all add to one copy.
        lanes_of_a_copy: How many of them add to each copy.
        turns: Rays that a lane takes, one after the other.
    """

    copies: int
    mode: dr.ReduceMode
    threads: int | None
    lane: Any | None = None
    lanes_of_a_copy: Any | None = None
    turns: Any | None = None

    @staticmethod
    def of(tracer: Tracer, floats: int, in_order: bool) -> Deal:
        """A deal for so many floats that are added to; a copy of them for each thread and more where order matters."""
        view = tracer.view
        backend, size = view.backend, floats * (8 if view.backend.is_double else 4)
        if backend.name != "llvm":
            return Deal(1, dr.ReduceMode.Auto, None)
        copies = next((n for n in _COPIES if n * size <= _COPIES_BUDGET), 1)
        if in_order and (copies == 1 or tracer.on_lanes(view.lane) is None):
            return Deal(1, _mode_of_one(size), 1)
        if not in_order:
            return Deal(1, _mode_of_one(size * dr.thread_count()), None)
        threads = 1 << (min(dr.thread_count(), copies // 2).bit_length() - 1)
        packets = -(-view.rays.lane_count // (copies * _WIDEST_PACKET))
        lanes = min(_MOST_LANES // copies, packets * _WIDEST_PACKET)
        turns = -(-view.rays.lane_count // (copies * lanes))
        numbers = backend.lanes(copies * lanes), backend.constant(lanes), backend.constant(turns)
        return Deal(copies, dr.ReduceMode.NoConflicts, threads, *numbers)

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


def _mode_of_one(size: int) -> dr.ReduceMode:
    return dr.ReduceMode.Expand if size <= _EXPAND_BUDGET else dr.ReduceMode.Local
