"""From meshes to mesh files."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from difftetvr.errors import MeshError, MeshWarning, shown
from difftetvr.files import atomic_write
from difftetvr.inputs import require_type
from difftetvr.mesh.field import Location
from difftetvr.mesh.frame import WORLD
from difftetvr.mesh.io.content import Output
from difftetvr.mesh.io.formats.table import FORMATS, format_of
from difftetvr.mesh.io.loading import FIELD_ARRAYS, HARMONICS
from difftetvr.mesh.tetmesh import TetMesh

GEOMETRY_SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.write and not kind.holds_field)
"""Suffixes of formats that hold a mesh but no field."""

WRITABLE_SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.write and kind.holds_field)
"""Suffixes of formats that hold a mesh with its field."""

DIRECTIONAL_SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.holds_harmonics)
"""Suffixes of formats that hold spherical harmonics, too: ``harmonics``, 3 components for each function."""


_CONVERSION_FAILS = (TypeError, ValueError, RuntimeError)
"""What NumPy and torch raise for what makes no array."""

_SMALL_FLOATS = (torch.float16, torch.bfloat16)
_LARGEST_NUMBER = 8
"""Bytes."""


class Storable(Protocol):
    """What lives on a mesh and can be saved with it: a `Field`, a `difftetvr.ScalarField`."""

    def arrays(self) -> dict[str, torch.Tensor]:
        """Arrays of one row for each vertex or cell, by name."""

    def location_on(self, mesh: TetMesh) -> Location:
        """Where on the mesh they live."""


def save(
    path: str | Path,
    mesh: TetMesh,
    field: Storable | None = None,
    *,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
    group_names: Mapping[int, str] | None = None,
) -> None:
    """Writes a mesh with its field and data; the suffix chooses the format.

    The file appears whole or not at all, and speaks of world space. ``color`` and ``density`` are point data of a field
    per vertex and cell data of a field per cell, as are ``harmonics`` where it has them; the numbers of a
    `difftetvr.ScalarField` are data ``scalar``. A .npz holds arrays ``vertices``, ``tets``, ``color``, ``density``,
    ``location`` and all other data; a .node or .ele is written with the other of the pair. A .bintet holds float32
    only, and float64 values are rounded. Data of 16 bits are written as float32, truth values as integers, and matrices
    of 3 x 3 as nine components, row by row; .npz and .xdmf keep rows of any shape. A .msh is of Gmsh's format 2.2, and
    cell data ``gmsh:physical`` and ``gmsh:geometrical`` are the groups of its cells. Any other change that a format
    asks for is a warning.

    Args:
        path: .vtu (zlib), .vtk, .msh, .xdmf, .npz, .bintet, .ovm, .node or .ele; .mesh for a mesh without a field.
        mesh: The mesh.
        field: Its colour and density, or its scalars with what they look like; None writes neither.
        point_data: More arrays of one row for each vertex, by name, tensors or what NumPy makes arrays of; .vtu, .vtk,
            .msh, .xdmf and .npz hold them.
        cell_data: More arrays of one row for each cell, by name.
        group_names: Names of the groups in the cell data ``gmsh:physical``, by number, as a .msh holds them; see
            `MeshData`.

    Raises:
        MeshError: The field or the data do not fit the mesh, the suffix names a format that cannot hold them, rounding
            to float32 would flatten or invert a cell, or the file cannot be written.

    Warns:
        MeshWarning: Data were written in another shape or precision than they have, or names of groups left out.
    """
    path = Path(path)
    location = None if field is None else field.location_on(mesh)
    arrays = {} if field is None else {name: _numbers(values) for name, values in field.arrays().items()}
    is_field = set(FIELD_ARRAYS) <= set(arrays)
    if is_field and arrays["color"].shape[1:] != (3,):
        raise MeshError(
            f"{path}: the field has {arrays['color'].shape[1]} channels, where files hold three colours; pass its "
            "tensors as point_data or cell_data instead, by names of your own."
        )
    require_writable_format(path, with_field=is_field)
    kind = format_of(path)
    assert kind.write is not None
    if HARMONICS in arrays and not kind.holds_harmonics:
        raise MeshError(
            f"{path}: '{path.suffix}' holds no colours that depend on the direction (spherical harmonics); use "
            f"{' or '.join(DIRECTIONAL_SUFFIXES)}, or save a field without harmonics (export --without-harmonics)."
        )
    on_vertices = _data(path, "point_data", point_data, mesh.num_vertices)
    on_cells = _data(path, "cell_data", cell_data, mesh.num_cells)
    own = on_cells if location == "cell" else on_vertices
    if not kind.holds_data and (on_vertices or on_cells or (arrays and not is_field)):
        suffixes = ", ".join(suffix for suffix, known in FORMATS.items() if known.holds_data)
        raise MeshError(f"{path}: '{path.suffix}' holds no data but colour and density; use one of {suffixes}.")
    if twice := set(own).intersection(arrays):
        raise MeshError(f"{path}: the data '{min(twice)}' have the name of what the field is saved as; rename them.")
    own.update(arrays)
    if kind.is_single:
        mesh = mesh.with_origin(WORLD).to(dtype=torch.float32)
    names = _group_names(path, group_names)
    is_per_cell = location == "cell" and is_field
    output = Output(_vertices(mesh), _numbers(mesh.tets), on_vertices, on_cells, is_per_cell, path, names)
    with atomic_write(path, MeshError) as temporary:
        notes = kind.write(temporary, output) or ()
    if names and not kind.holds_groups:
        notes = (*notes, f"{path}: the names of groups were left out, as a '{path.suffix}' holds none.")
    for note in notes:
        warnings.warn(note, MeshWarning, stacklevel=2)


def holds_data(path: Path) -> bool:
    """Whether the suffix of a path names a format that is written with any data of vertices and cells."""
    return format_of(path).holds_data


def require_writable_format(path: Path, with_field: bool = True) -> None:
    """Checks that the suffix of a path names a format that `save` writes.

    Args:
        path: The file to write.
        with_field: Whether it shall hold colour and density, too.

    Raises:
        MeshError: It does not.
    """
    suffix = path.suffix.lower()
    if with_field and suffix in GEOMETRY_SUFFIXES:
        raise MeshError(
            f"{path}: '{path.suffix}' holds a mesh but neither colour nor density; leave them out or use one of "
            f"{', '.join(WRITABLE_SUFFIXES)}."
        )
    if suffix not in (*WRITABLE_SUFFIXES, *GEOMETRY_SUFFIXES):
        raise MeshError(
            f"{path}: '{path.suffix}' is no format that holds tetrahedra with colour and density; "
            f"use one of {', '.join(WRITABLE_SUFFIXES)}."
        )


def _vertices(mesh: TetMesh) -> np.ndarray:
    """Positions in world space: as they are, or in double precision where only that holds them."""
    if mesh.origin == WORLD:
        return _numbers(mesh.vertices)
    exact = _numbers(mesh.positions)
    single = exact.astype(np.float32)
    return single if (single == exact).all() else exact


def _data(path: Path, what: str, arrays: Mapping[str, Any] | None, rows: int) -> dict[str, np.ndarray]:
    """Data by name as arrays of so many rows."""
    if arrays is None:
        return {}
    require_type(arrays, Mapping, what, "pass a dict of arrays by their names", MeshError)
    for name in arrays:
        if not isinstance(name, str) or not name or not _is_text(name):
            raise MeshError(f"{path}: {what} have the name {shown(name)}; give all data names that are text.")
    return {name: _rows(path, name, values, rows) for name, values in arrays.items()}


def _rows(path: Path, name: str, values: Any, rows: int) -> np.ndarray:
    """Numbers for so many vertices or cells."""
    wanted = f"pass numbers of shape ({rows},) or ({rows}, components)"
    try:
        array = _numbers(values)
    except _CONVERSION_FAILS as reason:
        raise MeshError(f"{path}: the data {name[:80]!r} are {shown(values)}; {wanted}.") from reason
    if array.ndim == 0 or len(array) != rows or array.size == 0 or array.dtype.kind not in "fiu":
        raise MeshError(f"{path}: the data {name[:80]!r} are {array.dtype} of shape {array.shape}; {wanted}.")
    if np.ma.is_masked(values):
        raise MeshError(f"{path}: some of the data {name[:80]!r} are masked; fill them, as with NaN.")
    if array.dtype.itemsize > _LARGEST_NUMBER:
        raise MeshError(f"{path}: the data {name[:80]!r} are {array.dtype}, which no format holds; pass float64.")
    return array


def _numbers(values: Any) -> np.ndarray:
    """An array of a type that all formats know: truth values as integers, numbers of 16 bits as float32."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().resolve_conj().resolve_neg()
        values = (values.float() if values.dtype in _SMALL_FLOATS else values).numpy()
    array = np.asarray(values)
    array = array.astype(array.dtype.newbyteorder("="), order="C", copy=False)
    if array.dtype.kind == "b":
        return array.astype(np.int64)
    return array.astype(np.float32) if array.dtype == np.float16 else array


def _group_names(path: Path, names: Mapping[int, str] | None) -> dict[int, str]:
    require_type(names, (Mapping, type(None)), "group_names", "pass a dict of names by numbers", MeshError)
    found = dict(names or {})
    for tag, name in found.items():
        if not isinstance(tag, int) or not isinstance(name, str) or not _is_text(name):
            raise MeshError(
                f"{path}: group_names say {shown(name)} of {shown(tag)}; give names that are text by whole numbers."
            )
    return found


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
