"""Text files of OpenVolumeMesh (.ovm).

Edges list vertices, faces list half-edges, cells list half-faces; half-edge 2e runs along edge e, 2e + 1 against it,
and half-faces likewise. Then come properties, of vertices (VProp), cells (CProp) and others, each with type and name.
The original DiffTetVR keeps red, green, blue and density in a vertex property "vertexColors" of type vec4f.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import (
    Content,
    Output,
    all_digits,
    as_indices,
    damaged,
    parse_numbers,
    split_rgba,
    tetra_block,
    write_table,
)
from difftetvr.mesh.topology.faces import LOCAL_FACES

_COMMENT = re.compile(rb"#[^\n]*")
_HEADING = re.compile(
    rb"^[ \t]*(Vertices|Edges|Faces|Polyhedra|(?:V|E|HE|F|HF|C|M)Prop)\b[ \t]*([^\n]*)$", re.MULTILINE | re.IGNORECASE
)
_PROPERTY = re.compile(rb'(\w+)[ \t]+"([^"]*)"')
_NUMBER_TYPES = re.compile(r"(?:vec([234]))?(?:[fd]|ui?|i)?|float|double|u?int|unsigned int|short|long|bool")
_COLORS = {"vertexcolors", "cellcolors"}


def read(path: Path) -> Content:
    """Read an .ovm file whose cells are tetrahedra.

    Args:
        path: The file.

    Returns:
        Its content; properties of numbers are point and cell data.

    Raises:
        MeshError: The file is damaged, or holds cells that are no tetrahedra.
    """
    text = path.read_bytes()
    if text[:20].split()[:2] != [b"OVM", b"ASCII"]:
        raise damaged(path, "it does not begin with 'OVM ASCII'; the binary form of this format is not read")
    text = _COMMENT.sub(b"", text)
    headings = list(_HEADING.finditer(text))
    ends = [h.start() for h in headings[1:]] + [len(text)]
    sections: dict[str, bytes] = {}
    properties: list[tuple[str, bytes, bytes]] = []
    for heading, end in zip(headings, ends):
        name, body = heading.group(1).decode().lower(), text[heading.end() : end]
        if name.endswith("prop"):
            properties.append((name, heading.group(2), body))
        elif sections.setdefault(name, body) is not body:
            raise damaged(path, f"it has two lists of {name}")
    vertices = _table(path, sections, "vertices", 3)
    tets = _tets(path, sections)
    data: dict[str, dict[str, np.ndarray]] = {"vprop": {}, "cprop": {}}
    for name, header, body in properties:
        if name in data:
            data[name] |= _property(path, header, body, len(vertices) if name == "vprop" else len(tets))
    return Content(vertices, (tetra_block(tets),), data["vprop"], data["cprop"])


def write(path: Path, output: Output) -> None:
    """Write an .ovm file; numbers have all digits that it takes to read the same ones again.

    Args:
        path: The file to write.
        output: The mesh, and the field's arrays.
    """
    vertices, rgba = output.vertices, output.rgba
    corners = output.tets.astype(np.int64)[:, LOCAL_FACES].reshape(-1, 3)
    order = corners.argsort(1)
    low, middle, high = np.take_along_axis(corners, order, 1).T
    # One number for each pair: numpy finds equal numbers much faster than equal rows.
    count = len(vertices)
    sides = np.column_stack((low * count + middle, middle * count + high, low * count + high))
    edge_keys, edge_of = np.unique(sides, return_inverse=True)
    edge_of = edge_of.reshape(-1, 3)
    edges = np.column_stack(np.divmod(edge_keys, count))
    _, first, face_of = np.unique(edge_of[:, 0] * count + high, return_index=True, return_inverse=True)
    half_edges = 2 * edge_of[first] + np.array([0, 0, 1])
    # A face is stored ascending; a cell whose own order is an odd permutation of that sees its other side.
    odd = ((order[:, 0] > order[:, 1]) ^ (order[:, 1] > order[:, 2]) ^ (order[:, 0] > order[:, 2])).astype(np.int64)
    half_faces = (2 * face_of.reshape(-1) + odd).reshape(-1, 4)
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write("OVM ASCII\n")
        for name, table in (("Vertices", vertices), ("Edges", edges), ("Faces", half_edges), ("Polyhedra", half_faces)):
            file.write(f"{name}\n{len(table)}\n")
            size = f"{table.shape[1]} " if name in ("Faces", "Polyhedra") else ""
            write_table(file, table, size + all_digits(table))
        if rgba is not None:
            kind = "vec4d" if rgba.dtype.itemsize == 8 else "vec4f"
            file.write(f'CProp {kind} "cellColors"\n' if output.is_per_cell else f'VProp {kind} "vertexColors"\n')
            write_table(file, rgba, all_digits(rgba))


def _table(path: Path, sections: dict[str, bytes], name: str, columns: int) -> np.ndarray:
    """The rows of a section, (N, columns)."""
    numbers = parse_numbers(path, sections.get(name, b""))
    if not numbers.size:
        raise damaged(path, f"it lacks its {name}")
    if float(numbers[0]) * columns != numbers.size - 1:
        if columns > 3 and numbers.size > 1 and numbers[1] != columns - 1:
            raise MeshError(f"{path} holds cells that are no tetrahedra; tetrahedralise it first.")
        raise damaged(path, f"its {name} are not as many as announced")
    return numbers[1:].reshape(-1, columns)


def _tets(path: Path, sections: dict[str, bytes]) -> np.ndarray:
    """(T, 4) vertex indices of the cells."""
    edges = as_indices(path, _table(path, sections, "edges", 2))
    half_edges = _lists(path, sections, "faces", 3)
    _require_range(path, half_edges, 2 * len(edges), "half-edge")
    faces = edges[half_edges >> 1, half_edges & 1]
    half_faces = _lists(path, sections, "polyhedra", 4)
    _require_range(path, half_faces, 2 * len(faces), "half-face")
    first, second = faces[half_faces[:, 0] >> 1], faces[half_faces[:, 1] >> 1]
    is_new = (second[:, :, None] != first[:, None, :]).all(2)
    # Each of four vertices lies in three faces of a tetrahedron.
    corners = np.sort(faces[half_faces >> 1].reshape(-1, 12), 1).reshape(-1, 4, 3)
    is_tet = (corners[..., 0] == corners[..., 2]).all(1) & (corners[:, 1:, 0] != corners[:, :-1, 0]).all(1)
    if not (is_tet & (is_new.sum(1) == 1)).all():
        raise damaged(path, "the faces of a cell do not make a tetrahedron")
    return np.column_stack((first, second[is_new]))


def _lists(path: Path, sections: dict[str, bytes], name: str, size: int) -> np.ndarray:
    table = as_indices(path, _table(path, sections, name, size + 1))
    if (table[:, 0] != size).any():
        raise MeshError(f"{path} holds cells that are no tetrahedra; tetrahedralise it first.")
    return table[:, 1:]


def _require_range(path: Path, indices: np.ndarray, count: int, what: str) -> None:
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise damaged(path, f"it uses a {what} that is not there")


def _property(path: Path, header: bytes, body: bytes, count: int) -> dict[str, np.ndarray]:
    match = _PROPERTY.match(header)
    if match is None:
        raise damaged(path, "a property lacks its type or name")
    kind, name = match.group(1).decode(errors="replace").lower(), match.group(2).decode(errors="replace")
    vector = _NUMBER_TYPES.fullmatch(kind)
    if vector is None or not kind:
        return {}
    columns = int(vector.group(1) or 1)
    numbers = parse_numbers(path, body)
    if numbers.size != count * columns:
        raise damaged(path, f"the property {name[:40]!r} has {numbers.size} numbers for {count} places")
    if name.lower() in _COLORS and columns == 4:
        return split_rgba(numbers.reshape(-1, 4))
    return {name: numbers.reshape(-1, columns) if columns > 1 else numbers}
