"""Formats that meshio reads for us.

Its readers trust their files: some never end where one is cut off, others follow what HDF5 links to. They run in a
process of their own, and only those that are named here.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, Content, damaged
from difftetvr.mesh.io.hdf5 import PlainFile, load_h5py
from difftetvr.mesh.io.isolation import isolated

SURFACES = (".ply", ".stl", ".obj", ".off")
"""Suffixes of formats that hold surfaces only."""

_HDF5 = (".cgns", ".h5m", ".hmf", ".med")

VOLUMES = (
    *(".avs", ".bdf", ".dat", ".dato", ".dato.gz", ".f3grid", ".fem", ".mdpa", ".meshb", ".nas"),
    *(".post", ".post.gz", ".su2", ".tec", ".ugrid", ".vol", ".vol.gz", ".xml"),
    *_HDF5,
)
"""Suffixes of formats that may hold volumes."""


_MOST_EMPTY_LINES = 100


def is_known(path: Path) -> bool:
    """Whether a file's suffix is one of those that meshio reads for us."""
    return path.name.lower().endswith((*SURFACES, *VOLUMES))


def read(path: Path) -> Content:
    """Read a file in a format of `SURFACES` or `VOLUMES`, in a process of its own.

    Args:
        path: The file; its suffix names the format.

    Raises:
        MeshError: It cannot be read, or takes too much time or memory.
    """
    if path.suffix.lower() in _HDF5:
        load_h5py(path)
    return isolated(read_here, path)


def read_here(path: Path, _: int | None = None) -> Content:
    """As `read`, in this process, which may never end."""
    import meshio  # late: it loads every format it knows

    # Many of its readers wait for a line that never comes where a file is cut off.
    meshio._files.open = _open
    if path.suffix.lower() in _HDF5:
        with PlainFile(path) as file:
            file.require_plain()
    output = io.StringIO()
    try:
        with _quiet(output):
            content = _converted(meshio.read(path))
    except (MeshError, MemoryError):
        raise
    # meshio's readers fail on broken files with whatever their parsers raise, and leave the process where none fits.
    except (Exception, SystemExit) as error:
        raise damaged(path, _reason(error, output.getvalue())) from error
    if "cannot handle" in output.getvalue() or "corrupt" in output.getvalue():
        raise damaged(path, _first_line(" ".join(output.getvalue().split())))
    return content


class _Text(io.TextIOWrapper):
    """A text that does not give empty lines for ever after its end."""

    empty_lines = 0

    def readline(self, *arguments: Any) -> str:  # type: ignore[override]
        line = super().readline(*arguments)
        self.empty_lines += not line
        if self.empty_lines > _MOST_EMPTY_LINES:
            raise EOFError("it ends too early")
        return line


class _Binary(io.BufferedReader):
    """As `_Text`, for lines of bytes."""

    empty_lines = 0

    def readline(self, *arguments: Any) -> bytes:
        line = super().readline(*arguments)
        self.empty_lines += not line
        if self.empty_lines > _MOST_EMPTY_LINES:
            raise EOFError("it ends too early")
        return line


def _open(path: str, mode: str = "r") -> Any:
    """What meshio opens files with."""
    if "r" not in mode or "+" in mode:
        return open(path, mode)
    binary = _Binary(io.FileIO(path))
    return binary if "b" in mode else _Text(binary)


def _converted(mesh: Any) -> Content:
    blocks, begin = [], 0
    for block in mesh.cells:
        rows = np.arange(begin, begin + len(block.data))
        begin += len(rows)
        is_table = isinstance(block.data, np.ndarray) and block.data.ndim == 2
        blocks.append(CellBlock(block.type, block.data if is_table else np.empty((len(rows), 0), np.int64), rows))
    cell_data = {name: np.concatenate(values) for name, values in mesh.cell_data.items()}
    return Content(np.asarray(mesh.points), tuple(blocks), dict(mesh.point_data), cell_data, _unused(mesh))


def _unused(mesh: Any) -> tuple[str, ...]:
    """A sentence about what meshio has read and we have no place for."""
    sets = [*mesh.point_sets, *mesh.cell_sets]
    return (f"Sets of nodes and cells were left out: {', '.join(map(repr, sets[:8]))}.",) if sets else ()


def _reason(error: BaseException, printed: str) -> str:
    """What is wrong, of what meshio raised or printed; nothing of what only its authors understand."""
    if isinstance(error, SystemExit):
        return _printed_reason(printed)
    if isinstance(error, (AssertionError, AttributeError, LookupError, NameError, TypeError)):
        return "meshio's reader does not understand it"
    return _first_line(error)


def _first_line(message: object) -> str:
    lines = [line.strip() for line in str(message).splitlines() if line.strip()]
    return lines[0][:200].rstrip(".") if lines else type(message).__name__


def _printed_reason(output: str) -> str:
    """What meshio printed before it gave up, less its last words, which repeat the path."""
    lines = [line for line in output.splitlines() if line.strip() and not line.startswith("Error:")]
    return _first_line(lines[0]) if lines else "it breaks its format's rules"


@contextlib.contextmanager
def _quiet(output: io.StringIO) -> Iterator[None]:
    """Keeps meshio from printing: its messages are either in the error we raise or of no use to the user."""
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # NumPy only warns of, and cuts off, what follows the last number that it understands.
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        yield
