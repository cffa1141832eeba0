"""What an image would gain if the mesh were finer or cut otherwise: derivatives by hat functions (Dr.Jit kernel).

A hat function is 1 at a point, 0 on the boundary of the cells around it, and linear on the pieces in between:

    of a vertex   the function that its colour and density multiply               lambda_i
    of an edge    what the values of a new vertex in its middle would multiply    2 min(lambda_i, lambda_j)
    of a face     what a flip of the face adds, with its peak in the centre       3 min(lambda_i, lambda_j, lambda_k)

For each ray and each hat the kernel integrates the response of the pixel, B to one unit of colour and (D_r, D_g, D_b)
to one unit of density. Its sums over rays give gradient and Gauss-Newton matrix of the squared error with respect to
the hat's four coefficients. A ray crosses the cells around a vertex, edge or face one after the other, so responses are
carried like vertices are: what a step drops is complete, and the square of the whole is added, not those of its parts.
Only where a ray leaves cells that are not convex together and enters them again, the parts are squared for themselves;
that underestimates the curvature of a few edges, in random Delaunay meshes by up to a fifth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.incidence import cell_edges, cell_faces
from difftetvr.mesh.topology.topology import LOCAL_EDGE_OF, LOCAL_EDGES, Topology
from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.kernels.gradients import reduce_mode
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.traversal.crossing import (
    Span,
    Step,
    Tracer,
    View,
    corner_of,
    read_channels,
    read_vertex,
)
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import Corner, Face

RECORD = 12
"""Floats a hat: colour gradient (3), density gradient, sums of B^2, B D (3), D^2, B, and two of padding."""

_SAMPLES = 4
"""Pieces of a crossing on which hats, colour and density are taken as constant."""

_UNKNOWN = 0xFFFFFFFF
_FACE_EDGES = ((1, 2), (2, 0), (0, 1))  # edge k of the entry face is opposite corner k
_APEX = 3

Response = list[Any]  # B, D_r, D_g, D_b


@dataclass
class HatTables:
    """Flat tables from a cell to its edges and faces, both in the order of its vertices' indices.

    Attributes:
        edges: (T, 6) indices into ``topology.edges``; pairs of ranks in the order of ``LOCAL_EDGES``.
        faces: (T, 4) indices into ``topology.faces``; entry r is the face opposite the r-th vertex.
    """

    edges: Any
    faces: Any

    @staticmethod
    def of(view: View, mesh: TetMesh, order: MemoryOrder) -> HatTables:
        """Upload the tables of a mesh in an order; built once for a topology."""
        edges, faces = order.topology.cached("render.hat_tables", lambda: _ranked_tables(mesh.topology, order))
        return HatTables(view.backend.uints(edges), view.backend.uints(faces))


@dataclass
class HatImage:
    """What the kernel reads of each pixel, flat: (H, W, 3) radiance over the background, and the loss's derivative."""

    color: Any
    gradient: Any


@dataclass
class HatRecords:
    """Flat buffers of ``RECORD`` floats for each vertex, edge and face."""

    vertices: Any
    edges: Any
    faces: Any
    mode: dr.ReduceMode


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
    """One cell's crossing, piece by piece: response to a change at the piece, and barycentric coordinates there."""

    responses: list[Response]
    weights: list[list[Any]]

    def respond(self, corners: tuple[int, ...]) -> Response:
        """Response of the hat over some of the cell's corners, 0 to 2 of the entry face and 3 the apex."""
        total: Response | None = None
        for response, weights in zip(self.responses, self.weights, strict=True):
            hat = weights[corners[0]]
            for corner in corners[1:]:
                hat = dr.fmin(hat, weights[corner])
            hat = hat * float(len(corners))
            total = (
                [hat * r for r in response]
                if total is None
                else [dr.fma(hat, r, t) for r, t in zip(response, total, strict=True)]
            )
        assert total is not None
        return total


def hat_records(tracer: Tracer, mesh: TetMesh, order: MemoryOrder, image: HatImage) -> HatRecords:
    """Sums over the rays of a view for every vertex, edge and face.

    Args:
        tracer: The view, to be walked through; its field lives on vertices.
        mesh: The mesh that is seen.
        order: Its order in memory, which is that of the records of vertices; edges and faces are in the mesh's.
        image: The rendered image, and the derivative of the loss with respect to it.
    """
    view, topology = tracer.view, mesh.topology
    counts = [few_lengths(n) for n in (mesh.num_vertices, topology.edges.shape[0], topology.faces.shape[0])]
    mode = reduce_mode(view, RECORD * sum(counts))
    records: HatRecords = replayed(_records, tracer, HatTables.of(view, mesh, order), image, counts, mode)
    return records


def _records(tracer: Tracer, tables: HatTables, image: HatImage, counts: list[int], mode: dr.ReduceMode) -> HatRecords:
    vertices, edges, faces = (dr.zeros(tracer.view.backend.Float, RECORD * count) for count in counts)
    records = HatRecords(vertices, edges, faces, mode)
    tracer.trace(lambda rays: _HatKernel(tracer, rays, tables, records, image))
    dr.eval(vertices, edges, faces)
    return records


class _HatKernel:
    """Gathers responses; see :class:`difftetvr.rendering.traversal.crossing.Kernel`."""

    def __init__(self, tracer: Tracer, rays: Lanes, tables: HatTables, records: HatRecords, image: HatImage) -> None:
        self.view, self.rays, self.tables, self.records = tracer.view, rays, tables, records
        self.span = Span.of(tracer, rays)
        pixel, valid = rays.pixel, rays.valid
        self.color, self.gradient = (
            [dr.gather(self.view.backend.Float, array, 3 * pixel + k, valid) for k in range(3)]
            for array in (image.color, image.gradient)
        )

    def start(self) -> HatRay:
        lanes = dr.width(self.rays.pixel)
        return HatRay(
            dr.ones(self.view.backend.Float, lanes),
            self.color,
            [self._no_response() for _ in range(3)],
            [dr.full(self.view.backend.UInt, _UNKNOWN, lanes) for _ in range(3)],
            self._no_response(),
        )

    def read(self, vertex: Any, active: Any) -> Corner:
        position, attributes = read_vertex(self.view, vertex, active)
        attributes = [*attributes, *read_channels(self.view, vertex, active)]
        return corner_of(self.rays.frame, vertex, position, attributes, 4)

    def visit(self, step: Step, ray: HatRay) -> HatRay:
        samples, transmittance, rest = self._sample(step, ray)
        self._finish_vertices(step, samples)
        edges, edge_ids = self._finish_edges(step, ray, samples)
        return HatRay(transmittance, rest, edges, edge_ids, self._finish_faces(step, ray, samples))

    def goes_on(self, ray: HatRay) -> Any:
        return ray.transmittance > self.view.threshold

    def leave(self, face: Face, ray: HatRay, active: Any) -> HatRay:
        for corner in face.corners:
            self._scatter(self.records.vertices, corner.vertex, corner.adjoints, active)
        for edge, response in zip(ray.edge_ids, ray.edges, strict=True):
            self._scatter(self.records.edges, edge, response, active & (edge != _UNKNOWN))
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
        length = dr.fmax(leaving[0] - entry[0], 0.0)
        piece = length * (1.0 / _SAMPLES)
        transmittance, rest = ray.transmittance, ray.rest
        samples = _Samples([], [])
        for k in range(_SAMPLES):
            x = (k + 0.5) / _SAMPLES
            density, *color = (dr.fma(x, v1 - v0, v0) for v0, v1 in zip(entry[1:], leaving[1:], strict=True))
            opacity = 1.0 - dr.exp(-density * piece)
            seen = transmittance * opacity
            transmittance = transmittance - seen
            rest = [dr.fma(-seen, c, r) for c, r in zip(color, rest, strict=True)]
            # More density here shows more of this piece and dims all that lies behind it.
            dims = [piece * dr.fma(transmittance, c, -r) for c, r in zip(color, rest, strict=True)]
            samples.responses.append([seen, *dims])
            samples.weights.append([dr.fma(x, w1 - w0, w0) for w0, w1 in zip(first, last, strict=True)])
        # The state goes on exactly: errors of the pieces do not add up along the ray.
        w0, w1, through = self.view.optics.weights(length, entry[1], leaving[1])
        w0, w1 = w0 * ray.transmittance, w1 * ray.transmittance
        colors = zip(entry[2:], leaving[2:], ray.rest, strict=True)
        return samples, ray.transmittance * through, [r - dr.fma(w0, c0, w1 * c1) for c0, c1, r in colors]

    def _finish_vertices(self, step: Step, samples: _Samples) -> None:
        for k, corner in enumerate(step.face.corners):
            corner.adjoints = _plus(corner.adjoints, samples.respond((k,)))
        done = [step.exit.pick([corner.adjoints[i] for corner in step.face.corners]) for i in range(4)]
        self._scatter(self.records.vertices, step.exit.vertex(step.face), done, True)
        step.exit.carry_adjoints(step.face, step.next_face)
        apex = samples.respond((_APEX,))
        for mask, corner in zip(step.exit.dropped, step.next_face.corners, strict=True):
            corner.adjoints = _select(mask, apex, corner.adjoints)

    def _finish_edges(self, step: Step, ray: HatRay, samples: _Samples) -> tuple[list[Response], list[Any]]:
        """Scatter the three edges at the dropped corner; returns those of the next face."""
        uint = self.view.backend.UInt
        ranks, pick = _ranks(step), step.exit.pick
        new_ids = [dr.gather(uint, self.tables.edges, _edge_row(step.cell, ranks[k], ranks[_APEX])) for k in range(3)]
        old_ids, old = [], []
        for k, (i, j) in enumerate(_FACE_EDGES):
            unknown = ray.edge_ids[k] == _UNKNOWN
            found = dr.gather(uint, self.tables.edges, _edge_row(step.cell, ranks[i], ranks[j]), unknown)
            old_ids.append(dr.select(unknown, found, ray.edge_ids[k]))
            old.append(_plus(ray.edges[k], samples.respond((i, j))))
        new = [samples.respond((k, _APEX)) for k in range(3)]
        self._scatter(self.records.edges, pick(new_ids), _pick(pick, new), True)
        for turn in (1, 2):
            ids, responses = ([values[(k + turn) % 3] for k in range(3)] for values in (old_ids, old))
            self._scatter(self.records.edges, pick(ids), _pick(pick, responses), True)
        edges, edge_ids = [], []
        for k in range(3):
            kept, after, before = step.exit.dropped[k], (k + 1) % 3, (k + 2) % 3
            # Edge k of the next face is the old one if corner k went; else it joins the apex and the corner that stays.
            other = _select(step.exit.dropped[after], new[before], new[after])
            other_id = dr.select(step.exit.dropped[after], new_ids[before], new_ids[after])
            edges.append(_select(kept, old[k], other))
            edge_ids.append(dr.select(kept, old_ids[k], other_id))
        return edges, edge_ids

    def _finish_faces(self, step: Step, ray: HatRay, samples: _Samples) -> Response:
        """Scatter the face entered through and the two passed by; returns the response of the face left through."""
        uint, faces = self.view.backend.UInt, self.tables.faces
        ranks, pick = _ranks(step), step.exit.pick
        entered = _plus(ray.face, samples.respond((0, 1, 2)))
        self._scatter(self.records.faces, dr.gather(uint, faces, 4 * step.cell + ranks[_APEX]), entered, True)
        opposite = [samples.respond((*_FACE_EDGES[k], _APEX)) for k in range(3)]
        for turn in (1, 2):
            responses = [opposite[(k + turn) % 3] for k in range(3)]
            row = 4 * step.cell + pick([ranks[(k + turn) % 3] for k in range(3)])
            self._scatter(self.records.faces, dr.gather(uint, faces, row), _pick(pick, responses), True)
        return _pick(pick, opposite)

    def _scatter(self, buffer: Any, index: Any, response: Response, active: Any) -> None:
        float4 = self.view.backend.Float4
        b, d, g = response[0], response[1:], self.gradient
        zero = dr.zeros_like(b)
        slope = dr.fma(g[0], d[0], dr.fma(g[1], d[1], g[2] * d[2]))
        square = dr.fma(d[0], d[0], dr.fma(d[1], d[1], d[2] * d[2]))
        packets = [[g[0] * b, g[1] * b, g[2] * b, slope], [b * b, *(b * v for v in d)], [square, b, zero, zero]]
        for k, packet in enumerate(packets):
            dr.scatter_add(buffer, float4(*packet), 3 * index + k, active, mode=self.records.mode)

    def _no_response(self) -> Response:
        return [dr.zeros(self.view.backend.Float, dr.width(self.rays.pixel)) for _ in range(4)]


def _barycentric(step: Step) -> tuple[list[Any], list[Any]]:
    """Coordinates in the cell, of the entry face's corners and the apex, where the ray enters and where it leaves."""
    first, last = step.face.weights(), step.next_face.weights()
    stays = [dr.select(mask, 0.0, w) for mask, w in zip(step.exit.dropped, last, strict=True)]
    return [*first, dr.zeros_like(first[0])], [*stays, step.exit.pick(last)]


def _ranks(step: Step) -> list[Any]:
    """Place of each corner of the entry face, and of the apex, among the cell's four vertices by index."""
    vertices = [*(corner.vertex for corner in step.face.corners), step.apex.vertex]
    uint = type(step.cell)
    ranks = []
    for vertex in vertices:
        rank = uint(0)
        for other in vertices:
            rank += dr.select(other < vertex, uint(1), uint(0))
        ranks.append(rank)
    return ranks


def _edge_row(cell: Any, one: Any, other: Any) -> Any:
    """Row of the edge table for two ranks, in the order of ``LOCAL_EDGES``."""
    low, high = dr.select(one < other, one, other), dr.select(one < other, other, one)
    return 6 * cell + ((low * (7 - low)) >> 1) + (high - low - 1)


def _plus(one: Response, other: Response) -> Response:
    return [x + y for x, y in zip(one, other, strict=True)]


def _select(mask: Any, one: Response, other: Response) -> Response:
    return [dr.select(mask, x, y) for x, y in zip(one, other, strict=True)]


def _pick(pick: Any, responses: list[Response]) -> Response:
    return [pick([response[i] for response in responses]) for i in range(4)]


def _ranked_tables(topology: Topology, order: MemoryOrder) -> tuple[torch.Tensor, torch.Tensor]:
    # Vertices of a cell are ranked by their numbers in memory; their places in the cell are the mesh's.
    ranked = order.topology.tets.argsort(dim=1)
    edges, faces = (table.index_select(0, order.cells) for table in (cell_edges(topology), cell_faces(topology)))
    local = torch.tensor(LOCAL_EDGE_OF, device=ranked.device)
    columns = torch.stack([local[ranked[:, i], ranked[:, j]] for i, j in LOCAL_EDGES], 1)
    return torch.gather(edges, 1, columns).contiguous(), torch.gather(faces, 1, ranked).contiguous()
