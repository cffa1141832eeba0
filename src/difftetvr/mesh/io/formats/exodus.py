"""Exodus files, of Cubit, MOOSE and Sierra: arrays in NetCDF, classic or in HDF5, with names that say what they are."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.io.content import CellBlock, Content, chosen_step, damaged
from difftetvr.mesh.io.hdf5 import PlainFile
from difftetvr.mesh.io.isolation import isolated
from difftetvr.mesh.io.netcdf import require_whole
from difftetvr.trust import require_modest

SUFFIXES = (".e", ".exo", ".ex2", ".exoii", ".exii", ".g", ".gen")
"""Suffixes of Exodus files."""

_FAMILIES = {
    "tetra": (4, 10),
    "hexahedron": (8, 20, 27),
    "wedge": (6, 15, 18),
    "pyramid": (5, 13, 14),
    "triangle": (3, 6),
    "quad": (4, 8, 9),
    "line": (2, 3),
    "vertex": (1,),
}
"""Numbers of nodes of the cells that we have names for."""

_PREFIXES = {
    "TET": "tetra",
    "HEX": "hexahedron",
    "WED": "wedge",
    "PYR": "pyramid",
    "TRI": "triangle",
    "QUA": "quad",
    "SHE": "quad",
    "BAR": "line",
    "BEA": "line",
    "TRU": "line",
    "ROD": "line",
    "EDG": "line",
    "SPH": "vertex",
    "CIR": "vertex",
}
"""Families by how the names of element types begin."""

_LINEAR_SIZES = (1, 2, 3, 4, 5, 6, 8)
_PACKAGES = "install them with pip install 'difftetvr[exodus]'"
_HDF5 = b"\x89HDF\r\n\x1a\n"


def read(path: Path, step: int | None = None) -> Content:
    """Read an Exodus file, in a process of its own.

    Args:
        path: The file.
        step: See `chosen_step`.

    Returns:
        Its content. The blocks' numbers are cell data ``exodus:block``; variables of elements are NaN in blocks that
        have none.

    Raises:
        MeshError: The package netCDF4 is not installed, or the file cannot be read.
    """
    with open(path, "rb") as file:
        begin = file.read(len(_HDF5))
    if begin[:3] != b"CDF" and begin != _HDF5:
        raise damaged(path, "it does not begin as files of NetCDF do")
    for package in ("netCDF4", "h5py") if begin == _HDF5 else ("netCDF4",):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise MeshError(f"{path} is an Exodus file, which netCDF4 and h5py read; {_PACKAGES}.") from error
    return isolated(read_here, path, step)


def read_here(path: Path, step: int | None) -> Content:
    """As `read`, with NetCDF's library in this process."""
    import netCDF4  # late: an extra

    with open(path, "rb") as file:
        is_hdf5 = file.read(len(_HDF5)) == _HDF5
    if is_hdf5:
        with PlainFile(path) as plain:
            plain.require_plain(sized=False)
    else:
        require_whole(path)
    try:
        with netCDF4.Dataset(str(path.resolve())) as file:
            file.set_auto_maskandscale(False)
            return _Reader(path, file).content(step)
    except (MeshError, MemoryError):
        raise
    # What damaged files raise is for netCDF4 to decide, and no list of it is complete.
    except Exception as error:
        is_clear = isinstance(error, (OSError, RuntimeError))
        raise damaged(path, str(error).split("\n")[0][:200] if is_clear else "it breaks its format's rules") from error


class _Reader:
    """Reads what a file names; what it does not name is missing or unused."""

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self.file = path, file
        self._size = 0

    def content(self, step: int | None) -> Content:
        vertices = self._vertices()
        blocks, numbers = self._blocks(len(vertices))
        times = self._array("time_whole").tolist() if "time_whole" in self.file.variables else []
        notes: tuple[str, ...] = ()
        index = 0
        if times:
            index, notes = chosen_step(self.path, times, step)
        elif step is not None:
            raise MeshError(f"{self.path} has no time steps; leave out --step.")
        point_data = self._node_data(len(vertices), index) if times else {}
        cell_data: dict[str, np.ndarray] = {"exodus:block": np.repeat(numbers, [len(b.nodes) for b in blocks])}
        cell_data.update(self._element_data(blocks, index) if times else {})
        merged: dict[str, list[CellBlock]] = {}
        for block in blocks:
            merged.setdefault(f"{block.kind}/{block.nodes.shape[1]}", []).append(block)
        cells = tuple(
            CellBlock(same[0].kind, np.concatenate([b.nodes for b in same]), np.concatenate([b.rows for b in same]))
            for same in merged.values()
        )
        return Content(vertices, cells, point_data, cell_data, (*notes, *self._unused()))

    def _count(self, dimension: str) -> int:
        """Length of a dimension, 0 where there is none."""
        return len(self.file.dimensions[dimension]) if dimension in self.file.dimensions else 0

    def _array(self, name: str, index: tuple[int, ...] = ()) -> np.ndarray:
        """A variable, or the part of it at some indices of its first dimensions."""
        variable = self.file.variables.get(name)
        if variable is None or variable.dtype is str or len(variable.shape) < len(index):
            raise damaged(self.path, f"it lacks {name!r}")
        self._size += variable.dtype.itemsize * int(np.prod(variable.shape[len(index) :], dtype=object))
        require_modest(self.path, self._size, "arrays", MeshError)
        return np.asarray(variable[index] if index else variable[...])

    def _numbers(self, name: str, count: int, index: tuple[int, ...] = ()) -> np.ndarray:
        """(count,) numbers."""
        values = self._array(name, index)
        if values.shape != (count,) or values.dtype.kind not in "fiu":
            raise damaged(self.path, f"{name!r} has shape {values.shape}, not ({count},)")
        return values

    def _names(self, variable: str, count: int) -> list[str]:
        """Names of data, which files keep as rows of characters; numbers where there are none."""
        if variable not in self.file.variables:
            return [str(i + 1) for i in range(count)]
        rows = self._array(variable)
        if rows.dtype.kind != "S" or rows.ndim != 2 or len(rows) != count:
            raise damaged(self.path, f"{variable!r} is no table of {count} names")
        texts = [b"".join(row.tolist()).split(b"\0")[0].decode("utf-8", "replace").strip() for row in rows]
        return [text or str(i + 1) for i, text in enumerate(texts)]

    def _vertices(self) -> np.ndarray:
        dimension, count = self._count("num_dim"), self._count("num_nodes")
        if dimension in (1, 2):
            raise MeshError(f"{self.path} is no mesh of three dimensions; give a volume mesh.")
        if dimension != 3 or not count:
            raise damaged(self.path, "it has no nodes, or is no Exodus file")
        if "coord" in self.file.variables:
            return np.column_stack([self._numbers("coord", count, (axis,)) for axis in range(3)])
        return np.column_stack([self._numbers(f"coord{axis}", count) for axis in "xyz"])

    def _blocks(self, num_nodes: int) -> tuple[list[CellBlock], list[int]]:
        """Cells of each block, an empty one too, and the blocks' numbers."""
        count = self._count("num_el_blk")
        numbers = [i + 1 for i in range(count)]
        if "eb_prop1" in self.file.variables:
            numbers = self._numbers("eb_prop1", count).astype(np.int64).tolist()
        blocks, begin = [], 0
        for i in range(1, count + 1):
            size = self._count(f"num_el_in_blk{i}")
            if not size:
                blocks.append(CellBlock("empty", np.empty((0, 0), np.int64), np.empty(0, np.int64)))
                continue
            name = str(getattr(self.file.variables.get(f"connect{i}"), "elem_type", "")).strip().strip("\0").upper()
            nodes = np.empty((size, 0), np.int64)
            if not name.startswith(("NSIDED", "NFACED")):
                nodes = self._array(f"connect{i}").astype(np.int64) - 1
                if nodes.ndim != 2 or len(nodes) != size:
                    raise damaged(self.path, f"the cells of block {numbers[i - 1]} have shape {nodes.shape}")
            kind, used = _kind(name, nodes.shape[1])
            blocks.append(CellBlock(kind, nodes[:, :used], np.arange(begin, begin + size)))
            begin += size
        return blocks, numbers

    def _node_data(self, num_nodes: int, step: int) -> dict[str, np.ndarray]:
        found = {}
        for i, name in enumerate(self._names("name_nod_var", self._count("num_nod_var"))):
            if f"vals_nod_var{i + 1}" in self.file.variables:
                found[name] = self._numbers(f"vals_nod_var{i + 1}", num_nodes, (step,))
            else:  # files of the first version keep all in one
                found[name] = self._numbers("vals_nod_var", num_nodes, (step, i))
        return found

    def _element_data(self, blocks: list[CellBlock], step: int) -> dict[str, np.ndarray]:
        found = {}
        total = sum(len(block.nodes) for block in blocks)
        for i, name in enumerate(self._names("name_elem_var", self._count("num_elem_var"))):
            values = np.full(total, np.nan)
            for number, block in enumerate(blocks):
                variable = f"vals_elem_var{i + 1}eb{number + 1}"
                if len(block.nodes) and variable in self.file.variables:
                    values[block.rows] = self._numbers(variable, len(block.nodes), (step,))
            found[name] = values
        return found

    def _unused(self) -> tuple[str, ...]:
        attributes = sum(1 for name in self.file.variables if re.fullmatch(r"attrib\d+", name))
        numbers = {
            ("set of nodes", "sets of nodes"): self._count("num_node_sets"),
            ("set of sides", "sets of sides"): self._count("num_side_sets"),
            ("set of elements", "sets of elements"): self._count("num_elem_sets"),
            ("variable of the whole mesh", "variables of the whole mesh"): self._count("num_glo_var"),
            ("block's attributes", "blocks' attributes"): attributes,
        }
        parts = [counted(number, *what) for what, number in numbers.items() if number]
        return (f"Left out: {', '.join(parts)}.",) if parts else ()


def _kind(name: str, size: int) -> tuple[str, int]:
    """Name of the kind of an element type with so many nodes, and how many of these it uses.

    Nodes that only larger types have come last, so a tetrahedron of 15 nodes is one of 10 with 5 more.
    """
    family = _PREFIXES.get(name[:3], "")
    if name.startswith("SHE") and size in (3, 6):
        family = "triangle"
    sizes = [n for n in _FAMILIES.get(family, ()) if n <= size]
    if not sizes or (sizes[-1] in _LINEAR_SIZES and sizes[-1] != size):
        return (f"{family or name[:40].lower() or 'unknown'}{size}" if size else "polyhedron"), size
    return (family if sizes[-1] == _FAMILIES[family][0] else f"{family}{sizes[-1]}"), sizes[-1]
