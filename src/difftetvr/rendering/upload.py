"""A mesh and what it holds, brought to where kernels read it, looked over, and aimed at along rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

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
from difftetvr.rendering.search.bundle_hits import BundleSearch
from difftetvr.rendering.search.camera_hits import CameraLanes, CameraSearch
from difftetvr.rendering.search.entry import EntryCounts, EntryLists, count_entries, list_entries
from difftetvr.rendering.search.memory_order import MemoryOrder, MeshTables, OrderedMesh
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.search.starts import AROUND, EXTENT, PointStarts
from difftetvr.rendering.traversal.bundle import BundleRays
from difftetvr.rendering.traversal.rays import ImageRays

_SUMMARY = EXTENT + 4


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

    def ordered(self, records: Any, extent: Any, largest: float | None = None) -> OrderedMesh:
        """The mesh in the order of memory, with laid out vertices."""
        return OrderedMesh(
            self.vertices.backend, self.order, self.tables, records, self.vertices.stride, extent, largest
        )

    def scene(self, records: Any, rays: Any) -> Scene:
        """The cells, with laid out vertices, in the space of some rays."""
        return Scene(self.vertices.backend, records, self.tables.tets, self.vertices.stride, rays)


@dataclass(frozen=True)
class Extent:
    """Where vertices are in the space of the rays.

    Attributes:
        low, high: Least and greatest coordinates.
        is_sound: Whether all of them, and what is at them, can be rendered.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    is_sound: bool

    @staticmethod
    def of(numbers: Sequence[float]) -> Extent:
        """From what kernels found, see :data:`difftetvr.rendering.search.starts.EXTENT`."""
        low, high = (-numbers[1], -numbers[3], -numbers[5]), (numbers[0], numbers[2], numbers[4])
        return Extent(low, high, not numbers[EXTENT - 2] > 0)

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
        device_extent: Where vertices are, on the device.
        extent: The same.
        entries: Where rays enter the mesh; None where that was not looked for.
    """

    records: Any
    cells: Any | None
    device_extent: Any
    extent: Extent
    entries: EntryLists | None


def lay_out(upload: Upload) -> LaidOut:
    """Lay out a mesh."""
    records, cells, extent = replayed(_lay_out, upload.vertices, upload.cells, *upload.lengths)
    return LaidOut(records, cells, extent, Extent.of(extent.numpy().tolist()), None)


def lay_out_for_camera(upload: Upload, rays: ImageRays, capacity: int = AROUND) -> LaidOut:
    """Lay out a mesh in camera space, and find where a camera's rays enter it; the host waits for both together.

    Args:
        upload: The mesh, whose cells are joined.
        rays: The rays.
        capacity: Cells around the camera that there is room for.
    """
    backend, tables = upload.vertices.backend, upload.tables
    lanes = CameraLanes.of(backend, rays, tables.faces, upload.mesh.num_cells, capacity)
    found = replayed(_lay_out_and_count, upload.vertices, upload.cells, upload.lengths, tables, rays, lanes)
    summary = _Summary.read(found.summary)
    around = summary.last
    if around > capacity:
        return lay_out_for_camera(upload, rays, few_lengths(around))
    starts = PointStarts(found.around, found.around_count, tables.adjacency, lanes.pixel)
    scene = upload.scene(found.records, rays)
    search = CameraSearch(scene, tables.boundary, lanes.worker, starts, tables.faces, lanes.workers)
    entries = list_entries(search, found.counts, summary.most, summary.total, around > 0)
    return LaidOut(found.records, found.cells, found.extent, summary.extent, entries)


def lay_out_for_bundle(upload: Upload, rays: BundleRays, sees_all: torch.Tensor) -> LaidOut:
    """Lay out a mesh, and find where a bundle's rays enter it if they see all of it; the host waits for both together.

    Args:
        upload: The mesh, whose cells are joined.
        rays: The rays.
        sees_all: Whether no ray starts or ends near the mesh. Where a GPU has still to tell, it is taken for granted
            until the host has to wait anyhow; if that was wrong, the entries are those of nobody, and not returned.
    """
    if not rays.count or (sees_all.device.type == "cpu" and not sees_all):
        return lay_out(upload)
    backend = upload.vertices.backend
    records, cells, extent = replayed(_lay_out, upload.vertices, upload.cells, *upload.lengths)
    search = BundleSearch.for_entries(upload.scene(records, rays), upload.ordered(records, extent), None)
    counts = replayed(count_entries, search, rays.count)
    is_wanted = backend.floats(sees_all.to(backend.device, backend.dtype)[None])
    summary = _Summary.read(replayed(_summarised, backend, extent, counts, is_wanted))
    entries = list_entries(search, counts, summary.most, summary.total, False) if summary.last else None
    return LaidOut(records, cells, extent, summary.extent, entries)


@dataclass(frozen=True)
class _Summary:
    """What the host has to know before it goes on: the extent, how many entries there are, and one number more."""

    extent: Extent
    most: int
    total: int
    last: int

    @staticmethod
    def read(numbers: Any) -> _Summary:
        """From what :func:`_summarised` makes, for which the host waits."""
        found = numbers.numpy().tolist()
        return _Summary(Extent.of(found), int(found[EXTENT]), int(found[-3]) << 16 | int(found[-2]), int(found[-1]))


def _summarised(backend: Backend, extent: Any, counts: EntryCounts, last: Any) -> Any:
    """One array, for one wait; halves, for floats do not hold all integers."""
    summary, total = dr.empty(backend.Float, _SUMMARY), counts.total
    dr.scatter(summary, extent, dr.arange(backend.UInt, EXTENT))
    numbers = (counts.most, total >> 16, total & 0xFFFF, last)
    dr.scatter(summary, backend.Floats([backend.Float(number) for number in numbers]), backend.UInt(EXTENT // 4))
    dr.eval(summary)
    return summary


def _lay_out(vertices: VertexSource, cells: CellSource | None, vertex_length: int, cell_length: int) -> Any:
    records, extent = lay_out_vertices(vertices, vertex_length)
    if cells is None:
        return records, None, extent
    cell_records, extent_of_cells = lay_out_cells(cells, cell_length)
    extent = any_extent(extent, extent_of_cells)
    return records, cell_records, extent


@dataclass
class _Found:
    records: Any
    cells: Any | None
    extent: Any
    around: Any
    around_count: Any
    counts: EntryCounts
    summary: Any


def _lay_out_and_count(
    vertices: VertexSource,
    cells: CellSource | None,
    lengths: tuple[int, int],
    tables: MeshTables,
    rays: ImageRays,
    lanes: CameraLanes,
) -> _Found:
    backend: Backend = vertices.backend
    records, cell_records, extent = _lay_out(vertices, cells, *lengths)
    scene = Scene(backend, records, tables.tets, vertices.stride, rays)
    search = CameraSearch.of(scene, tables, lanes, extent)
    counts = count_entries(search, rays.count)
    summary = _summarised(backend, extent, counts, search.starts.count)
    return _Found(records, cell_records, extent, search.starts.cells, search.starts.count, counts, summary)
