"""Buffers of derivatives, and how what many rays add to them is summed (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.recording import few_lengths
from difftetvr.rendering.traversal.crossing import View
from difftetvr.rendering.traversal.transfer import TransferGradients

_EXPAND_BUDGET = 1 << 30  # bytes of per-thread gradient copies; beyond it threads share one copy through atomics


@dataclass(frozen=True)
class Wanted:
    """Which gradients are wanted beside the field's; the kernel is cheaper without them."""

    vertices: bool
    limits: bool
    lines: bool = False


@dataclass
class Gradients:
    """Flat gradient buffers.

    Attributes:
        field: Of at least V vertices, (M, width) records of channels and density, or (M,) densities or scalars; None
            where cells hold the density.
        cells: Of at least T cells, (M, width) records of channels and density; None where they hold nothing.
        vertices: (M, 4): x, y, z in the space of the vertices and padding; None if positions need no gradient.
        limits: (N, 2): the distances between which rays are looked at; None if they need no gradient.
        lines: (N, 6): the rays' origins and directions; None if they need no gradient.
        transfer: The transfer function; None if there is none.
        mode: How additions of several rays to one record are reduced.
    """

    field: Any | None
    cells: Any | None
    vertices: Any | None
    limits: Any | None
    lines: Any | None
    transfer: TransferGradients | None
    mode: dr.ReduceMode

    @staticmethod
    def zeros(backend: Backend, sizes: BufferSizes) -> Gradients:
        """Buffers of some sizes, for kernels that add to them."""
        field, cells, vertices, limits, lines = (
            None if size is None else dr.zeros(backend.Float, size)
            for size in (sizes.field, sizes.cells, sizes.vertices, sizes.limits, sizes.lines)
        )
        transfer = None
        if sizes.transfer is not None:
            transfer = TransferGradients(*(dr.zeros(backend.Float, size) for size in sizes.transfer))
        return Gradients(field, cells, vertices, limits, lines, transfer, sizes.mode)


@dataclass(frozen=True)
class BufferSizes:
    """Floats in each of the buffers of :class:`Gradients`, None for those that are not there, and its mode."""

    field: int | None
    cells: int | None
    vertices: int | None
    limits: int | None
    lines: int | None
    transfer: tuple[int, int] | None
    mode: dr.ReduceMode

    @staticmethod
    def of(view: View, vertex_count: int, wanted: Wanted) -> BufferSizes:
        """Sizes for a view of V vertices; few different ones, for kernels are compiled for them."""
        width, transfer = view.records.width, view.transfer
        field = None if view.has_cell_density else width if view.has_vertex_channels else 1
        if field is not None:
            field *= few_lengths(vertex_count)
        cells = None if view.cells is None else width * few_lengths(dr.width(view.cells) // width)
        vertices = 4 * few_lengths(vertex_count) if wanted.vertices else None
        return BufferSizes(
            field,
            cells,
            vertices,
            limits=2 * view.rays.count if wanted.limits else None,
            lines=6 * view.rays.count if wanted.lines else None,
            transfer=None if transfer is None else (dr.width(transfer.knots), dr.width(transfer.values)),
            mode=reduce_mode(view, sum(size or 0 for size in (field, cells, vertices))),
        )


def reduce_mode(view: View, floats: int) -> dr.ReduceMode:
    """On CPUs one gradient copy a thread beats atomics, as long as the copies fit a budget."""
    if view.backend.name != "llvm":
        return dr.ReduceMode.Auto
    size = floats * (8 if view.backend.is_double else 4) * dr.thread_count()
    return dr.ReduceMode.Expand if size <= _EXPAND_BUDGET else dr.ReduceMode.Local
