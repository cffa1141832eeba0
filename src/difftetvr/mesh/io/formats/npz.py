"""Meshes in NumPy's archives (.npz)."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.archive import array_names, read_arrays
from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Content, Output, require_array, tetra_block
from difftetvr.mesh.io.formats.data import require_names

_VERTICES = ("vertices", "points")
_TETS = ("tets", "cells")
_PLACED = ("color", "density", "harmonics")
_NAMED = ("location", *_PLACED)
_LONGEST_NAME = 2**15


def read(path: Path) -> Content:
    """Read an archive with arrays ``vertices`` (or ``points``) and ``tets`` (or ``cells``).

    Any other array with one row for each vertex is point data, else with one for each cell cell data; the rest is left
    out. An array ``location`` says where ``color`` and ``density`` belong where both fit.

    Args:
        path: The file.

    Returns:
        Its content.

    Raises:
        MeshError: The file is damaged, lacks an array, or one has a wrong shape.
    """
    counts = _row_counts(path)
    arrays = read_arrays(path, MeshError, lambda name, shape: name in _NAMED or shape[:1] in counts)
    vertices, tets = (_pop(path, arrays, names) for names in (_VERTICES, _TETS))
    require_array(path, "vertices", vertices, 3)
    require_array(path, "tetrahedra", tets, 4, "iu")
    per_cell = str(arrays.pop("location", "")) == "cell"
    point_data, cell_data = {}, {}
    for name, values in arrays.items():
        rows = len(values) if values.ndim else -1
        if rows == len(tets) and (rows != len(vertices) or (per_cell and name in _PLACED)):
            cell_data[name] = values
        elif rows == len(vertices):
            point_data[name] = values
        elif name in ("color", "density"):
            (cell_data if per_cell else point_data)[name] = values
    return Content(vertices, (tetra_block(tets),), point_data, cell_data)


def is_mesh_archive(path: Path) -> bool:
    """Whether a .npz file holds a mesh, as opposed to anything else that is kept in such files.

    Args:
        path: The file; what is no archive holds no mesh.
    """
    names = array_names(path)
    return any(n in names for n in _VERTICES) and any(n in names for n in _TETS)


def write(path: Path, output: Output) -> None:
    """Write an archive.

    Args:
        path: The file to write.
        output: The mesh, and all data.

    Raises:
        MeshError: It cannot tell data of vertices from those of cells, or others of ours, by their names and lengths.
    """
    require_names(output, _problem)
    arrays: dict[str, Any] = {"vertices": output.vertices, "tets": output.tets, **output.point_data, **output.cell_data}
    if len(arrays) < 2 + len(output.point_data) + len(output.cell_data):
        raise MeshError(f"{output.path}: in this format all data need names of their own; rename some, or use .vtu.")
    # What belongs to cells is marked so with a field of cells only, and then all that has the names of its arrays.
    placed = set(_PLACED) if output.is_per_cell else set[str]()
    is_clear = set(output.cell_data) <= placed and not placed.intersection(output.point_data)
    if len(output.vertices) == len(output.tets) and not is_clear:
        raise MeshError(
            f"{output.path}: this format cannot tell data of cells from those of vertices where there are as many of "
            "both; use .vtu."
        )
    if {"color", "density"} & arrays.keys():
        arrays["location"] = np.array("cell" if output.is_per_cell else "vertex")
    # What numpy.savez writes, but that takes some names for arguments of its own.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def _problem(name: str) -> str | None:
    if name == "location":
        return "says whether a field is of vertices or of cells"
    if "\0" in name:
        return "has the character '\\x00'"
    return "is too long" if len(name.encode()) > _LONGEST_NAME else None


def _row_counts(path: Path) -> set[tuple[int, ...]]:
    """Numbers of vertices and of cells, each as a shape: what has another number of rows does not belong here."""
    counts: set[tuple[int, ...]] = set()

    def note(name: str, shape: tuple[int, ...]) -> bool:
        if name in (*_VERTICES, *_TETS):
            counts.add(shape[:1])
        return False

    read_arrays(path, MeshError, note)
    return counts


def _pop(path: Path, arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    for name in names:
        if name in arrays:
            return arrays.pop(name)
    raise MeshError(f"{path} lacks the array 'vertices' or 'tets'; write it again with save.")
