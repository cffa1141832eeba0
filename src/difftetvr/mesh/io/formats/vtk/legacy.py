"""Legacy VTK files, text and binary, versions 1.0 to 5.1."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Content
from difftetvr.mesh.io.formats.vtk.cells import from_legacy
from difftetvr.mesh.io.formats.vtk.grid import visible_grid
from difftetvr.mesh.io.formats.vtk.structured import hexahedra, lattice
from difftetvr.mesh.io.source import Source

_TYPES = {
    "char": "i1",
    "signed_char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "unsigned_long": "u8",
    "long_long": "i8",
    "unsigned_long_long": "u8",
    "float": "f4",
    "double": "f8",
    "vtkidtype": "i4",
    "vtktypeint8": "i1",
    "vtktypeuint8": "u1",
    "vtktypeint16": "i2",
    "vtktypeuint16": "u2",
    "vtktypeint32": "i4",
    "vtktypeuint32": "u4",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
    "vtktypefloat32": "f4",
    "vtktypefloat64": "f8",
}
_TEXTS = ("string", "utf8_string", "variant")
_STRUCTURE = ("dimensions", "origin", "spacing", "aspect_ratio", "x_coordinates", "y_coordinates", "z_coordinates")
_ATTRIBUTES = {"vectors": 3, "normals": 3, "tensors": 9, "tensors6": 6, "global_ids": 1, "pedigree_ids": 1}


@dataclass
class _State:
    """What was read so far.

    Attributes:
        kind: Kind of the data set.
        vertices: (V, 3), where listed.
        shape: Points along x, y and z of a structured data set.
        axes: Coordinates along each axis of a rectilinear grid; origin and spacing of an image.
        connectivity: Vertex indices of all cells in turn.
        offsets: (N + 1,) where each cell's indices begin and end; None where cell sizes lie between the indices.
        types: (N,) VTK's numbers of the cells' kinds.
        point_data: Arrays by name.
        cell_data: Arrays by name.
        active: The arrays that attributes go to, and the length they have.
        texts: Names of data that are no numbers.
        columns: Number of components of the last array, each of which metadata give a name.
    """

    kind: str = ""
    vertices: np.ndarray | None = None
    shape: tuple[int, ...] | None = None
    axes: dict[str, np.ndarray] = field(default_factory=dict)
    connectivity: np.ndarray | None = None
    offsets: np.ndarray | None = None
    types: np.ndarray | None = None
    point_data: dict[str, np.ndarray] = field(default_factory=dict)
    cell_data: dict[str, np.ndarray] = field(default_factory=dict)
    active: tuple[dict[str, np.ndarray], int] | None = None
    texts: set[str] = field(default_factory=set)
    columns: int = 1


def read(path: Path) -> Content:
    """Read a legacy .vtk file.

    Args:
        path: The file: an unstructured grid, or a structured one, whose cells are hexahedra.

    Returns:
        Its content.

    Raises:
        MeshError: The file is damaged or holds another kind of data set.
    """
    with open(path, "rb") as file:
        source = Source(path, file)
        source.order = ">"
        if not (source.line() or "").lower().startswith("# vtk datafile"):
            raise source.damaged("it does not begin as legacy VTK files do")
        source.line()
        mode = source.words("ASCII or BINARY")[0].upper()
        if mode not in ("ASCII", "BINARY"):
            raise source.damaged(f"{mode[:20]!r} is neither ASCII nor BINARY")
        source.text = mode == "ASCII"
        state = _State()
        while (line := source.next_line()) is not None:
            _read_section(source, state, line.split())
    return _content(source, state)


def _read_section(source: Source, state: _State, words: list[str]) -> None:
    keyword = words[0].lower()
    words = [*words, "", "", ""]
    if keyword == "dataset":
        state.kind = words[1].lower()
    elif keyword == "points":
        count = source.count(words[1], "points")
        state.vertices = _array(source, 3 * count, words[2], "points").reshape(count, 3)
        state.columns = 3
    elif keyword == "cells":
        _read_cells(source, state, words)
    elif keyword == "cell_types":
        state.types = source.numbers(source.count(words[1], "cell types"), "i4", "cell types")
    elif keyword in ("point_data", "cell_data"):
        count = source.count(words[1], "values")
        state.active = (state.point_data if keyword == "point_data" else state.cell_data, count)
    elif keyword == "metadata":
        _skip_metadata(source, state)
    elif keyword == "field":
        _read_field(source, state, source.count(words[2], "arrays"))
    elif keyword in _STRUCTURE:
        _read_structure(source, state, keyword, words)
    else:
        _read_attribute(source, state, keyword, words)


def _read_cells(source: Source, state: _State, words: list[str]) -> None:
    count, size = source.count(words[1], "cells"), source.count(words[2], "indices of cells")
    start = source.position()
    header = (source.line() or "").split()
    if len(header) == 2 and header[0].upper() == "OFFSETS":
        state.offsets = _array(source, count, header[1], "offsets of cells")
        header = source.words("the connectivity", 2)
        state.connectivity = _array(source, size, header[1], "indices of cells")
    else:
        source.seek(start)
        state.connectivity = source.numbers(size, "i4", "indices of cells")


def _read_structure(source: Source, state: _State, keyword: str, words: list[str]) -> None:
    axis = keyword.partition("_coordinates")[0]
    if keyword == "dimensions":
        state.shape = tuple(source.count(word, "points along an axis") for word in words[1:4])
    elif axis in ("x", "y", "z"):
        state.axes[axis] = _array(source, source.count(words[1], "coordinates"), words[2], "coordinates")
        state.columns = 1
    else:
        try:
            state.axes[keyword] = np.array([float(word) for word in words[1:4]])
        except ValueError as error:
            raise source.damaged(f"'{keyword}' is not followed by three numbers") from error


def _read_attribute(source: Source, state: _State, keyword: str, words: list[str]) -> None:
    if keyword == "lookup_table":
        # Colours of a palette: four bytes each, or numbers from 0 to 1 in text.
        source.numbers(4 * source.count(words[2], "colours"), "u1" if not source.text else "f4", "colours of a palette")
        return
    if state.active is None:
        raise source.damaged(f"it has {keyword[:40]!r} where no such section can be")
    arrays, count = state.active
    kind, columns = words[2], _ATTRIBUTES.get(keyword, 1)
    if keyword == "scalars":
        columns = source.count(words[3], "components") if words[3] else 1
        _skip_table_name(source)
    elif keyword == "color_scalars":
        columns, kind = source.count(words[2], "components"), "float" if source.text else "unsigned_char"
    elif keyword == "texture_coordinates":
        columns, kind = source.count(words[2], "components"), words[3]
    elif keyword not in _ATTRIBUTES:
        raise source.damaged(f"it has an unknown section {keyword[:40]!r}")
    values = _array(source, count * columns, kind, f"values of {words[1]}")
    arrays[unquote(words[1])] = values.reshape(count, columns) if columns > 1 else values
    state.columns = columns


def _read_field(source: Source, state: _State, count: int) -> None:
    for _ in range(count):
        words = source.words("an array", 1)
        if words[0].lower() == "metadata":
            _skip_metadata(source, state)
            words = source.words("an array", 1)
        if len(words) != 4:
            raise source.damaged(f"{words[0][:40]!r} does not begin an array")
        columns, rows = source.count(words[1], "components"), source.count(words[2], "values")
        state.columns = columns
        # A field before the first data section belongs to the file as a whole, such as its time.
        is_data = state.active is not None and rows == state.active[1]
        if words[3].lower() in _TEXTS:
            _skip_texts(source, columns * rows, words[3].lower())
            state.texts |= {unquote(words[0])} if is_data else set()
            continue
        values = _array(source, columns * rows, words[3], f"values of {words[0]}")
        if state.active is not None and is_data:
            state.active[0][unquote(words[0])] = values.reshape(rows, columns) if columns != 1 else values


def _skip_texts(source: Source, count: int, kind: str) -> None:
    """Pass over texts: a line each, or in binary their length in 1, 2, 4 or 8 bytes, as its two highest bits say."""
    for _ in range(count):
        if source.text or kind == "variant":
            if source.line() is None:
                raise source.damaged("its texts are incomplete")
            continue
        first = source.take(1, "texts")[0]
        size = 2 ** (3 - (first >> 6))
        rest = source.take(size - 1, "texts")
        source.take(int.from_bytes(bytes([first & 63]) + rest, "big"), "texts")


def _skip_metadata(source: Source, state: _State) -> None:
    """Pass over lines up to an empty one; those of components' names, which may be empty, are as many as these."""
    while (line := source.line()) is not None:
        if line.upper() == "COMPONENT_NAMES":
            for _ in range(state.columns):
                source.line()
        elif not line:
            start = source.position()
            if not (source.next_line() or "").upper().startswith("INFORMATION "):
                source.seek(start)
                return


def _skip_table_name(source: Source) -> None:
    start = source.position()
    words = (source.next_line() or "").split()
    if len(words) != 2 or words[0].lower() != "lookup_table":
        source.seek(start)


def _array(source: Source, count: int, kind: str, what: str) -> np.ndarray:
    kind = kind.lower()
    if kind == "bit" and not source.text:
        return np.unpackbits(source.numbers(-(-count // 8), "u1", what))[:count]
    if kind != "bit" and kind not in _TYPES:
        raise source.damaged(f"{what} are of type {kind[:40]!r}, which cannot be read")
    return source.numbers(count, _TYPES.get(kind, "u1"), what)


def _content(source: Source, state: _State) -> Content:
    if state.kind == "unstructured_grid":
        if state.vertices is None or state.connectivity is None or state.types is None:
            raise source.damaged("it lacks its points, its cells or their types")
        vertices = state.vertices
        cells = from_legacy(source.path, state.types, state.connectivity, state.offsets)
    elif state.kind in ("structured_points", "structured_grid", "rectilinear_grid"):
        shape = _shape(source, state)
        vertices, cells = _structured_vertices(source, state, shape), hexahedra(shape)
    else:
        raise MeshError(f"{source.path} holds a data set of kind {state.kind[:40]!r}; give an unstructured grid.")
    count = len(cells.types)
    for name, length, arrays in (("point", len(vertices), state.point_data), ("cell", count, state.cell_data)):
        if any(len(values) != length for values in arrays.values()):
            raise source.damaged(f"its {name} data are not of the length {length}")
    notes = (f"Left out data that are no numbers: {', '.join(sorted(state.texts))}.",) if state.texts else ()
    return visible_grid(vertices, cells, state.point_data, state.cell_data).content(source.path, notes)


def _shape(source: Source, state: _State) -> tuple[int, int, int]:
    if state.shape is None or len(state.shape) != 3:
        raise source.damaged("it lacks its dimensions")
    x, y, z = state.shape
    # Points that are not listed cost nothing in the file, but a value at each costs a byte at least.
    if x * y * z > source.size:
        raise source.damaged(f"it announces {x} x {y} x {z} points but has only {source.size} bytes")
    return x, y, z


def _structured_vertices(source: Source, state: _State, shape: tuple[int, int, int]) -> np.ndarray:
    if state.kind == "structured_grid":
        if state.vertices is None or len(state.vertices) != np.prod(shape):
            raise source.damaged("its points are not as many as its dimensions say")
        return state.vertices
    axes = [state.axes.get(name) for name in "xyz"]
    if state.kind == "structured_points":
        origin = state.axes.get("origin", np.zeros(3))
        spacing = state.axes.get("spacing", state.axes.get("aspect_ratio", np.ones(3)))
        with np.errstate(over="ignore", invalid="ignore"):  # the mesh refuses infinite positions
            axes = [o + s * np.arange(n) for o, s, n in zip(origin, spacing, shape)]
    if any(axis is None or len(axis) != n for axis, n in zip(axes, shape)):
        raise source.damaged("its coordinates are not as many as its dimensions say")
    return lattice([np.asarray(axis) for axis in axes])
