"""Mesh files: the native .vtu, and whatever else meshio can read.

A file holds the vertices, the tetrahedra and the field as point or cell data named ``color`` (3 components, linear RGB)
and ``density`` (>= 0, per unit length), so ParaView and pyvista show it as it is.
"""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.files import atomic_write
from difftetvr.mesh.field import Field, Location
from difftetvr.mesh.tetmesh import TetMesh

# Format name and options of meshio by suffix, for formats that can hold tetrahedra with their attributes.
_WRITERS: dict[str, tuple[str, dict[str, Any]]] = {
    ".vtu": ("vtu", {"binary": True, "compression": "zlib"}),
    ".vtk": ("vtk", {"binary": True}),
    ".msh": ("gmsh", {"binary": True}),
}
WRITABLE_SUFFIXES = (*_WRITERS, ".npz")
_FIELD_ARRAYS = ("color", "density")

# What commonly lies beside the tetrahedra in a file and bounds them; it carries no volume.
_LOWER_DIMENSIONAL = ("vertex", "line", "triangle", "quad", "polygon")


@dataclass(frozen=True)
class _Content:
    """Vertices (V, 3), tetrahedra (T, 4), point data and cell data of the tetrahedra, as stored in a file."""

    vertices: np.ndarray
    tets: np.ndarray
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, np.ndarray]


def load(path: str | Path, dtype: torch.dtype = torch.float32) -> tuple[TetMesh, Field]:
    """Reads a tetrahedral mesh with its field; :func:`load_mesh` reads the geometry of a file without one.

    Orientation is fixed by :class:`TetMesh`; vertices that no cell uses are dropped with their attributes; points,
    lines and polygons that lie beside the tetrahedra are left out. Colours and densities stored as integers are
    converted as they are, without scaling.

    Args:
        path: .vtu, .npz written by :func:`save`, or a format that meshio reads (.vtk, .msh, .xdmf, ...).
        dtype: Floating-point type of vertices, colours and densities. Files of this type round-trip to the bit.

    Raises:
        MeshError: The file cannot be read, holds other volume cells than tetrahedra, an invalid mesh, or no point or
            cell data ``color`` (3 components) and ``density``.
    """
    path = Path(path)
    mesh, field, found = _load(path, dtype)
    if field is None:
        raise MeshError(
            f"{path} has no color and density as point or as cell data (found: {found}); add both arrays to it."
        )
    return mesh, field


def load_with_optional_field(path: str | Path, dtype: torch.dtype = torch.float32) -> tuple[TetMesh, Field | None]:
    """Like :func:`load`, but gives None for the field of a file that holds no ``color`` and ``density``."""
    mesh, field, _ = _load(Path(path), dtype)
    return mesh, field


def load_mesh(path: str | Path, dtype: torch.dtype = torch.float32) -> TetMesh:
    """Reads the geometry alone, from any file that :func:`load` reads and from formats without attributes (.mesh).

    Raises:
        MeshError: As :func:`load`, except that no data arrays are needed.
    """
    path = Path(path)
    content = _read(path)
    return _build_mesh(path, content, dtype)[0]


def save(path: str | Path, mesh: TetMesh, field: Field) -> None:
    """Writes a mesh with its field; the suffix chooses the format: .vtu (zlib), .vtk, .msh or .npz.

    The file appears whole or not at all. ``color`` and ``density`` are point data of a field per vertex and cell data
    of a field per cell. A .npz holds arrays ``vertices``, ``tets``, ``color``, ``density`` and ``location``.

    Raises:
        MeshError: The field does not fit the mesh, the suffix names a format that cannot hold tetrahedra with
            attributes, or the file cannot be written.
    """
    path = Path(path)
    require_writable_format(path)
    suffix = path.suffix.lower()
    location = field.location_on(mesh)
    arrays = {"color": _array(field.color), "density": _array(field.density)}
    with atomic_write(path, MeshError) as temporary:
        if suffix == ".npz":
            content: dict[str, Any] = {"location": np.array(location), **arrays}
            with open(temporary, "wb") as file:
                np.savez_compressed(file, vertices=_array(mesh.vertices), tets=_array(mesh.tets), **content)
        else:
            _write_with_meshio(temporary, mesh, arrays, location, suffix)


def require_writable_format(path: Path) -> None:
    """Checks that the suffix of a path names a format that :func:`save` writes.

    Raises:
        MeshError: It does not.
    """
    if path.suffix.lower() not in WRITABLE_SUFFIXES:
        raise MeshError(
            f"{path}: '{path.suffix}' is no format that holds tetrahedra with colour and density; "
            f"use one of {', '.join(WRITABLE_SUFFIXES)}."
        )


def is_mesh_archive(path: Path) -> bool:
    """Whether a .npz file holds a mesh, as opposed to anything else that is kept in such files."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return "tets" in archive
    except (ValueError, OSError, EOFError, TypeError, zipfile.BadZipFile):
        return False


def _write_with_meshio(
    path: Path, mesh: TetMesh, arrays: dict[str, np.ndarray], location: Location, suffix: str
) -> None:
    import meshio  # late: it loads every format it knows

    file_format, options = _WRITERS[suffix]
    content = meshio.Mesh(
        _array(mesh.vertices),
        [("tetra", _array(mesh.tets))],
        point_data=arrays if location == "vertex" else None,
        cell_data={name: [values] for name, values in arrays.items()} if location == "cell" else None,
    )
    with _quiet():
        content.write(str(path), file_format=file_format, **options)


def _load(path: Path, dtype: torch.dtype) -> tuple[TetMesh, Field | None, str]:
    """Mesh, field if there is one, and the names of the data found."""
    content = _read(path)
    mesh, used = _build_mesh(path, content, dtype)
    found = [f"point data {n}" for n in sorted(content.point_data)]
    found += [f"cell data {n}" for n in sorted(content.cell_data)]
    names = ", ".join(found) or "no data"
    if all(n in content.point_data for n in _FIELD_ARRAYS):
        arrays = [content.point_data[n][used] for n in _FIELD_ARRAYS]
        return mesh, _build_field(path, mesh, arrays, "vertex", dtype), names
    if all(n in content.cell_data for n in _FIELD_ARRAYS):
        return mesh, _build_field(path, mesh, [content.cell_data[n] for n in _FIELD_ARRAYS], "cell", dtype), names
    return mesh, None, names


def _read(path: Path) -> _Content:
    if path.is_dir():
        raise MeshError(f"{path} is a folder; give the mesh file in it.")
    if not path.is_file():
        raise MeshError(f"There is no mesh file {path}; check the path.")
    reader = _read_npz if path.suffix.lower() == ".npz" else _read_with_meshio
    return reader(path)


def _read_npz(path: Path) -> _Content:
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in _FIELD_ARRAYS if name in archive}
            per_cell = str(archive["location"]) == "cell" if "location" in archive else False
            vertices, tets = archive["vertices"], archive["tets"]
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise MeshError(f"{path} is no intact numpy archive of plain arrays; write it again with save.") from error
    except KeyError as error:
        raise MeshError(f"{path} lacks the array 'vertices' or 'tets'; write it again with save.") from error
    _require_shapes(path, vertices, tets)
    return _Content(vertices, tets, {} if per_cell else arrays, arrays if per_cell else {})


def _read_with_meshio(path: Path) -> _Content:
    import meshio

    output = io.StringIO()
    try:
        with _quiet(output):
            content = meshio.read(path)
    except MemoryError:
        raise
    # meshio's readers fail on broken files with whatever their parsers raise, and leave the process where none fits.
    except (Exception, SystemExit) as error:
        reason = _printed_reason(output.getvalue()) if isinstance(error, SystemExit) else _first_line(error)
        raise MeshError(
            f"{path} cannot be read as a mesh ({reason}); check that it is complete and that meshio knows its format "
            "and compression (zlib or none)."
        ) from error
    blocks = _tetrahedral_blocks(path, content.cells)
    vertices = np.asarray(content.points)
    tets = np.concatenate([content.cells[i].data for i in blocks])
    _require_shapes(path, vertices, tets)
    cell_data = {name: np.concatenate([values[i] for i in blocks]) for name, values in content.cell_data.items()}
    return _Content(vertices, tets, dict(content.point_data), cell_data)


def _tetrahedral_blocks(path: Path, cells: list[Any]) -> list[int]:
    for block in cells:
        if block.type != "tetra" and not block.type.startswith(_LOWER_DIMENSIONAL) and len(block.data):
            raise MeshError(
                f"{path} holds {len(block.data)} cells of type '{block.type}'; only linear tetrahedra can be rendered, "
                "so tetrahedralise it first."
            )
    blocks = [i for i, block in enumerate(cells) if block.type == "tetra" and len(block.data)]
    if not blocks:
        found = ", ".join(sorted({block.type for block in cells})) or "no cells"
        raise MeshError(f"{path} holds no tetrahedra (found: {found}); give a tetrahedral volume mesh.")
    return blocks


def _require_shapes(path: Path, vertices: np.ndarray, tets: np.ndarray) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise MeshError(f"{path} has vertices of shape {vertices.shape}; they must be (V, 3) numbers.")
    if tets.ndim != 2 or tets.shape[1] != 4 or tets.dtype.kind not in "iu":
        raise MeshError(f"{path} has tetrahedra of shape {tets.shape}; they must be (T, 4) integers.")


def _build_mesh(path: Path, content: _Content, dtype: torch.dtype) -> tuple[TetMesh, np.ndarray]:
    """The mesh of the used vertices, and their indices in the file."""
    vertices, tets = content.vertices, content.tets
    try:
        points = torch.from_numpy(np.array(vertices, dtype=_native(vertices))).to(dtype)
        mesh, used = TetMesh(
            points, torch.from_numpy(np.array(tets, dtype=_native_integers(tets)))
        ).without_unused_vertices()
        return mesh, used.numpy()
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _build_field(path: Path, mesh: TetMesh, arrays: list[np.ndarray], location: Location, dtype: torch.dtype) -> Field:
    count = mesh.num_vertices if location == "vertex" else mesh.num_cells
    color, density = arrays
    if density.ndim == 2 and density.shape[1] == 1:
        density = density[:, 0]
    for name, values, shape in (("color", color, (count, 3)), ("density", density, (count,))):
        if values.shape != shape or values.dtype.kind not in "fiu":
            raise MeshError(
                f"{path}: the data array '{name}' is {values.dtype} of shape {values.shape}; "
                f"it must be numbers of shape {shape}."
            )
    tensors = [torch.from_numpy(np.array(values, dtype=_native(values))).to(dtype) for values in (color, density)]
    field = Field(tensors[0], tensors[1], location=location)
    try:
        field.validate(mesh)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    return field


def _native(values: np.ndarray) -> np.dtype:
    """The floating-point type in native byte order that holds the stored values, integers up to 2^53 exactly."""
    return np.dtype(np.float32 if values.dtype.kind == "f" and values.dtype.itemsize <= 4 else np.float64)


def _native_integers(values: np.ndarray) -> np.dtype:
    return np.dtype(np.int32 if values.dtype.itemsize <= 4 and values.dtype.kind == "i" else np.int64)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()


def _first_line(message: object) -> str:
    lines = [line.strip() for line in str(message).splitlines() if line.strip()]
    return lines[0].rstrip(".") if lines else type(message).__name__


def _printed_reason(output: str) -> str:
    """What meshio printed before it gave up, less its last words, which repeat the path."""
    lines = [line for line in output.splitlines() if line.strip() and not line.startswith("Error:")]
    return _first_line(lines[0]) if lines else "it breaks its format's rules"


@contextlib.contextmanager
def _quiet(output: io.StringIO | None = None) -> Iterator[None]:
    """Keeps meshio from printing: its messages are either in the error we raise or of no use to the user."""
    sink = io.StringIO() if output is None else output
    with contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        yield
