"""From meshes to mesh files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.files import atomic_write
from difftetvr.mesh.field import Field
from difftetvr.mesh.io.content import Output
from difftetvr.mesh.io.formats.table import FORMATS, format_of
from difftetvr.mesh.io.loading import HARMONICS
from difftetvr.mesh.tetmesh import TetMesh

GEOMETRY_SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.write and not kind.holds_field)
"""Suffixes of formats that hold a mesh but no field."""

WRITABLE_SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.write and kind.holds_field)
"""Suffixes of formats that hold a mesh with its field."""

DIRECTIONAL_SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.holds_harmonics)
"""Suffixes of formats that hold spherical harmonics, too: ``harmonics``, 3 components for each function."""


def save(path: str | Path, mesh: TetMesh, field: Field | None = None) -> None:
    """Writes a mesh with its field; the suffix chooses the format.

    The file appears whole or not at all. ``color`` and ``density`` are point data of a field per vertex and cell data
    of a field per cell, as are ``harmonics`` where it has them. A .npz holds arrays ``vertices``, ``tets``, ``color``,
    ``density`` and ``location``; a .node or .ele is written with the other of the pair. A .bintet holds float32 only,
    and float64 values are rounded.

    Args:
        path: .vtu (zlib), .vtk, .msh, .xdmf, .npz, .bintet, .ovm, .node or .ele; .mesh for a mesh without a field.
        mesh: The mesh.
        field: Its colour and density; None writes the geometry alone.

    Raises:
        MeshError: The field does not fit the mesh, the suffix names a format that cannot hold tetrahedra with
            attributes, rounding to float32 would flatten or invert a cell, or the file cannot be written.
    """
    path = Path(path)
    require_writable_format(path, with_field=field is not None)
    kind = format_of(path)
    assert kind.write is not None
    if kind.is_single:
        mesh = mesh.to(dtype=torch.float32)
    is_per_cell = field is not None and field.location_on(mesh) == "cell"
    output = Output(_array(mesh.vertices), _array(mesh.tets), _arrays(path, field), is_per_cell, path)
    with atomic_write(path, MeshError) as temporary:
        kind.write(temporary, output)


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


def _arrays(path: Path, field: Field | None) -> dict[str, np.ndarray]:
    """The field's arrays by name."""
    if field is None:
        return {}
    arrays = {"color": _array(field.color), "density": _array(field.density)}
    if field.harmonics is not None:
        if path.suffix.lower() not in DIRECTIONAL_SUFFIXES:
            raise MeshError(
                f"{path}: '{path.suffix}' holds no colours that depend on the direction (spherical harmonics); use "
                f"{' or '.join(DIRECTIONAL_SUFFIXES)}, or save a field without harmonics (export --without-harmonics)."
            )
        arrays[HARMONICS] = _array(field.harmonics.flatten(1))
    return arrays


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
