"""``voxelise_to_file``: from a mesh into a file of a grid, some layers at a time: it need not fit into memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.inputs import as_number, as_whole, require_type
from difftetvr.mesh import TetMesh
from difftetvr.mesh.field import Location
from difftetvr.sampling.grid_files import ArrayOfGrid, Slab, dtype_of, in_file_order, layers, named, write_grid
from difftetvr.sampling.grids import Grid
from difftetvr.sampling.probing import checked_values
from difftetvr.sampling.voxels import AT_ONCE, require_samples, voxelise
from difftetvr.trust import require_free

# Of each sample point at a time: the cell that holds it, its place in double precision and twice while the axes are put
# together; and for each number its value, once more for the filler, and in the order of the file.
_BYTES_OF_PLACE, _COPIES_OF_VALUE = 80, 3


@dataclass(frozen=True, eq=False)
class MeshValues:
    """Values of a mesh to be sampled.

    Attributes:
        mesh: The mesh.
        values: (V, ...) per vertex or (T, ...) per cell.
        location: Where they live; None lets their number decide, vertices first where both fit.
    """

    mesh: TetMesh
    values: torch.Tensor
    location: Location | None = None


@dataclass(frozen=True)
class Sampling:
    """How a grid takes its values; see `voxelise`.

    Attributes:
        samples: 1 for the values at its points, n > 1 for the mean of n^3 points of each voxel.
        outside: What points have that no cell holds; they count in means.

    Raises:
        MeshError: The number of samples is not in [1, 16].
    """

    samples: int = 1
    outside: float = 0.0

    def __post_init__(self) -> None:
        require_samples(self.samples)

    def remark(self) -> str:
        """What the header of a file says of it."""
        mean = f"Means of {self.samples}^3 points a voxel.\n" if self.samples > 1 else ""
        return f"{mean}Points outside of the mesh have the value {self.outside!r}."


def voxelise_to_file(
    path: str | Path,
    mesh: TetMesh,
    values: torch.Tensor | Mapping[str, torch.Tensor],
    grid: Grid,
    location: Location | None = None,
    samples: int = 1,
    outside: float = 0.0,
) -> None:
    """Writes what `voxelise` finds on a grid, without holding more than a few of its layers at a time.

    Args:
        path: The file, .nrrd, .vti, .nii or .npy, as `save_grid` writes it.
        mesh: The mesh; loose cells and holes may be.
        values: (V, ...) per vertex or (T, ...) per cell; in a .vti, several of them by name. One alone is called
            "values".
        grid: Where to sample; along directions of its own, too.
        location: "vertex" or "cell"; None lets the number of values decide, vertices first where both fit.
        samples: As of `voxelise`.
        outside: As of `voxelise`; the header of .nrrd and .vti tells it.

    Raises:
        MeshError: The values do not fit the mesh, an argument is out of range, there is too little memory for a layer,
            or the file cannot be written.
        BackendError: No back end runs on the device of the vertices.
    """
    arrays = {name: MeshValues(mesh, table, location) for name, table in named(values).items()}
    sampling = Sampling(as_whole(samples, "samples", MeshError), as_number(outside, "outside", MeshError))
    write_sampled(path, arrays, grid, sampling)


def write_sampled(
    path: str | Path,
    arrays: Mapping[str, MeshValues],
    grid: Grid,
    sampling: Sampling,
    written_as: Grid | None = None,
    x_first: bool = False,
) -> None:
    """Writes what a grid has of values, each on a mesh of its own; see `voxelise_to_file`.

    Args:
        path: The file.
        arrays: The values by name.
        grid: Where to sample.
        sampling: How.
        written_as: The grid that the file tells, of the same shape, where the meshes are not in its world; None: the
            one that is sampled.
        x_first: Whether the axes of a ``.npy`` are x, y, z, instead of z, y, x.

    Raises:
        MeshError: As `voxelise_to_file`.
        BackendError: No back end runs on the device of the vertices.
    """
    require_type(grid, Grid, "grid", "pass a difftetvr.sampling.Grid", MeshError)
    groups = _groups(arrays, grid)
    kinds = {name: kind for group in groups for name, kind in group.columns.items()}
    cost = sampling.samples**3
    _require_memory(grid, cost, groups)

    def slabs() -> Iterator[Slab]:
        for first, count in layers(grid, cost):
            found = {name: values for group in groups for name, values in group.layers(first, count, sampling).items()}
            yield [found[name] for name in arrays]

    write_grid(path, [kinds[name] for name in arrays], written_as or grid, slabs(), sampling.remark(), x_first)


@dataclass(frozen=True, eq=False)
class _Group:
    """Arrays that live at the same places of one mesh, side by side.

    Attributes:
        mesh: The mesh, seen along the axes of the grid.
        grid: The grid, without directions.
        table: (N, C) their numbers.
        location: Where they live.
        columns: What each of them is in a file, by name, in the order of its columns.
    """

    mesh: TetMesh
    grid: Grid
    table: torch.Tensor
    location: Location
    columns: dict[str, ArrayOfGrid]

    def layers(self, first: int, count: int, sampling: Sampling) -> dict[str, np.ndarray]:
        """The arrays in some layers along z."""
        (x, y, z), (_, _, dz), (nx, ny, _) = self.grid.origin, self.grid.spacing, self.grid.shape
        origin, shape = (x, y, z + first * dz), (nx, ny, count)
        how = (self.location, sampling.samples, sampling.outside)
        with torch.no_grad():
            found = voxelise(self.mesh, self.table, origin, self.grid.spacing, shape, *how)
        widths = [array.components or 1 for array in self.columns.values()]
        parts = zip(self.columns.values(), found.split(widths, dim=-1), strict=True)
        return {a.name: in_file_order(part[..., 0] if a.components is None else part) for a, part in parts}


def _groups(arrays: Mapping[str, MeshValues], grid: Grid) -> list[_Group]:
    """The arrays by mesh and location: those of one group are looked up at once."""
    members: dict[tuple[int, Location], list[tuple[str, torch.Tensor, int | None]]] = {}
    meshes: dict[int, TetMesh] = {}
    for name, array in arrays.items():
        table, location = checked_values(array.mesh, array.values, array.location)
        components = table.shape[1] if torch.as_tensor(array.values).ndim > 1 else None
        if components == 0:
            raise MeshError(f"The values '{name}' have no components; pass numbers or vectors.")
        meshes[id(array.mesh)] = array.mesh
        members.setdefault((id(array.mesh), location), []).append((name, table.detach(), components))
    groups = []
    for (key, location), parts in members.items():
        turned, straight = grid.seen_by(meshes[key])
        columns = {name: ArrayOfGrid(name, dtype_of(table), components) for name, table, components in parts}
        table = torch.cat([part for _, part, _ in parts], dim=1)
        groups.append(_Group(turned, straight, table, location, columns))
    return groups


def _require_memory(grid: Grid, cost: int, groups: list[_Group]) -> None:
    """Checks that there is memory for the layers that are sampled at a time.

    Raises:
        MeshError: There is not.
    """
    nx, ny, _ = grid.shape
    points = nx * ny * max(count for _, count in layers(grid, cost))
    # `voxelise` takes some planes along x at a time, at least one.
    at_once = max(min(points * cost, AT_ONCE), points * cost // nx)
    widths = [group.table.shape[1] * group.table.element_size() for group in groups]
    size = at_once * (_BYTES_OF_PLACE + _COPIES_OF_VALUE * max(widths)) + _COPIES_OF_VALUE * points * sum(widths)
    what = f"A layer of the grid of {' x '.join(map(str, grid.shape))} points"
    require_free(math.ceil(size), what, "choose a coarser one, or fewer samples", MeshError)
