"""Tetrahedral meshes of the inside of a closed triangle surface, by fTetWild or by TetGen.

Both are packages of their own, looked for when they are asked for: ``pip install 'difftetvr[mesh]'`` installs them.
fTetWild (``pytetwild``, MPL-2.0) takes any surface, gaps and self-intersections included, and follows it within a
tolerance.
TetGen (``tetgen``; its core is AGPL-3.0, which binds whoever hands on or serves a program with it) needs a closed
surface that does not intersect itself, and keeps its vertices and faces.

Hu, Schneider, Wang, Zorin, Panozzo: Fast Tetrahedral Meshing in the Wild, 2020. Si: TetGen, a Delaunay-Based Quality
Tetrahedral Mesh Generator, 2015.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.errors import MeshError
from difftetvr.mesh.limits import MAX_CELLS
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.trust import require_regular

Mesher = Literal["ftetwild", "tetgen"]
Arrays = tuple[NDArray[np.float64], NDArray[np.int32]]

SURFACE_SUFFIXES = (".ply", ".stl", ".obj", ".off", ".msh", ".vtk", ".vtu")
"""Formats that surfaces are commonly kept in; the other formats of meshes are read, too."""

_PACKAGES = {"ftetwild": ("pytetwild", "fTetWild", "MPL-2.0"), "tetgen": ("tetgen", "TetGen", "AGPL-3.0")}
_REGULAR_VOLUME = 1.0 / (6.0 * math.sqrt(2.0))
_OTHER_MESHER = {"ftetwild": "", "tetgen": ", or use fTetWild"}
_WORKER = Path(__file__).with_name("mesher_worker.py")
_DEFAULT_EDGE = 1.0 / 20.0
_FIRST_EDGE = {"ftetwild": 0.9, "tetgen": 1.2}  # what brings the first try near to a number of cells
_NEAR_ENOUGH = 0.1
_ATTEMPTS = 4
_BOX_FACES = (
    *((0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4)),
    *((2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)),
)


@dataclass(frozen=True)
class MesherOptions:
    """How fine a mesh of a surface is to be.

    Attributes:
        cells: Number of cells wanted; the edge length is searched for that comes nearest. None: `edge_length` decides.
        edge_length: Edge length wanted inside, in units of the surface; None: 1/20 of the bounding box's diagonal.
        tolerance: How far fTetWild's boundary may be from the surface, in diagonals of its bounding box.

    Raises:
        MeshError: A number is out of range, or both cells and an edge length are given.
    """

    cells: int | None = None
    edge_length: float | None = None
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if self.cells is not None and not 1 <= self.cells <= MAX_CELLS:
            raise MeshError(f"The number of cells wanted is {self.cells}; ask for at least 1 and at most {MAX_CELLS}.")
        if self.edge_length is not None and not (self.edge_length > 0 and math.isfinite(self.edge_length)):
            raise MeshError(f"The edge length is {self.edge_length:g}; pass one greater than 0 and finite.")
        if self.cells is not None and self.edge_length is not None:
            raise MeshError("Both a number of cells and an edge length are given; give one of them.")
        if not 0 < self.tolerance < 1:
            raise MeshError(f"The tolerance is {self.tolerance:g}; pass one between 0 and 1.")


def tetrahedralize(
    vertices: Any,
    triangles: Any,
    mesher: Mesher = "ftetwild",
    options: MesherOptions | None = None,
    dtype: torch.dtype = torch.float32,
) -> TetMesh:
    """Fill the inside of a surface with tetrahedra.

    Inside is where the surface's winding number is not zero: cavities whose surface is turned inwards stay empty.
    Vertices at exactly the same position count as one. The result of fTetWild differs a little from call to call; that
    of TetGen does not.

    Args:
        vertices: (V, 3) positions, array-like.
        triangles: (F, 3) integer vertex indices, array-like, all wound alike: counter-clockwise seen from outside.
        mesher: "ftetwild" or "tetgen".
        options: How fine; default: `MesherOptions()`.
        dtype: Precision of the mesh.

    Returns:
        The mesh, without unused vertices.

    Raises:
        MeshError: The mesher is not installed or refuses the surface, the surface is open where it must not be, or the
            arrays are no surface.
    """
    if mesher not in _PACKAGES:
        raise MeshError(f"There is no mesher '{mesher}'; use ftetwild or tetgen.")
    options = options or MesherOptions()
    _require_installed(mesher)
    points, faces = as_surface(vertices, triangles)
    if mesher == "tetgen" and (edges := open_edges(faces)):
        raise MeshError(
            f"The surface is open along {edges} edges, but TetGen needs a closed one; close it, or use fTetWild."
        )
    # The meshers' tolerances are made for coordinates near 1: fTetWild never returns from a box of 1e-6.
    centre = points.min(0) / 2 + points.max(0) / 2
    scale = 2.0 ** math.frexp(float(np.ptp(points, axis=0).max()))[1]
    surface = (points - centre) / scale, faces
    target = _edge_length(surface, options, scale)
    inner, cells = _search(mesher, surface, target, options)
    used, numbers = np.unique(cells, return_inverse=True)
    positions = torch.from_numpy(inner[used] * scale + centre).to(dtype)
    try:
        return TetMesh(positions, numbers.reshape(-1, 4))
    except MeshError as error:
        raise MeshError(f"The mesh that {_PACKAGES[mesher][1]} made is not valid in {dtype}: {error}") from error


def tetrahedralize_box(
    lower: Sequence[float],
    upper: Sequence[float],
    mesher: Mesher = "ftetwild",
    options: MesherOptions | None = None,
    dtype: torch.dtype = torch.float32,
) -> TetMesh:
    """An unstructured mesh of a box: what the article begins a reconstruction with, beside regular grids.

    Args:
        lower: (3,) lowest corner.
        upper: (3,) highest corner.
        mesher: "ftetwild" or "tetgen".
        options: How fine, such as `MesherOptions(cells=20_000)`; default: `MesherOptions()`.
        dtype: Precision of the mesh.

    Returns:
        The mesh.

    Raises:
        MeshError: The box is empty or not finite, or as `tetrahedralize`.
    """
    corners = np.asarray([lower, upper], dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise MeshError(f"The box goes from {tuple(lower)} to {tuple(upper)}; pass three finite ends, lower < upper.")
    picks = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    return tetrahedralize(corners[picks, [0, 1, 2]], _BOX_FACES, mesher, options, dtype)


def as_surface(vertices: Any, triangles: Any) -> Arrays:
    """A surface of distinct positions from arrays.

    Args:
        vertices: (V, 3) positions, array-like.
        triangles: (F, 3) integer vertex indices, array-like.

    Returns:
        (V', 3) float64 used positions, no two alike, and (F', 3) int32 triangles, without those that use one twice.

    Raises:
        MeshError: Shapes or types are others, an index is out of range, a position is not finite, or all lie in one
            plane.
    """
    try:
        points, faces = np.asarray(vertices), np.asarray(triangles)
    except ValueError as error:
        raise MeshError("The surface cannot be read as arrays of numbers; pass (V, 3) and (F, 3) arrays.") from error
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise MeshError(f"The surface's vertices have shape {points.shape}; pass (V, 3) numbers.")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not len(faces):
        raise MeshError(f"The surface's triangles have shape {faces.shape}; pass (F, 3) integers, at least one.")
    if faces.min() < 0 or faces.max() >= len(points):
        raise MeshError(f"A triangle uses a vertex out of range; indices go from 0 to {len(points) - 1}.")
    corners = points[faces].astype(np.float64).reshape(-1, 3) + 0.0
    not_finite = np.flatnonzero(~np.isfinite(corners).all(1))
    if not_finite.size:
        raise MeshError(f"Triangle {not_finite[0] // 3} has a vertex that is not finite; give all a finite position.")
    points, faces = np.unique(corners, axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False) if len(points) > 3 else np.zeros(3)
    if not spread[-1] > 1e-12 * spread[0]:
        raise MeshError("The surface lies in one plane, so it has no inside; give one that encloses a volume.")
    return points, faces[proper]


def open_edges(triangles: NDArray[np.int32]) -> int:
    """Number of edges that an odd number of triangles has; 0 for a closed surface.

    Args:
        triangles: (F, 3) vertex indices.
    """
    ends = np.sort(np.concatenate((triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]])), axis=1)
    _, uses = np.unique(ends, axis=0, return_counts=True)
    return int((uses % 2).sum())


def load_surface(path: str | Path) -> Arrays:
    """Read the triangles of a file: .ply, .stl, .obj, .off, or the boundary triangles in a .msh, .vtk or .vtu.

    Quadrilaterals are cut along the diagonal from their first corner; points, lines and volume cells are left out.

    Args:
        path: The file.

    Returns:
        As `as_surface`.

    Raises:
        MeshError: The file cannot be read, has no triangles, has polygons of more corners, or is no surface.
    """
    path = Path(path)
    require_regular(path, MeshError)
    if not path.is_file():
        raise MeshError(f"There is no surface file {path}; check the path.")
    from difftetvr.mesh.io.formats.table import read_content  # late: readers need what is made here

    content = read_content(path)
    blocks = [_triangles(path, block.kind, np.asarray(block.nodes)) for block in content.cells]
    found = [block for block in blocks if len(block)]
    if not found:
        types = ", ".join(sorted({block.kind for block in content.cells})) or "no cells"
        raise MeshError(f"{path} has no triangles (found: {types}); give a surface.")
    points = np.asarray(content.vertices)
    if points.ndim == 2 and points.shape[1] == 2:
        raise MeshError(f"{path} has vertices in two dimensions; give a surface in three.")
    try:
        return as_surface(points, np.concatenate(found))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _triangles(path: Path, kind: str, cells: NDArray[Any]) -> NDArray[Any]:
    if kind == "triangle":
        return cells
    if kind == "quad":
        return np.concatenate((cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]))
    if kind.startswith("polygon"):
        raise MeshError(f"{path} has polygons of more than four corners; cut its faces into triangles first.")
    return np.empty((0, 3), dtype=np.int64)


def _require_installed(mesher: Mesher) -> None:
    package, name, licence = _PACKAGES[mesher]
    if find_spec(package) is None:
        raise MeshError(f"{name} ({licence}) is not installed; install it with pip install 'difftetvr[mesh]'.")


def _edge_length(surface: Arrays, options: MesherOptions, scale: float) -> float:
    """What to begin with, in diagonals of the bounding box."""
    points, faces = surface
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if options.edge_length is not None:
        return options.edge_length / scale / diagonal
    if options.cells is None:
        return _DEFAULT_EDGE
    volume = abs(float(np.linalg.det(points[faces]).sum())) / 6.0 or diagonal**3 / 10.0
    return float((volume / options.cells / _REGULAR_VOLUME) ** (1.0 / 3.0)) / diagonal


def _search(mesher: Mesher, surface: Arrays, edge: float, options: MesherOptions) -> Arrays:
    """The mesh of an edge length; where a number of cells is asked for, of the one that comes nearest to it."""
    wanted = options.cells
    if wanted is None:
        return _run(mesher, surface, edge, options)
    edge *= _FIRST_EDGE[mesher]
    best = found = _run(mesher, surface, edge, options)
    for _ in range(_ATTEMPTS - 1):
        if abs(len(best[1]) - wanted) <= _NEAR_ENOUGH * wanted:
            break
        edge *= (len(found[1]) / wanted) ** (1.0 / 3.0)
        found = _run(mesher, surface, edge, options)
        best = found if abs(len(found[1]) - wanted) < abs(len(best[1]) - wanted) else best
    return best


def _run(mesher: Mesher, surface: Arrays, edge: float, options: MesherOptions) -> Arrays:
    """Vertices (V, 3) and cells (T, 4) of one call of a mesher, in a process and a folder of its own."""
    package, name, _ = _PACKAGES[mesher]
    request: dict[str, Any] = {"mesher": mesher, "points": surface[0], "faces": surface[1], "edge": edge}
    request["tolerance"] = options.tolerance
    with tempfile.TemporaryDirectory() as folder:
        asked, answered = Path(folder) / "request.npz", Path(folder) / "answer.npz"
        np.savez(asked, **request)
        done = subprocess.run(
            [sys.executable, str(_WORKER), str(asked), str(answered)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(os.path.abspath(p) for p in sys.path)},
            stdin=subprocess.DEVNULL,
            capture_output=True,
        )
        if not answered.is_file():
            raise MeshError(f"{name} broke off (exit code {done.returncode}); repair the surface, or coarsen it.")
        with np.load(answered) as archive:
            answer = dict(archive)
    if "missing" in answer:
        lacks = answer["missing"]
        raise MeshError(f"{name} cannot be used, as its package {package} needs {lacks}; run pip install {lacks}.")
    if "refused" in answer:
        reason = str(answer["refused"]).rstrip(".")
        raise MeshError(f"{name} refuses the surface ({reason}); repair it{_OTHER_MESHER[mesher]}.")
    cells = answer["tets"]
    if "regions" in answer:
        cells = cells[_is_inside(answer["vertices"], cells, answer["regions"], surface)]
    if not len(cells):
        raise MeshError(f"{name} found no inside of the surface; close it, and wind its triangles alike.")
    return answer["vertices"], cells


def _is_inside(vertices: NDArray[Any], tets: NDArray[Any], regions: NDArray[Any], surface: Arrays) -> NDArray[np.bool_]:
    """(T,) whether the surface winds around a cell; TetGen fills cavities, too, as regions of their own."""
    corners = vertices[tets]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    inside = np.zeros(len(tets), dtype=bool)
    for region in np.unique(regions):
        members = np.flatnonzero(regions == region)
        centre = corners[members[volumes[members].argmax()]].mean(0)
        inside[members] = round(abs(_winding_number(centre, surface))) != 0
    return inside


def _winding_number(point: NDArray[np.float64], surface: Arrays) -> float:
    """How often a surface winds around a point: solid angles of its triangles (van Oosterom and Strackee 1983)."""
    points, faces = surface
    a, b, c = np.moveaxis(points[faces] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = (a * np.cross(b, c)).sum(1)
    divisor = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(triple, divisor).sum() / (2.0 * math.pi))
