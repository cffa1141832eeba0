"""From meshes to VTK's XML files of unstructured grids (.vtu).

Arrays are packed in blocks by zlib and encoded in base64, so that the file is XML to every reader.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np

from difftetvr.mesh.io.content import Output
from difftetvr.mesh.io.formats.data import flattened, require_names, xml_problem
from difftetvr.vtk_xml import TYPES

_NAMES = {code: name for name, code in TYPES.items()}
_HEAD = (
    '<?xml version="1.0" encoding="utf-8"?>\n<VTKFile type="{0}" version="1.0" byte_order="LittleEndian" '
    'header_type="UInt64" compressor="vtkZLibDataCompressor">\n<{0}>\n<Piece {1}>\n'
)
_TAIL = "</Piece>\n</{0}>\n</VTKFile>\n"
_TETRA = 10
_BLOCK = 2**20


def write(path: Path, output: Output) -> tuple[str, ...]:
    """Write a tetrahedral mesh with its data.

    Args:
        path: The file to write.
        output: The mesh, and all data.

    Returns:
        Sentences about data that were written in another shape.

    Raises:
        MeshError: XML cannot hold a name.
    """
    require_names(output, xml_problem)
    output, notes = flattened(output)
    tets = output.tets.astype(np.int64)
    count = len(tets)
    cells: dict[str, np.ndarray] = {
        "connectivity": tets.reshape(-1),
        "offsets": np.arange(4, 4 * count + 1, 4),
        "types": np.full(count, _TETRA, np.uint8),
    }
    numbers = f'NumberOfPoints="{len(output.vertices)}" NumberOfCells="{count}"'
    with open(path, "wb") as file, piece(file, "UnstructuredGrid", numbers):
        write_section(file, "Points", {"Points": output.vertices})
        write_section(file, "Cells", cells)
        write_section(file, "PointData", output.point_data)
        write_section(file, "CellData", output.cell_data)
    return notes


@contextmanager
def piece(file: BinaryIO, kind: str, numbers: str) -> Iterator[None]:
    """Context that writes sections of the one piece of a file.

    Args:
        file: Where to.
        kind: Of data: UnstructuredGrid, PolyData.
        numbers: Attributes of the piece.
    """
    write_text(file, _HEAD.format(kind, numbers))
    yield
    write_text(file, _TAIL.format(kind))


def write_section(file: BinaryIO, section: str, arrays: dict[str, np.ndarray], attributes: str = "") -> None:
    """Write an element of data arrays.

    Args:
        file: Where to.
        section: Name of the element.
        arrays: (N,) or (N, C) arrays by name; XML must know the characters of the names.
        attributes: Of the element, with a space before them.
    """
    write_text(file, f"<{section}{attributes}>\n")
    for name, values in arrays.items():
        columns = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
        kind = _NAMES[values.dtype.str[1:]]
        write_text(file, f'<DataArray type="{kind}" Name={quoteattr(name)}{columns} format="binary">\n')
        _write_packed(file, values.astype(values.dtype.newbyteorder("<"), order="C", copy=False).tobytes())
        write_text(file, "\n</DataArray>\n")
    write_text(file, f"</{section}>\n")


def _write_packed(file: BinaryIO, data: bytes) -> None:
    """Number of blocks, their size, the last one's if it is smaller, all packed sizes; then the packed blocks."""
    blocks = [zlib.compress(data[begin : begin + _BLOCK]) for begin in range(0, len(data), _BLOCK)]
    sizes = [len(blocks), _BLOCK, len(data) % _BLOCK, *map(len, blocks)]
    file.write(base64.b64encode(np.array(sizes, "<u8").tobytes()))
    file.write(base64.b64encode(b"".join(blocks)))


def write_text(file: BinaryIO, text: str) -> None:
    """Write text as UTF-8."""
    file.write(text.encode())
