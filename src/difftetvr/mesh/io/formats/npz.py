"""Meshes in NumPy's archives (.npz)."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Content, Output, require_array, tetra_block

_VERTICES = ("vertices", "points")
_TETS = ("tets", "cells")
# The most that the compression of .zip files can win.
_LARGEST_RATIO = 1032


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
    try:
        arrays = _arrays(path)
    # What damaged archives raise is for zipfile, zlib, ast and tokenize to decide, and no list of it is complete.
    except Exception as error:
        raise MeshError(f"{path} is no intact numpy archive of plain arrays; write it again with save.") from error
    vertices, tets = (_pop(path, arrays, names) for names in (_VERTICES, _TETS))
    require_array(path, "vertices", vertices, 3)
    require_array(path, "tetrahedra", tets, 4, "iu")
    per_cell = str(arrays.pop("location", "")) == "cell"
    point_data, cell_data = {}, {}
    for name, values in arrays.items():
        rows = len(values) if values.ndim else -1
        if rows == len(tets) and (rows != len(vertices) or (per_cell and name in ("color", "density", "harmonics"))):
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
    try:
        with np.load(path, allow_pickle=False) as archive:
            return any(n in archive for n in _VERTICES) and any(n in archive for n in _TETS)
    except (ValueError, OSError, EOFError, TypeError, zipfile.BadZipFile):
        return False


def write(path: Path, output: Output) -> None:
    """Write an archive.

    Args:
        path: The file to write.
        output: The mesh, and the field's arrays.
    """
    arrays: dict[str, Any] = {"vertices": output.vertices, "tets": output.tets, **output.arrays}
    if output.arrays:
        arrays["location"] = np.array("cell" if output.is_per_cell else "vertex")
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.file_size > _LARGEST_RATIO * (member.compress_size + 1):
                raise ValueError("it announces more than it can hold")
            with archive.open(member) as file:
                _require_honest_header(file, member.file_size)
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _require_honest_header(file: Any, size: int) -> None:
    """Numpy allocates what an array's header announces before it reads; so look whether that much is there."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    count = 1
    for length in shape:
        count *= length
    if not 0 <= count * dtype.itemsize <= size:
        raise ValueError("it announces more than it holds")


def _pop(path: Path, arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    for name in names:
        if name in arrays:
            return arrays.pop(name)
    raise MeshError(f"{path} lacks the array 'vertices' or 'tets'; write it again with save.")
