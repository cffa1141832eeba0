"""``probe``: the values of a mesh at points."""

from __future__ import annotations

import math
from typing import Any

import torch

from difftetvr.errors import MeshError, shown
from difftetvr.inputs import as_number, as_reals, require_type
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.field import Location, location_of, require_location
from difftetvr.sampling.interpolation import Interpolate
from difftetvr.sampling.location import locate


@tried_twice
def probe(
    mesh: TetMesh,
    values: torch.Tensor,
    points: torch.Tensor,
    location: Location | None = None,
    outside: float = math.nan,
) -> torch.Tensor:
    """The values of a mesh at points: linear in each cell, or constant.

    Differentiable in values, points and ``mesh.vertices``. Values per cell have derivatives by themselves alone.

    Args:
        mesh: The mesh; loose cells and holes may be.
        values: (V, ...) per vertex or (T, ...) per cell.
        points: (..., 3) places in world space.
        location: "vertex" or "cell"; None lets the number of values decide, vertices first where both fit.
        outside: What points have that no cell holds.

    Returns:
        (...) with the shape of a value behind it, on the device and at the precision of the vertices.

    Raises:
        MeshError: The values do not fit the mesh, the points are no real vectors, or one of them is not finite.
        BackendError: No back end runs on the device of the vertices.
    """
    table, where = checked_values(mesh, values, location)
    like = mesh.vertices
    places = as_reals(points, "The points", MeshError, like.dtype, "pass (..., 3)")
    if places.shape[-1:] != (3,):
        raise MeshError(f"The points have shape {tuple(places.shape)}; pass (..., 3).")
    if not bool(torch.isfinite(places.detach()).all()):
        raise MeshError("A point is not finite; check where the points come from.")
    filler = as_number(outside, "outside", MeshError)
    local = local_points(mesh, places.reshape(-1, 3).to(like.device))
    cells = locate(mesh, like.detach(), local.detach())
    found = interpolated(mesh, table, where, local, cells)
    found = torch.where((cells >= 0)[:, None], found, filler)
    return found.reshape((*places.shape[:-1], *as_reals(values, "The values", MeshError).shape[1:]))


def checked_values(mesh: Any, values: Any, location: Location | None) -> tuple[torch.Tensor, Location]:
    """(N, C) values in the precision and on the device of the vertices, and where they live.

    Raises:
        MeshError: They do not fit the mesh.
    """
    require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", MeshError)
    if isinstance(values, Field):
        raise MeshError("values is a Field; pass one of its tensors, such as field.density.")
    table = as_reals(values, "The values", MeshError, mesh.vertices.dtype)
    if not table.ndim:
        raise MeshError(f"The values are {shown(values)}; pass one for each vertex or cell.")
    if table.device != mesh.vertices.device:
        raise MeshError(f"The values are on '{table.device}', the mesh on '{mesh.vertices.device}'; move one of them.")
    require_location(location, "location")
    where = location_of(table.shape[0], location, mesh, f"There are {table.shape[0]} values")
    return table.reshape(table.shape[0], -1).to(mesh.vertices.dtype), where


def local_points(mesh: TetMesh, points: torch.Tensor) -> torch.Tensor:
    """(P, 3) places relative to the mesh's origin, in its precision; differentiable."""
    if any(mesh.origin):
        points = points.double() - torch.tensor(mesh.origin, dtype=torch.float64, device=points.device)
    return points.to(mesh.vertices.dtype)


def interpolated(
    mesh: TetMesh, table: torch.Tensor, where: Location, points: torch.Tensor, cells: torch.Tensor
) -> torch.Tensor:
    """(P, C) values at points in known cells; 0 where the cell is -1."""
    if where == "cell":
        known = cells >= 0
        return torch.where(known[:, None], table[cells.clamp(min=0).long()], 0.0)
    result: torch.Tensor = Interpolate.apply(mesh, mesh.vertices, table, points, cells)
    return result
