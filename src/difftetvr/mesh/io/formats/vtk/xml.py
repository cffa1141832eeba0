"""VTK's XML files of one data set in one piece or several: unstructured and structured grids (.vtu, .vts, ...)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import chosen_step
from difftetvr.mesh.io.formats.vtk.cells import Cells, checked
from difftetvr.mesh.io.formats.vtk.faces import NO_POLYHEDRA, from_stream, from_tables
from difftetvr.mesh.io.formats.vtk.grid import Grid, visible_grid
from difftetvr.mesh.io.formats.vtk.structured import hexahedra, lattice
from difftetvr.mesh.making.polyhedra import Polyhedra
from difftetvr.trust import require_modest
from difftetvr.vtk_xml import Document, is_numeric

KINDS = ("UnstructuredGrid", "StructuredGrid", "RectilinearGrid", "ImageData")
"""Data sets that have volume cells, by VTK's names."""

_POLYHEDRON = 42
_POINTS_PER_BYTE = 1100  # at the highest compression that there is
_BYTES_PER_POINT = 24 + 64  # a point with the indices of a hexahedron


@dataclass(frozen=True)
class Pieces:
    """What a file holds.

    Attributes:
        grids: Its pieces that have cells.
        texts: Names of data that are no numbers.
        notes: What is to be said of it.
    """

    grids: tuple[Grid, ...]
    texts: frozenset[str]
    notes: tuple[str, ...]


def read_pieces(document: Document, step: int | None) -> Pieces:
    """All pieces of a data set.

    Args:
        document: A file whose type is one of `KINDS`.
        step: As for `difftetvr.mesh.io.content.chosen_step`.

    Raises:
        MeshError: The file is damaged, or has no such step.
    """
    kind = document.root.get("type", "")
    element = document.root.find(kind)
    if element is None:
        raise document.damaged(f"it has no element {kind}")
    times = document.numbers(element, "TimeValues", len(element.get("TimeValues", "").split()), "")
    if not times and step is not None:
        raise MeshError(f"{document.path} has no time steps; leave out --step.")
    index, notes = chosen_step(document.path, times or [0.0], step)
    reader = _Reader(document, index)
    grids = [grid for piece in element.findall("Piece") if (grid := reader.grid(kind, element, piece)) is not None]
    return Pieces(tuple(grids), frozenset(reader.texts), notes)


class _Reader:
    """Reads the pieces of one file at one time step."""

    def __init__(self, document: Document, step: int) -> None:
        self.texts: set[str] = set()
        self._document, self._step = document, str(step)

    def grid(self, kind: str, element: Element, piece: Element) -> Grid | None:
        """One piece; None where it has no cells."""
        if kind == "UnstructuredGrid":
            return self._unstructured_grid(piece)
        return self._structured_grid(kind, element, piece)

    def _unstructured_grid(self, piece: Element) -> Grid | None:
        num_points = self._document.count(piece, "NumberOfPoints")
        num_cells = self._document.count(piece, "NumberOfCells")
        if not num_cells:
            return None
        data = self._data(piece, num_points, num_cells)
        return visible_grid(self._points(piece, num_points), self._cells(piece, num_cells), *data)

    def _structured_grid(self, kind: str, element: Element, piece: Element) -> Grid | None:
        extent = [int(x) for x in self._document.numbers(piece, "Extent", 6, element.get("WholeExtent", ""))]
        low, shape = extent[::2], tuple(extent[i + 1] - extent[i] + 1 for i in (0, 2, 4))
        if min(shape) < 2:
            return None
        nx, ny, nz = shape
        count = nx * ny * nz
        if count > _POINTS_PER_BYTE * self._document.path.stat().st_size:
            raise self._document.damaged(f"it announces {nx} x {ny} x {nz} points, for which it is too small")
        require_modest(self._document.path, _BYTES_PER_POINT * count, "hexahedra", MeshError)
        data = self._data(piece, count, (nx - 1) * (ny - 1) * (nz - 1))
        if kind == "StructuredGrid":
            points = self._points(piece, count)
        elif kind == "RectilinearGrid":
            points = self._rectilinear_points(piece, (nx, ny, nz))
        else:
            points = self._image_points(element, low, (nx, ny, nz))
        return visible_grid(points, hexahedra((nx, ny, nz)), *data)

    def _arrays(self, piece: Element, section: str) -> Iterator[Element]:
        """Arrays of a section that belong to the time step, or to all."""
        for element in piece.findall(section):
            for array in element:
                if array.tag in ("DataArray", "Array") and array.get("TimeStep", self._step) == self._step:
                    yield array

    def _data(self, piece: Element, points: int, cells: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Point data and cell data; what is no number is noted and left out."""
        found: tuple[dict[str, np.ndarray], dict[str, np.ndarray]] = ({}, {})
        for arrays, section, count in zip(found, ("PointData", "CellData"), (points, cells)):
            for array in self._arrays(piece, section):
                name = array.get("Name") or f"array {len(arrays)}"
                if not is_numeric(array):
                    self.texts.add(name)
                    continue
                columns = max(self._document.count(array, "NumberOfComponents"), 1)
                values = self._document.array(array, count * columns)
                arrays[name] = values if columns == 1 else values.reshape(count, columns)
        return found

    def _points(self, piece: Element, count: int) -> np.ndarray:
        array = next(self._arrays(piece, "Points"), None)
        if array is None:
            raise self._document.damaged("it has no points")
        return self._document.array(array, 3 * count).reshape(count, 3)

    def _rectilinear_points(self, piece: Element, shape: tuple[int, int, int]) -> np.ndarray:
        axes = list(self._arrays(piece, "Coordinates"))
        if len(axes) != 3:
            raise self._document.damaged("it has not three arrays of coordinates")
        return lattice([self._document.array(axis, n) for axis, n in zip(axes, shape)])

    def _image_points(self, image: Element, low: list[int], shape: tuple[int, int, int]) -> np.ndarray:
        origin = np.array(self._document.numbers(image, "Origin", 3, "0 0 0"))
        spacing = self._document.numbers(image, "Spacing", 3, "1 1 1")
        direction = np.array(self._document.numbers(image, "Direction", 9, "1 0 0 0 1 0 0 0 1")).reshape(3, 3)
        with np.errstate(over="ignore", invalid="ignore"):  # the mesh refuses infinite positions
            # Of all pieces the same number makes the same position, to the last bit.
            steps = [s * np.arange(first, first + n) for s, first, n in zip(spacing, low, shape)]
            if (direction == np.eye(3)).all():
                return lattice([o + along for o, along in zip(origin, steps)])
            x, y, z = lattice(steps).T[:, :, None]
            return origin + (x * direction[:, 0] + y * direction[:, 1] + z * direction[:, 2])

    def _cells(self, piece: Element, count: int) -> Cells:
        tables = {array.get("Name", ""): array for array in self._arrays(piece, "Cells")}
        lacking = [name for name in ("connectivity", "offsets", "types") if name not in tables]
        if lacking:
            raise self._document.damaged(f"its cells have no {lacking[0]}")
        types = self._document.array(tables["types"], count)
        offsets = np.concatenate(([0], self._integers(tables["offsets"], count)))
        is_of_any_size = tables["connectivity"].get("type") == "vtkIdType"
        nodes = self._integers(tables["connectivity"], int(offsets[-1]) if is_of_any_size else None)
        polyhedra = self._polyhedra(tables, types) if (types == _POLYHEDRON).any() else NO_POLYHEDRA
        return checked(self._document.path, types, nodes, offsets, polyhedra)

    def _integers(self, array: Element, count: int | None) -> np.ndarray:
        values = self._document.array(array, count)
        if values.dtype.kind == "f":
            raise self._document.damaged(
                f"the array {array.get('Name', '')[:40]!r} has fractions, where indices must be"
            )
        return values.astype(np.int64)

    def _polyhedra(self, tables: dict[str, Element], types: np.ndarray) -> Polyhedra:
        rows, path = np.flatnonzero(types == _POLYHEDRON), self._document.path
        if {"faces", "faceoffsets"} <= tables.keys():
            # Of cells that are no polyhedra the offset is -1.
            stops = self._integers(tables["faceoffsets"], len(types))[rows]
            return from_stream(path, self._integers(tables["faces"], None), np.concatenate(([0], stops[:-1])), stops)
        names = ("face_connectivity", "face_offsets", "polyhedron_to_faces", "polyhedron_offsets")
        if not tables.keys() >= set(names):
            raise self._document.damaged("it has polyhedra, but not their faces")
        connectivity, ends, of_cells, offsets = (self._integers(tables[name], None) for name in names)
        if len(offsets) != len(types):
            raise self._document.damaged(f"it has {len(offsets)} offsets of polyhedra for {len(types)} cells")
        begins = np.concatenate(([0], offsets))
        return from_tables(path, connectivity, ends, of_cells, begins[rows], begins[rows + 1])
