"""How the values of a scalar are distributed in space, and how steep it is where it has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from difftetvr.capture.volumes.volume import Volume
from difftetvr.mesh import TetMesh
from difftetvr.mesh.field import Location

_NEAR, _FAR = 0.5854101966249685, 0.1381966011250105
"""Weights of a cell's vertices at the four points of the rule that integrates quadratic functions exactly."""

_MOST_CELLS, _MOST_VOXELS = 1_000_000, 4_000_000


@dataclass(frozen=True, eq=False)
class Distribution:
    """Samples of a scalar, which together fill the space in which it is known; the longest side of that is 1 here.

    Attributes:
        values: (N,) float64 values.
        volumes: (N,) float64 volume that each stands for, >= 0.
        slopes: (N,) float64 length of the gradient there.
        surface: Area of the surface of that space.
        ends: The least and the greatest value anywhere.
    """

    values: torch.Tensor
    volumes: torch.Tensor
    slopes: torch.Tensor
    surface: float
    ends: tuple[float, float]

    @staticmethod
    def of_scalars(mesh: TetMesh, values: torch.Tensor, location: Location) -> Distribution:
        """Four samples of each cell, of very many of some; one of each where a scalar is constant in cells.

        The slope of such a one is that of its means at the vertices: it says which values lie beside others.

        Args:
            mesh: The mesh.
            values: (V,) or (T,) finite numbers.
            location: Where they live.
        """
        cells, numbers = mesh.tets.long().cpu(), values.detach().cpu().double()
        if location == "vertex":
            cells = cells[:: max(1, len(cells) // _MOST_CELLS)]  # of so many, every few tell the same
        corners = mesh.vertices.detach().cpu().double()[cells]
        edges = corners[:, 1:] - corners[:, :1]
        # So that no volume vanishes or overflows, however small or large the mesh is.
        size = float((corners.amax((0, 1)) - corners.amin((0, 1))).max())
        inverse, volumes = _inverse_and_volume(edges / size)
        at_vertices = numbers if location == "vertex" else _averaged(cells, numbers, volumes, mesh.num_vertices)
        rises = at_vertices[cells][:, 1:] - at_vertices[cells][:, :1]
        slopes = (inverse @ rises[:, :, None])[:, :, 0].norm(dim=1)
        ends = (float(numbers.min()), float(numbers.max()))
        if location == "vertex":
            inner = at_vertices[cells]
            numbers = (_FAR * inner.sum(1, keepdim=True) + (_NEAR - _FAR) * inner).flatten()
            share = mesh.num_cells / len(cells) / 4.0
            volumes, slopes = (share * volumes).repeat_interleave(4), slopes.repeat_interleave(4)
        return Distribution(numbers, volumes, slopes, _surface(mesh, size), ends)

    @staticmethod
    def of_volume(volume: Volume) -> Distribution:
        """The samples of a volume; of a large one some million, evenly spaced."""
        step = max(1, round((volume.values.size / _MOST_VOXELS) ** (1 / 3)))
        values = volume.values[::step, ::step, ::step].astype(np.float64)
        spacing = step * volume.cell_size
        axes = [axis for axis in range(3) if values.shape[axis] > 1]
        steepness = np.sqrt(sum(np.gradient(values, spacing[2 - axis], axis=axis) ** 2 for axis in axes))
        extent = (volume.bounds[1] - volume.bounds[0]).double()
        surface = 2.0 * float(extent[0] * extent[1] + extent[1] * extent[2] + extent[2] * extent[0])
        flat = torch.from_numpy(values.reshape(-1))
        each = float(extent.prod()) / len(flat)
        ends = (float(volume.values.min()), float(volume.values.max()))
        return Distribution(flat, torch.full_like(flat, each), torch.from_numpy(steepness.reshape(-1)), surface, ends)

    def chosen(self, which: torch.Tensor) -> Distribution:
        """Some of the samples, by a mask (N,)."""
        values = self.values[which]
        ends = (float(values.min()), float(values.max()))
        return replace(self, values=values, volumes=self.volumes[which], slopes=self.slopes[which], ends=ends)

    def quantiles(self, shares: Sequence[float]) -> list[float]:
        """Values below which these shares of the volume lie.

        Args:
            shares: In [0, 1].
        """
        order = torch.argsort(self.values)
        below = self.volumes[order].cumsum(0)
        places = torch.searchsorted(below, below[-1] * torch.tensor(shares, dtype=torch.float64))
        return [float(value) for value in self.values[order][places.clamp(max=len(order) - 1)]]

    def mean_depth(self, densities: torch.Tensor) -> float:
        """Mean optical depth over all straight lines that cross the space, whatever their direction.

        By Cauchy's theorem: lines cross a convex body along 4 V / S on the mean; where it is not convex, along less.

        Args:
            densities: (N,) density at each sample.
        """
        return 4.0 * float((densities * self.volumes).sum()) / self.surface


def _inverse_and_volume(edges: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(T, 3, 3) inverse of the edges and (T,) volumes; flat cells count nothing."""
    determinant = torch.linalg.det(edges)
    is_flat = ~torch.isfinite(1.0 / determinant)
    safe = torch.where(is_flat[:, None, None], torch.eye(3, dtype=edges.dtype), edges)
    inverse = torch.where(is_flat[:, None, None], 0.0, torch.linalg.inv(safe))
    return inverse, torch.where(is_flat, 0.0, determinant.abs() / 6.0)


def _averaged(cells: torch.Tensor, values: torch.Tensor, volumes: torch.Tensor, count: int) -> torch.Tensor:
    """(V,) means of the values of the cells around each vertex, weighted by volume."""
    total, weight = values.new_zeros(count), values.new_zeros(count)
    total.index_add_(0, cells.flatten(), (volumes * values).repeat_interleave(4))
    weight.index_add_(0, cells.flatten(), volumes.repeat_interleave(4))
    return total / weight.clamp(min=torch.finfo(torch.float64).tiny)


def _surface(mesh: TetMesh, size: float) -> float:
    """Area of the boundary in units of the mesh's longest side; of loose cells, which have none, of their box."""
    if not mesh.is_conforming:
        x, y, z = ((mesh.bounds()[1] - mesh.bounds()[0]).double().cpu() / size).tolist()
        return float(2.0 * (x * y + y * z + z * x))
    corners = mesh.vertices.detach().cpu().double()[mesh.topology.boundary_faces.long().cpu()] / size
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(across.norm(dim=1).sum())
