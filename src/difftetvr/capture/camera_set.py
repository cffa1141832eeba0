"""Cameras of a capture, without its images: where it was looked at from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from difftetvr.capture.viewing import Floats, positions_of
from difftetvr.rendering.cameras.pinhole import Camera

_PREFERRED = (0.45, -1.0)  # where the usual picture is looked at from, seen from above: in front, to the right
_ONE_SIDED = 0.5  # length of the mean of horizontal unit vectors from which on cameras have a side
_LEAST_ANGLE = 1e-6  # between optical axes that still say where they meet, in squares of the sine


@dataclass(frozen=True, eq=False)
class CameraSet:
    """Cameras of a capture, and which of its views are held out.

    Attributes:
        cameras: N cameras, each of its image's size; at least one.
        test: (N,) bool, views that training never sees.
        name: What to call the capture.
    """

    cameras: list[Camera]
    test: torch.Tensor
    name: str

    @property
    def train_cameras(self) -> list[Camera]:
        """Cameras of the views that training uses."""
        return [camera for camera, is_test in zip(self.cameras, self.test.tolist(), strict=True) if not is_test]

    @cached_property
    def positions(self) -> Floats:
        """(N, 3) where the cameras are."""
        return positions_of(self.cameras)

    @cached_property
    def up(self) -> Floats:
        """(3,) unit vector: upwards in the images, on the mean; the world's z where they have no common direction."""
        mean = -_rotations(self.cameras)[:, 1].mean(0)
        length = float(np.linalg.norm(mean))
        return mean / length if length > _ONE_SIDED else np.array([0.0, 0.0, 1.0])

    @cached_property
    def focus(self) -> Floats:
        """(3,) what the cameras look at: the point with the least mean square distance from their optical axes.

        Of axes that are (nearly) parallel, a point in front of the cameras as far away as these are spread.
        """
        forward = _rotations(self.cameras)[:, 2]
        across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
        system, center = across.mean(0), self.positions.mean(0)
        if np.linalg.eigvalsh(system)[0] > _LEAST_ANGLE:
            right = (across @ (self.positions - center)[:, :, None]).mean(0)[:, 0]
            found = center + np.linalg.solve(system, right)
            if (((found - self.positions) * forward).sum(1) > 0).mean() > 0.5:
                return found
        reach = float(np.linalg.norm(self.positions - center, axis=1).max())
        return center + (reach or 1.0) * forward.mean(0)

    @cached_property
    def typical(self) -> Camera:
        """The training camera that stands most as all do: of median height and distance, in the middle of their side.

        Cameras all around a scene have no side; then it is the one nearest to the usual direction of pictures. It is a
        camera of the capture and no mean of several, so it is where a scene can be looked at: neither inside of things
        nor behind what surrounds them.
        """
        cameras = self.train_cameras or self.cameras
        offset = positions_of(cameras) - self.focus
        distance = np.linalg.norm(offset, axis=1).clip(min=np.finfo(float).tiny)
        right, ahead = self._horizon
        azimuth = np.arctan2(offset @ ahead, offset @ right)
        elevation = np.arcsin((offset @ self.up / distance).clip(-1.0, 1.0))
        mean = np.exp(1j * azimuth).mean()
        wanted = float(np.angle(mean)) if abs(mean) > _ONE_SIDED else math.atan2(_PREFERRED[1], _PREFERRED[0])
        aside = np.angle(np.exp(1j * (azimuth - wanted)))
        deviation = (elevation - np.median(elevation)) ** 2 + aside**2 + np.log(distance / np.median(distance)) ** 2
        return cameras[int(deviation.argmin())]

    @property
    def inner_bounds(self) -> torch.Tensor:
        """(2, 3) float64 corners of a cube around `focus` that reaches as far as half of the cameras stand away."""
        distance = float(np.median(np.linalg.norm(self.positions - self.focus, axis=1)))
        return torch.from_numpy(np.stack((self.focus - distance, self.focus + distance)))

    @property
    def _horizon(self) -> tuple[Floats, Floats]:
        """Unit vectors across `up`; the world's x and y where up is z."""
        right = np.cross((0.0, 1.0, 0.0), self.up)
        if np.linalg.norm(right) < _ONE_SIDED:
            right = np.cross(self.up, (0.0, 0.0, 1.0))
        right = right / np.linalg.norm(right)
        return right, np.cross(self.up, right)


def _rotations(cameras: list[Camera]) -> Floats:
    """(N, 3, 3) of the cameras: rows point to the right, downwards and forward."""
    return np.stack([camera.world_to_camera[:3, :3].detach().cpu().double().numpy() for camera in cameras])
