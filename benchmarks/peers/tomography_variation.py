"""The proximal map of the total variation of voxels, in the metric of a diagonal matrix (Dr.Jit).

What minimises ``sum of d_i (x_i - z_i)^2 / 2 + v TV(x)`` over x >= 0 is ``max(0, z - v D^-1 div p)`` for vectors p of
length at most 1 in each voxel, which are found by projected gradient steps from those of the call before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, get_backend

_LONGEST = 12.0  # greatest eigenvalue of the differences' square in three dimensions


@dataclass(frozen=True)
class _Lattice:
    """Numbers of voxels and what is at their sides.

    Attributes:
        b: Back end.
        lane: Numbers of all voxels.
        strides: Opaque distances of neighbours along x, y and z.
        has_next, has_last: Three flags each, whether there is a neighbour.
    """

    b: Backend
    lane: Any
    strides: list[Any]
    has_next: list[Any]
    has_last: list[Any]

    @staticmethod
    def of(b: Backend, size: int) -> _Lattice:
        lane = dr.arange(b.UInt, size**3)
        side = b.opaque_uint(size)
        strides = [b.opaque_uint(1), side, b.opaque_uint(size * size)]
        row = lane // side
        place = [lane - row * side, row % side, row // side]
        return _Lattice(b, lane, strides, [p + 1 < side for p in place], [p > 0 for p in place])


class VariationProximal:
    """The map, which remembers the vectors of the call before."""

    def __init__(self, metric: torch.Tensor, variation: float, size: int) -> None:
        """For a diagonal (N^3), and the weight of the sum over voxels of the lengths of their differences."""
        self._b, self._size, self._variation = get_backend("cpu"), size, variation
        self._metric = metric
        self._vectors = [torch.zeros_like(metric) for _ in range(3)]

    def __call__(self, wanted: torch.Tensor, steps: int) -> torch.Tensor:
        """(N^3) densities near those wanted."""
        b = self._b
        if self._variation == 0.0:
            return wanted.clamp_min(0.0)
        with b.exclusive():
            target, metric, variation = b.floats(wanted), b.floats(self._metric), b.opaque(self._variation)
            vectors = [b.floats(v) for v in self._vectors]
            for _ in range(steps):
                density = _density(_Lattice.of(b, self._size), target, metric, variation, vectors)
                dr.eval(density)
                vectors = _stepped(_Lattice.of(b, self._size), density, metric, variation, vectors)
                dr.eval(vectors)
            density = _density(_Lattice.of(b, self._size), target, metric, variation, vectors)
            result = b.tensor(density)
            self._vectors = [b.tensor(v) for v in vectors]
        return result


def _density(lattice: _Lattice, target: Any, metric: Any, variation: Any, vectors: list[Any]) -> Any:
    """The densities that belong to vectors."""
    b, pull = lattice.b, lattice.b.Float(0)
    for vector, stride, follows, precedes in zip(vectors, lattice.strides, lattice.has_next, lattice.has_last):
        before = dr.gather(b.Float, vector, lattice.lane - stride, precedes)
        pull += before - dr.select(follows, vector, 0.0)
    return dr.fmax(target - variation * pull / metric, 0.0)


def _stepped(lattice: _Lattice, density: Any, metric: Any, variation: Any, vectors: list[Any]) -> list[Any]:
    """Vectors after a step uphill of the dual problem, cut off at length 1."""
    b, rises, least = lattice.b, [], metric
    for stride, follows in zip(lattice.strides, lattice.has_next):
        after = dr.gather(b.Float, density, lattice.lane + stride, follows)
        rises.append(dr.select(follows, after - density, 0.0))
        near = dr.gather(b.Float, metric, lattice.lane + stride, follows)
        least = dr.select(follows, dr.fmin(least, near), least)
    rate = least / (_LONGEST * variation)
    moved = [dr.fma(rate, rise, vector) for rise, vector in zip(rises, vectors)]
    square = sum(m * m for m in moved)
    cut = dr.select(square > 1.0, dr.rsqrt(square), 1.0)
    return [cut * m for m in moved]
