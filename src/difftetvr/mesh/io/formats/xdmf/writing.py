"""From meshes to XDMF files that keep their arrays as text; meshio would write too few digits of float32."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

import numpy as np

from difftetvr.mesh.io.content import Output, all_digits, write_table

_HEAD = '<?xml version="1.0"?>\n<Xdmf Version="3.0"><Domain><Grid Name="mesh" GridType="Uniform">\n'
_TAIL = "</Grid></Domain></Xdmf>\n"


def write(path: Path, output: Output) -> None:
    """Write a tetrahedral mesh with its data; numbers have all digits that it takes to read the same ones again.

    Args:
        path: The file to write.
        output: The mesh, and the field's arrays.
    """
    tets = output.tets
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(_HEAD)
        _write_item(file, 'Geometry GeometryType="XYZ"', output.vertices)
        _write_item(file, f'Topology TopologyType="Tetrahedron" NumberOfElements="{len(tets)}"', tets)
        for arrays, center in ((output.point_data, "Node"), (output.cell_data, "Cell")):
            for name, values in arrays.items():
                kind = "Scalar" if values.ndim == 1 else "Vector"
                _write_item(file, f'Attribute Name="{name}" AttributeType="{kind}" Center="{center}"', values)
        file.write(_TAIL)


def _write_item(file: TextIO, element: str, values: np.ndarray) -> None:
    size, kind = values.dtype.itemsize, "Float" if values.dtype.kind == "f" else "Int"
    shape = " ".join(map(str, values.shape))
    file.write(f'<{element}><DataItem DataType="{kind}" Precision="{size}" Dimensions="{shape}" Format="XML">\n')
    write_table(file, values, all_digits(values))
    file.write(f"</DataItem></{element.split()[0]}>\n")
