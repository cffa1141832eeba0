"""How strongly a view's image depends on its camera's pose: what Gauss-Newton steps of poses are divided by.

An image's derivative by the pose is taken from the image itself: what is seen at a pixel moves with the flow that a
motion of the world gives to the point at the pixel's depth, and the image changes by its own slope times that flow, as
in the registration of images (Lucas & Kanade 1981; Baker & Matthews 2004). That is cheap, and good enough to divide
by; the gradient that is divided is the exact one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.rendering import Camera, RenderedImage

_LEAST_ALPHA = 0.05
"""Opacity from which the depth of a pixel is taken to be where something is."""

_DAMPING = 1e-3
"""Of steps, in parts of the mean curvature: what no image tells is left as it is."""


@dataclass(frozen=True)
class WorldMotion:
    """A rigid motion of the world about a point, by a rotation vector and a translation.

    Attributes:
        center: (3,) float64, the point.
        unit: Length in which translations are counted.
    """

    center: torch.Tensor
    unit: float


def pose_curvature(camera: Camera, image: RenderedImage, weights: torch.Tensor, motion: WorldMotion) -> torch.Tensor:
    """Second derivatives of a weighted sum of an image's squared residuals by a motion of the world.

    Args:
        camera: The camera, (H, W).
        image: What it sees, with (H, W, C) colours over a background.
        weights: (H, W, C) of the squares.
        motion: How the world moves.

    Returns:
        (6, 6) float64 on the CPU, by rotation vector and translation.
    """
    with torch.no_grad():
        across, down = _slopes(image.color.detach(), 1), _slopes(image.color.detach(), 0)
        products = (across * across, across * down, down * down)
        xx, xy, yy = ((weights * product).sum(-1) for product in products)
        column, row = _flow(camera, image, motion).unbind(-2)
        by_column = xx[..., None] * column + xy[..., None] * row
        by_row = xy[..., None] * column + yy[..., None] * row
        # No products of millions of small matrices, which are slow.
        one, other = (torch.cat((x.reshape(-1, 6), y.reshape(-1, 6))) for x, y in ((column, row), (by_column, by_row)))
        curvature = 2.0 * (one.T @ other)
        return curvature.cpu().double()


def gauss_newton_steps(gradient: torch.Tensor, curvature: torch.Tensor, longest: float) -> torch.Tensor:
    """Steps to where a quadratic model has its least value, none of them too long.

    Args:
        gradient: (R, 6) derivatives.
        curvature: (R, 6, 6) second derivatives.
        longest: Greatest length of a step's rotation, in radians, and of its translation.

    Returns:
        (R, 6).
    """
    mean = curvature.diagonal(dim1=1, dim2=2).mean(1)
    least = torch.finfo(curvature.dtype).tiny ** 0.5
    damped = curvature + (_DAMPING * mean + least)[:, None, None] * torch.eye(6, dtype=curvature.dtype)
    steps = -torch.linalg.solve(damped, gradient)
    return steps * (longest / lengths_of(steps).clamp(min=longest))[:, None]


def lengths_of(steps: torch.Tensor) -> torch.Tensor:
    """(R,) lengths of (R, 6) steps: of the rotation or of the translation, whichever is longer."""
    return torch.maximum(steps[:, :3].norm(dim=1), steps[:, 3:].norm(dim=1))


def _slopes(color: torch.Tensor, axis: int) -> torch.Tensor:
    """(H, W, C) derivatives of an image along one of its axes, per pixel; 0 where there is but one."""
    if color.shape[axis] < 2:
        return torch.zeros_like(color)
    (slopes,) = torch.gradient(color, dim=axis)
    return slopes


def _flow(camera: Camera, image: RenderedImage, motion: WorldMotion) -> torch.Tensor:
    """(H, W, 2, 6) by how many columns and rows what is seen at a pixel moves; 0 where the camera has no ray."""
    pose = camera.world_to_camera.detach()
    rotation = pose[:3, :3].to(image.depth)
    middle = (pose[:3, :3].double() @ motion.center.to(pose.device) + pose[:3, 3].double()).to(image.depth)
    away = middle.norm().clamp(min=motion.unit)  # where nothing is: as far as the middle, in which a camera may be
    depth = torch.where(image.alpha.detach() > _LEAST_ALPHA, image.depth.detach(), away)[..., None]
    # Made where the image is, and not on the host for each iteration.
    directions = camera.with_pose(pose.to(depth.device)).ray_directions().detach().to(depth)
    columns_and_rows = _pixels_by_direction(directions) / depth[..., None]
    # In the axes of the world: a rotation vector w moves what is at an arm a by w x a, and g (w x a) = w (a x g).
    arms = (depth * directions - middle) @ rotation
    shifts = columns_and_rows @ rotation
    turns = torch.linalg.cross(arms[..., None, :].expand_as(shifts), shifts)
    flow = torch.cat((turns, motion.unit * shifts), dim=-1)
    return torch.where(torch.isfinite(flow).all(-1, keepdim=True).all(-2, keepdim=True), flow, 0.0)


def _pixels_by_direction(directions: torch.Tensor) -> torch.Tensor:
    """(H, W, 2, 3) derivatives of columns and rows by (H, W, 3) directions, from those of neighbours: of any lens."""
    across, down = _slopes(directions, 1), _slopes(directions, 0)
    aa, ad, dd = (
        (one * other).sum(-1, keepdim=True) for one, other in ((across, across), (across, down), (down, down))
    )
    # An image of one row or column has no slope along the other axis, by which this is multiplied.
    aa, dd = (torch.where(square > 0, square, 1.0) for square in (aa, dd))
    determinant = aa * dd - ad * ad
    return torch.stack((dd * across - ad * down, aa * down - ad * across), dim=-2) / determinant[..., None]
