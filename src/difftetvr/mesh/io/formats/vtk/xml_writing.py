"""From meshes to VTK's XML files of unstructured grids (.vtu).

Arrays are packed in blocks by zlib and encoded in base64, so that the file is XML to every reader.
"""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np

from difftetvr.mesh.io.content import Output
from difftetvr.mesh.io.formats.data import flattened, require_names, xml_problem
from difftetvr.vtk_xml import TYPES

_NAMES = {code: name for name, code in TYPES.items()}
_HEAD = (
    '<?xml version="1.0" encoding="utf-8"?>\n<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" '
    'header_type="UInt64" compressor="vtkZLibDataCompressor">\n<UnstructuredGrid>\n'
)
_TAIL = "</Piece>\n</UnstructuredGrid>\n</VTKFile>\n"
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
    with open(path, "wb") as file:
        _write_text(file, f'{_HEAD}<Piece NumberOfPoints="{len(output.vertices)}" NumberOfCells="{count}">\n')
        _write_section(file, "Points", {"Points": output.vertices})
        _write_section(file, "Cells", cells)
        _write_section(file, "PointData", output.point_data)
        _write_section(file, "CellData", output.cell_data)
        _write_text(file, _TAIL)
    return notes


def _write_section(file: BinaryIO, section: str, arrays: dict[str, np.ndarray]) -> None:
    _write_text(file, f"<{section}>\n")
    for name, values in arrays.items():
        columns = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
        kind = _NAMES[values.dtype.str[1:]]
        _write_text(file, f'<DataArray type="{kind}" Name={quoteattr(name)}{columns} format="binary">\n')
        _write_packed(file, values.astype(values.dtype.newbyteorder("<"), order="C", copy=False).tobytes())
        _write_text(file, "\n</DataArray>\n")
    _write_text(file, f"</{section}>\n")


def _write_packed(file: BinaryIO, data: bytes) -> None:
    """Number of blocks, their size, the last one's if it is smaller, all packed sizes; then the packed blocks."""
    blocks = [zlib.compress(data[begin : begin + _BLOCK]) for begin in range(0, len(data), _BLOCK)]
    sizes = [len(blocks), _BLOCK, len(data) % _BLOCK, *map(len, blocks)]
    file.write(base64.b64encode(np.array(sizes, "<u8").tobytes()))
    file.write(base64.b64encode(b"".join(blocks)))


def _write_text(file: BinaryIO, text: str) -> None:
    file.write(text.encode())
