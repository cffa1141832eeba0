"""From meshes to mesh files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.files import atomic_write
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
) -> None:
    """Writes a mesh with its field and data; the suffix chooses the format.

    The file appears whole or not at all, and speaks of world space. ``color`` and ``density`` are point data of a field
    per vertex and cell data of a field per cell, as are ``harmonics`` where it has them; the numbers of a
    `difftetvr.ScalarField` are data ``scalar``. A .npz holds arrays ``vertices``, ``tets``, ``color``, ``density``,
    ``location`` and all other data; a .node or .ele is written with the other of the pair. A .bintet holds float32
    only, and float64 values are rounded.

    Args:
        path: .vtu (zlib), .vtk, .msh, .xdmf, .npz, .bintet, .ovm, .node or .ele; .mesh for a mesh without a field.
        mesh: The mesh.
        field: Its colour and density, or its scalars with what they look like; None writes neither.
        point_data: More arrays of one row for each vertex, by name; .vtu, .vtk, .msh, .xdmf and .npz hold them.
        cell_data: More arrays of one row for each cell, by name.

    Raises:
        MeshError: The field or the data do not fit the mesh, the suffix names a format that cannot hold them, rounding
            to float32 would flatten or invert a cell, or the file cannot be written.
    """
    path = Path(path)
    location = None if field is None else field.location_on(mesh)
    arrays = {} if field is None else {name: _array(values) for name, values in field.arrays().items()}
    is_field = set(FIELD_ARRAYS) <= set(arrays)
    require_writable_format(path, with_field=is_field)
    kind = format_of(path)
    assert kind.write is not None
    if HARMONICS in arrays and not kind.holds_harmonics:
        raise MeshError(
            f"{path}: '{path.suffix}' holds no colours that depend on the direction (spherical harmonics); use "
            f"{' or '.join(DIRECTIONAL_SUFFIXES)}, or save a field without harmonics (export --without-harmonics)."
        )
    on_vertices, on_cells = _data(path, point_data, mesh.num_vertices), _data(path, cell_data, mesh.num_cells)
    own = on_cells if location == "cell" else on_vertices
    if not kind.holds_data and (on_vertices or on_cells or (arrays and not is_field)):
        suffixes = ", ".join(suffix for suffix, known in FORMATS.items() if known.holds_data)
        raise MeshError(f"{path}: '{path.suffix}' holds no data but colour and density; use one of {suffixes}.")
    if twice := set(own).intersection(arrays):
        raise MeshError(f"{path}: the data '{min(twice)}' have the name of what the field is saved as; rename them.")
    own.update(arrays)
    if kind.is_single:
        mesh = mesh.with_origin(WORLD).to(dtype=torch.float32)
    output = Output(_vertices(mesh), _array(mesh.tets), on_vertices, on_cells, location == "cell" and is_field, path)
    with atomic_write(path, MeshError) as temporary:
        kind.write(temporary, output)


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
        return _array(mesh.vertices)
    exact = _array(mesh.positions)
    single = exact.astype(np.float32)
    return single if (single == exact).all() else exact


def _data(path: Path, arrays: Mapping[str, Any] | None, rows: int) -> dict[str, np.ndarray]:
    """Data by name as arrays of so many rows."""
    found = {}
    for name, values in (arrays or {}).items():
        array = _array(values) if isinstance(values, torch.Tensor) else np.asarray(values)
        if array.ndim not in (1, 2) or len(array) != rows or array.dtype.kind not in "fiub":
            raise MeshError(
                f"{path}: the data '{name}' are {array.dtype} of shape {array.shape}; pass numbers of shape ({rows},) "
                f"or ({rows}, components)."
            )
        found[name] = array.astype(np.int64) if array.dtype.kind == "b" else array
    return found


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
