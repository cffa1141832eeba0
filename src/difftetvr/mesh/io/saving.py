"""From meshes to mesh files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.files import atomic_write
from difftetvr.mesh.field import Field
from difftetvr.mesh.io.formats import bintet, npz, ovm, tetgen, through_meshio
from difftetvr.mesh.io.loading import HARMONICS
from difftetvr.mesh.tetmesh import TetMesh

GEOMETRY_SUFFIXES = (".mesh",)
"""Suffixes of formats that hold a mesh but no field."""

WRITABLE_SUFFIXES = (".vtu", ".vtk", ".msh", ".xdmf", ".npz", ".bintet", ".ovm", ".node", ".ele")
"""Suffixes of formats that hold a mesh with its field."""

DIRECTIONAL_SUFFIXES = (".vtu", ".npz")
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
    suffix = path.suffix.lower()
    if suffix == ".bintet":
        mesh = mesh.to(dtype=torch.float32)
    location = "vertex" if field is None else field.location_on(mesh)
    arrays = _arrays(path, field)
    vertices, tets = _array(mesh.vertices), _array(mesh.tets)
    with atomic_write(path, MeshError) as temporary:
        if suffix == ".npz":
            place = {} if field is None else {"location": np.array(location)}
            npz.write(temporary, {"vertices": vertices, "tets": tets, **arrays, **place})
        elif suffix in (".xdmf", *through_meshio.SUFFIXES):
            here, there = ("point_data", "cell_data") if location == "vertex" else ("cell_data", "point_data")
            data = {here: arrays, there: {}}
            if suffix == ".xdmf":
                _write_xdmf(temporary, vertices, tets, data)
            else:
                through_meshio.write(temporary, suffix, vertices, tets, data)
        else:
            rgba = None if field is None else np.column_stack((arrays["color"], arrays["density"]))
            _write_rgba(path, temporary, (vertices, tets), rgba, location == "cell")


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


def _write_xdmf(path: Path, *content: Any) -> None:
    from difftetvr.mesh.io.formats import xdmf  # late: it loads meshio and so every format that meshio knows

    xdmf.write(path, *content)


def _write_rgba(
    path: Path, temporary: Path, mesh: tuple[np.ndarray, np.ndarray], rgba: np.ndarray | None, per_cell: bool
) -> None:
    """Write a format that keeps colour and density in one array."""
    suffix = path.suffix.lower()
    if suffix in (".node", ".ele"):
        node, ele = tetgen.files(path)
        other = ele if suffix == ".node" else node
        with atomic_write(other, MeshError) as partner:
            pair = (temporary, partner) if suffix == ".node" else (partner, temporary)
            tetgen.write(*pair, mesh, rgba, per_cell)
    else:
        write = bintet.write if suffix == ".bintet" else ovm.write
        write(temporary, *mesh, rgba, per_cell)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
