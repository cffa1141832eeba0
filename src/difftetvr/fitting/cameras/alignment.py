"""Poses of held-out views: found on their own images, with the reconstruction held still.

Once training poses have moved, those of held-out views as given belong to another world. As in BARF (Lin et al. 2021),
they are optimised before images are compared; nothing else is, so an image can be aligned, and no better explained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from difftetvr.capture.truth import Color, Truth
from difftetvr.fitting.cameras.curvature import gauss_newton_steps, lengths_of
from difftetvr.fitting.cameras.options import CameraRefinement
from difftetvr.fitting.cameras.refined import RefinedCameras
from difftetvr.fitting.processes import Processes
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render

_SHORTER = 0.25  # the next step, where one has made the error greater


@dataclass(frozen=True)
class StillWorld:
    """A reconstruction that is held still, and what views show of it.

    Attributes:
        mesh: The mesh.
        field: Its colours and densities.
        truth: The images.
        background: Behind the volume.
        deterministic: Whether gradients are the same in every run to the last bit.
    """

    mesh: TetMesh
    field: Field
    truth: Truth
    background: Color
    deterministic: bool


def align_held_out(
    cameras: RefinedCameras, options: CameraRefinement, world: StillWorld, views: Sequence[int], processes: Processes
) -> None:
    """Moves the cameras of held-out views to where their images fit best.

    Args:
        cameras: Whose motions of these views begin at 0 and are replaced.
        options: How many steps, and how long.
        world: What is seen.
        views: Indices of the views; each is aligned by one of the processes.
        processes: Those that fit together.
    """
    own = [_aligned(cameras, options, world, view) for view in processes.share(views)]
    rows = processes.gathered(own, len(views), 6)
    with torch.no_grad():
        for view, row in zip(views, rows, strict=True):
            cameras.motion[view] = torch.tensor(row, dtype=torch.float64)


def _aligned(cameras: RefinedCameras, options: CameraRefinement, world: StillWorld, view: int) -> list[float]:
    """The motion of a view's world with the least error of those that were tried: Gauss-Newton steps, if they help."""
    truth, lens = world.truth, cameras.lens.detach()
    expected = truth.image(view, world.background)
    motion, longest, least = torch.zeros(6, dtype=torch.float64), options.rate, float("inf")
    best, step = motion, motion
    for count in range(options.align_steps + 1):
        variable = motion.clone().requires_grad_()
        camera, behind = cameras.camera_with(view, variable, lens), torch.tensor(world.background)
        seen = render(world.mesh, world.field, camera, behind, deterministic=world.deterministic)
        residual = truth.where_valid(view, seen.color.to(expected.device), expected) - expected
        loss = residual.square().mean()
        if float(loss.detach()) < least:
            best, least = motion, float(loss.detach())
            if count == options.align_steps or not loss.requires_grad:
                break
            (gradient,) = torch.autograd.grad(loss, variable)
            counts = truth.where_valid(view, torch.ones_like(seen.color), torch.zeros_like(seen.color))
            curvature = cameras.curvature_of(camera, seen, counts / counts.numel())
        else:
            longest = _SHORTER * min(longest, float(lengths_of(step[None])))
        step = gauss_newton_steps(gradient[None], curvature[None], longest)[0]
        if not bool(step.any()):  # the image does not depend on the pose: nothing is seen, say
            break
        motion = best + step
    found: list[float] = best.tolist()
    return found
