"""A phantom of four materials with sharp edges, ellipsoids and plates, as voxels.

python benchmarks/phantom.py PHANTOM.nrrd [--size 256]

It fills most of the cube from -1 to 1, as `difftetvr project` with `"volume_size": [2, 2, 2]` takes it. A voxel holds
the mean of 4 x 4 x 4 points, at each of which the last body counts that holds it.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
import torch

from difftetvr.sampling import Grid, save_grid

POINTS = 4
"""Along each side of a voxel."""

AIR, SOFT, HARD, METAL = 0.0, 0.3, 0.6, 1.0


@dataclass(frozen=True)
class Body:
    """An ellipsoid or a plate.

    Attributes:
        density: Inside of it, per unit of length.
        center: Its middle.
        half: Half of its lengths along its own axes.
        is_plate: Whether it is a box rather than an ellipsoid.
        turn: Degrees by which its first axis is turned from x towards y.
        tilt: Degrees by which, before that, its third axis is turned from z towards x.
    """

    density: float
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    is_plate: bool = False
    turn: float = 0.0
    tilt: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """(3, 3) its axes in the world, as rows."""
        (c, s), (d, t) = ((math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (self.turn, self.tilt))
        return np.array([[c * d, s * d, -t], [-s, c, 0.0], [c * t, s * t, d]])

    @property
    def reach(self) -> np.ndarray:
        """(3,) half the lengths of the box around it."""
        lengths = np.array(self.half)[:, None] * self.axes
        return np.abs(lengths).sum(0) if self.is_plate else np.sqrt((lengths**2).sum(0))

    def holds(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Which points it holds, of coordinates that broadcast."""
        offset = [part - center for part, center in zip((x, y, z), self.center)]
        own = [sum(a * o for a, o in zip(axis, offset)) / half for axis, half in zip(self.axes, self.half)]
        if self.is_plate:
            return np.maximum(np.maximum(abs(own[0]), abs(own[1])), abs(own[2])) <= 1.0
        return own[0] ** 2 + own[1] ** 2 + own[2] ** 2 <= 1.0


BODIES = (
    Body(SOFT, (0.0, 0.0, 0.0), (0.85, 0.7, 0.9)),
    Body(HARD, (-0.35, 0.2, 0.1), (0.25, 0.2, 0.45), turn=30, tilt=15),
    Body(AIR, (0.35, 0.15, 0.0), (0.3, 0.25, 0.5), turn=-20),
    Body(AIR, (-0.35, 0.2, 0.15), (0.1, 0.08, 0.25), turn=30, tilt=15),
    Body(HARD, (0.38, 0.15, -0.1), (0.09, 0.09, 0.09)),
    Body(HARD, (0.05, -0.35, 0.0), (0.55, 0.02, 0.4), is_plate=True, turn=10),
    Body(AIR, (0.0, -0.48, 0.0), (0.4, 0.03, 0.3), is_plate=True, turn=10, tilt=20),
    Body(METAL, (-0.05, -0.1, -0.45), (0.3, 0.2, 0.025), is_plate=True, turn=40, tilt=25),
    Body(METAL, (0.0, 0.45, 0.3), (0.06, 0.06, 0.2), tilt=50),
    Body(METAL, (0.5, -0.25, 0.45), (0.05, 0.05, 0.05)),
)


def phantom(size: int, bodies: tuple[Body, ...] = BODIES) -> np.ndarray:
    """(X, Y, Z) float32 means over voxels."""
    fine = ((np.arange(size * POINTS) + 0.5) * (2.0 / (size * POINTS)) - 1.0).astype(np.float32)
    values = np.empty((size, size, size), dtype=np.float32)
    for layer in range(size):
        z = fine[layer * POINTS : (layer + 1) * POINTS]
        points = np.zeros((len(fine), len(fine), POINTS), dtype=np.float32)
        for body in bodies:
            low, high = body.center - body.reach, body.center + body.reach
            if high[2] < z[0] or low[2] > z[-1]:
                continue
            x, y = (slice(*np.searchsorted(fine, (low[k], high[k]))) for k in range(2))
            inside = body.holds(fine[x, None, None], fine[None, y, None], z[None, None])
            points[x, y][inside] = body.density
        values[:, :, layer] = points.reshape(size, POINTS, size, POINTS, POINTS).mean((1, 3, 4))
    return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path")
    parser.add_argument("--size", type=int, default=256)
    options = parser.parse_args()
    step = 2.0 / options.size
    grid = Grid((0.5 * step - 1.0,) * 3, (step,) * 3, (options.size,) * 3)
    save_grid(options.path, torch.from_numpy(phantom(options.size)), grid)


if __name__ == "__main__":
    main()
