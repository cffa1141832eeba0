"""Mesh files: the native .vtu, and the formats that other programs of this field write.

A file holds the vertices, the tetrahedra and the field as point or cell data named ``color`` (3 components, linear RGB)
and ``density`` (>= 0, per unit length), so ParaView and pyvista show it as it is.

Whatever a file holds, reading it gives a valid mesh or a :class:`MeshError`: every number that a file announces is
compared with its size before anything is allocated.
"""

from difftetvr.mesh.io.loading import (
    FIELD_ARRAYS,
    HARMONICS,
    Flat,
    MeshData,
    load,
    load_data,
    load_mesh,
    load_with_optional_field,
)
from difftetvr.mesh.io.npz import is_mesh_archive
from difftetvr.mesh.io.saving import GEOMETRY_SUFFIXES, WRITABLE_SUFFIXES, require_writable_format, save

__all__ = [
    "FIELD_ARRAYS",
    "GEOMETRY_SUFFIXES",
    "HARMONICS",
    "WRITABLE_SUFFIXES",
    "Flat",
    "MeshData",
    "is_mesh_archive",
    "load",
    "load_data",
    "load_mesh",
    "load_with_optional_field",
    "require_writable_format",
    "save",
]
