"""Values on regular grids: which data, and where."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from difftetvr.cli.export.job import Job, dtype_for
from difftetvr.errors import MeshError, counted, listed
from difftetvr.terminal import waiting

if TYPE_CHECKING:
    from difftetvr.capture.volumes.placement import Placement
    from difftetvr.mesh.io import Scalar
    from difftetvr.sampling import Grid


@dataclass(frozen=True)
class GridOptions:
    """Where a grid samples, and how."""

    spacing: float | tuple[float, float, float] | None = None
    """Distance of a grid's points, or those along x, y and z; default: by --size."""
    size: int | tuple[int, int, int] | None = None
    """Points along the mesh's longest side at equal distances, or along x, y and z; default: 256 along the longest."""
    like: str | None = None
    """Take the grid of this volume, in the coordinates of its file: shape, spacing, directions and origin."""
    fitted: bool = False
    """MODEL was fitted to the volume of --like, so its box is laid onto that of the samples; found by itself where
    MODEL lies in the folder of its run."""
    samples: int = 1
    """N: a voxel's value is the mean of N x N x N points in it; 1: the value at its centre."""
    outside: float = 0.0
    """What points outside of the mesh have, such as nan."""
    device: str | None = None
    """Where to sample, such as cpu or cuda; default: the best that works."""

    def write(self, job: Job) -> None:
        """Samples and writes."""
        self.require_valid()
        scalars = scalars_of(job)
        self.write_sampled(job, scalars, *self._grids(job))

    def require_valid(self) -> None:
        """Checks how a grid takes its values, before anything is read."""
        from difftetvr.sampling.slabs import Sampling

        Sampling(self.samples, self.outside)

    def write_sampled(
        self, job: Job, scalars: dict[str, Scalar], sampled: Grid, written: Grid, x_first: bool = False
    ) -> None:
        """Writes what a mesh has on a grid.

        Args:
            job: What is written where.
            scalars: Of the mesh, by name.
            sampled: Where to sample in the mesh's world.
            written: What the file says of that.
            x_first: Whether the axes of a .npy are x, y, z.
        """
        from difftetvr.fitting.beginning.requirements import resolve_device
        from difftetvr.sampling.slabs import MeshValues, Sampling, write_sampled

        sampling = Sampling(self.samples, self.outside)
        device = resolve_device(self.device)
        dtype = dtype_for([scalar.values for scalar in scalars.values()])
        meshes = {id(scalar.mesh): scalar.mesh.to(device, dtype) for scalar in scalars.values()}
        arrays = {
            name: MeshValues(meshes[id(scalar.mesh)], scalar.values.to(device), scalar.location)
            for name, scalar in scalars.items()
        }
        with waiting(job.console, f"Sampling {counted(sampled.num_points, 'point')}"):
            write_sampled(job.output, arrays, sampled, sampling, written, x_first)
        job.say(f"Wrote {job.output} ({' x '.join(map(str, written.shape))} points, {listed(list(arrays))})")

    def _grids(self, job: Job) -> tuple[Grid, Grid]:
        """Where to sample in the mesh's world, and what the file says of that."""
        from difftetvr.capture.volumes.placement import Placement
        from difftetvr.sampling import Grid

        if self.like is None:
            if self.fitted:
                raise MeshError("--fitted says what the volume of --like is to MODEL; give both.")
            grid = Grid.around(job.data.mesh, self.spacing, self.size)
            return grid, grid
        if self.spacing is not None or self.size is not None:
            raise MeshError("--like takes the grid of a volume; leave out --spacing and --size.")
        with waiting(job.console, f"Reading {self.like}"):
            placement = Placement.of(self.like)
        return self.grids_like(job, placement)

    def grids_like(self, job: Job, placement: Placement) -> tuple[Grid, Grid]:
        """Where the samples of a volume are in the mesh's world, and in that of the volume's file.

        Args:
            job: What is written where.
            placement: Of the volume of --like.

        Raises:
            MeshError: The mesh lies elsewhere.
        """
        assert self.like is not None
        run = job.run
        is_own = run is not None and _is_same(self.like, run.capture)
        if is_own and not self.fitted:
            job.say(f"{job.model} was fitted to {self.like}: its box is laid onto that of the samples.")
        sampled = written = grid_of(placement)
        if self.fitted or is_own:
            spacing = run.capture_options.spacing if run is not None and is_own else None
            sampled = grid_of(placement.in_views(spacing))
        self._require_overlap(job, sampled)
        return sampled, written

    def _require_overlap(self, job: Job, grid: Grid) -> None:
        """Checks that a grid has points in the box of the mesh.

        Raises:
            MeshError: It has none, or one at most along each axis.
        """
        first, last = grid.corner_indices(job.data.mesh)
        counts = [
            math.floor(min(high, n - 1.0)) - math.ceil(max(low, 0.0)) + 1
            for low, high, n in zip(first, last, grid.shape)
        ]
        if min(counts) < 1 or max(counts) < 2:
            raise MeshError(
                f"The grid of {self.like} does not lie where {job.model} does; give the volume whose coordinates the "
                "mesh has, or --fitted if it was fitted to this one."
            )


def scalars_of(job: Job) -> dict[str, Scalar]:
    """What a grid has, by name.

    Raises:
        MeshError: There is no such data, or the format holds fewer arrays.
    """
    from difftetvr.mesh.io import FIELD_ARRAYS, array_of
    from difftetvr.sampling.grid_files import require_grid_format

    names: Sequence[str | None] = job.names
    takes_several = job.output.suffix.lower() == ".vti"
    if not names and job.data.field is not None:
        names = FIELD_ARRAYS if takes_several else ("density",)
    elif not names:
        names = (takes_several and _names_of_values(job)) or (None,)
    with job.naming_model():
        found = {name: array_of(job.data, job.of_field(name)) for name in names}
    scalars = {scalar.name if name is None else name: scalar for name, scalar in found.items()}
    require_grid_format(job.output, list(scalars))
    for name, scalar in scalars.items():
        job.say_missing(scalar)
        if scalar.offset:
            job.say(f"'{name}' is counted from {scalar.offset}, its least value.")
    return scalars


def _names_of_values(job: Job) -> list[str]:
    """Names of all data that have a finite value; prints those of others."""
    from difftetvr.mesh.io import array_names, array_of

    names = []
    for name in array_names(job.data):
        try:
            array_of(job.data, name)
        except MeshError:
            job.say(f"'{name}' has no finite value and was left out.")
        else:
            names.append(name)
    return names


def grid_of(placement: Placement) -> Grid:
    """The grid of a volume's samples."""
    from difftetvr.sampling import Grid

    is_plain = bool((placement.directions == np.eye(3)).all())
    origin, space, unit = placement.world
    directions = None if is_plain else placement.directions
    return Grid(origin, placement.spacing, placement.shape, directions, space, unit)  # type: ignore[arg-type]


def _is_same(volume: str, capture: str | None) -> bool:
    """Whether two names are those of one volume."""
    if capture is None or volume == capture:
        return volume == capture
    try:
        return os.path.samefile(volume, capture)
    except OSError:
        return False
