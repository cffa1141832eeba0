"""From meshes to Gmsh's files, binary, format 2.2.

Of Gmsh's formats this is the one where each element has its own groups, as cell data do: format 4 has groups of
entities only, so that cells of one entity could not lie in different ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Output
from difftetvr.mesh.io.formats.data import control_problem, flattened, require_names, said

_PHYSICAL, _GEOMETRICAL = "gmsh:physical", "gmsh:geometrical"
"""Cell data that are groups."""

_TETRA = 4
_LARGEST_TAG = 2**31 - 1
_LARGEST_WHOLE = 2**53
_LONGEST_NAME, _LONGEST_GROUP = 255, 127
_PADDED, _AS_TENSORS, _APART = _CHANGES = (
    "with a third component of 0",
    "as symmetric tensors of 9 components",
    "one component at a time, their names ending in :0, :1, ...",
)
_WHY = "as Gmsh knows 1, 3 and 9 components"
_FULL = (0, 3, 5, 3, 1, 4, 5, 4, 2)
"""Of a 3 x 3 matrix, row by row, the places among the six of a symmetric one: xx yy zz xy yz xz."""


def write(path: Path, output: Output) -> tuple[str, ...]:
    """Write a tetrahedral mesh with its data, which are float64 in this format, and its groups.

    Data of 1, 3 and 9 components are all that Gmsh knows: to 2 a third of 0 is added, 6 are written as the 9 of the
    symmetric tensor, and others as data of one component each.

    Args:
        path: The file to write.
        output: The mesh, and all data.

    Returns:
        Sentences about data that were written in another way.

    Raises:
        MeshError: Gmsh cannot read a name.
    """
    require_names(output, _problem)
    _require_group_names(output)
    output, shapes = flattened(output)
    output, groups = _without_groups(output)
    point_data, of_points = _components(output.path, output.point_data)
    cell_data, of_cells = _components(output.path, output.cell_data)
    changed = [said(output.path, of_points[how] + of_cells[how], f"written {how}, {_WHY}") for how in _CHANGES]
    rounded = said(output.path, _too_large(output), "rounded, as Gmsh's numbers are exact up to 2^53 only")
    with open(path, "wb") as file:
        file.write(b"$MeshFormat\n2.2 1 8\n" + np.array([1], "<i4").tobytes() + b"\n$EndMeshFormat\n")
        _write_group_names(file, output.group_names)
        file.write(f"$Nodes\n{len(output.vertices)}\n".encode())
        _write_tagged(file, output.vertices, "$EndNodes")
        _write_elements(file, output.tets, groups)
        for section, arrays in (("NodeData", point_data), ("ElementData", cell_data)):
            for name, values in arrays.items():
                sizes = f"3\n0\n{values.shape[1]}\n{len(values)}\n"
                file.write(f'${section}\n1\n"{name}"\n1\n0.0\n{sizes}'.encode())
                _write_tagged(file, values, f"$End{section}")
    return (*shapes, *(note for notes in changed for note in notes), *rounded)


def _require_group_names(output: Output) -> None:
    for tag, name in output.group_names.items():
        if len(name.encode()) > _LONGEST_GROUP or control_problem(name, others='"') or not 0 < tag <= _LARGEST_TAG:
            raise MeshError(
                f"{output.path}: Gmsh cannot read the group {tag} named {name[:80]!r}; give groups from 1 on names of "
                f"at most {_LONGEST_GROUP} bytes without control characters and quotes."
            )


def _write_group_names(file: BinaryIO, names: dict[int, str]) -> None:
    if names:
        lines = "".join(f'3 {tag} "{name}"\n' for tag, name in names.items())
        file.write(f"$PhysicalNames\n{len(names)}\n{lines}$EndPhysicalNames\n".encode())


def _write_tagged(file: BinaryIO, values: np.ndarray, end: str) -> None:
    """Rows of numbers (N, n), each after its number from 1 on."""
    records = np.empty(len(values), [("tag", "<i4"), ("values", "<f8", (values.shape[1],))])
    records["tag"] = np.arange(1, len(values) + 1)
    records["values"] = values
    file.write(records.tobytes())
    file.write(f"\n{end}\n".encode())


def _write_elements(file: BinaryIO, tets: np.ndarray, groups: np.ndarray) -> None:
    file.write(f"$Elements\n{len(tets)}\n".encode())
    file.write(np.array([_TETRA, len(tets), groups.shape[1]], "<i4").tobytes())
    file.write(np.column_stack((np.arange(1, len(tets) + 1), groups, tets + 1)).astype("<i4").tobytes())
    file.write(b"\n$EndElements\n")


def _without_groups(output: Output) -> tuple[Output, np.ndarray]:
    """What is to be written but groups, and these: (T, 2) physical and geometrical tags.

    Data with the name of groups that can be none stay data.
    """
    tags = {name: v for name, v in output.cell_data.items() if name in (_PHYSICAL, _GEOMETRICAL) and _are_tags(v)}
    physical = tags.get(_PHYSICAL, np.zeros(len(output.tets))).reshape(-1)
    # Gmsh has groups of entities, so without any known each group must be one.
    entities = tags.get(_GEOMETRICAL, np.unique(physical, return_inverse=True)[1] + 1).reshape(-1)
    data = {name: values for name, values in output.cell_data.items() if name not in tags}
    return replace(output, cell_data=data), np.column_stack((physical, entities)).astype(np.int64)


def _are_tags(values: np.ndarray) -> bool:
    is_one_each = values.size == len(values)
    return is_one_each and bool(((values >= 0) & (values <= _LARGEST_TAG) & (values == np.floor(values))).all())


def _components(path: Path, arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, list[str]]]:
    """Arrays (N, 1), (N, 3) or (N, 9), and the names of those that were changed to be such, by how."""
    found: dict[str, np.ndarray] = {}
    changed: dict[str, list[str]] = {how: [] for how in _CHANGES}
    for name, values in arrays.items():
        columns = values.reshape(len(values), -1).astype(np.float64)
        count = columns.shape[1]
        parts = {name: columns}
        if count == 2:
            parts = {name: np.pad(columns, ((0, 0), (0, 1)))}
            changed[_PADDED].append(name)
        elif count == 6:
            parts = {name: columns[:, _FULL]}
            changed[_AS_TENSORS].append(name)
        elif count not in (1, 3, 9):
            parts = {f"{name}:{i}": columns[:, i : i + 1] for i in range(count)}
            changed[_APART].append(name)
        if clash := set(parts).intersection({*found, *arrays}.difference([name])):
            raise MeshError(f"{path}: the components of {name!r} need the name {min(clash)!r}, too; rename either.")
        found |= parts
    return found, changed


def _too_large(output: Output) -> list[str]:
    """Names of integers that float64 does not hold."""
    return [
        name
        for arrays in (output.point_data, output.cell_data)
        for name, values in arrays.items()
        if values.dtype.kind in "iu" and max(int(values.max()), -int(values.min())) > _LARGEST_WHOLE
    ]


def _problem(name: str) -> str | None:
    if len(name.encode()) > _LONGEST_NAME:
        return "is too long"
    return control_problem(name, others='"')
