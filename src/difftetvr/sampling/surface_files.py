"""Surfaces of triangles in files: PLY, glTF, VTK's polygons, OBJ and STL.

Sources: "The PLY Polygon File Format" (Turk 1994), "VTK XML File Formats", "Object Files (.obj)" (Wavefront) with the
colours behind places that MeshLab and Blender read, "StL Format" (3D Systems 1989).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from difftetvr.errors import MeshError, shown
from difftetvr.files import atomic_write
from difftetvr.inputs import as_reals
from difftetvr.mesh.io.formats.vtk.xml_writing import piece, write_section
from difftetvr.sampling.gltf import rounded_places, write_glb
from difftetvr.srgb import Encoding, linear_to_srgb, srgb_to_linear

_MOST_VERTICES = 2**31 - 1  # what PLY counts in an int


@dataclass(frozen=True, eq=False)
class Surface:
    """What files hold of a surface.

    Attributes:
        places: (P, 3) float32 or float64 vertices.
        triangles: (M, 3) int32 vertices, counter-clockwise seen from outside.
        normals: (P, 3) float32 unit vectors.
        colors: (P, 3) RGB, or None.
        encoding: What these are.
    """

    places: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    colors: torch.Tensor | None
    encoding: Encoding

    def colors_as(self, encoding: Encoding) -> np.ndarray | None:
        """(P, 3) float32 colours in [0, 1], in another encoding or in the same."""
        if self.colors is None:
            return None
        colors = self.colors.clamp(0.0, 1.0)
        if encoding != self.encoding:
            colors = linear_to_srgb(colors) if encoding == "srgb" else srgb_to_linear(colors)
        found: np.ndarray = colors.float().numpy()
        return found


def save_surface(
    path: str | Path,
    vertices: torch.Tensor,
    triangles: torch.Tensor,
    colors: torch.Tensor | None = None,
    encoding: Encoding = "linear",
) -> None:
    """Writes a surface, such as `isosurface` gives, with smooth normals; the suffix chooses the format.

    - ``.ply``: binary; places in the precision of the vertices; colours are sRGB-encoded, in 8 bits.
    - ``.glb``: binary glTF 2.0; colours are linear floats. Places are float32 and count from the surface's centre, to
      which a node moves them; another turns z, which is up in the world, to glTF's y.
    - ``.vtp``: VTK's polygons, packed; colours are data ``color``, as they are.
    - ``.obj``: text; colours are sRGB-encoded and follow the places, as MeshLab and Blender read them.
    - ``.stl``: binary; triangles one by one in float32, without colours.

    Vertices stay shared, so what is watertight stays so, but in .stl, which knows no vertices. The file appears whole
    or not at all.

    Args:
        path: The file.
        vertices: (P, 3) places in world space, float32 or float64.
        triangles: (M, 3) integer vertices, counter-clockwise seen from outside.
        colors: (P, 3) RGB; what lies outside of [0, 1] is clamped, but in .vtp. None: the surface has none.
        encoding: What the colours are: "linear", or "srgb" of models that were fitted to photographs.

    Raises:
        MeshError: The suffix is another, there is no triangle, an argument is not valid, float32 would round away the
            shape where a format has no other numbers, or the file cannot be written.
    """
    require_surface_format(path)
    surface = _checked(path, vertices, triangles, colors, encoding)
    with atomic_write(path, MeshError) as temporary, temporary.open("wb") as file:
        _FORMATS[Path(path).suffix.lower()](file, surface)


def require_surface_format(path: str | Path) -> None:
    """Checks that a path names a file of a surface.

    Raises:
        MeshError: It does not.
    """
    if Path(path).suffix.lower() not in _FORMATS:
        raise MeshError(f"'{path}' is no file of a surface; use one of {', '.join(_FORMATS)}.")


def _checked(
    path: str | Path,
    vertices: torch.Tensor,
    triangles: torch.Tensor,
    colors: torch.Tensor | None,
    encoding: Encoding,
) -> Surface:
    places = as_reals(vertices, "The vertices", MeshError).detach().cpu()
    if places.ndim != 2 or places.shape[1] != 3 or not bool(torch.isfinite(places).all()):
        raise MeshError(f"The vertices have shape {tuple(places.shape)}; pass (P, 3) finite places.")
    corners = torch.as_tensor(triangles).detach().cpu()
    if corners.is_floating_point() or corners.is_complex() or corners.ndim != 2 or corners.shape[1] != 3:
        raise MeshError(
            f"The triangles are {corners.dtype} of shape {tuple(corners.shape)}; pass (M, 3) whole numbers."
        )
    if not len(corners):
        raise MeshError(f"The surface for '{path}' has no triangles; choose a level that the scalar reaches.")
    if len(places) > _MOST_VERTICES or not 0 <= int(corners.min()) <= int(corners.max()) < len(places):
        raise MeshError(f"The triangles name vertices that are none of the {len(places)}; pass those of this surface.")
    if encoding not in ("linear", "srgb"):
        raise MeshError(f'encoding is {shown(encoding)}; pass "linear" or "srgb".')
    if colors is not None:
        colors = as_reals(colors, "The colors", MeshError).detach().cpu()
        if colors.shape != places.shape or not bool(torch.isfinite(colors).all()):
            raise MeshError(f"The colors have shape {tuple(colors.shape)}; pass three finite numbers for each vertex.")
    normals = _normals(places.double().numpy(), corners.numpy())
    return Surface(places.numpy(), corners.numpy().astype(np.int32), normals, colors, encoding)


def _normals(places: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(P, 3) float32 unit normals at vertices: those of their triangles, weighted by area.

    Where a vertex has none but triangles without area, nothing of it is seen, and any direction does.
    """
    size = np.ptp(places, axis=0).max()
    a, b, c = ((places[triangles[:, k]] - places[0]) / (size or 1.0) for k in range(3))
    of_triangles = np.cross(b - a, c - a)
    sums = np.stack(
        [sum(np.bincount(triangles[:, k], of_triangles[:, axis], len(places)) for k in range(3)) for axis in range(3)],
        axis=1,
    )
    # Squares of areas may be too small for numbers.
    sums /= np.maximum(np.abs(sums).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1.0), (0.0, 0.0, 1.0)).astype(np.float32)


def _write_ply(file: BinaryIO, surface: Surface) -> None:
    kind = "double" if surface.places.dtype == np.float64 else "float"
    colors = surface.colors_as("srgb")
    fields = [(axis, f"<f{surface.places.itemsize}") for axis in "xyz"] + [(f"n{axis}", "<f4") for axis in "xyz"]
    columns = [*surface.places.T, *surface.normals.T]
    if colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns += [*np.rint(255.0 * colors).T]
    rows = np.empty(len(surface.places), dtype=fields)
    for (name, _), column in zip(fields, columns, strict=True):
        rows[name] = column
    words = {f"<f{surface.places.itemsize}": kind, "<f4": "float", "u1": "uchar"}
    header = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"),
        *(f"property {words[code]} {name}" for name, code in fields),
        *(f"element face {len(surface.triangles)}", "property list uchar int vertex_indices", "end_header", ""),
    ]
    faces = np.empty(len(surface.triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, surface.triangles
    file.write("\n".join(header).encode("ascii"))
    file.write(rows.data)
    file.write(faces.data)


def _write_glb(file: BinaryIO, surface: Surface) -> None:
    write_glb(file, surface.places, surface.triangles, surface.normals, surface.colors_as("linear"))


def _write_vtp(file: BinaryIO, surface: Surface) -> None:
    data = {"Normals": surface.normals}
    if surface.colors is not None:
        data["color"] = surface.colors.numpy()
    count = len(surface.triangles)
    polygons = {
        "connectivity": surface.triangles.reshape(-1).astype(np.int64),
        "offsets": np.arange(3, 3 * count + 1, 3, dtype=np.int64),
    }
    with piece(file, "PolyData", f'NumberOfPoints="{len(surface.places)}" NumberOfPolys="{count}"'):
        write_section(file, "PointData", data, ' Normals="Normals"')
        write_section(file, "Points", {"Points": surface.places})
        write_section(file, "Polys", polygons)


def _write_obj(file: BinaryIO, surface: Surface) -> None:
    colors, digits = surface.colors_as("srgb"), "%.17g" if surface.places.dtype == np.float64 else "%.9g"
    rows = surface.places if colors is None else np.concatenate([surface.places, colors], axis=1)
    formats = [digits] * 3 + ["%.4f"] * (rows.shape[1] - 3)
    np.savetxt(file, rows, " ".join(["v", *formats]))
    np.savetxt(file, surface.normals, "vn %.6f %.6f %.6f")
    np.savetxt(file, np.repeat(surface.triangles + 1, 2, axis=1), "f %d//%d %d//%d %d//%d")


def _write_stl(file: BinaryIO, surface: Surface) -> None:
    places = rounded_places(surface.places, ".stl")
    corners = places[surface.triangles]
    flat = np.arange(3 * len(corners)).reshape(-1, 3)
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
    rows["normal"] = _normals(corners.reshape(-1, 3).astype(np.float64), flat)[::3]
    rows["corners"] = corners
    file.write(b"binary STL".ljust(80))
    file.write(np.uint32(len(rows)).astype("<u4").tobytes())
    file.write(rows.data)


_FORMATS: dict[str, Callable[[BinaryIO, Surface], None]] = {
    ".ply": _write_ply,
    ".glb": _write_glb,
    ".vtp": _write_vtp,
    ".obj": _write_obj,
    ".stl": _write_stl,
}
SURFACE_SUFFIXES = tuple(_FORMATS)
"""Suffixes of files of surfaces."""
