"""XDMF: meshio's reader with our own reading of arrays, and a writer that keeps arrays as text.

meshio's own ask for h5py even where no array lies in HDF5, and write too few digits of float32.
"""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from meshio.xdmf.common import xdmf_to_numpy_type
from meshio.xdmf.main import XdmfReader

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Output, all_digits, damaged, parse_numbers, write_table

_MOST_REFERENCES = 16
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


class GuardedReader(XdmfReader):
    """meshio's reader, less its opening of any file that an array is said to lie in.

    Arrays are read from the file itself, or from files beside it, and are no larger than those.
    """

    def __init__(self, path: Path) -> None:
        """Read later.

        Args:
            path: The .xdmf file.
        """
        super().__init__(str(path))
        self._path = path
        self._references = 0

    def _read_data_item(self, data_item: Any, root: Any = None) -> np.ndarray:
        """Array of a DataItem element; meshio calls this for every one."""
        if "Reference" in data_item.attrib:
            self._references += 1
            if self._references > _MOST_REFERENCES:
                raise damaged(self._path, "its arrays refer to each other without end")
            return super()._read_data_item(data_item, root)
        shape = [int(word) for word in data_item.get("Dimensions", "").split()]
        kind, storage = self._type(data_item), data_item.get("Format", "XML")
        text = (data_item.text or "").strip()
        if storage == "XML":
            return parse_numbers(self._path, text.encode(), kind.type).reshape(shape)
        if storage == "Binary":
            return self._read_binary(data_item, self._beside(text), kind, shape)
        if storage == "HDF":
            return self._read_hdf(text)
        raise damaged(self._path, f"it keeps arrays in the unknown format {storage[:40]!r}")

    def _type(self, data_item: Any) -> np.dtype:
        name = data_item.get("DataType", data_item.get("NumberType", "Float"))
        key = (name, data_item.get("Precision", "4"))
        if key not in xdmf_to_numpy_type:
            raise damaged(self._path, f"it has numbers of the unknown type {key[0][:40]!r} of {key[1][:40]} bytes")
        return np.dtype(xdmf_to_numpy_type[key])

    def _read_binary(self, data_item: Any, file: Path, kind: np.dtype, shape: list[int]) -> np.ndarray:
        endian = data_item.get("Endian", "Native")
        stored = kind.newbyteorder(">" if endian == "Big" else "<" if endian == "Little" else "=")
        seek, count = int(data_item.get("Seek", "0")), math.prod(shape)
        if min(shape, default=0) < 0 or seek < 0 or seek + count * kind.itemsize > file.stat().st_size:
            raise damaged(self._path, f"{file.name} is shorter than announced")
        values = np.fromfile(file, stored, count, offset=seek)
        return values.astype(kind).reshape(shape)

    def _read_hdf(self, text: str) -> np.ndarray:
        try:
            h5py = importlib.import_module("h5py")
        except ImportError as error:
            raise MeshError(
                f"{self._path} keeps its arrays in HDF5, which the package h5py reads; install it or write the arrays "
                "as XML."
            ) from error
        name, _, inside = text.rpartition(":")
        with h5py.File(self._beside(name), "r") as file:
            return np.asarray(file[inside.strip("/")][()])

    def _beside(self, name: str) -> Path:
        file = (self._path.parent / name).resolve()
        if not file.is_relative_to(self._path.parent.resolve()) or not file.is_file():
            raise damaged(self._path, f"there is no file {name[:80]!r} with its arrays beside it")
        return file
