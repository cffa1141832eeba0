"""The command ``difftetvr voxelise``."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.export.grids import GridOptions, grid_of, scalars_of
from difftetvr.cli.export.job import Job
from difftetvr.cli.options import TRUST_GROUPS, MeshOptions, Output, TrustOptions
from difftetvr.errors import DiffTetError, MeshError
from difftetvr.files import require_writable
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.terminal import waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture.volumes.placement import Placement
    from difftetvr.sampling import Grid

_SUFFIXES = (".npy", ".nrrd", ".nii")


@dataclass(frozen=True)
class Voxelise:
    """Write what a mesh holds as voxels: axes x, y and z, values at the middles of voxels."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh, in any format that is read."""
    output: Output
    """File to write: .npy, an array with the axes x, y, z; .nrrd; or .nii."""
    like: str | None = None
    """Take as many voxels as this volume has, in the order of the world's axes. They lie where its file says, or fill
    the box of the projections that MODEL was reconstructed from, as those of project do; and that of the mesh where
    neither tells a place."""
    shape: tuple[int, int, int] | None = None
    """Voxels along x, y and z; they fill the mesh's box, or --bounds."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Box that the outer faces of the voxels bound: its lowest and its highest x y z."""
    scalar: str | None = None
    """Name of the point or cell data, with a component if wanted (velocity:x); default: density, or the only data there
    are."""
    samples: int = 1
    """N: a voxel's value is the mean of N x N x N points in it; 1: the value at its middle."""
    outside: float = 0.0
    """What voxels outside of the mesh have, such as nan."""
    device: str | None = None
    """Where to sample, such as cpu or cuda; default: the best that works."""
    reading: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {"How MODEL is read": ("split", "step"), **TRUST_GROUPS}

    def run(self, console: Console) -> None:
        """Reads, samples and writes."""
        if (self.like is None) == (self.shape is None):
            raise MeshError("Say how many voxels there are: give either --like VOLUME or --shape NX NY NZ.")
        if self.output.suffix.lower() not in _SUFFIXES:
            raise MeshError(f"'{self.output}' is no file of voxels that is written; use one of {', '.join(_SUFFIXES)}.")
        options = GridOptions(samples=self.samples, outside=self.outside, device=self.device)
        options.require_valid()
        require_writable(self.output, MeshError)
        data = self.reading.load(self.model, console)
        job = Job(self.model, self.output, () if self.scalar is None else (self.scalar,), data, console)
        options.write_sampled(job, scalars_of(job), *self._grids(job), x_first=True)
        if self.output.suffix.lower() == ".npy":
            job.say(
                f"{self.output} has the axes x, y, z; to be read as a volume, an array needs z, y, x, or be a .nrrd."
            )

    def _grids(self, job: Job) -> tuple[Grid, Grid]:
        """Where to sample in the mesh's world, and what the file says of that."""
        from difftetvr.capture.volumes.placement import Placement

        if self.like is None:
            assert self.shape is not None
            grid = _filling(self._box(job), self.shape)
            return grid, grid
        with waiting(job.console, f"Reading {self.like}"):
            placement = Placement.of(self.like).in_world_order()
        if self.bounds is not None:
            grid = _filling(self._box(job), placement.shape)
            return grid, grid
        if (box := _box_of_projections(self.model)) is not None:
            job.say(f"{self.model} was reconstructed from projections: the voxels fill the box of these.")
            return _filling(box, placement.shape), _written(placement, box)
        if not placement.is_told:
            job.say(f"{self.like} tells no place: its voxels fill the box of {self.model}.")
            grid = _filling(self._box(job), placement.shape)
            return grid, grid
        return GridOptions(like=self.like).grids_like(job, placement)

    def _box(self, job: Job) -> np.ndarray:
        """(2, 3) the box that voxels fill."""
        if self.bounds is None:
            box: np.ndarray = job.data.mesh.bounds().detach().double().cpu().numpy()
            return box
        box = np.array(self.bounds).reshape(2, 3)
        if not (all(map(math.isfinite, self.bounds)) and (box[0] < box[1]).all()):
            raise MeshError(f"--bounds are {self.bounds}; give a lower and, greater in all axes, an upper corner.")
        return box


def _filling(box: np.ndarray, shape: tuple[int, int, int]) -> Grid:
    """A grid of voxels that fill a box."""
    from difftetvr.sampling import Grid

    if min(shape) < 1:
        raise MeshError(f"--shape is {' '.join(map(str, shape))}; give three numbers of at least 1.")
    steps = (box[1] - box[0]) / np.array(shape)
    x, y, z = (box[0] + 0.5 * steps).tolist()
    dx, dy, dz = steps.tolist()
    return Grid((x, y, z), (dx, dy, dz), shape)


def _written(placement: Placement, box: np.ndarray) -> Grid:
    """What a file says of voxels: the place of those that they are compared with, where that is told."""
    return grid_of(placement) if placement.is_told else _filling(box, placement.shape)


def _box_of_projections(model: Path) -> np.ndarray | None:
    """(2, 3) the box of the projections that a model is reconstructed from, by the run in whose folder it lies."""
    from difftetvr.capture import ProjectionCapture, is_projection_source

    folder = RunFolder(model.parent)
    if model.name != folder.model.name or not folder.config.is_file():
        return None
    try:
        saved = json.loads(folder.config.read_bytes())
        capture = saved.get("capture") if isinstance(saved, dict) else None
        if not isinstance(capture, str) or not is_projection_source(capture):
            return None
        bounds: np.ndarray = ProjectionCapture.load(capture).geometry.bounds.numpy()
        return bounds
    except (OSError, ValueError, RecursionError, DiffTetError):
        return None
