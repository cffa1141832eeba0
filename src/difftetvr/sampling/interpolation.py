"""The linear interpolant of a mesh's values, and its derivatives (Dr.Jit and PyTorch).

At a point x of a cell the value is sum_k lambda_k(x) v_k. It changes by its gradient when x moves, and by
-lambda_k times it when vertex k does.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend, backend_for
from difftetvr.memory import tried_twice
from difftetvr.mesh import TetMesh
from difftetvr.rendering.kernels.flags import flags_here, with_flags
from difftetvr.sampling.location import NOWHERE, CellReader, cross, dot


class Interpolate(torch.autograd.Function):
    """(P, C) values at points from (V, 3) vertices, (V, C) values, (P, 3) points and (P,) int32 cells that hold them.

    0 where the cell is -1.
    """

    @staticmethod
    def forward(
        ctx: Any, mesh: TetMesh, vertices: torch.Tensor, values: torch.Tensor, points: torch.Tensor, cells: torch.Tensor
    ) -> torch.Tensor:
        """Interpolate."""
        backend, channels = backend_for(vertices), values.shape[1]
        ctx.mesh, ctx.flags = mesh, flags_here()
        ctx.save_for_backward(vertices, values, points, cells)
        if not points.shape[0]:
            return values.new_empty((0, channels))
        with backend.exclusive():
            place = _Place.of(backend, mesh, vertices, points, cells)
            weights, _ = place.weights()
            table, found = backend.floats(values), dr.empty(backend.Float, channels * points.shape[0])
            totals = []
            for channel in range(channels):
                total = backend.Float(0)
                for weight, vertex in zip(weights, place.tet, strict=True):
                    value = dr.gather(backend.Float, table, channels * vertex + channel, place.known)
                    total = dr.fma(weight, value, total)
                totals.append(dr.select(place.known, total, 0.0))
            if totals:
                dr.scatter(found, backend.Floats(totals), place.lane)
            return backend.tensor(found, points.shape[0], channels)

    @staticmethod
    @once_differentiable
    @tried_twice
    def backward(ctx: Any, gradient: torch.Tensor) -> Any:
        """Derivatives by vertices, values and points."""
        vertices, values, points, cells = ctx.saved_tensors
        _, needs_vertices, needs_values, needs_points, _ = ctx.needs_input_grad
        backend, channels, real = backend_for(vertices), values.shape[1], backend_for(vertices).Float
        wanted = (needs_vertices, needs_values, needs_points)
        likes = (vertices, values, points)
        if not points.shape[0]:
            return None, *(torch.zeros_like(t) if w else None for t, w in zip(likes, wanted, strict=True)), None
        with with_flags(ctx.flags), backend.exclusive():
            place = _Place.of(backend, ctx.mesh, vertices, points, cells)
            weights, slopes = place.weights()
            table, worth = backend.floats(values), backend.floats(gradient)
            sizes = (like.numel() if want else 1 for like, want in zip(likes, wanted, strict=True))
            of_vertices, of_values, of_points = (dr.zeros(real, size) for size in sizes)
            corner_worth = [real(0) for _ in range(4)]
            for channel in range(channels):
                g = dr.gather(real, worth, channels * place.lane + channel, place.known)
                for k, vertex in enumerate(place.tet):
                    index = channels * vertex + channel
                    value = dr.gather(real, table, index, place.known)
                    corner_worth[k] = dr.fma(g, value, corner_worth[k])
                    if needs_values:
                        dr.scatter_add(of_values, g * weights[k], index, place.known)
            slope = [dot(corner_worth, [row[axis] for row in slopes]) for axis in range(3)]
            if needs_points:
                known = [dr.select(place.known, part, 0.0) for part in slope]
                dr.scatter(of_points, backend.Floats(known), place.lane)
            for axis in range(3):
                if needs_vertices:
                    for weight, vertex in zip(weights, place.tet, strict=True):
                        dr.scatter_add(of_vertices, -weight * slope[axis], 3 * vertex + axis, place.known)
            backend.run(of_vertices, of_values, of_points)
            found = zip((of_vertices, of_values, of_points), likes, wanted, strict=True)
            return None, *(backend.tensor(array, *like.shape) if want else None for array, like, want in found), None


class _Place:
    """Points in their cells, as kernels see them."""

    def __init__(self, reader: CellReader, points: Any, cells: Any, count: int) -> None:
        backend = reader.backend
        self.reader, self.lane = reader, dr.arange(backend.UInt, count)
        self.known = cells != NOWHERE & 0xFFFFFFFF
        tet, self.corners = reader.corners(cells, self.known)
        self.tet = [tet[k] for k in range(4)]
        self.point = [dr.gather(backend.Float, points, 3 * self.lane + axis) for axis in range(3)]

    @staticmethod
    def of(
        backend: Backend, mesh: TetMesh, vertices: torch.Tensor, points: torch.Tensor, cells: torch.Tensor
    ) -> _Place:
        reader = CellReader.of(backend, mesh, vertices)
        return _Place(reader, backend.floats(points), backend.uints(cells), points.shape[0])

    def weights(self) -> tuple[list[Any], list[list[Any]]]:
        """Barycentric weights, and their gradients by the point."""
        weights, _ = self.reader.weights(self.corners, self.point)
        edges = [[x - y for x, y in zip(corner, self.corners[0], strict=True)] for corner in self.corners[1:]]
        normals = [cross(edges[1], edges[2]), cross(edges[2], edges[0]), cross(edges[0], edges[1])]
        volume = dot(edges[0], normals[0])
        inverse = dr.select(volume != 0, 1.0 / volume, 0.0)
        slopes = [[n * inverse for n in normal] for normal in normals]
        first = [-(slopes[0][axis] + slopes[1][axis] + slopes[2][axis]) for axis in range(3)]
        return weights, [first, *slopes]
