"""From meshes to legacy VTK files, binary, version 5.1."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from difftetvr.mesh.io.content import Output
from difftetvr.mesh.io.formats.data import flattened, require_names

_TYPES = {
    "i1": "signed_char",
    "u1": "unsigned_char",
    "i2": "short",
    "u2": "unsigned_short",
    "i4": "int",
    "u4": "unsigned_int",
    "i8": "vtktypeint64",
    "u8": "vtktypeuint64",
    "f4": "float",
    "f8": "double",
}
_HEAD = "# vtk DataFile Version 5.1\nwritten by DiffTetVR\nBINARY\nDATASET UNSTRUCTURED_GRID\n"
_TETRA = 10
_LONGEST_NAME = 255
"""Bytes of a word that VTK reads at once."""


def write(path: Path, output: Output) -> tuple[str, ...]:
    """Write a tetrahedral mesh with its data, as a field of arrays with any number of components.

    Args:
        path: The file to write.
        output: The mesh, and all data.

    Returns:
        Sentences about data that were written in another shape.

    Raises:
        MeshError: A name is too long.
    """
    require_names(output, _problem)
    output, notes = flattened(output)
    tets = output.tets.astype(np.int64)
    count = len(tets)
    with open(path, "wb") as file:
        _write(file, f"{_HEAD}POINTS {len(output.vertices)} {_type_of(output.vertices)}\n", output.vertices)
        _write(file, f"CELLS {count + 1} {4 * count}\nOFFSETS vtktypeint64\n", np.arange(0, 4 * count + 1, 4))
        _write(file, "CONNECTIVITY vtktypeint64\n", tets)
        _write(file, f"CELL_TYPES {count}\n", np.full(count, _TETRA, np.int32))
        for place, rows, arrays in (
            ("POINT_DATA", len(output.vertices), output.point_data),
            ("CELL_DATA", count, output.cell_data),
        ):
            heading = f"{place} {rows}\nFIELD FieldData {len(arrays)}\n"
            for name, values in arrays.items():
                columns = values.shape[1] if values.ndim == 2 else 1
                _write(file, f"{heading}{_encoded(name)} {columns} {rows} {_type_of(values)}\n", values)
                heading = ""
    return notes


def _write(file: BinaryIO, heading: str, values: np.ndarray) -> None:
    file.write(heading.encode("ascii"))
    file.write(values.astype(values.dtype.newbyteorder(">"), order="C", copy=False).tobytes())
    file.write(b"\n")


def _type_of(values: np.ndarray) -> str:
    return _TYPES[values.dtype.str[1:]]


def _encoded(name: str) -> str:
    """A name as VTK writes it: one word of printable ASCII, all other bytes as a percent sign and two digits."""
    return "".join(chr(b) if 32 < b < 127 and b not in b'%"' else f"%{b:02X}" for b in name.encode())


def _problem(name: str) -> str | None:
    if "\0" in name:
        return "has the character '\\x00'"
    return "is too long" if len(_encoded(name)) > _LONGEST_NAME else None
