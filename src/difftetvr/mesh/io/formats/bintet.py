"""The binary format of the original DiffTetVR (.bintet).

Little-endian: the version (1 or 2), then arrays, each after its number of elements: cell indices (uint32, four a cell),
positions (3 float32), colours of vertices (red, green, blue, density as float32) and, in version 2, colours of cells.
Arrays of colours may be empty.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Content, Output, damaged, split_rgba, tetra_block
from difftetvr.mesh.io.source import Source


def read(path: Path) -> Content:
    """Read a .bintet file.

    Args:
        path: The file.

    Returns:
        Its content, float32.

    Raises:
        MeshError: The file is damaged or of another version.
    """
    with open(path, "rb") as file:
        source = Source(path, file)
        source.text = False
        version = int(source.numbers(1, "u4", "its version")[0])
        if version not in (1, 2):
            raise MeshError(f"{path} is of version {version} of this format; only versions 1 and 2 are known.")
        indices = _array(source, "u4", 1, "cell indices").ravel()
        vertices = _array(source, "f4", 3, "positions")
        colors = _array(source, "f4", 4, "colours of vertices")
        cell_colors = _array(source, "f4", 4, "colours of cells") if version == 2 else np.empty((0, 4), np.float32)
        if source.position() != source.size:
            raise damaged(path, f"{source.size - source.position()} bytes follow its end")
    if len(indices) % 4:
        raise damaged(path, f"{len(indices)} cell indices do not make whole tetrahedra")
    tets = indices.reshape(-1, 4)
    for values, count, what in ((colors, len(vertices), "vertices"), (cell_colors, len(tets), "cells")):
        if len(values) not in (0, count):
            raise damaged(path, f"it has {len(values)} colours for {count} {what}")
    return Content(
        vertices,
        (tetra_block(tets),),
        split_rgba(colors) if len(colors) else {},
        split_rgba(cell_colors) if len(cell_colors) else {},
    )


def write(path: Path, output: Output) -> None:
    """Write a .bintet file: version 2 where colours belong to cells, else version 1.

    Args:
        path: The file to write.
        output: The mesh, and the field's arrays.
    """
    none, per_cell = np.empty((0, 4)), output.is_per_cell
    colors = none if output.rgba is None else output.rgba
    arrays = [(output.tets.reshape(-1, 1), "<u4"), (output.vertices, "<f4"), (none if per_cell else colors, "<f4")]
    if per_cell:
        arrays.append((colors, "<f4"))
    with open(path, "wb") as file:
        file.write(np.array([2 if per_cell else 1], "<u4").tobytes())
        for values, kind in arrays:
            file.write(np.array([len(values)], "<u4").tobytes())
            file.write(values.astype(kind).tobytes())


def _array(source: Source, kind: str, columns: int, what: str) -> np.ndarray:
    count = int(source.numbers(1, "u4", f"number of {what}")[0])
    return source.numbers(count * columns, kind, what).reshape(count, columns)
