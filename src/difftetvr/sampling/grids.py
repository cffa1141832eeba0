"""Regular grids in space: around a mesh, or where the samples of a volume are."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.errors import MeshError, shown
from difftetvr.inputs import as_reals, as_whole, require_type
from difftetvr.mesh import TetMesh
from difftetvr.sampling.location import Lattice

MOST_VOXELS = 1 << 31
USUAL_SIZE = 256
"""Points along the longest side of a mesh."""

Vector = tuple[float, float, float]

_ROUNDING = 1e-3  # of a voxel, by which a side may be longer than so many
_LEAST_DETERMINANT = 1e-6  # of three unit vectors that are taken for axes
_NAME = re.compile(r'[^\x00-\x1f\x7f"\\]*')


@dataclass(frozen=True)
class Grid:
    """Points of a regular grid: (i, j, k) is ``origin`` and i, j and k steps of ``spacing`` along its ``directions``.

    Attributes:
        origin: (3,) the first point, in world space.
        spacing: (3,) distances of neighbouring points along the grid's axes, > 0.
        shape: (3,) how many points there are along the axes.
        directions: (3, 3) rows are unit vectors along which the axes run in the world; None: along x, y and z.
        space: What the world's axes are, as NRRD calls it, such as "left-posterior-superior"; empty if unknown.
        unit: Of length, such as "mm"; empty if unknown.

    Raises:
        MeshError: One of these is out of range, or the grid has more than 2^31 points.
    """

    origin: Vector
    spacing: Vector
    shape: tuple[int, int, int]
    directions: tuple[Vector, Vector, Vector] | None = None
    space: str = ""
    unit: str = ""

    def __post_init__(self) -> None:
        lattice = checked_lattice(self.origin, self.spacing, self.shape)
        for name in ("origin", "spacing", "shape"):
            object.__setattr__(self, name, getattr(lattice, name))
        if self.directions is not None:
            object.__setattr__(self, "directions", _axes(self.directions))
        for name in ("space", "unit"):
            if not isinstance(value := getattr(self, name), str) or not _NAME.fullmatch(value):
                raise MeshError(f"The grid's {name} is {shown(value)}; pass its name.")

    @staticmethod
    def around(
        mesh: TetMesh, spacing: float | Sequence[float] | None = None, size: int | Sequence[int] | None = None
    ) -> Grid:
        """A grid whose voxels fill the box around a mesh; their centres are its points.

        Args:
            mesh: The mesh.
            spacing: Distance of neighbouring points along x, y and z, or one for all; the box of the voxels has the
                mesh's in its middle, and is larger by less than a voxel.
            size: Number of points along the mesh's longest side, at equal distances along all; or along each of x, y
                and z, at the distances that follow. Neither: 256 along the longest side.

        Raises:
            MeshError: Both are given, one is out of range, or the grid would have more than 2^31 points.
        """
        require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", MeshError)
        if spacing is not None and size is not None:
            raise MeshError("A grid is given by its spacing or by its size; leave one of them out.")
        lower, upper = mesh.bounds().detach().double().cpu().unbind(0)
        extent = (upper - lower).tolist()
        if spacing is not None:
            steps = _three(spacing, "spacing", "one or three finite numbers greater than 0")
            counts = [_fitting(side, step) for side, step in zip(extent, steps)]
        else:
            counts, steps = _divided(extent, USUAL_SIZE if size is None else size)
        if math.prod(counts) > MOST_VOXELS:
            by = f"spacing of {_words(steps)}" if spacing is not None else f"size of {_words(counts)}"
            raise MeshError(
                f"A {by} makes a grid of {math.prod(counts):.3g} points, where at most {MOST_VOXELS:,} are possible; "
                "choose a coarser one."
            )
        middle = (0.5 * (lower + upper)).tolist()
        x, y, z = (m - 0.5 * (n - 1) * step for m, n, step in zip(middle, counts, steps))
        return Grid((x, y, z), (steps[0], steps[1], steps[2]), (counts[0], counts[1], counts[2]))

    @property
    def num_points(self) -> int:
        """How many points there are."""
        return math.prod(self.shape)

    def seen_by(self, mesh: TetMesh) -> tuple[TetMesh, Grid]:
        """A mesh and this grid in a space whose axes are the grid's, so that the grid has no directions any more.

        A mesh with exchanged or reversed axes is not rounded; its cells are those of this one, whatever their sense.
        """
        if self.directions is None:
            return mesh, self
        inverse = torch.linalg.inv(torch.tensor(self.directions, dtype=torch.float64))
        vertices = mesh.vertices.double() @ inverse.to(mesh.vertices.device)
        # Around the point that the vertices are counted from, which stays where it is.
        center = torch.tensor(mesh.origin, dtype=torch.float64)
        x, y, z = (center + (torch.tensor(self.origin, dtype=torch.float64) - center) @ inverse).tolist()
        turned = mesh.with_vertices(vertices.to(mesh.vertices.dtype))
        return turned, dataclasses.replace(self, origin=(x, y, z), directions=None)

    def corner_indices(self, mesh: TetMesh) -> tuple[list[float], list[float]]:
        """Least and greatest indices, along the grid's axes and not rounded, of what a mesh fills."""
        turned, grid = self.seen_by(mesh)
        lower, upper = turned.bounds().detach().double().cpu().tolist()
        first, last = (
            [(x - start) / step for x, start, step in zip(corner, grid.origin, grid.spacing)]
            for corner in (lower, upper)
        )
        return first, last


def checked_lattice(origin: Any, spacing: Any, shape: Any) -> Lattice:
    """A grid along the world's axes.

    Args:
        origin: (3,) its first point.
        spacing: Distances of its points along x, y and z; or one for all.
        shape: How many there are along each.

    Raises:
        MeshError: One of them is out of range.
    """
    first = _numbers(origin, "origin")
    if len(first) != 3 or not all(math.isfinite(x) for x in first):
        raise MeshError(f"origin is {shown(origin)}; pass three finite numbers.")
    step = _three(spacing, "spacing", "one or three finite numbers greater than 0")
    try:
        counts = [as_whole(n, "shape", MeshError, "pass three whole numbers") for n in shape]
    except TypeError as reason:
        raise MeshError(f"shape is {shown(shape)}; pass three whole numbers.") from reason
    if len(counts) != 3 or min(counts) < 1 or math.prod(counts) > MOST_VOXELS:
        raise MeshError(f"shape is {shown(shape)}; pass three numbers of voxels, at most {MOST_VOXELS:,} in all.")
    (x, y, z), (dx, dy, dz), (nx, ny, nz) = first, step, counts
    return Lattice((x, y, z), (dx, dy, dz), (nx, ny, nz))


def _divided(extent: Sequence[float], size: Any) -> tuple[list[int], list[float]]:
    """Numbers of voxels and their sides, by the number along the longest side or along each."""
    numbers = _three(size, "size", "one or three whole numbers greater than 0")
    if any(n != round(n) for n in numbers):
        raise MeshError(f"size is {shown(size)}; pass one or three whole numbers greater than 0.")
    if len(_numbers(size, "size")) == 3:
        return [int(n) for n in numbers], [side / n for side, n in zip(extent, numbers)]
    step = max(extent) / numbers[0]
    return [_fitting(side, step) for side in extent], [step] * 3


def _fitting(side: float, step: float) -> int:
    """How many steps it takes to span a side; more than a grid may have where there is no number for it."""
    ratio = side / step
    return max(1, math.ceil(ratio - _ROUNDING)) if ratio < 1e30 else 10**30


def _three(value: Any, name: str, wanted: str) -> list[float]:
    """Three finite numbers greater than 0, of which one may have been given for all."""
    found = _numbers(value, name)
    found = found * 3 if len(found) == 1 else found
    if len(found) != 3 or not all(math.isfinite(x) and x > 0 for x in found):
        raise MeshError(f"{name} is {shown(value)}; pass {wanted}.")
    return found


def _numbers(value: Any, name: str) -> list[float]:
    reals = as_reals(value, name, MeshError, torch.float64, "pass three numbers")
    found: list[float] = reals.detach().double().reshape(-1).tolist()
    return found


def _axes(directions: Any) -> tuple[Vector, Vector, Vector]:
    rows = as_reals(directions, "directions", MeshError, torch.float64, "pass three vectors").detach().double().cpu()
    is_valid = rows.shape == (3, 3) and bool(torch.isfinite(rows).all())
    if not is_valid or bool(((rows.norm(dim=1) - 1.0).abs() > 1e-3).any()):
        raise MeshError(f"directions is {shown(directions)}; pass three unit vectors.")
    if abs(float(torch.linalg.det(rows))) < _LEAST_DETERMINANT:
        raise MeshError("The grid's directions lie in one plane; pass those of three axes.")
    a, b, c = ((x, y, z) for x, y, z in rows.tolist())
    return a, b, c


def _words(numbers: Sequence[float]) -> str:
    return " x ".join(f"{n:g}" for n in numbers) if len(set(numbers)) > 1 else f"{numbers[0]:g}"
