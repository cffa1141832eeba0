"""Buffers of derivatives, and how what many rays add to them is summed (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
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
    def of(view: View, vertex_count: int, wanted: Wanted) -> Gradients:
        """Zeros for a view of V vertices."""
        real, width = view.backend.Float, view.records.width
        vertex_width = 0 if view.has_cell_density else width if view.has_vertex_channels else 1
        cell_count = 0 if view.cells is None else dr.width(view.cells) // width
        sizes = {
            "field": vertex_width * buffer_length(vertex_count),
            "cells": width * buffer_length(cell_count),
            "vertices": 4 * buffer_length(vertex_count) if wanted.vertices else 0,
        }
        arrays = {name: dr.zeros(real, size) if size else None for name, size in sizes.items()}
        transfer = None
        if view.transfer is not None:
            knots, values = (dr.zeros(real, dr.width(a)) for a in (view.transfer.knots, view.transfer.values))
            transfer = TransferGradients(knots, values)
        return Gradients(
            **arrays,
            limits=dr.zeros(real, dr.width(view.limits)) if wanted.limits else None,
            lines=dr.zeros(real, 6 * view.rays.count) if wanted.lines else None,
            transfer=transfer,
            mode=reduce_mode(view, sum(sizes.values())),
        )

    def run(self, backend: Backend) -> None:
        """Compute them."""
        backend.run(self.field, self.cells, self.vertices, self.limits, self.lines, self.transfer)


def buffer_length(count: int) -> int:
    """A length of at least ``count`` out of few, four an octave: per-thread copies bake it into the kernel."""
    step = 1 << max(0, count.bit_length() - 3)
    return -(-count // step) * step


def reduce_mode(view: View, floats: int) -> dr.ReduceMode:
    """On CPUs one gradient copy a thread beats atomics, as long as the copies fit a budget."""
    if view.backend.name != "llvm":
        return dr.ReduceMode.Auto
    size = floats * (8 if view.backend.is_double else 4) * dr.thread_count()
    return dr.ReduceMode.Expand if size <= _EXPAND_BUDGET else dr.ReduceMode.Local
