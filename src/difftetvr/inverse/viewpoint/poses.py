"""Cameras that a search may move: on a sphere around a point, or about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from difftetvr.rendering.cameras.pinhole import Camera

_POLE = 1.0 - 1e-6
_NEAREST, _FARTHEST = 0.75, 1.25  # of free cameras, in distances of the orbit
_ASIDE = 0.25  # how far beside the centre free cameras may look, likewise
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class Poses:
    """Where cameras may be.

    A pose is a vector of the camera's place and of the point it looks at, both from the centre and in distances of the
    orbit: (3,) on an orbit, whose cameras look at the centre; (6,) of free cameras. Its up direction is always the
    same, so an orbit has two degrees of freedom and free cameras have five.

    Attributes:
        center: (3,) what the cameras of an orbit look at.
        radius: Their distance from it.
        up: (3,) unit vector that points upwards in pictures; the sphere's poles lie in its direction.
        fov_y: Vertical field of view in radians.
        width: Pixels.
        height: Pixels.
        is_free: Whether distance and target may change: the distance by a quarter, the target by a quarter of it.
    """

    center: torch.Tensor
    radius: float
    up: torch.Tensor
    fov_y: float
    width: int
    height: int
    is_free: bool

    def starts(self, count: int) -> list[torch.Tensor]:
        """Poses on the orbit: of eight, one in the middle of each octant; else evenly spread over the sphere."""
        if count != 8:
            return self.spread(count)
        signs = [-1.0, 1.0]
        corners = [(x, y, z) for z in signs for y in signs for x in signs]
        # 45 degrees above or below the horizon, as in the published experiments.
        return [self._pose(torch.tensor([0.5 * x, 0.5 * y, math.sqrt(0.5) * z])) for x, y, z in corners]

    def spread(self, count: int) -> list[torch.Tensor]:
        """Poses on the orbit along a Fibonacci spiral."""
        places = []
        for index in range(count):
            z, angle = 1.0 - (2.0 * index + 1.0) / count, index * _GOLDEN_ANGLE
            across = math.sqrt(1.0 - z * z)
            places.append(self._pose(torch.tensor([across * math.cos(angle), across * math.sin(angle), z])))
        return places

    def _pose(self, direction: torch.Tensor) -> torch.Tensor:
        place = direction.double() @ self._axes()
        return self.valid(torch.cat((place, torch.zeros(3, dtype=torch.float64))) if self.is_free else place)

    def _axes(self) -> torch.Tensor:
        """(3, 3) rows: two axes across the up direction, and that; x, y and z where that is z."""
        up = self.up
        helper = torch.eye(3, dtype=torch.float64)[int(up.abs()[:2].argmin())]
        first = helper - (helper @ up) * up
        first = first / first.norm()
        return torch.stack((first, torch.linalg.cross(up, first), up))

    def valid(self, pose: torch.Tensor) -> torch.Tensor:
        """The nearest pose that is allowed."""
        place, rest = pose[:3], pose[3:]
        height = float(place @ self.up) / float(place.norm())
        if abs(height) > _POLE:  # where the picture could be turned any way
            across = self._axes()[0]
            place = place.norm() * (math.copysign(_POLE, height) * self.up + math.sqrt(1.0 - _POLE**2) * across)
        if not self.is_free:
            return place / place.norm()
        distance = float(place.norm())
        place = place * (min(max(distance, _NEAREST), _FARTHEST) / distance)
        return torch.cat((place, rest * min(1.0, _ASIDE / max(float(rest.norm()), 1e-12))))

    def uphill(self, pose: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """The part of a gradient along which an allowed pose may go; (3,) or (6,)."""
        place, normal = pose[:3], pose[:3] / pose[:3].norm()
        along = gradient[:3] @ normal
        outwards = float(place.norm())
        is_stopped = (outwards >= _FARTHEST and along > 0) or (outwards <= _NEAREST and along < 0)
        if self.is_free and not is_stopped:
            return gradient
        return torch.cat((gradient[:3] - along * normal, gradient[3:]))

    def camera(self, pose: torch.Tensor) -> Camera:
        """The camera of an allowed pose; differentiable in it."""
        target = pose[3:] if self.is_free else torch.zeros_like(pose)
        forward = target - pose[:3]
        forward = forward / forward.norm()
        right = torch.linalg.cross(forward, self.up)
        right = right / right.norm()
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
        eye = self.center + self.radius * pose[:3]
        top = torch.cat((rotation, -(rotation * eye).sum(1, keepdim=True)), dim=1)
        matrix = torch.cat((top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])))
        focal = 0.5 * self.height / math.tan(0.5 * self.fov_y)
        return Camera(matrix, focal, focal, 0.5 * self.width, 0.5 * self.height, self.width, self.height)
