"""Buffers of derivatives, and how what many rays add to them is summed (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.recording import few_lengths
from difftetvr.rendering.traversal.crossing import View
from difftetvr.rendering.traversal.records import Records
from difftetvr.rendering.traversal.sums import Copies, Sums
from difftetvr.rendering.traversal.transfer import KNOT_RECORD

_POSITION = 4  # floats of a record of a position


@dataclass(frozen=True)
class Wanted:
    """Which gradients are wanted beside the field's; the kernel is cheaper without them."""

    vertices: bool
    limits: bool
    lines: bool = False
    knots: bool = False


@dataclass
class Gradients:
    """Flat gradients.

    Attributes:
        field: Of at least V vertices, (M, width) records of channels and density or scalar; None where cells hold the
            density, and where vertices hold nothing else and ``vertices`` has it.
        cells: Of at least T cells, (M, width) records of channels and density; None where they hold nothing.
        vertices: (M, 4): x, y, z in the space of the vertices, and by the density or scalar where ``field`` is None;
            None if positions need no gradient.
        knots: (K, 8) of the transfer function: by its knots, densities, linear RGB, and padding; None if there is none,
            or it needs no gradient.
        limits: (N, 2): the distances between which rays are looked at; None if they need no gradient.
        lines: (N, 6): the rays' origins and directions; None if they need no gradient.
    """

    field: Any | None
    cells: Any | None
    vertices: Any | None
    knots: Any | None
    limits: Any | None
    lines: Any | None


@dataclass
class GradientSums:
    """What kernels add to, or store in, to make :class:`Gradients` of; the attributes are those."""

    field: Sums | None
    cells: Sums | None
    vertices: Sums | None
    knots: Sums | None
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
        summed: Any = (
            None if size is None else Sums.zeros(backend, size, places, mode)
            for size, places in zip(sizes.summed, copies, strict=True)
        )
        ends = (None if size is None else dr.zeros(backend.Float, size) for size in (sizes.limits, sizes.lines))
        return GradientSums(*summed, *ends)

    def of_copy(self, copy: Any | None) -> GradientSums:
        """The same for lanes that each add to a copy of their own."""
        summed: Any = (None if sums is None else sums.of_copy(copy) for sums in self._summed)
        return GradientSums(*summed, *self._stored)

    def total(self) -> Gradients:
        """The sums of all copies."""
        totals: Any = (None if sums is None else sums.total() for sums in self._summed)
        return Gradients(*totals, *self._stored)

    @property
    def _summed(self) -> tuple[Sums | None, ...]:
        return self.field, self.cells, self.vertices, self.knots

    @property
    def _stored(self) -> tuple[Any | None, ...]:
        return self.limits, self.lines


@dataclass(frozen=True)
class BufferSizes:
    """Floats in each of the buffers of :class:`Gradients`, None for those that are not there.

    Attributes:
        widths: Floats in a record of each of those that many rays add to.
    """

    field: int | None
    cells: int | None
    vertices: int | None
    knots: int | None
    limits: int | None
    lines: int | None
    widths: tuple[int, ...]

    @staticmethod
    def of(view: View, vertex_count: int, wanted: Wanted) -> BufferSizes:
        """Sizes for a view of V vertices; few different ones, for kernels are compiled for them."""
        vertices, records = few_lengths(vertex_count), view.records
        has_field = view.has_vertex_channels or not (view.has_cell_density or wanted.vertices)
        field = records.width_of_sums if view.has_vertex_channels else Records(0).width_of_sums
        cells = None if view.cells is None else few_lengths(dr.width(view.cells) // records.width)
        return BufferSizes(
            field * vertices if has_field else None,
            None if cells is None else records.width_of_sums * cells,
            _POSITION * vertices if wanted.vertices else None,
            knots=KNOT_RECORD * dr.width(view.transfer.knots) if view.transfer is not None and wanted.knots else None,
            limits=2 * view.rays.count if wanted.limits else None,
            lines=6 * view.rays.count if wanted.lines else None,
            widths=(field, records.width_of_sums, _POSITION, KNOT_RECORD),
        )

    @property
    def summed(self) -> tuple[int | None, ...]:
        """Sizes of the buffers that many rays add to."""
        return self.field, self.cells, self.vertices, self.knots

    @property
    def floats(self) -> int:
        """Sum of these sizes."""
        return sum(size or 0 for size in self.summed)

    def places(self, backend: Backend, copies: int) -> list[Copies | None]:
        """Where so many copies of these are; None where there is but one."""
        pairs = zip(self.summed, self.widths, strict=True)
        return [None if size is None else Copies.of(backend, copies, size, width) for size, width in pairs]
