"""From the tetrahedra of a file to a mesh: what is flat, broken or far away, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from difftetvr.errors import MeshError, counted
from difftetvr.mesh import validation
from difftetvr.mesh.making.overlaps import sampled_overlap
from difftetvr.mesh.making.repair import repair
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.faces import match_faces

Flat = Literal["refuse", "drop", "repair"]
"""What becomes of cells of exactly zero volume."""


_LEAST_SINGLE, _MOST_SINGLE = 1e-35, 1e35
"""Sizes of meshes that can be drawn in single precision."""


@dataclass(frozen=True)
class Request:
    """What is to be loaded, and how; see `difftetvr.load_data`."""

    path: Path
    dtype: torch.dtype | None
    split: bool | None
    flat: Flat
    step: int | None = None
    loose: bool = False


@dataclass(frozen=True)
class Tets:
    """Tetrahedra (T, 4) int64, the rows of the file's cell data they belong to (T,), and sentences about them."""

    nodes: np.ndarray
    rows: np.ndarray
    notes: tuple[str, ...]

    def without(self, left_out: np.ndarray, note: str) -> Tets:
        """Those that a mask (T,) bool does not name, with one sentence more."""
        return Tets(self.nodes[~left_out], self.rows[~left_out], (*self.notes, note))


@dataclass(frozen=True)
class Defects:
    """What is wrong with the cells of a file.

    Attributes:
        flat: Cells of no volume.
        not_finite: Cells that use a vertex whose position is not finite.
        repeated: Cells with the four vertices of an earlier one.
        crowded_faces: Faces that more than two cells share.
        folded_faces: Faces whose two cells lie on the same side.
        doubled_places: Share of places just inside the boundary that lie in two cells, of a sample.
    """

    flat: int = 0
    not_finite: int = 0
    repeated: int = 0
    crowded_faces: int = 0
    folded_faces: int = 0
    doubled_places: float = 0.0


NO_DEFECTS = Defects()
"""Of a sound file."""


@dataclass(frozen=True)
class Built:
    """A mesh, the rows of the file's data that its vertices and cells have, and what was done to it."""

    mesh: TetMesh
    kept: dict[str, np.ndarray]
    notes: tuple[str, ...]
    defects: Defects = NO_DEFECTS
    repair: str | None = None


def build_mesh(request: Request, vertices: np.ndarray, tets: Tets) -> Built:
    """Makes the mesh.

    Whether cells are flat, and how they lie, is decided in the precision of the file. Only then is anything rounded,
    after a mesh far from the origin has got an origin of its own.

    Args:
        request: What is to be loaded.
        vertices: (V, 3) numbers as stored.
        tets: Cells, with indices in range.

    Raises:
        MeshError: It is no valid mesh, or has flat cells where these are refused; names the file.
    """
    # Arrays that lie in a file's bytes cannot be written to, and PyTorch warns of them.
    points = torch.from_numpy(np.require(vertices, _precision_of(vertices), ["C", "W"]))
    try:
        built = _repaired(points, tets) if request.flat == "repair" else _valid(request, points, tets)
        return _rounded(request, built)
    except MeshError as error:
        raise MeshError(f"{request.path}: {error}") from error


def _precision_of(values: np.ndarray) -> type:
    return np.float32 if values.dtype.kind == "f" and values.dtype.itemsize <= 4 else np.float64


def _repaired(points: torch.Tensor, tets: Tets) -> Built:
    repaired = repair(points, tets.nodes)
    report = str(repaired.report) if repaired.report.changed else None
    kept = {"vertex": repaired.vertex_origins.numpy(), "cell": tets.rows[repaired.cell_origins.numpy()]}
    return Built(repaired.mesh, kept, (*tets.notes, report) if report else tets.notes, repair=report)


def _valid(request: Request, points: torch.Tensor, tets: Tets) -> Built:
    defects = Defects()
    if request.loose:
        points, tets, defects = _without_unusable(points, tets)
    tets, flat = _without_flat(request, points, tets)
    defects = replace(defects, flat=flat)
    cells = torch.from_numpy(tets.nodes)
    try:
        mesh = TetMesh(points, cells)
    except MeshError as error:
        if not request.loose:
            raise
        mesh = TetMesh(points, cells, conforming=False)
        defects, note = _broken(mesh, defects, error)
        tets = Tets(tets.nodes, tets.rows, (*tets.notes, note))
    mesh, used = mesh.without_unused_vertices()
    return Built(mesh, {"vertex": used.numpy(), "cell": tets.rows}, tets.notes, defects)


def _without_unusable(points: torch.Tensor, tets: Tets) -> tuple[torch.Tensor, Tets, Defects]:
    """Positions that are all finite, and the cells but those that use one that was not, or that repeat another."""
    finite = torch.isfinite(points).all(1).numpy()
    lost = ~finite[tets.nodes].all(1)
    if lost.any():
        note = f"{counted(int(lost.sum()), 'cell')} with vertices that are not finite were left out."
        tets = tets.without(lost, note)
    points = torch.where(torch.from_numpy(finite)[:, None], points, 0.0)
    corners = np.sort(tets.nodes, 1)
    order = np.lexsort(corners.T)
    again = np.zeros(len(corners), bool)
    again[order[1:]] = (corners[order[1:]] == corners[order[:-1]]).all(1)
    if again.any():
        note = f"{counted(int(again.sum()), 'cell')} with the vertices of an earlier one were left out."
        tets = tets.without(again, note)
    if not len(tets.nodes):
        raise MeshError("none of its cells can be used; give a mesh whose vertices are finite.")
    return points, tets, Defects(not_finite=int(lost.sum()), repeated=int(again.sum()))


def _without_flat(request: Request, points: torch.Tensor, tets: Tets) -> tuple[Tets, int]:
    """The tetrahedra without those of exactly zero volume, and how many these were."""
    cells = torch.from_numpy(tets.nodes)
    corners = np.sort(tets.nodes, 1)
    flat = (corners[:, 1:] == corners[:, :-1]).any(1)
    proper = np.flatnonzero(~flat)
    validation.check_finite(points, cells)
    flat[proper] = (validation.orientations(points, cells[proper]) == 0).numpy()
    count = int(flat.sum())
    if not count:
        return tets, 0
    if request.flat == "refuse":
        first = int(flat.argmax())
        names = ", ".join(str(v) for v in tets.nodes[first])
        what = "it repeats a vertex" if len(set(tets.nodes[first])) < 4 else "its vertices lie in one plane"
        raise MeshError(
            f"Cell {tets.rows[first]}: its volume is zero, as {what} ({names}), and so it is for {count:,} of "
            f"{len(flat):,} cells; load with flat='drop' to leave them out."
        )
    if count == len(flat):
        raise MeshError(f"of its {counted(count, 'cell')} none has any volume; give a volume mesh.")
    note = (
        f"{count:,} of {len(flat):,} cells {'has' if count == 1 else 'have'} no volume and "
        f"{'was' if count == 1 else 'were'} left out; {'it does' if count == 1 else 'they do'} not change the picture."
    )
    return tets.without(flat, note), count


def _broken(mesh: TetMesh, defects: Defects, error: MeshError) -> tuple[Defects, str]:
    """What keeps the cells from meeting face to face, counted and in words."""
    matching = match_faces(mesh.tets, mesh.num_vertices)
    # A face of n cells has n half-faces here, so counting smallest ones would need them sorted again.
    crowded = len(torch.unique(_sorted_corners(mesh.tets, matching.crowded), dim=0))
    defects = replace(defects, crowded_faces=crowded, folded_faces=len(matching.folded))
    found = [f"{counted(crowded, 'face')} belong to more than two cells"] if crowded else []
    if defects.folded_faces:
        found.append(f"at {counted(defects.folded_faces, 'face')} both cells lie on the same side")
    first = str(error).split("; ")[0]
    return defects, f"Cells overlap, so they are taken one by one: {' and '.join(found)}. First: {first}."


def _sorted_corners(tets: torch.Tensor, half_faces: torch.Tensor) -> torch.Tensor:
    cells, opposite = tets[half_faces >> 2], half_faces & 3
    others = torch.stack([(opposite + k) % 4 for k in (1, 2, 3)], 1)
    return cells.gather(1, others).sort(1).values


def _rounded(request: Request, built: Built) -> Built:
    """In the wanted precision, or in double precision where single does not do and the choice was left open."""
    mesh = built.mesh
    if request.dtype is None and not _LEAST_SINGLE < _size(mesh) < _MOST_SINGLE:
        note = "Kept in double precision, as single precision does not hold products of its size."
        return replace(built, mesh=mesh.to(dtype=torch.float64), notes=(*built.notes, note))
    if request.dtype == torch.float64:
        return replace(built, mesh=mesh.to(dtype=torch.float64))
    try:
        return replace(
            built, mesh=mesh.with_origin() if mesh.vertices.dtype == torch.float32 else mesh.to(dtype=torch.float32)
        )
    except MeshError as error:
        if request.dtype is not None or mesh.vertices.dtype == torch.float32:
            reason = str(error).split("; ")[0]
            raise MeshError(f"in single precision, {reason}; load with dtype=torch.float64.") from error
        note = "Kept in double precision, as single precision would flatten some of its cells."
        return replace(built, notes=(*built.notes, note))


def _size(mesh: TetMesh) -> float:
    lower, upper = mesh.bounds().double()
    return float((upper - lower).max())


def with_overlaps(built: Built) -> Built:
    """With what a sample of places says of cells that overlap though they are no neighbours."""
    if not built.mesh.is_conforming or (overlap := sampled_overlap(built.mesh)) is None:
        return built
    place = ", ".join(f"{x:.6g}" for x in overlap.place)
    note = (
        f"Cells overlap that are no neighbours, as at ({place}): of places just inside the boundary "
        f"{100 * overlap.share:.2g} % lie in two cells, and what is seen there depends on the renderer."
    )
    defects = replace(built.defects, doubled_places=overlap.share)
    return replace(built, notes=(*built.notes, note), defects=defects)
