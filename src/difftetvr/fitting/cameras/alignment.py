"""Poses of held-out views: found on their own images, with the reconstruction held still.

Once training poses have moved, those of held-out views as given belong to another world. As in BARF (Lin et al. 2021),
they are optimised before images are compared; nothing else is, so an image can be aligned, and no better explained.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from difftetvr.capture.truth import Color, Truth
from difftetvr.fitting.cameras.options import CameraRefinement
from difftetvr.fitting.cameras.refined import RefinedCameras, adam_of_poses
from difftetvr.fitting.processes import Processes
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render

_LAST = 0.02  # of the rate, in the last step


def align_held_out(
    cameras: RefinedCameras,
    options: CameraRefinement,
    mesh: TetMesh,
    field: Field,
    truth: Truth,
    views: Sequence[int],
    background: Color,
    processes: Processes,
    deterministic: bool,
) -> None:
    """Moves the cameras of held-out views to where their images fit best.

    Args:
        cameras: Whose motions of these views begin at 0 and are replaced.
        options: How many steps, and how long.
        mesh: The reconstruction.
        field: Its colours and densities.
        truth: The images.
        views: Indices of the views; each is aligned by one of the processes.
        background: Behind the volume.
        processes: Those that fit together.
        deterministic: Whether gradients are the same in every run to the last bit.
    """
    own = [
        _aligned(cameras, options, mesh, field, truth, view, background, deterministic)
        for view in processes.share(views)
    ]
    rows = processes.gathered(own, len(views), 6)
    with torch.no_grad():
        for view, row in zip(views, rows, strict=True):
            cameras.motion[view] = torch.tensor(row, dtype=torch.float64)


def _aligned(
    cameras: RefinedCameras,
    options: CameraRefinement,
    mesh: TetMesh,
    field: Field,
    truth: Truth,
    view: int,
    background: Color,
    deterministic: bool,
) -> list[float]:
    """The motion of a view's world with the least error of those that were tried."""
    expected, lens = truth.image(view, background), cameras.lens.detach()
    motion = torch.zeros(6, dtype=torch.float64)
    best, least = motion, float("inf")
    moments = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    for step in range(options.align_steps + 1):
        variable = motion.clone().requires_grad_()
        camera = cameras.camera_with(view, variable, lens)
        behind = torch.tensor(background)
        image = render(mesh, field, camera, behind, deterministic=deterministic).color.to(expected.device)
        loss = (truth.where_valid(view, image, expected) - expected).square().mean()
        if float(loss.detach()) < least:
            best, least = motion, float(loss.detach())
        if step == options.align_steps or not loss.requires_grad:
            break
        (gradient,) = torch.autograd.grad(loss, variable)
        rate = 2.0 * options.rate * _LAST ** (step / max(options.align_steps, 1))
        count = torch.tensor([[step + 1.0]], dtype=torch.float64)
        motion = motion + adam_of_poses(gradient[None], *moments, count, rate)[0]
    found: list[float] = best.tolist()
    return found
