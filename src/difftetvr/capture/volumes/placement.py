"""Where the samples of a volume lie: in the world of its file, and in that of the views which are rendered of it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from difftetvr.capture.volumes.orientation import nearest_axes, require_right_angles
from difftetvr.capture.volumes.readers.table import read_volume
from difftetvr.capture.volumes.volume_capture import TOOTH, TOOTH_VOLUME, packaged
from difftetvr.capture.volumes.volume_file import World
from difftetvr.errors import CaptureError


class Placement(NamedTuple):
    """The places of a volume's samples.

    Attributes:
        source: The file's name, for messages.
        shape: Number of samples along the file's axes x, y and z, x the fastest.
        spacing: Distances of samples along these axes.
        directions: (3, 3) float64, row a is the unit vector in the world along which the file's axis a runs.
        world: Where the first sample lies, in what space, in which unit.
    """

    source: str
    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    directions: np.ndarray
    world: World

    @staticmethod
    def of(volume: str | Path) -> Placement:
        """The places as the file tells them; a left-handed world has its first axis reversed.

        Args:
            volume: Volume file, or ``tooth`` for the packaged scan.

        Raises:
            CaptureError: The file cannot be read.
        """
        if str(volume) == TOOTH:
            with packaged(TOOTH_VOLUME) as path:
                raw = read_volume(path, None, None)
        else:
            raw = read_volume(Path(volume), None, None)
        nz, ny, nx = raw.values.shape
        directions = np.eye(3) if raw.directions is None else raw.directions
        return Placement(str(volume), (nx, ny, nz), raw.spacing, directions, raw.world)

    def in_views(self, spacing: tuple[float, float, float] | None = None) -> Placement:
        """The places in the world of the volume's views, and so of what is reconstructed from them; see `Volume`.

        There the box of the samples is centred at the origin, its longest side is 1, and its axes are the world's.

        Args:
            spacing: Distances of samples along x, y and z of the world that the views were made with; None: the file's.

        Raises:
            CaptureError: No views can be made of it: its axes are not at right angles, or one has a single sample.
        """
        require_right_angles(self.directions, self.source)
        if min(self.shape) < 2:
            raise CaptureError(f"'{self.source}' has a single sample along an axis, so that nothing is fitted to it.")
        axes, signs = nearest_axes(self.directions)
        steps = np.array(self.spacing if spacing is None else [spacing[axis] for axis in axes])
        extents = (np.array(self.shape) - 1) * steps
        directions = np.eye(3)[list(axes)] * np.array(signs, dtype=np.float64)[:, None]
        x, y, z = (-0.5 * (extents / extents.max()) @ directions).tolist()
        dx, dy, dz = (steps / extents.max()).tolist()
        return Placement(self.source, self.shape, (dx, dy, dz), directions, World((x, y, z)))

    def in_world_order(self) -> Placement:
        """The same places with the samples in the order of the world's axes, as `load_volume` has them.

        Raises:
            CaptureError: The axes are not at right angles.
        """
        require_right_angles(self.directions, self.source)
        axes, signs = nearest_axes(self.directions)
        order = [axes.index(axis) for axis in range(3)]
        steps = np.array(self.spacing)[:, None] * self.directions
        reversed_axes = np.array([sign < 0 for sign in signs])
        first = np.array(self.world.origin) + ((np.array(self.shape) - 1) * reversed_axes) @ steps
        directions = (self.directions * np.array(signs, dtype=np.float64)[:, None])[order]
        nx, ny, nz = (self.shape[axis] for axis in order)
        dx, dy, dz = (self.spacing[axis] for axis in order)
        x, y, z = first.tolist()
        return Placement(self.source, (nx, ny, nz), (dx, dy, dz), directions, self.world._replace(origin=(x, y, z)))

    @property
    def is_told(self) -> bool:
        """Whether the file tells a place at all; else samples are at whole numbers, from 0."""
        is_plain = bool((self.directions == np.eye(3)).all()) and set(self.spacing) == {1.0}
        return not is_plain or self.world != World()
