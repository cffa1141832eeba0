"""Values on regular grids in files: NRRD, VTK's image data, NIfTI and NumPy's arrays.

Files are written slab by slab, x fastest, so a grid that is sampled on its way into one need not fit into memory.

Sources: https://teem.sourceforge.net/nrrd/format.html, and "VTK XML File Formats".
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np
import torch

from difftetvr.errors import MeshError, counted, listed, shown
from difftetvr.files import atomic_write, require_room
from difftetvr.inputs import as_reals, require_type
from difftetvr.mesh.io.formats.data import xml_problem
from difftetvr.sampling.grids import Grid
from difftetvr.sampling.nifti import nifti_header
from difftetvr.sampling.voxels import AT_ONCE
from difftetvr.vtk_xml import TYPES

Slab = list[np.ndarray]
"""Of each array of a file, (Z, Y, X) or (Z, Y, X, C) values in some layers of a grid."""

_VTK_NAMES = {code: name for name, code in TYPES.items()}
_NRRD_NAMES = {"f4": "float", "f8": "double"}
# The highest at which zlib is quick.
_GZIP_LEVEL = 4


@dataclass(frozen=True)
class ArrayOfGrid:
    """One array of a file.

    Attributes:
        name: What it is called.
        dtype: float32 or float64, little-endian in files.
        components: Numbers for each point, where they are vectors; None for scalars.
    """

    name: str
    dtype: np.dtype
    components: int | None

    @property
    def bytes_of_point(self) -> int:
        """What a point takes in memory and, unpacked, in files."""
        return self.dtype.itemsize * (1 if self.components is None else self.components)


def save_grid(
    path: str | Path, values: torch.Tensor | Mapping[str, torch.Tensor], grid: Grid, remark: str = ""
) -> None:
    """Writes values that `voxelise` gave, or any others on a regular grid; the suffix chooses the format.

    The values are those at the grid's points, in all of the formats:

    - ``.nrrd``: one array, packed by gzip, with the grid's directions, space and unit; components of vectors are the
      fastest axis.
    - ``.vti``: any number of arrays as point data, so that points of the image are points of the grid; not packed. VTK
      before 9.0 passes over directions.
    - ``.nii``: one array, NIfTI 1, not packed, in the patient's axes where the grid's space tells them, else in the
      world's as they are; components of vectors are the fifth axis.
    - ``.npy``: one array of shape (Z, Y, X) or (Z, Y, X, C), and nothing about the grid.

    The file appears whole or not at all. `voxelise_to_file` samples a mesh on the way into a file.

    Args:
        path: The file.
        values: (X, Y, Z) scalars or (X, Y, Z, C) vectors, float32 or float64; others are written as float32. Several
            of them by name; one alone is called "values".
        grid: Where they are.
        remark: What else to say in the header of .nrrd and .vti, such as the value of points outside.

    Raises:
        MeshError: The suffix is another, the format holds one array only, the values do not fit the grid, or the file
            cannot be written.
    """
    require_type(grid, Grid, "grid", "pass a difftetvr.sampling.Grid", MeshError)
    tables = {}
    for name, given in named(values).items():
        table = as_reals(given, f"The values '{name}'", MeshError).detach()
        if table.ndim not in (3, 4) or tuple(table.shape[:3]) != grid.shape or not table.numel():
            raise MeshError(
                f"The values '{name}' have shape {tuple(table.shape)} on a grid of {grid.shape} points; pass a number "
                "or a vector for each."
            )
        tables[name] = table
    arrays = [
        ArrayOfGrid(name, dtype_of(table), table.shape[3] if table.ndim == 4 else None)
        for name, table in tables.items()
    ]

    def slabs() -> Iterator[Slab]:
        for first, count in layers(grid):
            yield [in_file_order(table[:, :, first : first + count]) for table in tables.values()]

    write_grid(path, arrays, grid, slabs(), remark)


def write_grid(
    path: str | Path,
    arrays: Sequence[ArrayOfGrid],
    grid: Grid,
    slabs: Iterable[Slab],
    remark: str,
    x_first: bool = False,
) -> None:
    """Writes arrays of which some layers along z are there at a time; see `save_grid`.

    Args:
        path: The file.
        arrays: What it holds.
        grid: Where the values are.
        slabs: The values, layer by layer.
        remark: What else to say in a header.
        x_first: Whether the axes of a ``.npy`` are x, y, z, instead of z, y, x; its bytes are the same.

    Raises:
        MeshError: As `save_grid`.
    """
    require_grid_format(path, [array.name for array in arrays])
    if not str(path).lower().endswith(".nrrd"):  # of what is packed, the size is not known
        require_room(path, grid.num_points * sum(array.bytes_of_point for array in arrays), MeshError)
    with atomic_write(path, MeshError) as temporary, temporary.open("wb") as file:
        suffix = Path(path).suffix.lower()
        write = _write_npy_x_first if x_first and suffix == ".npy" else _FORMATS[suffix]
        write(file, arrays, grid, slabs, remark)


def require_grid_format(path: str | Path, names: Sequence[str]) -> None:
    """Checks that a path names a file of a grid that holds arrays of some names.

    Raises:
        MeshError: It does not.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMATS:
        raise MeshError(f"'{path}' is no file of values on a grid; use one of {', '.join(_FORMATS)}.")
    if suffix != ".vti" and len(names) != 1:
        found = f"{counted(len(names), 'array')} ({listed(names)})" if names else "no array"
        raise MeshError(f"'{path}' would hold {found}, where a '{suffix}' holds one; choose one, or write a .vti.")
    for name in names:
        if (reason := xml_problem(name)) is not None and suffix == ".vti":
            raise MeshError(f"'{path}' cannot hold the array {name[:80]!r}, as its name {reason}; rename it.")


def named(values: Any) -> dict[str, Any]:
    """Values by name; such without one are called "values".

    Raises:
        MeshError: There are none, or a name is no text.
    """
    found = dict(values) if isinstance(values, Mapping) else {"values": values}
    if not found:
        raise MeshError("There are no values for the grid; pass at least one array.")
    for name in found:
        if not isinstance(name, str) or not name:
            raise MeshError(f"The values have the name {shown(name)}; give all arrays names that are text.")
    return found


def dtype_of(table: torch.Tensor) -> np.dtype:
    """NumPy's type of a tensor of float32 or float64."""
    return np.dtype("f8" if table.dtype == torch.float64 else "f4")


def layers(grid: Grid, cost: int = 1) -> Iterator[tuple[int, int]]:
    """First layers along z and numbers of them, of which one number makes about as many points as fit at a time.

    Args:
        grid: The grid.
        cost: Points that each of its points stands for.
    """
    nx, ny, nz = grid.shape
    rows = min(max(1, AT_ONCE // (nx * ny * cost)), nz)
    return ((first, min(rows, nz - first)) for first in range(0, nz, rows))


def in_file_order(values: torch.Tensor) -> np.ndarray:
    """(Z, Y, X, ...) array of (X, Y, Z, ...) values."""
    order = (2, 1, 0, 3)[: values.ndim]
    array: np.ndarray = values.permute(order).contiguous().cpu().numpy()
    return array


def _write_nrrd(file: BinaryIO, arrays: Sequence[ArrayOfGrid], grid: Grid, slabs: Iterable[Slab], remark: str) -> None:
    (array,) = arrays
    vector = [] if array.components is None else [array]
    sizes = [*(array.components for array in vector), *grid.shape]
    steps = [tuple(step * x for x in axis) for step, axis in zip(grid.spacing, _axes_of(grid))]
    lines = [
        "NRRD0004",
        *(f"# {_in_ascii(line)}" for line in remark.splitlines()),
        f"content: {_in_ascii(array.name)}",
        f"type: {_NRRD_NAMES[array.dtype.str[1:]]}",
        f"dimension: {len(sizes)}",
        f"space: {grid.space}" if grid.space else "space dimension: 3",
        f"sizes: {' '.join(map(str, sizes))}",
        f"space directions: {' '.join([*('none' for _ in vector), *map(_point, steps)])}",
        f"kinds: {' '.join([*('vector' for _ in vector), *['domain'] * 3])}",
        "endian: little",
        "encoding: gzip",
        f"space origin: {_point(grid.origin)}",
        *([f"space units: {' '.join([_quoted(grid.unit)] * 3)}"] if grid.unit else []),
    ]
    file.write("\n".join([*lines, "", ""]).encode("ascii"))
    # Without a name and a time, so that the same values are the same bytes.
    with gzip.GzipFile("", "wb", _GZIP_LEVEL, file, mtime=0) as packed:
        for (values,) in slabs:
            packed.write(_little_endian(values))


def _write_vti(file: BinaryIO, arrays: Sequence[ArrayOfGrid], grid: Grid, slabs: Iterable[Slab], remark: str) -> None:
    sizes = [grid.num_points * array.bytes_of_point for array in arrays]
    offsets = [sum(sizes[:index]) + 8 * index for index in range(len(sizes))]
    extent = " ".join(f"0 {count - 1}" for count in grid.shape)
    matrix = [x for row in zip(*_axes_of(grid)) for x in row]  # its columns are the axes
    place = f'Origin="{_joined(grid.origin)}" Spacing="{_joined(grid.spacing)}"'
    if grid.directions is not None:
        place += f' Direction="{_joined(matrix)}"'
    scalars = next((f" Scalars={quoteattr(array.name)}" for array in arrays if array.components is None), "")
    head = [
        '<?xml version="1.0" encoding="utf-8"?>',
        *(f"<!-- {_in_ascii(line).replace('-', '- ')} -->" for line in remark.splitlines()),
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        f'<ImageData WholeExtent="{extent}" {place}>',
        f'<Piece Extent="{extent}">',
        f"<PointData{scalars}>",
        *(_data_array(array, offset) for array, offset in zip(arrays, offsets)),
        "</PointData>",
        "</Piece>",
        "</ImageData>",
        '<AppendedData encoding="raw">',
        "_",
    ]
    file.write("\n".join(head).encode())
    begin = file.tell()
    for offset, size in zip(offsets, sizes):
        file.seek(begin + offset)
        file.write(struct.pack("<Q", size))
    places = [begin + offset + 8 for offset in offsets]
    for slab in slabs:
        for index, values in enumerate(slab):
            file.seek(places[index])
            places[index] += file.write(_little_endian(values))
    file.seek(begin + offsets[-1] + 8 + sizes[-1])
    file.write(b"\n</AppendedData>\n</VTKFile>\n")


def _data_array(array: ArrayOfGrid, offset: int) -> str:
    kind, components = _VTK_NAMES[array.dtype.str[1:]], array.components or 1
    return (
        f'<DataArray type="{kind}" Name={quoteattr(array.name)} NumberOfComponents="{components}" format="appended" '
        f'offset="{offset}"/>'
    )


def _write_npy(file: BinaryIO, arrays: Sequence[ArrayOfGrid], grid: Grid, slabs: Iterable[Slab], remark: str) -> None:
    (array,) = arrays
    shape = (*grid.shape[::-1], *([] if array.components is None else [array.components]))
    _write_npy_of(file, array, shape, False, slabs)


def _write_npy_x_first(
    file: BinaryIO, arrays: Sequence[ArrayOfGrid], grid: Grid, slabs: Iterable[Slab], remark: str
) -> None:
    (array,) = arrays
    shape = (*([] if array.components is None else [array.components]), *grid.shape)
    _write_npy_of(file, array, shape, True, slabs)


def _write_npy_of(
    file: BinaryIO, array: ArrayOfGrid, shape: tuple[int, ...], first_is_fastest: bool, slabs: Iterable[Slab]
) -> None:
    header = {"descr": array.dtype.newbyteorder("<").str, "fortran_order": first_is_fastest, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    for (values,) in slabs:
        file.write(_little_endian(values))


def _write_nii(file: BinaryIO, arrays: Sequence[ArrayOfGrid], grid: Grid, slabs: Iterable[Slab], remark: str) -> None:
    (array,) = arrays
    header = nifti_header(grid, array.dtype, array.components, array.name, remark)
    file.write(header)
    size = array.dtype.itemsize * grid.num_points
    done = 0
    for (values,) in slabs:
        # Components are the slowest axis: a part of the file for each.
        for index in range(array.components or 1):
            file.seek(len(header) + index * size + done)
            file.write(_little_endian(values if array.components is None else values[..., index]))
        done += values[..., 0].nbytes if array.components else values.nbytes


def _little_endian(values: np.ndarray) -> memoryview:
    """The bytes of an array, copied only where the machine keeps them in the other order."""
    array = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    return array.reshape(-1).view(np.uint8).data


def _axes_of(grid: Grid) -> Sequence[Sequence[float]]:
    return grid.directions or ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _point(numbers: Sequence[float]) -> str:
    return f"({','.join(map(repr, numbers))})"


def _joined(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))


def _in_ascii(text: str) -> str:
    return text.encode("unicode_escape").decode("ascii")


def _quoted(unit: str) -> str:
    return '"' + unit.replace("\u00b5", "u").replace("\u03bc", "u").encode("ascii", "replace").decode() + '"'


_FORMATS: dict[str, Callable[[BinaryIO, Sequence[ArrayOfGrid], Grid, Iterable[Slab], str], None]] = {
    ".nrrd": _write_nrrd,
    ".vti": _write_vti,
    ".nii": _write_nii,
    ".npy": _write_npy,
}
GRID_SUFFIXES = tuple(_FORMATS)
"""Suffixes of files of grids."""
