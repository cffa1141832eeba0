"""Formats that meshio reads and writes for us."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, Content, Output, damaged

_WRITERS: dict[str, tuple[str, dict[str, Any]]] = {
    ".vtu": ("vtu", {"binary": True, "compression": "zlib"}),
    ".vtk": ("vtk", {"binary": True}),
    ".msh": ("gmsh", {"binary": True}),
    ".mesh": ("medit", {}),
}
"""Format name and options of meshio by suffix."""


def read(path: Path) -> Content:
    """Read a file in any format that meshio knows.

    Args:
        path: The file; its suffix names the format.

    Raises:
        MeshError: It cannot be read.
    """
    import meshio  # late: it loads every format it knows

    return _content(path, lambda: meshio.read(path))


def read_xdmf(path: Path) -> Content:
    """Read an .xdmf file of one grid; its arrays may lie in the file, in binary files beside it, or in HDF5 files.

    Args:
        path: The file. Arrays in HDF5 need the package h5py.

    Raises:
        MeshError: It cannot be read.
    """
    from difftetvr.mesh.io.formats.xdmf import GuardedReader

    return _content(path, lambda: GuardedReader(path).read())


def write(path: Path, output: Output) -> None:
    """Write a tetrahedral mesh with its data in the format that the suffix of ``output.path`` names.

    Args:
        path: The file to write.
        output: The mesh, and the field's arrays.
    """
    import meshio

    file_format, options = _WRITERS[output.path.suffix.lower()]
    cell_data = {name: [values] for name, values in output.cell_data.items()}
    content = meshio.Mesh(output.vertices, [("tetra", output.tets)], point_data=output.point_data, cell_data=cell_data)
    with _quiet():
        content.write(str(path), file_format=file_format, **options)


def _content(path: Path, read_mesh: Callable[[], Any]) -> Content:
    output = io.StringIO()
    try:
        with _quiet(output):
            mesh = read_mesh()
        content = _converted(mesh)
    except MeshError:
        raise
    except MemoryError as error:
        raise damaged(path, "it needs more memory than there is") from error
    # meshio's readers fail on broken files with whatever their parsers raise, and leave the process where none fits.
    except (Exception, SystemExit) as error:
        reason = _printed_reason(output.getvalue()) if isinstance(error, SystemExit) else _first_line(error)
        raise MeshError(
            f"{path} cannot be read as a mesh ({reason}); check that it is complete and that meshio knows its format "
            "and compression (zlib or none)."
        ) from error
    if "cannot handle" in output.getvalue() or "corrupt" in output.getvalue():
        raise damaged(path, _first_line(" ".join(output.getvalue().split())))
    return content


def _converted(mesh: Any) -> Content:
    blocks, begin = [], 0
    for block in mesh.cells:
        rows = np.arange(begin, begin + len(block.data))
        begin += len(rows)
        is_table = isinstance(block.data, np.ndarray) and block.data.ndim == 2
        blocks.append(CellBlock(block.type, block.data if is_table else np.empty((len(rows), 0), np.int64), rows))
    cell_data = {name: np.concatenate(values) for name, values in mesh.cell_data.items()}
    return Content(np.asarray(mesh.points), tuple(blocks), dict(mesh.point_data), cell_data)


def _first_line(message: object) -> str:
    lines = [line.strip() for line in str(message).splitlines() if line.strip()]
    return lines[0][:200].rstrip(".") if lines else type(message).__name__


def _printed_reason(output: str) -> str:
    """What meshio printed before it gave up, less its last words, which repeat the path."""
    lines = [line for line in output.splitlines() if line.strip() and not line.startswith("Error:")]
    return _first_line(lines[0]) if lines else "it breaks its format's rules"


@contextlib.contextmanager
def _quiet(output: io.StringIO | None = None) -> Iterator[None]:
    """Keeps meshio from printing: its messages are either in the error we raise or of no use to the user."""
    sink = io.StringIO() if output is None else output
    with contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # NumPy only warns of, and cuts off, what follows the last number that it understands.
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        yield
