"""From mesh files to meshes."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.inputs import require_type
from difftetvr.mesh.field import Field, Location
from difftetvr.mesh.io.building import NO_DEFECTS, Defects, Flat, Request, build_mesh, with_overlaps
from difftetvr.mesh.io.content import Content, require_array
from difftetvr.mesh.io.formats.table import read_content
from difftetvr.mesh.io.tetrahedra import tetrahedra_of
from difftetvr.mesh.tetmesh import TetMesh

FIELD_ARRAYS = ("color", "density")
HARMONICS = "harmonics"
"""Names of the point or cell data that are a mesh's field."""

_LARGEST_INTEGER = 2**63 - 1


@dataclass(frozen=True)
class MeshData:
    """A mesh file's content, as far as it belongs to the mesh.

    Attributes:
        mesh: The mesh of the tetrahedra, without vertices that none of them uses.
        field: Colour and density, where the file has both and they can be rendered; else None.
        point_data: Arrays of one row for each vertex of the mesh: floating-point ones in the precision of the file or
            of the mesh, whichever is higher, integers and truth values as int64, or as uint64 if one is too large.
        cell_data: Arrays of one row for each cell of the mesh; pieces of a cell have its row.
        warnings: Sentences about what was left out or changed.
        defects: What is wrong with the file's cells, as far as they were loaded all the same.
        repair: What repairing the mesh changed, in words; None where nothing was.
        group_names: Names of the physical groups of Gmsh that the cell data ``gmsh:physical`` count, by number.
    """

    mesh: TetMesh
    field: Field | None
    point_data: dict[str, torch.Tensor]
    cell_data: dict[str, torch.Tensor]
    warnings: tuple[str, ...] = ()
    defects: Defects = NO_DEFECTS
    repair: str | None = None
    group_names: dict[int, str] = dataclasses.field(default_factory=dict)

    @property
    def flat_cells(self) -> int:
        """Number of cells without volume that were left out."""
        return self.defects.flat


def load(
    path: str | Path, dtype: torch.dtype | None = None, *, split: bool = False, flat: Flat = "refuse"
) -> tuple[TetMesh, Field]:
    """Reads a tetrahedral mesh with its field; `load_mesh` reads the geometry of a file without one.

    Orientation is fixed by :class:`TetMesh`; vertices that no cell uses are dropped with their attributes; points,
    lines and polygons that lie beside the tetrahedra are left out. Colours and densities stored as integers are
    converted as they are, without scaling.

    Args:
        path: .vtu and the other XML files of VTK, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node or .ele, or
            another that the manual lists.
        dtype: Floating-point type of vertices, colours and densities. Files of this type round-trip to the bit. None:
            float32, or float64 where rounding to that would flatten or invert a cell, or lose the mesh's size.
        split: Split hexahedra, wedges, pyramids and polyhedra into tetrahedra, and straighten cells of higher order.
        flat: What becomes of cells of exactly zero volume: "drop" leaves them out, which changes no picture; "repair"
            mends the mesh so that it can be deformed, too (see `difftetvr.mesh.making.repair`); "refuse" makes them an
            error.

    Raises:
        MeshError: The file cannot be read, holds other volume cells than tetrahedra, an invalid mesh, or no point or
            cell data ``color`` (3 components) and ``density``.
    """
    data = load_data(path, dtype, split=split, flat=flat, require_field=True)
    assert data.field is not None
    return data.mesh, data.field


def load_with_optional_field(
    path: str | Path, dtype: torch.dtype | None = None, *, split: bool = False, flat: Flat = "refuse"
) -> tuple[TetMesh, Field | None]:
    """Like `load`, but gives None for the field of a file that holds no ``color`` and ``density``."""
    data, problem = _load(Request(_path(path), dtype, split, flat))
    if problem is not None:
        raise problem
    return data.mesh, data.field


def load_mesh(
    path: str | Path, dtype: torch.dtype | None = None, *, split: bool = False, flat: Flat = "refuse"
) -> TetMesh:
    """Reads the geometry alone, from any file that `load` reads and from formats without attributes (.mesh).

    Raises:
        MeshError: As `load`, except that no data arrays are needed.
    """
    return _load(Request(_path(path), dtype, split, flat))[0].mesh


def load_data(
    path: str | Path,
    dtype: torch.dtype | None = None,
    *,
    split: bool | None = False,
    flat: Flat = "refuse",
    step: int | None = None,
    loose: bool = False,
    require_field: bool = False,
) -> MeshData:
    """Reads a mesh with all data of its vertices and cells, such as the scalars of a simulation.

    Args:
        path: As for `load`.
        dtype: Floating-point type of the mesh, its field and its data.
        split: As for `load`; None: split and straighten, too, and say so in a warning.
        flat: As for `load`.
        step: Time step to read of a file that has several, from 0; negative ones count from the last; None: the last,
            with a warning.
        loose: Take cells that overlap their neighbours, or share a face with two others, as loose ones (see `TetMesh`),
            which some renderers draw, and leave out copies of cells and those without finite positions; each with a
            warning.
        require_field: Insist on ``color`` and ``density``, as `load` does. Else arrays of these names that cannot
            be rendered are data like any other, and a warning says so.

    Returns:
        The mesh, its data, and warnings.

    Raises:
        MeshError: As `load`.
    """
    request = Request(_path(path), dtype, split, flat, step, loose)
    data, problem = _load(request)
    if require_field:
        if problem is not None:
            raise problem
        if data.field is None:
            found = [f"point data {n}" for n in sorted(data.point_data)]
            found += [f"cell data {n}" for n in sorted(data.cell_data)]
            raise MeshError(
                f"{path} has no color and density as point or as cell data (found: {', '.join(found) or 'no data'}); "
                "add both arrays to it."
            )
    elif problem is not None:
        return replace(data, warnings=(*data.warnings, str(problem)))
    return data


def _path(path: str | Path) -> Path:
    require_type(path, (str, os.PathLike), "The mesh file", "pass its path", MeshError)
    return Path(path)


def _load(request: Request) -> tuple[MeshData, MeshError | None]:
    """The mesh with its data, and what keeps ``color`` and ``density`` from being its field where the file has both."""
    content = _read(request.path, request.step)
    tets = tetrahedra_of(request, content)
    built = with_overlaps(build_mesh(request, content.vertices, tets))
    mesh, kept = built.mesh, built.kept
    stored = {"vertex": content.point_data, "cell": content.cell_data}
    data = {
        place: {n: v for n, values in arrays.items() if (v := _tensor(values, kept[place], request.dtype)) is not None}
        for place, arrays in stored.items()
    }
    unused = sorted({*content.point_data, *content.cell_data}.difference(*data.values()))
    notes = (
        (*built.notes, f"Left out data that are no numbers, or too few: {', '.join(unused)}.")
        if unused
        else built.notes
    )
    about = notes, built.defects, built.repair, content.group_names
    found = MeshData(mesh, None, data["vertex"], data["cell"], *about)
    location = next((place for place, arrays in stored.items() if all(n in arrays for n in FIELD_ARRAYS)), None)
    if location is None:
        return found, None
    try:
        names = (*FIELD_ARRAYS, HARMONICS) if HARMONICS in stored[location] else FIELD_ARRAYS
        arrays = [_picked(request.path, stored[location], n, kept[location]) for n in names]
        field = _build_field(request, mesh, arrays, "vertex" if location == "vertex" else "cell")
        return replace(found, field=field), None
    except MeshError as error:
        return found, error


def _read(path: Path, step: int | None) -> Content:
    content = read_content(path, step)
    require_array(path, "vertices", content.vertices, 3)
    return replace(content, point_data=_columns(content.point_data), cell_data=_columns(content.cell_data))


def _columns(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of which those with one number a row, (N, 1), are (N,): some programs write all scalars so."""
    return {name: v[:, 0] if v.ndim == 2 and v.shape[1] == 1 else v for name, v in arrays.items()}


def _tensor(values: np.ndarray, rows: np.ndarray, dtype: torch.dtype | None) -> torch.Tensor | None:
    """Rows of a data array; None for one that has fewer, or that holds no numbers."""
    if values.dtype.kind not in "fiub" or values.ndim == 0 or values.size == 0 or len(values) <= rows.max():
        return None
    picked = values[rows]
    if picked.dtype.kind == "f":
        found = _floats(picked)
        return found.to(dtype) if dtype == torch.float64 else found
    is_too_large = picked.dtype.kind == "u" and (picked > _LARGEST_INTEGER).any()
    return torch.from_numpy(picked.astype(np.uint64 if is_too_large else np.int64))


def _picked(path: Path, arrays: dict[str, np.ndarray], name: str, rows: np.ndarray) -> np.ndarray:
    values = arrays[name]
    if values.ndim == 0 or len(values) <= rows.max():
        raise MeshError(f"{path}: the data array '{name}' is too short, of shape {values.shape}; write it again.")
    return values[rows]


def _build_field(request: Request, mesh: TetMesh, arrays: list[np.ndarray], location: Location) -> Field:
    count = mesh.num_vertices if location == "vertex" else mesh.num_cells
    color, density, *directional = arrays
    shapes = [("color", color, (count, 3)), ("density", density, (count,))]
    shapes += [(HARMONICS, values, (count, 3 * (values.size // max(1, 3 * count)))) for values in directional]
    for name, values, shape in shapes:
        if values.shape != shape or values.dtype.kind not in "fiu":
            raise MeshError(
                f"{request.path}: the data array '{name}' is {values.dtype} of shape {values.shape}; "
                f"it must be numbers of shape {shape}."
            )
    try:
        harmonics = _floats(directional[0]).reshape(count, -1, 3) if directional else None
        field = Field(_floats(color), _floats(density), location, harmonics).to(dtype=mesh.vertices.dtype)
        field.validate(mesh)
    except MeshError as error:
        raise MeshError(f"{request.path}: {error}") from error
    return field


def _floats(values: np.ndarray) -> torch.Tensor:
    """Stored numbers in the floating-point type that holds them; integers up to 2^53 pass through exactly."""
    native = np.float32 if values.dtype.kind == "f" and values.dtype.itemsize <= 4 else np.float64
    return torch.from_numpy(np.array(values, dtype=native))
