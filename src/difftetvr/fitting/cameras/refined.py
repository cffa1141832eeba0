"""Poses and intrinsics under optimisation.

A view's pose is world_to_camera M with a rigid motion M of the world about the middle c of the capture's box:

    M x = R(w) (x - c) + c + s t

with a rotation vector w, a translation t and half of the box's longest side s. About the middle of what is seen,
turning and shifting are least alike: both about the camera would move the picture the same way.

What no image tells is held still: motions of all training views together, by which only the reconstruction would turn,
shift or grow. So their mean rotation and translation are 0, and so is the mean translation towards the cameras.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch

from difftetvr.capture.capture import Capture
from difftetvr.fitting.cameras.curvature import WorldMotion, gauss_newton_steps, pose_curvature
from difftetvr.fitting.cameras.options import CameraRefinement
from difftetvr.rendering import Camera, RenderedImage

_BETAS, _EPSILON = (0.9, 0.99), 1e-15
_KEPT = 0.5
"""Share of a view's curvature that stays when it is seen anew: it changes as the reconstruction grows sharp."""


class RefinedCameras:
    """The cameras of a capture as they are now, and what moves them.

    Poses take Gauss-Newton steps, each view by itself: turning a camera and shifting it sideways move its picture
    nearly alike, and only their curvature tells how far to go along what differs. Intrinsics have Adam's.

    Attributes:
        curvature: (N, 6, 6) second derivatives of the loss by the motions of the views that an iteration has seen.
        motion: (N, 6) leaf tensor, float64: rotation vectors and translations of all views' worlds.
        lens: (3,) leaf tensor, float64: log of the factor of all focal lengths, and shifts of all principal points in
            image widths and heights.
    """

    def __init__(self, capture: Capture, options: CameraRefinement, poses: bool, intrinsics: bool) -> None:
        """Cameras as they are given.

        Args:
            capture: The capture.
            options: How they move.
            poses: Whether poses move.
            intrinsics: Whether intrinsics do.
        """
        self._given, self._options = capture.cameras, options
        self._moves, self._zooms = poses, intrinsics
        count = len(capture.cameras)
        bounds = capture.bounds.double()
        self._world = WorldMotion(0.5 * (bounds[0] + bounds[1]), 0.5 * float((bounds[1] - bounds[0]).max()))
        self._training = capture.train_indices
        places = torch.stack([camera.position.detach().cpu().double() for camera in capture.cameras])
        towards = (places - self._world.center)[self._training]
        self._towards = towards - towards.mean(0)  # so that taking growth out leaves the mean where it is
        self.motion = torch.zeros(count, 6, dtype=torch.float64).requires_grad_(poses)
        self.lens = torch.zeros(3, dtype=torch.float64).requires_grad_(intrinsics)
        self.curvature = torch.zeros(count, 6, 6, dtype=torch.float64)
        self._state = {
            "motion_curvature": torch.zeros(count, 6, 6, dtype=torch.float64),
            "lens_first": torch.zeros(3, dtype=torch.float64),
            "lens_second": torch.zeros(3, dtype=torch.float64),
            "lens_steps": torch.zeros((), dtype=torch.float64),
        }

    def leaves(self) -> list[torch.Tensor]:
        """What gradients gather in."""
        return [leaf for leaf in (self.motion, self.lens) if leaf.requires_grad]

    def camera(self, view: int) -> Camera:
        """A view's camera; differentiable in what is refined."""
        return self.camera_with(view, self.motion[view], self.lens)

    def known(self, view: int) -> Camera:
        """A view's camera, without derivatives."""
        return self.camera_with(view, self.motion[view].detach(), self.lens.detach())

    def camera_with(self, view: int, motion: torch.Tensor, lens: torch.Tensor) -> Camera:
        """A view's camera with a motion of its world and a change of its intrinsics; differentiable in both.

        Args:
            view: Index of the view.
            motion: (6,) rotation vector and translation.
            lens: (3,) change of the intrinsics.
        """
        given = self._given[view]
        camera = given
        if self._moves:
            pose = given.world_to_camera.detach()
            rotation = rotation_of(motion[:3])
            center = self._world.center
            shift = center + self._world.unit * motion[3:] - (rotation * center).sum(1)
            old = pose.cpu().double()
            turned = (old[:3, :3, None] * rotation[None]).sum(1)
            moved = (old[:3, :3] * shift).sum(1) + old[:3, 3]
            top = torch.cat((turned, moved[:, None]), dim=1)
            camera = given.with_pose(torch.cat((top, old[3:])).to(pose))
        if self._zooms:
            zoom = torch.exp(lens[0])
            fx, fy, cx, cy = given.fx * zoom, given.fy * zoom, given.cx + given.width * lens[1], lens[2] * given.height
            own = torch.stack((fx, fy, cx, given.cy + cy))
            if not own.requires_grad:
                values = dict(zip(("fx", "fy", "cx", "cy"), own.tolist(), strict=True))
                return dataclasses.replace(camera, intrinsics=None, **values)
            camera = dataclasses.replace(camera, intrinsics=own)
        return camera

    def cameras(self) -> list[Camera]:
        """The cameras of all views as they are now."""
        return [self.known(view) for view in range(len(self._given))]

    def note_curvature(self, view: int, image: RenderedImage, weights: torch.Tensor) -> None:
        """Add what a view's image tells of the loss's curvature.

        Args:
            view: Index of the view.
            image: What its camera sees.
            weights: (H, W, C) of the squares of residuals in the loss.
        """
        self.curvature[view] += self.curvature_of(self.known(view), image, weights)

    def curvature_of(self, camera: Camera, image: RenderedImage, weights: torch.Tensor) -> torch.Tensor:
        """(6, 6) second derivatives of a weighted sum of squares by a motion of the world of one of these cameras."""
        return pose_curvature(camera, image, weights, self._world)

    def step(self, views: Sequence[int], progress: float) -> None:
        """One step with the gradients and curvatures that have gathered.

        Args:
            views: Those that had a part in them.
            progress: Share of the run that is done.
        """
        rate = self._options.rate_at(progress)
        with torch.no_grad():
            if self._moves and self.motion.grad is not None:
                self._move(torch.tensor(sorted(set(views))), self.motion.grad, rate)
            if self._zooms and self.lens.grad is not None:
                state = self._state
                state["lens_steps"] += 1
                first, second = state["lens_first"], state["lens_second"]
                share = self._options.intrinsics_rate / self._options.rate
                self.lens += _adam(self.lens.grad, first, second, state["lens_steps"], share * rate)
            self._hold_still()

    def _move(self, rows: torch.Tensor, gradient: torch.Tensor, rate: float) -> None:
        known, found = self._state["motion_curvature"][rows], self.curvature[rows]
        is_known = known.diagonal(dim1=1, dim2=2).sum(1) > 0
        mean = torch.where(is_known[:, None, None], torch.lerp(found, known, _KEPT), found)
        self._state["motion_curvature"][rows] = mean
        self.motion[rows] += gauss_newton_steps(gradient[rows], mean, rate)

    def _hold_still(self) -> None:
        rows = self.motion[self._training]
        if len(rows) < 2:
            self.motion[self._training] = 0.0
            return
        rows = rows - rows.mean(0)
        # By what the world has grown: cameras come nearer or farther off, all in the same proportion.
        growth = (rows[:, 3:] * self._towards).sum() / self._towards.square().sum().clamp(min=1e-300)
        self.motion[self._training] = torch.cat((rows[:, :3], rows[:, 3:] - growth * self._towards), dim=1)

    def state(self) -> dict[str, torch.Tensor]:
        """Parameters and moments by name: all that the next step depends on."""
        return {"motion": self.motion.detach(), "lens": self.lens.detach(), **self._state}

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])

    def summary(self) -> dict[str, Any]:
        """How far the training views' cameras have been moved, as JSON values; translations in units of the world."""
        rows = self.motion.detach()[self._training]
        return {
            "rotation_degrees": math.degrees(float(rows[:, :3].norm(dim=1).mean())),
            "translation": self._world.unit * float(rows[:, 3:].norm(dim=1).mean()),
            "focal_factor": math.exp(float(self.lens.detach()[0])),
        }


def rotation_of(vector: torch.Tensor) -> torch.Tensor:
    """(3, 3) rotation about a vector by its length in radians (Rodrigues); differentiable, at 0 too."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero)).reshape(3, 3)
    square = (skew[:, :, None] * skew[None]).sum(1)
    angle2 = (vector * vector).sum()
    is_small = angle2 < 1e-8
    angle = torch.where(is_small, 1.0, angle2).sqrt()
    one = torch.where(is_small, 1.0 - angle2 / 6.0, torch.sin(angle) / angle)
    two = torch.where(is_small, 0.5 - angle2 / 24.0, (1.0 - torch.cos(angle)) / (angle * angle))
    return torch.eye(3, dtype=vector.dtype) + one * skew + two * square


def _adam(
    gradient: torch.Tensor, first: torch.Tensor, second: torch.Tensor, steps: torch.Tensor, rate: float
) -> torch.Tensor:
    first.mul_(_BETAS[0]).add_(gradient, alpha=1.0 - _BETAS[0])
    second.mul_(_BETAS[1]).add_(gradient.square(), alpha=1.0 - _BETAS[1])
    size = (second / (1.0 - _BETAS[1] ** steps)).sqrt()
    return -rate * (first / (1.0 - _BETAS[0] ** steps)) / (size + _EPSILON)
