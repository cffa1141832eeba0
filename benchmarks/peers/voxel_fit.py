"""From images to a voxel grid in a given time: coarse to fine, with total variation, by RMSprop.

As in Plenoxels, steps are taken on random rays of all training views. Rays come in tiles of neighbouring pixels, which
share what they read; those that meet nothing that the grid holds cannot teach it anything and are left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import torch
import voxel_kernels as kernels
import voxel_learning as learning
from voxel_grid import VoxelGrid, first_grid, refined
from voxel_rays import TILE, TrainingRays

from difftetvr.backend import get_backend
from difftetvr.capture import Capture
from difftetvr.fitting.metrics import psnr
from difftetvr.fitting.records.evaluation import true_image, usual_background
from difftetvr.recording import few_lengths, replayed

_RAYS_AT_A_TIME = 1 << 15
_RAYS_TO_PRUNE_BY = 1 << 17
_RAYS_OF_A_TILE = (0, 2, 5, 7)  # none of the others is farther than a pixel away
_SAMPLES_PER_RAY = 16  # for which there is room at first
_OPAQUE = 1e9


@dataclass(frozen=True)
class Settings:
    """How the grid is fitted; the defaults were chosen on validation views of Lego, see docs/results.md.

    Attributes:
        stages: Share of the time at which each resolution begins, and cells along the longest side.
        prunings: Shares of the time at which cells are dropped that no ray sees, besides those moments.
        degree: Degree of the harmonics, 0 to 2.
        step: Length of a ray's steps, in edges of cells.
        batch: Rays of a step of the optimiser.
        color_rate: First and last learning rate of coefficients; log-linear in between.
        density_rate: The same for densities, in units of the capture's density.
        decay: Share of the means of squared derivatives that a step keeps.
        color_variation: Weight of the total variation of coefficients.
        density_variation: Weight of that of densities, which are counted in units of the capture's density.
        varied: Share of the vertices of which it is taken in each step.
        first_density: Density to begin with, in units of the capture's density.
        least_weight: Largest weight in a ray's colour below which a cell is dropped.
        random_background: Whether every ray has a background of its own, where alpha is known.
    """

    stages: tuple[tuple[float, int], ...] = ((0.0, 64), (0.15, 128), (0.4, 192))
    prunings: tuple[float, ...] = (0.1, 0.3, 0.6)
    degree: int = 2
    step: float = 0.5
    batch: int = 4096
    color_rate: tuple[float, float] = (0.03, 0.001)
    density_rate: tuple[float, float] = (1.0, 0.05)
    decay: float = 0.95
    color_variation: float = 1e-4
    density_variation: float = 1e-5
    varied: float = 0.1
    first_density: float = 0.1
    least_weight: float = 0.005
    random_background: bool = True


class VoxelFit:
    """A fit under way.

    Attributes:
        grid: Where values are, and what they were when the grid was made; see :meth:`current`.
        rays: Number of rays that were learned from.
        steps: Number of steps of the optimiser.
    """

    def __init__(self, capture: Capture, settings: Settings, seed: int = 0) -> None:
        self.capture, self.settings = capture, settings
        self.rays = self.steps = 0
        self._backend = get_backend("cpu")
        self._background = torch.tensor(usual_background(capture))
        self._random = torch.Generator().manual_seed(seed)
        self._room = few_lengths(_SAMPLES_PER_RAY * _RAYS_AT_A_TIME)
        rays = TrainingRays.of(capture)
        self._table = learning.RayTable(*(self._floats(t) for t in (rays.origin, rays.direction, rays.truth)))
        self._tiles = torch.arange(len(rays.direction) // math.prod(TILE))
        self._longest = settings.stages[0][1]
        density = settings.first_density * capture.density_unit
        self._use(first_grid(self._backend, capture, self._longest, settings.degree, settings.step, density))

    def run(self, seconds: float, moments: list[float]) -> Iterator[float]:
        """Fit for some time, and hand over at some moments; what is done then does not count.

        Args:
            seconds: How long.
            moments: When, in seconds; the last should be ``seconds``.

        Yields:
            The seconds spent.
        """
        settings, spent, waiting = self.settings, 0.0, sorted(moments)
        events = sorted([*settings.stages[1:], *((share, 0) for share in settings.prunings)])
        while waiting:
            start = time.perf_counter()
            while events and spent >= events[0][0] * seconds:
                self.refine(events.pop(0)[1])
            self.step(min(spent / seconds, 1.0))
            spent += time.perf_counter() - start
            if spent >= waiting[0]:
                waiting.pop(0)
                yield spent

    def step(self, progress: float) -> None:
        """Learn from a batch.

        Args:
            progress: Share of the time that has gone by, in [0, 1].
        """
        lattice, rows = self.grid.lattice, self._rows
        chosen = self._next_batch()
        rays, behind, wanted = self._taken(chosen)
        samples, lane = self._samples(rays)
        colors = replayed(kernels.color_samples, lattice, rows, samples, rays.direction, lane)
        seen = replayed(kernels.compose, lattice, samples, colors, behind)
        by_seen = replayed(learning.loss_adjoint, seen, wanted)
        adjoint = replayed(kernels.adjoint_of_samples, lattice, samples, colors, behind, by_seen)
        seen_by = (lattice, rows, samples, rays.direction, adjoint, lane)
        gradient = replayed(learning.gradient_of, *seen_by, self._smoothing(), self.grid.rows.numel())
        self._rows, self._squares = replayed(
            learning.take_step, lattice, rows, self._squares, gradient, self._rates(progress), self.settings.decay
        )
        self._density = self._densities()
        self.rays += len(chosen)
        self.steps += 1

    def refine(self, longest: int) -> None:
        """Drop cells that no ray sees.

        Args:
            longest: Cells along the longest side from now on; 0 for as many as before.
        """
        self._longest = longest or self._longest
        some = self._tiles[torch.randperm(len(self._tiles), generator=self._random)]
        seen, least, count = 0, self.settings.least_weight, int(self.grid.held.sum())
        for chosen in _rays_of(some)[:_RAYS_TO_PRUNE_BY].split(_RAYS_AT_A_TIME):
            samples, lane = self._samples(self._taken(chosen)[0])
            flags = replayed(learning.seen_cells, self.grid.lattice, samples, lane, least, count)
            seen = seen | flags.numpy()
        self._use(refined(self.current(), self.capture.bounds, self._longest, np.asarray(seen) > 0))

    def current(self) -> VoxelGrid:
        """The grid with its values as they are now."""
        self.grid.rows.copy_(self._backend.tensor(self._rows, *self.grid.rows.shape))
        return self.grid

    def image(self, view: int) -> torch.Tensor:
        """(H, W, 3) image of a view of the capture, over the usual background."""
        rays = self.capture.cameras[view].rays()
        parts = zip(*(v.reshape(-1, 3).float().split(_RAYS_AT_A_TIME) for v in (rays.origins, rays.directions)))
        return torch.cat([self._image(*part) for part in parts]).reshape(rays.directions.shape)

    def psnr(self, views: list[int]) -> float:
        """Mean PSNR in dB over views, each as `difftetvr.fitting.evaluate` takes it."""
        background = usual_background(self.capture)
        return sum(psnr(self.image(v), true_image(self.capture, v, background)) for v in views) / len(views)

    def _image(self, origin: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        """(N, 3) colours of rays."""
        backend, lattice = self._backend, self.grid.lattice
        columns = ([self._floats(v) for v in values.unbind(1)] for values in (origin, direction))
        rays, behind = kernels.Rays(*columns), [backend.opaque(float(b)) for b in self._background]
        samples, lane = self._samples(rays)
        colors = replayed(kernels.color_samples, lattice, self._rows, samples, rays.direction, lane)
        seen = replayed(kernels.compose, lattice, samples, colors, behind)
        return torch.stack([backend.tensor(channel) for channel in seen], dim=1)

    def _use(self, grid: VoxelGrid) -> None:
        """Go on with a grid."""
        self.grid = grid
        self._rows = self._floats(grid.rows)
        self._squares = self._floats(torch.zeros(grid.rows.numel()))
        self._density = self._densities()
        self._next = self._backend.UInt(grid.next_rows().reshape(-1).numpy().astype(np.uint32))
        self._tiles = self._tiles[self._meets_something()]
        self._order = self._tiles[:0]

    def _densities(self) -> Any:
        """What rays are searched with."""
        row = self._backend.lanes(len(self.grid.vertices))
        return replayed(learning.densities_of_cells, self.grid.lattice, self._rows, row)

    def _meets_something(self) -> torch.Tensor:
        """(tiles,) bool, whether one of some of their rays meets a cell that holds something."""
        density, found = dr.full(self._backend.Float, _OPAQUE, len(self._density)), []
        dr.make_opaque(density)
        some = _rays_of(self._tiles).reshape(-1, math.prod(TILE))[:, _RAYS_OF_A_TILE]
        for chosen in some.reshape(-1).split(_RAYS_AT_A_TIME):
            rays = self._taken(chosen)[0]
            samples = replayed(kernels.find_samples, self.grid.lattice, density, rays, self._room)
            found.append(torch.from_numpy(samples.through.numpy() < 1.0))
        return torch.cat(found).reshape(some.shape).any(1)

    def _next_batch(self) -> torch.Tensor:
        """Numbers of the rays of some tiles; each comes once before any comes again."""
        count = self.settings.batch // math.prod(TILE)
        if len(self._order) < count:
            self._order = self._tiles[torch.randperm(len(self._tiles), generator=self._random)]
        tiles, self._order = self._order[:count], self._order[count:]
        return _rays_of(tiles)

    def _taken(self, chosen: torch.Tensor) -> tuple[kernels.Rays, list[Any], list[Any]]:
        """Rays of the table, what is behind them, and what should be seen."""
        background = self._background.expand(len(chosen), 3)
        if self.settings.random_background and self.capture.alphas is not None:
            background = torch.rand(len(chosen), 3, generator=self._random)
        behind = self._floats(torch.nn.functional.pad(background, (0, 1)))
        numbers = self._backend.UInt(chosen.numpy().astype(np.uint32))
        taken: tuple[kernels.Rays, list[Any], list[Any]] = replayed(
            learning.take_batch, self.grid.lattice, self._table, numbers, behind
        )
        return taken

    def _samples(self, rays: kernels.Rays) -> tuple[kernels.Samples, Any]:
        """Samples of rays, and numbers of as many or a few more."""
        while True:
            samples = replayed(kernels.find_samples, self.grid.lattice, self._density, rays, self._room)
            count = int(samples.count[0])
            if count <= self._room:
                return samples, self._backend.lanes(few_lengths(max(count, 1)))
            self._room = few_lengths(count + count // 4)

    def _smoothing(self) -> learning.Smoothing:
        """Of what total variation is taken in a step."""
        count, settings, backend = len(self.grid.vertices), self.settings, self._backend
        lane = backend.lanes(int(settings.varied * count) * self.grid.lattice.width // 4)
        first = int(torch.randint(count, (1,), generator=self._random))
        weights = settings.color_variation, settings.density_variation
        return learning.Smoothing(lane, backend.opaque_uint(first), backend.opaque_uint(count), self._next, *weights)

    def _rates(self, progress: float) -> tuple[Any, Any]:
        """Lengths of steps of coefficients and densities."""
        settings = self.settings
        color, density = (
            first * (last / first) ** progress for first, last in (settings.color_rate, settings.density_rate)
        )
        return self._backend.opaque(color), self._backend.opaque(density * self.capture.density_unit)

    def _floats(self, values: torch.Tensor) -> Any:
        """A copy of values for kernels, flat."""
        return self._backend.Float(values.reshape(-1).numpy().copy())


def _rays_of(tiles: torch.Tensor) -> torch.Tensor:
    """Numbers of the rays of tiles."""
    size = math.prod(TILE)
    return (tiles[:, None] * size + torch.arange(size)).reshape(-1)
