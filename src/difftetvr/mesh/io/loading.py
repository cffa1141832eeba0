"""From mesh files to meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from difftetvr.errors import MeshError, counted
from difftetvr.mesh import validation
from difftetvr.mesh.field import Field, Location
from difftetvr.mesh.io.content import CellBlock, Content, require_array
from difftetvr.mesh.io.formats.table import format_of
from difftetvr.mesh.making.conversion import CONVERTIBLE, is_quadratic, num_nodes, to_tetrahedra
from difftetvr.mesh.making.repair import repair
from difftetvr.mesh.tetmesh import TetMesh

FIELD_ARRAYS = ("color", "density")
HARMONICS = "harmonics"
"""Names of the point or cell data that are a mesh's field."""

Flat = Literal["refuse", "drop", "repair"]
"""What becomes of cells of exactly zero volume."""

# What commonly lies beside the volume cells in a file and bounds them; it carries no volume.
_LOWER_DIMENSIONAL = ("vertex", "line", "triangle", "quad", "polygon", "pixel", "empty", "poly_")
_LARGEST_INTEGER = 2**63 - 1


@dataclass(frozen=True)
class MeshData:
    """A mesh file's content, as far as it belongs to the mesh.

    Attributes:
        mesh: The mesh of the tetrahedra, without vertices that none of them uses.
        field: Colour and density, where the file has both and they can be rendered; else None.
        point_data: Arrays of one row for each vertex of the mesh: floating-point ones in the mesh's precision, integers
            and truth values as int64.
        cell_data: Arrays of one row for each cell of the mesh; pieces of a cell have its row.
        warnings: Sentences about what was left out or changed.
        flat_cells: Number of cells without volume that were left out.
        repair: What repairing the mesh changed, in words; None where nothing was.
    """

    mesh: TetMesh
    field: Field | None
    point_data: dict[str, torch.Tensor]
    cell_data: dict[str, torch.Tensor]
    warnings: tuple[str, ...] = ()
    flat_cells: int = 0
    repair: str | None = None


@dataclass(frozen=True)
class _Request:
    """What is to be loaded, and how; see `load_data`."""

    path: Path
    dtype: torch.dtype
    split: bool
    flat: Flat
    step: int | None = None


@dataclass(frozen=True)
class _Tets:
    """Tetrahedra (T, 4) int64, the rows of the file's cell data they belong to (T,), and sentences about them."""

    nodes: np.ndarray
    rows: np.ndarray
    notes: tuple[str, ...]


def load(
    path: str | Path, dtype: torch.dtype = torch.float32, *, split: bool = False, flat: Flat = "refuse"
) -> tuple[TetMesh, Field]:
    """Reads a tetrahedral mesh with its field; `load_mesh` reads the geometry of a file without one.

    Orientation is fixed by :class:`TetMesh`; vertices that no cell uses are dropped with their attributes; points,
    lines and polygons that lie beside the tetrahedra are left out. Colours and densities stored as integers are
    converted as they are, without scaling.

    Args:
        path: .vtu, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node or .ele, or what else meshio reads.
        dtype: Floating-point type of vertices, colours and densities. Files of this type round-trip to the bit.
        split: Split hexahedra, wedges and pyramids into tetrahedra, and straighten quadratic cells.
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
    path: str | Path, dtype: torch.dtype = torch.float32, *, split: bool = False, flat: Flat = "refuse"
) -> tuple[TetMesh, Field | None]:
    """Like `load`, but gives None for the field of a file that holds no ``color`` and ``density``."""
    data, problem = _load(_Request(Path(path), dtype, split, flat))
    if problem is not None:
        raise problem
    return data.mesh, data.field


def load_mesh(
    path: str | Path, dtype: torch.dtype = torch.float32, *, split: bool = False, flat: Flat = "refuse"
) -> TetMesh:
    """Reads the geometry alone, from any file that `load` reads and from formats without attributes (.mesh).

    Raises:
        MeshError: As `load`, except that no data arrays are needed.
    """
    return _load(_Request(Path(path), dtype, split, flat))[0].mesh


def load_data(
    path: str | Path,
    dtype: torch.dtype = torch.float32,
    *,
    split: bool = False,
    flat: Flat = "refuse",
    step: int | None = None,
    require_field: bool = False,
) -> MeshData:
    """Reads a mesh with all data of its vertices and cells, such as the scalars of a simulation.

    Args:
        path: As for `load`.
        dtype: Floating-point type of the mesh, its field and its data.
        split: As for `load`.
        flat: As for `load`.
        step: Time step to read of a file that has several, from 0; negative ones count from the last; None: the last,
            with a warning.
        require_field: Insist on ``color`` and ``density``, as `load` does. Else arrays of these names that cannot
            be rendered are data like any other, and a warning says so.

    Returns:
        The mesh, its data, and warnings.

    Raises:
        MeshError: As `load`.
    """
    request = _Request(Path(path), dtype, split, flat, step)
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


def _load(request: _Request) -> tuple[MeshData, MeshError | None]:
    """The mesh with its data, and what keeps ``color`` and ``density`` from being its field where the file has both."""
    content = _read(request.path, request.step)
    tets = _tetrahedra(request, content)
    built = _build_mesh(request, _floats(content.vertices, request.dtype), tets)
    mesh, kept = built.mesh, built.kept
    stored = {"vertex": content.point_data, "cell": content.cell_data}
    data = {
        place: {n: v for n, values in arrays.items() if (v := _tensor(values, kept[place], request.dtype)) is not None}
        for place, arrays in stored.items()
    }
    found = MeshData(mesh, None, data["vertex"], data["cell"], built.notes, built.flat_cells, built.repair)
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


@dataclass(frozen=True)
class _Built:
    """A mesh, the rows of the file's data that its vertices and cells have, and what was done to it."""

    mesh: TetMesh
    kept: dict[str, np.ndarray]
    notes: tuple[str, ...]
    flat_cells: int = 0
    repair: str | None = None


def _build_mesh(request: _Request, points: torch.Tensor, tets: _Tets) -> _Built:
    if request.flat == "repair":
        try:
            repaired = repair(points, tets.nodes)
        except MeshError as error:
            raise MeshError(f"{request.path}: {error}") from error
        report = str(repaired.report) if repaired.report.changed else None
        kept = {"vertex": repaired.vertex_origins.numpy(), "cell": tets.rows[repaired.cell_origins.numpy()]}
        return _Built(repaired.mesh, kept, (*tets.notes, report) if report else tets.notes, 0, report)
    tets, flat_cells = _without_flat(request, points, tets)
    try:
        mesh, used = TetMesh(points, torch.from_numpy(tets.nodes)).without_unused_vertices()
    except MeshError as error:
        raise MeshError(f"{request.path}: {error}") from error
    return _Built(mesh, {"vertex": used.numpy(), "cell": tets.rows}, tets.notes, flat_cells)


def _read(path: Path, step: int | None) -> Content:
    if path.is_dir():
        raise MeshError(f"{path} is a folder; give the mesh file in it.")
    if not path.is_file():
        raise MeshError(f"There is no mesh file {path}; check the path.")
    try:
        content = format_of(path).content(path, step)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise MeshError(f"{path} cannot be read ({reason}); check the disk and the file's permissions.") from error
    require_array(path, "vertices", content.vertices, 3)
    return content


def _tetrahedra(request: _Request, content: Content) -> _Tets:
    volumes = [b for b in content.cells if len(b.nodes) and not b.kind.startswith(_LOWER_DIMENSIONAL)]
    if not volumes:
        found = ", ".join(sorted({block.kind for block in content.cells})) or "no cells"
        raise MeshError(f"{request.path} holds no tetrahedra (found: {found}); give a tetrahedral volume mesh.")
    nodes, rows, notes = [], [], list(content.notes)
    for block in volumes:
        _require_convertible(request, block, len(content.vertices))
        if is_quadratic(block.kind):
            notes.append(
                f"Straightened {counted(len(block.nodes), 'cell')} of type '{block.kind}'; what nodes other than "
                "corners hold was left out."
            )
        pieces, parents = to_tetrahedra(block.kind, block.nodes.astype(np.int64))
        nodes.append(pieces)
        rows.append(block.rows[parents])
    return _Tets(np.concatenate(nodes), np.concatenate(rows), tuple(notes))


def _require_convertible(request: _Request, block: CellBlock, num_vertices: int) -> None:
    path, cells = request.path, f"{counted(len(block.nodes), 'cell')} of type '{block.kind}'"
    if block.kind not in CONVERTIBLE:
        raise MeshError(f"{path} holds {cells}, which cannot be split into tetrahedra; tetrahedralise it first.")
    if block.kind != "tetra" and not request.split:
        raise MeshError(
            f"{path} holds {cells}; only linear tetrahedra can be rendered, so load with split=True (--split of "
            "render, info and export) to make tetrahedra of them."
        )
    require_array(path, f"cells of type '{block.kind}'", block.nodes, num_nodes(block.kind), "iu")
    outside = (block.nodes < 0) | (block.nodes >= num_vertices)
    if outside.any():
        row, column = np.argwhere(outside)[0]
        raise MeshError(
            f"{path}: Cell {block.rows[row]}: its vertex index {block.nodes[row, column]} is out of range; the mesh "
            f"has {num_vertices} vertices, so indices go from 0 to {num_vertices - 1}."
        )


def _without_flat(request: _Request, points: torch.Tensor, tets: _Tets) -> tuple[_Tets, int]:
    """The tetrahedra without those of exactly zero volume, and how many these were."""
    cells = torch.from_numpy(tets.nodes)
    corners = np.sort(tets.nodes, 1)
    flat = (corners[:, 1:] == corners[:, :-1]).any(1)
    proper = np.flatnonzero(~flat)
    try:
        validation.check_finite(points, cells)
        flat[proper] = (validation.orientations(points, cells[proper]) == 0).numpy()
    except MeshError as error:
        raise MeshError(f"{request.path}: {error}") from error
    count = int(flat.sum())
    if not count:
        return tets, 0
    if request.flat == "refuse":
        first = int(flat.argmax())
        names = ", ".join(str(v) for v in tets.nodes[first])
        what = "it repeats a vertex" if len(set(tets.nodes[first])) < 4 else "its vertices lie in one plane"
        raise MeshError(
            f"{request.path}: Cell {tets.rows[first]}: its volume is zero, as {what} ({names}), and so it is for "
            f"{count:,} of {len(flat):,} cells; load with flat='drop' to leave them out."
        )
    if count == len(flat):
        raise MeshError(f"{request.path}: of its {counted(count, 'cell')} none has any volume; give a volume mesh.")
    note = (
        f"{count:,} of {len(flat):,} cells {'has' if count == 1 else 'have'} no volume and "
        f"{'was' if count == 1 else 'were'} left out; {'it does' if count == 1 else 'they do'} not change the picture."
    )
    return _Tets(tets.nodes[~flat], tets.rows[~flat], (*tets.notes, note)), count


def _tensor(values: np.ndarray, rows: np.ndarray, dtype: torch.dtype) -> torch.Tensor | None:
    """Rows of a data array; None for one that has fewer, or that holds no numbers."""
    if values.dtype.kind not in "fiub" or values.ndim == 0 or values.size == 0 or len(values) <= rows.max():
        return None
    picked = values[rows]
    if picked.dtype.kind == "f" or (picked.dtype.itemsize == 8 and (picked > _LARGEST_INTEGER).any()):
        return _floats(picked, dtype)
    return torch.from_numpy(picked.astype(np.int64))


def _picked(path: Path, arrays: dict[str, np.ndarray], name: str, rows: np.ndarray) -> np.ndarray:
    values = arrays[name]
    if values.ndim == 0 or len(values) <= rows.max():
        raise MeshError(f"{path}: the data array '{name}' is too short, of shape {values.shape}; write it again.")
    return values[rows]


def _build_field(request: _Request, mesh: TetMesh, arrays: list[np.ndarray], location: Location) -> Field:
    count = mesh.num_vertices if location == "vertex" else mesh.num_cells
    color, density, *directional = arrays
    if density.ndim == 2 and density.shape[1] == 1:
        density = density[:, 0]
    shapes = [("color", color, (count, 3)), ("density", density, (count,))]
    shapes += [(HARMONICS, values, (count, 3 * (values.size // max(1, 3 * count)))) for values in directional]
    for name, values, shape in shapes:
        if values.shape != shape or values.dtype.kind not in "fiu":
            raise MeshError(
                f"{request.path}: the data array '{name}' is {values.dtype} of shape {values.shape}; "
                f"it must be numbers of shape {shape}."
            )
    try:
        harmonics = _floats(directional[0], request.dtype).reshape(count, -1, 3) if directional else None
        field = Field(_floats(color, request.dtype), _floats(density, request.dtype), location, harmonics)
        field.validate(mesh)
    except MeshError as error:
        raise MeshError(f"{request.path}: {error}") from error
    return field


def _floats(values: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
    """Stored numbers in a floating-point type; integers up to 2^53 pass through exactly."""
    native = np.float32 if values.dtype.kind == "f" and values.dtype.itemsize <= 4 else np.float64
    return torch.from_numpy(np.array(values, dtype=native)).to(dtype)
