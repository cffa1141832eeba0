"""From XDMF files to contents: which grids make up a mesh, and which time step of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.io.content import Content, chosen_step, damaged
from difftetvr.mesh.io.formats.vtk.grid import GHOSTS, are_unseen
from difftetvr.mesh.io.formats.xdmf.assembly import Assembly
from difftetvr.mesh.io.formats.xdmf.document import Document
from difftetvr.mesh.io.formats.xdmf.items import Items
from difftetvr.mesh.io.formats.xdmf.topology import Shape, shape_of
from difftetvr.mesh.io.hdf5 import load_h5py
from difftetvr.mesh.io.isolation import isolated

_DEEPEST, _MOST_VISITS = 16, 100_000
_PLACES = {"node": "point", "": "point", "cell": "cell"}
_TENSOR_AS_VTK = [0, 3, 5, 1, 4, 2]
"""Where VTK's components xx yy zz xy yz xz of a symmetric tensor stand in XDMF's order xx xy xz yy yz zz."""

_Key = tuple[float, int]
"""A time, and which of the steps with this time."""


def read(path: Path, step: int | None = None) -> Content:
    """Read an .xdmf file; its arrays may lie in it, in binary files beside it, or in HDF5 files beside it.

    Grids side by side, as FEniCS, dolfinx and meshio write them for each quantity and for tags, and the parts of a
    spatial collection become one mesh; those with the same points share them.

    Args:
        path: The file. Arrays in HDF5 need the package h5py.
        step: Of temporal collections; see `chosen_step`.

    Raises:
        MeshError: It cannot be read.
    """
    files = Items(Document(path)).hdf5_files()
    if not files:
        return read_here(path, step)
    load_h5py(path)
    return isolated(read_here, path, step, [file for file in files if file.is_file()])


def read_here(path: Path, step: int | None) -> Content:
    """As `read`, with HDF5's library in this process."""
    with Items(Document(path)) as items:
        return _Reader(items).content(step)


@dataclass(frozen=True)
class _Grid:
    """A grid that holds points and cells: its elements, includes and references replaced by what they stand for."""

    topology: Element
    geometry: Element
    attributes: tuple[Element, ...]


class _Reader:
    def __init__(self, items: Items) -> None:
        self.items, self.document, self.path = items, items.document, items.path
        self.left_out: dict[str, None] = {}  # in the order of the file
        self.visits = 0

    def content(self, step: int | None) -> Content:
        tops = [grid for domain in self.document.root.iter("Domain") for grid in self._grids(domain)]
        if not tops:
            raise damaged(self.path, "it has no grid")
        keys = sorted({key for grid in tops for key in self._keys(grid, 0)})
        key: _Key | None = None
        notes: tuple[str, ...] = ()
        if keys:
            index, notes = chosen_step(self.path, [time for time, _ in keys], step)
            key = keys[index]
        elif step is not None:
            raise MeshError(f"{self.path} has no time steps; leave out --step.")
        assembly, shapes = Assembly(), dict[tuple[int, int], Shape]()
        added = 0
        for top in tops:
            before = assembly.num_points
            for grid in self._chosen(top, key, 0):
                self._add(assembly, shapes, grid)
            added += assembly.num_points > before
        if not added:
            raise damaged(self.path, "no grid of it has points and cells at this time")
        if added > 1:
            notes = (*notes, f"Put {added} meshes together, each with points of its own.")
        if self.left_out:
            notes = (*notes, f"Left out: {', '.join(self.left_out)}.")
        return assembly.content(notes)

    def _grids(self, element: Element) -> list[Element]:
        found = []
        for child in self.document.children(element):
            if child.tag == "Grid":
                reference = child.get("Reference")
                text = child.text if reference is not None and reference.upper() == "XML" else reference
                found += [child] if text is None else self.document.referred(text)
        return found

    def _is_temporal(self, grid: Element) -> bool:
        return _kind(grid) == "collection" and grid.get("CollectionType", "Spatial").lower() == "temporal"

    def _steps(self, collection: Element) -> dict[_Key, list[Element]]:
        """Grids of a temporal collection by time; those with other attributes at one time are one step."""
        found: dict[_Key, list[Element]] = {}
        names: dict[float, set[str]] = {}
        last: dict[float, int] = {}
        grids = self._grids(collection)
        for time, grid in zip(self._times(collection, grids), grids):
            own = {a.get("Name", "") for a in self.document.children(grid) if a.tag == "Attribute"}
            if names.setdefault(time, set()) & own:
                last[time], names[time] = last.get(time, 0) + 1, set()
            names[time] |= own
            found.setdefault((time, last.get(time, 0)), []).append(grid)
        return found

    def _times(self, collection: Element, grids: list[Element]) -> list[float]:
        """Times of grids: each one's own, else those that the collection lists, else numbers from 0."""
        times: list[float] = [float(i) for i in range(len(grids))]
        listed = next((c for c in self.document.children(collection) if c.tag == "Time"), None)
        if listed is not None and (arrays := self.items.of(listed)):
            kind, values = listed.get("TimeType", "Single").lower(), arrays[0].ravel().tolist()
            if kind == "list" and len(values) >= len(grids):
                times = [float(value) for value in values[: len(grids)]]
            elif kind == "hyperslab" and len(values) == 3:
                times = [float(values[0] + i * values[1]) for i in range(len(grids))]
        for i, grid in enumerate(grids):
            own = next((c.get("Value") for c in self.document.children(grid) if c.tag == "Time"), None)
            if own is not None:
                times[i] = self._time(own)
        return times

    def _time(self, text: str) -> float:
        try:
            return float(text)
        except ValueError as error:
            raise damaged(self.path, f"{text[:40]!r} is no time") from error

    def _keys(self, grid: Element, depth: int) -> Iterator[_Key]:
        """Of all steps of all temporal collections in a grid."""
        self._visit(depth)
        if self._is_temporal(grid):
            yield from self._steps(grid)
        elif _kind(grid) in ("collection", "tree"):
            for inner in self._grids(grid):
                yield from self._keys(inner, depth + 1)

    def _chosen(self, grid: Element, key: _Key | None, depth: int) -> Iterator[_Grid]:
        """The grids with points and cells in a grid, at one time."""
        self._visit(depth)
        kind = _kind(grid)
        if self._is_temporal(grid):
            steps = self._steps(grid)
            # What is there at one time only holds for all times.
            for inner in next(iter(steps.values())) if len(steps) == 1 else steps.get(key, []) if key else []:
                yield from self._chosen(inner, key, depth + 1)
            if len(steps) > 1 and key not in steps:
                self.left_out[f"{grid.get('Name', 'a collection')!r}, which has no values at this time"] = None
        elif kind in ("collection", "tree"):
            for inner in self._grids(grid):
                yield from self._chosen(inner, key, depth + 1)
        elif kind == "uniform":
            yield from self._uniform(grid)
        else:
            raise MeshError(f"{self.path} has a grid of the kind {kind[:40]!r}, which is not read; write it in full.")

    def _visit(self, depth: int) -> None:
        self.visits += 1
        if depth > _DEEPEST or self.visits > _MOST_VISITS:
            raise damaged(self.path, "its grids lie in each other without end")

    def _uniform(self, grid: Element) -> Iterator[_Grid]:
        children = list(self.document.children(grid))
        topology, geometry = (
            next((self._resolved(c) for c in children if c.tag == tag), None) for tag in ("Topology", "Geometry")
        )
        for child in children:
            if child.tag == "Set":
                self.left_out[f"the set {child.get('Name', '')!r}"] = None
        if topology is None or geometry is None:
            raise damaged(self.path, f"its grid {grid.get('Name', '')[:40]!r} has no points or no cells")
        yield _Grid(topology, geometry, tuple(c for c in children if c.tag == "Attribute"))

    def _resolved(self, element: Element) -> Element:
        reference = element.get("Reference")
        if reference is None:
            return element
        return self.document.referred((element.text or "") if reference.upper() == "XML" else reference)[0]

    def _add(self, assembly: Assembly, shapes: dict[tuple[int, int], Shape], grid: _Grid) -> None:
        key = id(grid.topology), id(grid.geometry)
        if key not in shapes:
            shapes[key] = shape_of(self.items, grid.topology, grid.geometry)
        shape = shapes[key]
        for block in shape.cells:
            if block.nodes.size and not 0 <= block.nodes.min() <= block.nodes.max() < len(shape.vertices):
                raise damaged(self.path, "a cell uses a point that is not there")
        rows = dict(zip(("point", "cell"), assembly.add(shape)))
        for attribute in grid.attributes:
            place = _PLACES.get(attribute.get("Center", "Node").lower())
            name = attribute.get("Name", "data")
            if place is None or attribute.get("ItemType", "").lower() == "finiteelementfunction":
                kind = attribute.get("ItemType") or f"data of each {attribute.get('Center', '')[:20]}"
                self.left_out[f"{name[:80]!r} ({kind[:40]})"] = None
                continue
            values = self._values(attribute, len(rows[place]))
            if values is None:
                continue
            if name not in GHOSTS:
                assembly.put(place, name, rows[place], values)
            elif place == "cell" and values.ndim == 1:
                assembly.mark(rows[place], are_unseen(name, values.astype(np.int64)))

    def _values(self, attribute: Element, count: int) -> np.ndarray | None:
        """(count, ...) numbers; None, and a word about it, for others."""
        arrays, name = self.items.of(attribute), attribute.get("Name", "data")
        if len(arrays) == 1 and count and arrays[0].size and arrays[0].size % count == 0:
            values = arrays[0]
            if len(values) != count:
                values = values.reshape(count, -1)
            kind = attribute.get("AttributeType", attribute.get("Type", "")).lower()
            if kind == "tensor6" and values.size == 6 * count:
                return values.reshape(count, 6)[:, _TENSOR_AS_VTK]
            return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
        sizes = " + ".join(str(values.size) for values in arrays) or "no"
        self.left_out[f"{name[:80]!r} ({sizes} numbers for {counted(count, 'row')})"] = None
        return None


def _kind(grid: Element) -> str:
    return grid.get("GridType", "Collection" if "CollectionType" in grid.attrib else "Uniform").lower()
