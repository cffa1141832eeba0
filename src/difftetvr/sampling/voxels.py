"""``voxelise``: a mesh's values on a regular grid."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from difftetvr.errors import MeshError
from difftetvr.inputs import as_number, as_reals, as_whole
from difftetvr.memory import tried_twice
from difftetvr.mesh import TetMesh
from difftetvr.mesh.field import Location
from difftetvr.sampling.grids import checked_lattice
from difftetvr.sampling.location import Lattice, locate_lattice
from difftetvr.sampling.probing import checked_values, interpolated

_MOST_SAMPLES = 16
AT_ONCE = 1 << 22
"""Points whose values are interpolated at a time."""


@tried_twice
def voxelise(
    mesh: TetMesh,
    values: torch.Tensor,
    origin: Sequence[float],
    spacing: Sequence[float] | float,
    shape: Sequence[int],
    location: Location | None = None,
    samples: int = 1,
    outside: float = 0.0,
) -> torch.Tensor:
    """The values of a mesh on a regular grid; differentiable in the values and in ``mesh.vertices``.

    Args:
        mesh: The mesh; loose cells and holes may be.
        values: (V, ...) per vertex or (T, ...) per cell.
        origin: (3,) centre of the first voxel, in world space.
        spacing: Distances of neighbouring voxels along x, y and z; or one for all.
        shape: How many voxels along x, y and z.
        location: "vertex" or "cell"; None lets the number of values decide, vertices first where both fit.
        samples: 1 takes the values at the voxels' centres, exactly; n > 1 takes the mean of n^3 points in each voxel,
            at the centres of its n^3 parts.
        outside: What points have that no cell holds; they count in means.

    Returns:
        (X, Y, Z) with the shape of a value behind it, on the device and at the precision of the vertices.

    Raises:
        MeshError: The values do not fit the mesh, or an argument is out of range.
        BackendError: No back end runs on the device of the vertices.
    """
    table, where = checked_values(mesh, values, location)
    lattice = checked_lattice(origin, spacing, shape)
    samples = as_whole(samples, "samples", MeshError)
    require_samples(samples)
    filler = as_number(outside, "outside", MeshError)
    shift = mesh.origin
    slabs = []
    rows = max(1, AT_ONCE // (lattice.shape[1] * lattice.shape[2] * samples**3))
    for first in range(0, lattice.shape[0], rows):
        count = min(rows, lattice.shape[0] - first)
        fine = _refined(lattice, first, count, samples, shift)
        cells = locate_lattice(mesh, mesh.vertices.detach(), fine)
        points = fine.points(mesh.vertices.dtype, mesh.vertices.device).reshape(-1, 3)
        found = interpolated(mesh, table, where, points, cells.reshape(-1))
        found = torch.where((cells >= 0).reshape(-1, 1), found, filler)
        parts = found.reshape(count, samples, lattice.shape[1], samples, lattice.shape[2], samples, -1)
        slabs.append(parts.mean(dim=(1, 3, 5)) if samples > 1 else parts[:, 0, :, 0, :, 0])
    grid = torch.cat(slabs)
    return grid.reshape(*lattice.shape, *as_reals(values, "The values", MeshError).shape[1:])


def require_samples(samples: int) -> None:
    """Checks how finely voxels are divided for a mean.

    Raises:
        MeshError: The number is not in [1, 16].
    """
    if not 1 <= samples <= _MOST_SAMPLES:
        raise MeshError(f"samples is {samples}; pass a number from 1 to {_MOST_SAMPLES}.")


def _refined(lattice: Lattice, first: int, count: int, samples: int, shift: Sequence[float]) -> Lattice:
    """Sample points of some of a grid's first coordinates, relative to a mesh's origin."""
    _, ny, nz = lattice.shape
    fine = [step / samples for step in lattice.spacing]
    steps = zip(lattice.origin, lattice.spacing, fine, shift, strict=True)
    x, y, z = (start - 0.5 * step + 0.5 * part - own for start, step, part, own in steps)
    begin = x + first * lattice.spacing[0]
    return Lattice((begin, y, z), (fine[0], fine[1], fine[2]), (count * samples, ny * samples, nz * samples))
