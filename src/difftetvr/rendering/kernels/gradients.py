"""Buffers of derivatives, and how what many rays add to them is summed (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.recording import few_lengths
from difftetvr.rendering.traversal.crossing import View
from difftetvr.rendering.traversal.sums import Copies, Sums
from difftetvr.rendering.traversal.transfer import TransferGradients

_POSITION = 4  # floats of a record of a position


@dataclass(frozen=True)
class Wanted:
    """Which gradients are wanted beside the field's; the kernel is cheaper without them."""

    vertices: bool
    limits: bool
    lines: bool = False


@dataclass
class Gradients:
    """Flat gradients.

    Attributes:
        field: Of at least V vertices, (M, width) records of channels and density, or (M,) densities or scalars; None
            where cells hold the density.
        cells: Of at least T cells, (M, width) records of channels and density; None where they hold nothing.
        vertices: (M, 4): x, y, z in the space of the vertices and padding; None if positions need no gradient.
        knots: (K,) of the knots of the transfer function; None if there is none.
        values: (K, 4) of its densities and linear RGB; likewise.
        limits: (N, 2): the distances between which rays are looked at; None if they need no gradient.
        lines: (N, 6): the rays' origins and directions; None if they need no gradient.
    """

    field: Any | None
    cells: Any | None
    vertices: Any | None
    knots: Any | None
    values: Any | None
    limits: Any | None
    lines: Any | None


@dataclass
class GradientSums:
    """What kernels add to, or store in, to make :class:`Gradients` of; the attributes are those."""

    field: Sums | None
    cells: Sums | None
    vertices: Sums | None
    transfer: TransferGradients | None
    limits: Any | None
    lines: Any | None

    @staticmethod
    def zeros(
        backend: Backend, sizes: BufferSizes, copies: Sequence[Copies | None], mode: dr.ReduceMode
    ) -> GradientSums:
        """Buffers of some sizes.

        Args:
            backend: Array types.
            sizes: The sizes.
            copies: What :meth:`BufferSizes.places` says about them.
            mode: How additions of several rays to one record are reduced.
        """
        field, cells, vertices, knots, values = (
            None if size is None else Sums.zeros(backend, size, places, mode)
            for size, places in zip(sizes.summed, copies, strict=True)
        )
        return GradientSums(
            field,
            cells,
            vertices,
            None if knots is None or values is None else TransferGradients(knots, values),
            *(None if size is None else dr.zeros(backend.Float, size) for size in (sizes.limits, sizes.lines)),
        )

    def of_copy(self, copy: Any | None) -> GradientSums:
        """The same for lanes that each add to a copy of their own."""
        field, cells, vertices = (
            None if sums is None else sums.of_copy(copy) for sums in (self.field, self.cells, self.vertices)
        )
        transfer = self.transfer
        if transfer is not None:
            transfer = TransferGradients(transfer.knots.of_copy(copy), transfer.values.of_copy(copy))
        return GradientSums(field, cells, vertices, transfer, self.limits, self.lines)

    def total(self) -> Gradients:
        """The sums of all copies."""
        transfer = self.transfer
        parts = [self.field, self.cells, self.vertices]
        parts += [None, None] if transfer is None else [transfer.knots, transfer.values]
        field, cells, vertices, knots, values = (None if part is None else part.total() for part in parts)
        return Gradients(field, cells, vertices, knots, values, self.limits, self.lines)


@dataclass(frozen=True)
class BufferSizes:
    """Floats in each of the buffers of :class:`Gradients`, None for those that are not there.

    Attributes:
        width: Floats in a record of ``field`` and ``cells``.
    """

    field: int | None
    cells: int | None
    vertices: int | None
    knots: int | None
    values: int | None
    limits: int | None
    lines: int | None
    width: int

    @staticmethod
    def of(view: View, vertex_count: int, wanted: Wanted) -> BufferSizes:
        """Sizes for a view of V vertices; few different ones, for kernels are compiled for them."""
        transfer = view.transfer
        width = view.records.width if view.has_vertex_channels or view.cells is not None else 1
        field = None if view.has_cell_density else width if view.has_vertex_channels else 1
        if field is not None:
            field *= few_lengths(vertex_count)
        cells = None if view.cells is None else width * few_lengths(dr.width(view.cells) // width)
        vertices = _POSITION * few_lengths(vertex_count) if wanted.vertices else None
        return BufferSizes(
            field,
            cells,
            vertices,
            knots=None if transfer is None else dr.width(transfer.knots),
            values=None if transfer is None else dr.width(transfer.values),
            limits=2 * view.rays.count if wanted.limits else None,
            lines=6 * view.rays.count if wanted.lines else None,
            width=width,
        )

    @property
    def summed(self) -> tuple[int | None, ...]:
        """Sizes of the buffers that many rays add to."""
        return self.field, self.cells, self.vertices, self.knots, self.values

    @property
    def floats(self) -> int:
        """Sum of these sizes."""
        return sum(size or 0 for size in self.summed)

    def places(self, backend: Backend, copies: int) -> list[Copies | None]:
        """Where so many copies of these are; None where there is but one."""
        pairs = zip(self.summed, (self.width, self.width, _POSITION, 1, 1), strict=True)
        return [None if size is None else Copies.of(backend, copies, size, width) for size, width in pairs]
