"""Rays taken apart into segments of linear density: one a cell, or several by a transfer function (Dr.Jit)."""

from __future__ import annotations

from typing import Any

from difftetvr.rendering.traversal.crossing import Clip, Span, Step, Tracer, corner_of, read_vertex
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import Corner, Face


class SegmentKernel:
    """Passes rays through segments; see :class:`difftetvr.rendering.traversal.crossing.Kernel`.

    What a ray is before the first and behind the last one is up to what is gathered from them: :meth:`start`,
    :meth:`pass_segment`, :meth:`goes_on`, :meth:`finish`.
    """

    def __init__(self, tracer: Tracer, rays: Lanes, slots: int = 0) -> None:
        """Begin, with a number of accumulators at each vertex."""
        self.view, self.rays, self.slots = tracer.view, rays, slots
        self.span = Span.of(tracer, rays)

    def start(self) -> Any:
        """State of the rays before their first crossing."""
        raise NotImplementedError

    def pass_segment(self, entry: list[Any], leaving: list[Any], ray: Any) -> Any:
        """Pass a segment.

        Args:
            entry: Distance, density and channels where it starts; channels only where they are not those of vertices.
            leaving: The same where it ends.
            ray: State of the rays.

        Returns:
            The new state.
        """
        raise NotImplementedError

    def goes_on(self, ray: Any) -> Any:
        """Whether a ray has something to gather from the cells that are still ahead of it."""
        raise NotImplementedError

    def finish(self, ray: Any) -> None:
        """Store what is to be kept of the rays."""
        raise NotImplementedError

    def read(self, vertex: Any, active: Any) -> Corner:
        """A vertex as the ray sees it."""
        position, attributes = read_vertex(self.view, vertex, active)
        return corner_of(self.rays.frame, vertex, position, attributes, self.slots)

    def visit(self, step: Step, ray: Any) -> Any:
        """Pass the segments of a cell."""
        entry, leaving, _ = self.clipped(step)
        return self.pass_cell(step.cell, entry, leaving, ray)

    def leave(self, face: Face, ray: Any, active: Any) -> Any:
        """Nothing is left at the last face."""
        return ray

    def clipped(self, step: Step) -> tuple[list[Any], list[Any], Clip | None]:
        """Distance and density or scalar, where a cell has none, at both ends of the part that is looked at."""
        entry, leaving, clip = step.entry, step.leaving, None
        if self.view.transfer is not None:
            entry = self.view.transfer.bounded(entry, step.face)
            leaving = self.view.transfer.bounded(leaving, step.next_face)
        if self.span is not None:
            clip = self.span.clip(entry[0], leaving[0])
            entry, leaving = clip.start(entry, leaving), clip.end(entry, leaving)
        return entry, leaving, clip

    def pass_cell(self, cell: Any, entry: list[Any], leaving: list[Any], ray: Any) -> Any:
        """Pass a cell whose channels, if any, are its own or those of a transfer function."""
        view = self.view
        channels: list[Any] | None = None if view.channels else []
        if view.cells is not None:
            *channels, density = view.records.gather(view.backend, view.cells, cell)
            if view.has_cell_density:
                entry, leaving = [entry[0], density], [leaving[0], density]

        def complete(values: list[Any]) -> list[Any]:
            return values if channels is None else [*values[:2], *channels]

        if view.transfer is None:
            return self.pass_segment(complete(entry), complete(leaving), ray)
        return view.transfer.cut(
            entry,
            leaving,
            lambda piece, ray: self.pass_segment(complete(piece.start_values), complete(piece.end_values), ray),
            ray,
        )
