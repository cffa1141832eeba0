"""From meshes to XDMF files that keep their arrays as text."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO
from xml.sax.saxutils import quoteattr

import numpy as np

from difftetvr.mesh.io.content import Output, all_digits, write_table
from difftetvr.mesh.io.formats.data import require_names, xml_problem

_HEAD = '<?xml version="1.0" encoding="utf-8"?>\n<Xdmf Version="3.0"><Domain><Grid Name="mesh" GridType="Uniform">\n'
_TAIL = "</Grid></Domain></Xdmf>\n"
_TYPES = {"f": "Float", "i": "Int", "u": "UInt", "i1": "Char", "u1": "UChar", "i2": "Short", "u2": "UShort"}
_KINDS = {(): "Scalar", (1,): "Scalar", (9,): "Tensor", (3, 3): "Tensor"}
"""Kind by the shape of a row. All others are vectors: VTK reads those of any length, puts the components of a Tensor6
into another order, and takes all rows of a Matrix for one."""


def write(path: Path, output: Output) -> None:
    """Write a tetrahedral mesh with its data; numbers have all digits that it takes to read the same ones again.

    Args:
        path: The file to write.
        output: The mesh, and all data.

    Raises:
        MeshError: XML cannot hold a name.
    """
    require_names(output, xml_problem)
    tets = output.tets
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.write(_HEAD)
        _write_item(file, 'Geometry GeometryType="XYZ"', output.vertices)
        _write_item(file, f'Topology TopologyType="Tetrahedron" NumberOfElements="{len(tets)}"', tets)
        for arrays, center in ((output.point_data, "Node"), (output.cell_data, "Cell")):
            for name, values in arrays.items():
                kind = _KINDS.get(values.shape[1:], "Vector")
                head = f'Attribute Name={quoteattr(name)} AttributeType="{kind}" Center="{center}"'
                _write_item(file, head, values)
        file.write(_TAIL)


def _write_item(file: TextIO, element: str, values: np.ndarray) -> None:
    kind, size = values.dtype.kind, values.dtype.itemsize
    name, shape = _TYPES.get(f"{kind}{size}", _TYPES[kind]), " ".join(map(str, values.shape))
    file.write(f'<{element}><DataItem DataType="{name}" Precision="{size}" Dimensions="{shape}" Format="XML">\n')
    table = values.reshape(len(values), -1)
    write_table(file, table, all_digits(table))
    file.write(f"</DataItem></{element.split()[0]}>\n")
