"""A mesh and what it holds, brought to where kernels read it, looked over, and aimed at along rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.kernels.layout import (
    CellSource,
    VertexSource,
    any_extent,
    lay_out_cells,
    lay_out_vertices,
)
from difftetvr.rendering.search.memory_order import MemoryOrder, MeshTables
from difftetvr.rendering.search.plan import Found, SearchPlan, Told
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.search.starts import EXTENT
from difftetvr.rendering.traversal.rays import KernelRays

_NUMBERS = 8
"""Floats behind an extent that tell the host what was found; one packet, which EXTENT is a multiple of."""


@dataclass(frozen=True)
class Upload:
    """What is sent to kernels.

    Attributes:
        mesh: The mesh.
        order: Its order in memory.
        tables: Its topology.
        vertices: What vertices are and hold.
        cells: What cells hold, if anything.
    """

    mesh: TetMesh
    order: MemoryOrder
    tables: MeshTables
    vertices: VertexSource
    cells: CellSource | None

    @property
    def lengths(self) -> tuple[int, int]:
        """Numbers of records to make for vertices and cells."""
        return few_lengths(self.mesh.num_vertices), few_lengths(self.mesh.num_cells)

    def scene(self, records: Any, rays: Any) -> Scene:
        """The cells, with laid out vertices, in the space of some rays."""
        return Scene(self.vertices.backend, records, self.tables.tets, self.vertices.stride, rays)


@dataclass(frozen=True)
class Extent:
    """Where vertices are in the space of the rays.

    Attributes:
        low, high: Least and greatest coordinates.
        is_sound: Whether all of them, and what is at them, can be rendered.
        shift: Greatest coordinate by which a camera's pose moves the origin; 0 where there is none.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    is_sound: bool
    shift: float

    @staticmethod
    def of(numbers: Sequence[float]) -> Extent:
        """From what kernels found, see :data:`difftetvr.rendering.search.starts.EXTENT`."""
        low, high = (-numbers[1], -numbers[3], -numbers[5]), (numbers[0], numbers[2], numbers[4])
        return Extent(low, high, not numbers[EXTENT - 2] > 0, max(numbers[EXTENT - 1], 0.0))

    @property
    def largest(self) -> float:
        """Greatest absolute coordinate."""
        return max(max(self.high), -min(self.low))


@dataclass
class LaidOut:
    """A mesh as kernels read it.

    Attributes:
        records: Of vertices.
        cells: Of cells; None where they hold nothing.
        extent: Where vertices are.
        found: What was looked for in it, as the plan has settled it; None where nothing was.
        sees_all: Whether no ray turned out to begin or end near the mesh.
    """

    records: Any
    cells: Any | None
    extent: Extent
    found: Any | None
    sees_all: bool


def lay_out(upload: Upload, rays: KernelRays, plan: SearchPlan | None) -> LaidOut:
    """Lay out a mesh in the space of rays, and look for what is planned; the host waits for both together.

    Args:
        upload: The mesh.
        rays: The rays.
        plan: What to look for; None for nothing.
    """
    if plan is None:
        records, cells, extent = replayed(_lay_out, upload.vertices, upload.cells, *upload.lengths)
        return LaidOut(records, cells, Extent.of(extent.numpy().tolist()), None, False)
    made: _Made = replayed(_lay_out_and_find, upload.vertices, upload.cells, upload.lengths, upload.tables, rays, plan)
    extent, told = _read(made.summary)
    if made.found.around is not None and told.around > plan.capacity:
        roomier: Any = replace(cast("Any", plan), capacity=few_lengths(told.around))
        return lay_out(upload, rays, roomier)
    found = plan.settled(upload.scene(made.records, rays), made.found, told)
    return LaidOut(made.records, made.cells, extent, found, told.sees_all)


@dataclass
class _Made:
    """What kernels made of an upload, and (SUMMARY,) what the host has to hear of it."""

    records: Any
    cells: Any | None
    found: Found
    summary: Any


def _lay_out_and_find(
    vertices: VertexSource,
    cells: CellSource | None,
    lengths: tuple[int, int],
    tables: MeshTables,
    rays: KernelRays,
    plan: SearchPlan,
) -> _Made:
    backend = vertices.backend
    records, cell_records, extent = _lay_out(vertices, cells, *lengths)
    found = plan.find(Scene(backend, records, tables.tets, vertices.stride, rays), extent)
    shift = None if vertices.pose is None else _shift(backend, vertices.pose)
    return _Made(records, cell_records, found, _summary(backend, extent, shift, found, plan.sees_all))


def _lay_out(vertices: VertexSource, cells: CellSource | None, vertex_length: int, cell_length: int) -> Any:
    records, extent = lay_out_vertices(vertices, vertex_length)
    if cells is None:
        return records, None, extent
    cell_records, extent_of_cells = lay_out_cells(cells, cell_length)
    extent = any_extent(extent, extent_of_cells)
    return records, cell_records, extent


def _shift(backend: Backend, pose: Any) -> Any:
    """Greatest coordinate of the translation of a (4, 4) matrix."""
    x, y, z = (dr.abs(dr.gather(backend.Float, pose, backend.UInt(4 * row + 3))) for row in range(3))
    return dr.fmax(dr.fmax(x, y), z)


def _summary(backend: Backend, extent: Any, shift: Any | None, found: Found, sees_all: Any | None) -> Any:
    """One array, for one wait; halves, for floats do not hold all integers."""
    summary, none = dr.empty(backend.Float, EXTENT + _NUMBERS), dr.zeros(backend.UInt, 1)
    place = dr.arange(backend.UInt, EXTENT)
    dr.scatter(summary, extent if shift is None else dr.select(place == EXTENT - 1, shift, extent), place)
    around = none if found.around is None else found.around.count
    whole = (found.counts.most, found.counts.total, around)
    halves = [half for number in whole for half in (number >> 16, number & 0xFFFF)]
    sees = backend.Float(0) if sees_all is None else dr.gather(backend.Float, sees_all, backend.UInt(0))
    flags = none if found.flags is None else found.flags
    numbers = [*(backend.Float(part) for part in (*halves, flags)), sees]
    dr.scatter(summary, backend.Floats(numbers), backend.UInt(EXTENT // _NUMBERS))
    dr.eval(summary)
    return summary


def _read(summary: Any) -> tuple[Extent, Told]:
    """What :func:`_summary` tells, for which the host waits."""
    numbers = summary.numpy().tolist()
    halves = [int(number) for number in numbers[EXTENT : EXTENT + 6]]
    most, total, around = (high << 16 | low for high, low in zip(halves[::2], halves[1::2], strict=True))
    flags, sees_all = numbers[EXTENT + 6 :]
    return Extent.of(numbers), Told(most, total, around, sees_all > 0, int(flags))
