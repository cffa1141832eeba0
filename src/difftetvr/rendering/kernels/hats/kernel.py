"""Rays through hat functions: what all that is gathered from their responses shares (Dr.Jit kernel).

A hat function is 1 at a point, 0 on the boundary of the cells around it, and linear on the pieces in between:

    of a vertex   the function that its colour and density multiply               lambda_i
    of an edge    what the values of a new vertex in its middle would multiply    2 min(lambda_i, lambda_j)
    of a face     what a flip of the face adds, with its peak in the centre       3 min(lambda_i, lambda_j, lambda_k)

For each ray and each hat a kernel integrates the response of what is measured to the hat's coefficients. Its sums over
rays give gradient and Gauss-Newton matrix of the squared error with respect to them. A ray crosses the cells around a
vertex, edge or face one after the other, so responses are carried like vertices are: what a step drops is complete, and
the square of the whole is added, not those of its parts.
Only where a ray leaves cells that are not convex together and enters them again, the parts are squared for themselves;
that underestimates the curvature of a few edges, in random Delaunay meshes by up to a fifth.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.recording import replayed
from difftetvr.rendering.kernels.hats.space import HatRecords, HatSpace
from difftetvr.rendering.kernels.hats.tables import HatTables, RankedCell, ranks_of
from difftetvr.rendering.kernels.shares import Deal
from difftetvr.rendering.traversal.crossing import (
    Span,
    Step,
    Tracer,
    corner_of,
    read_channels,
    read_vertex,
)
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.sums import Copies, Sums
from difftetvr.rendering.traversal.walk import Corner, Exit, Face

SAMPLES = 4
"""Pieces of a crossing on which hats, colour and density are taken as constant."""

PLACES = [(k + 0.5) / SAMPLES for k in range(SAMPLES)]

_UNKNOWN = 0xFFFFFFFF
# A cell's corners in a kernel: the one that the walk drops, those that follow in the entry face's turn, and the apex.
_DROPPED, _AFTER, _BEFORE, _APEX = range(4)

Response = list[Any]  # of light B, D_r, D_g, D_b


@dataclass
class HatSums:
    """What the kernel adds to to make them."""

    vertices: Sums
    edges: Sums
    faces: Sums
    width: int  # of a record, but of those of steps

    def of_copy(self, copy: Any | None) -> HatSums:
        """The same for lanes that each add to a copy of their own."""
        vertices, edges, faces = (sums.of_copy(copy) for sums in (self.vertices, self.edges, self.faces))
        return HatSums(vertices, edges, faces, self.width)


@dataclass
class HatRay:
    """State of a ray.

    Attributes:
        transmittance: Transmittance up to the current crossing.
        rest: Radiance from there on, three components.
        edges: Response of each edge of the face that the ray enters through, edge k opposite corner k.
        edge_ids: Which edges these are.
        face: Response of the face itself.
    """

    transmittance: Any
    rest: list[Any]
    edges: list[Response]
    edge_ids: list[Any]
    face: Response


@dataclass
class _Samples:
    """One cell's crossing, piece by piece.

    Attributes:
        responses: To a change at each piece.
        first, last: Barycentric coordinates of the cell's corners where the crossing begins and ends.
    """

    responses: list[Response]
    first: list[Any]
    last: list[Any]

    def respond(self, *corners: int) -> Response:
        """Response of the hat over some corners."""
        total: Response = []
        for x, response in zip(PLACES, self.responses, strict=True):
            weights = [dr.fma(x, self.last[k] - self.first[k], self.first[k]) for k in corners]
            hat = functools.reduce(dr.fmin, weights) * float(len(corners))
            total = [dr.fma(hat, r, t) for r, t in zip(response, total)] or [hat * r for r in response]
        return total


def gathered_records(kernel: Any, tracer: Tracer, asked: Any, space: HatSpace, in_order: bool) -> HatRecords:
    """Sums over the rays of a view.

    Args:
        kernel: Class of a :class:`HatKernel`, made of tracer, rays, tables, sums and what is asked.
        tracer: The view.
        asked: What the kernel reads.
        space: What there are hats of.
        in_order: Whether sums over rays have a certain order.
    """
    view = tracer.view
    sizes = [count * width for count, width in zip(space.counts, space.widths, strict=True)]
    deal, pairs = Deal.of(tracer, sum(sizes), in_order), zip(sizes, space.widths, strict=True)
    copies = [Copies.of(view.backend, deal.copies, size, width) for size, width in pairs]
    buffers = _Buffers(sizes, copies, space.width)
    tables = HatTables.of(space)
    with view.backend.on_threads(deal.threads):
        records: HatRecords = replayed(_records, kernel, tracer, tables, asked, deal, buffers)
    return records


@dataclass
class _Buffers:
    """Numbers of floats, where copies are, None where there is but one, and the floats of a record."""

    sizes: list[int]
    copies: list[Copies | None]
    width: int


def _records(kernel: Any, tracer: Tracer, tables: HatTables, asked: Any, deal: Deal, buffers: _Buffers) -> HatRecords:
    backend, pairs = tracer.view.backend, zip(buffers.sizes, buffers.copies, strict=True)
    vertices, edges, faces = (Sums.zeros(backend, size, copies, deal.mode) for size, copies in pairs)
    sums = HatSums(vertices, edges, faces, buffers.width)

    def run(part: Tracer, copy: Any | None) -> None:
        part.trace(lambda rays: kernel(part, rays, tables, sums.of_copy(copy), asked))

    deal.trace(tracer, run)
    totals = HatRecords(vertices.total(), edges.total(), faces.total())
    dr.eval(totals)
    return totals


class HatKernel:
    """Gathers responses; see :class:`difftetvr.rendering.traversal.crossing.Kernel`.

    What a response is, and what is kept of one, is up to what is looked for: :meth:`sample`, :meth:`record`,
    :meth:`step_record`.
    """

    slots: int
    """Numbers in a response."""
    has_steps: bool
    """Whether but one step of each face is looked at."""

    def __init__(self, tracer: Tracer, rays: Lanes, tables: HatTables, records: HatSums) -> None:
        self.view, self.rays, self.tables, self.records = tracer.view, rays, tables, records
        self.span = Span.of(tracer, rays)

    def sample(self, entry: list[Any], leaving: list[Any], ray: HatRay) -> tuple[list[Response], Any, list[Any]]:
        """Responses to a change at each piece of a crossing.

        Args:
            entry: Distance, density and channels where it begins.
            leaving: The same where it ends.
            ray: State of the rays.

        Returns:
            The responses, and transmittance and rest of the rays behind the crossing.
        """
        raise NotImplementedError

    def record(self, response: Response) -> list[Any]:
        """What is added to a hat's record."""
        raise NotImplementedError

    def step_record(self, face: Any, response: Response) -> list[Any]:
        """What is added to the record of a face's one step."""
        raise NotImplementedError

    def start(self) -> HatRay:
        """State of the rays before their first crossing."""
        lanes = dr.width(self.rays.pixel)
        return HatRay(
            dr.ones(self.view.backend.Float, lanes),
            self.light(),
            [self._no_response() for _ in range(3)],
            [dr.full(self.view.backend.UInt, _UNKNOWN, lanes) for _ in range(3)],
            self._no_response(),
        )

    def light(self) -> list[Any]:
        """Radiance of the whole rays; nothing where it does not matter."""
        return []

    def read(self, vertex: Any, active: Any) -> Corner:
        """A vertex with its values."""
        position, attributes = read_vertex(self.view, vertex, active)
        if self.view.has_vertex_channels:
            attributes = [*attributes, *read_channels(self.view, vertex, active)]
        return corner_of(self.rays.frame, vertex, position, attributes, self.slots)

    def visit(self, step: Step, ray: HatRay) -> HatRay:
        """Add a crossing's responses, and scatter those of hats that the ray leaves behind."""
        samples, transmittance, rest = self._sample(step, ray)
        self._finish_vertices(step, samples)
        vertices = [*_turned(step.exit, [corner.vertex for corner in step.face.corners]), step.apex.vertex]
        cell = RankedCell(self.tables, step.cell, ranks_of(vertices))
        edges, edge_ids = self._finish_edges(step.exit, ray, samples, cell)
        return HatRay(transmittance, rest, edges, edge_ids, self._finish_faces(ray, samples, cell))

    def goes_on(self, ray: HatRay) -> Any:
        """Whether a ray has something to gather from the cells that are still ahead of it."""
        return ray.transmittance > self.view.threshold

    def leave(self, face: Face, ray: HatRay, active: Any) -> HatRay:
        """Scatter what is carried at a face behind which there is no cell."""
        for corner in face.corners:
            self._scatter(self.records.vertices, corner.vertex, corner.adjoints, active)
        for edge, response in zip(ray.edge_ids, ray.edges, strict=True):
            self._scatter_edge(edge, response, active & (edge != _UNKNOWN))
        # A face on the boundary cannot be flipped, so its record is of no use.
        fresh = self.start()
        return HatRay(ray.transmittance, ray.rest, fresh.edges, fresh.edge_ids, fresh.face)

    def finish(self, ray: HatRay) -> None:
        """Nothing is kept of the rays themselves."""

    def _sample(self, step: Step, ray: HatRay) -> tuple[_Samples, Any, list[Any]]:
        """The crossing in pieces, and transmittance and rest behind it."""
        entry, leaving = step.entry, step.leaving
        first, last = _barycentric(step)
        if self.span is not None:
            clip = self.span.clip(entry[0], leaving[0])
            first, last = clip.start(first, last), clip.end(first, last)
            entry, leaving = clip.start(entry, leaving), clip.end(entry, leaving)
        responses, transmittance, rest = self.sample(entry, leaving, ray)
        return _Samples(responses, first, last), transmittance, rest

    def _finish_vertices(self, step: Step, samples: _Samples) -> None:
        """Scatter the dropped corner; the others go on to the next face."""
        old = _turned_rows(step.exit, [corner.adjoints for corner in step.face.corners])
        dropped, *kept = (_plus(old[k], samples.respond(k)) for k in (_DROPPED, _AFTER, _BEFORE))
        self._scatter(self.records.vertices, step.exit.vertex(step.face), dropped, True)
        adjoints = _turned_back(step.exit, [samples.respond(_APEX), *kept])
        for corner, response in zip(step.next_face.corners, adjoints, strict=True):
            corner.adjoints = response

    def _finish_edges(
        self, exit_: Exit, ray: HatRay, samples: _Samples, cell: RankedCell
    ) -> tuple[list[Response], list[Any]]:
        """Scatter the three edges at the dropped corner; returns those of the next face."""
        rows = _turned_rows(exit_, [[known, *edge] for known, edge in zip(ray.edge_ids, ray.edges, strict=True)])
        old = []
        for row, corners in zip(rows, ((_AFTER, _BEFORE), (_BEFORE, _DROPPED), (_DROPPED, _AFTER)), strict=True):
            unknown = row[0] == _UNKNOWN
            edge = dr.select(unknown, cell.edge(*corners, unknown), row[0])
            old.append([edge, *_plus(row[1:], samples.respond(*corners))])
        new = [[cell.edge(k, _APEX), *samples.respond(k, _APEX)] for k in (_DROPPED, _AFTER, _BEFORE)]
        for edge, *response in (new[_DROPPED], old[_AFTER], old[_BEFORE]):
            self._scatter_edge(edge, response)
        # The apex takes the dropped corner's place: opposite it lies what lay opposite that one.
        kept = _turned_back(exit_, [old[_DROPPED], new[_BEFORE], new[_AFTER]])
        return [row[1:] for row in kept], [row[0] for row in kept]

    def _finish_faces(self, ray: HatRay, samples: _Samples, cell: RankedCell) -> Response:
        """Scatter the face entered through and the two passed by; returns the response of the face left through."""
        entered = _plus(ray.face, samples.respond(_DROPPED, _AFTER, _BEFORE))
        self._scatter_face(cell.face(_APEX), entered)
        for opposite, other in ((_BEFORE, _AFTER), (_AFTER, _BEFORE)):
            self._scatter_face(cell.face(opposite), samples.respond(_DROPPED, other, _APEX))
        return samples.respond(_AFTER, _BEFORE, _APEX)

    def _scatter_edge(self, edge: Any, response: Response, active: Any = True) -> None:
        limit = self.tables.asked_edges
        self._scatter(self.records.edges, edge, response, active if limit is None else active & (edge < limit))

    def _scatter_face(self, face: Any, response: Response) -> None:
        limit = self.tables.asked_faces
        is_asked = True if limit is None else face < limit
        if not self.has_steps:
            self._scatter(self.records.faces, face, response, is_asked)
            return
        self.records.faces.add(self.view.backend.Floats(self.step_record(face, response)), face, is_asked)

    def _scatter(self, sums: Sums, index: Any, response: Response, active: Any) -> None:
        # In one piece: on GPUs, threads of a warp that share a record have to find each other but once.
        record = self.record(response)
        padding = [dr.zeros_like(record[0])] * (self.records.width - len(record))
        sums.add(self.view.backend.Floats(record + padding), index, active)

    def _no_response(self) -> Response:
        return [dr.zeros(self.view.backend.Float, dr.width(self.rays.pixel)) for _ in range(self.slots)]


def _barycentric(step: Step) -> tuple[list[Any], list[Any]]:
    """Coordinates of the cell's corners where the ray enters and where it leaves."""
    first, last = (_turned(step.exit, face.weights()) for face in (step.face, step.next_face))
    zero = dr.zeros_like(first[0])
    return [*first, zero], [zero, *last[1:], last[0]]


def _turned(exit_: Exit, items: list[Any]) -> list[Any]:
    """Three corners' items, beginning with that of the dropped one."""
    return [exit_.pick([items[(k + turn) % 3] for k in range(3)]) for turn in range(3)]


def _turned_rows(exit_: Exit, rows: list[list[Any]]) -> list[list[Any]]:
    columns = [_turned(exit_, list(column)) for column in zip(*rows, strict=True)]
    return [list(row) for row in zip(*columns, strict=True)]


def _turned_back(exit_: Exit, rows: list[list[Any]]) -> list[list[Any]]:
    """The inverse of :func:`_turned_rows`."""
    dropped = exit_.dropped
    return [_select(dropped[k], rows[0], _select(dropped[(k + 2) % 3], rows[1], rows[2])) for k in range(3)]


def _plus(one: Response, other: Response) -> Response:
    return [x + y for x, y in zip(one, other, strict=True)]


def _select(mask: Any, one: Response, other: Response) -> Response:
    return [dr.select(mask, x, y) for x, y in zip(one, other, strict=True)]
