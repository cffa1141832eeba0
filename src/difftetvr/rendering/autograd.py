"""Rendering as a PyTorch operation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from difftetvr.memory import tried_twice
from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.kernels.adjoint import ImageAdjoint, render_adjoint
from difftetvr.rendering.kernels.composition import Composition, Pixels
from difftetvr.rendering.kernels.flags import flags_here, with_flags
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.kernels.gradients import Gradients, Wanted
from difftetvr.rendering.kernels.layout import GradientSource, collect
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.task import RenderTask
from difftetvr.rendering.traversal.crossing import Tracer
from difftetvr.rendering.traversal.transfer import KNOT_RECORD


class RenderFunction(torch.autograd.Function):
    """From vertices, pose, background, limits, rays and content to an image.

    The outputs are (..., C) channels, (...) opacity, expected distance and optical depth. The inputs that may require
    gradients are what the tracer was made of, and the (C,) background, which may be None.
    """

    @staticmethod
    def forward(ctx: Any, task: RenderTask, shot: Shot, *tensors: Any) -> Any:
        """Render; keeps only what was gathered and, while gradients are wanted, the tracer."""
        backend, (vertices, pose, background, _, _, *_) = task.backend, tensors
        how = Composition(
            None if background is None or not task.channels else backend.floats(background.clone()),
            shot.shift,
            shot.unit,
        )
        with backend.exclusive():
            rendered = render_forward(shot.tracer, how)
            image = rendered.image
            rest = [backend.tensor(part).view(shot.shape) for part in (image.alpha, image.depth, image.optical_depth)]
            channels = backend.tensor(image.color)[: task.channels * rest[0].numel()]
            pixels = channels.view(*shot.shape, task.channels), *rest
        ctx.set_materialize_grads(False)
        ctx.task, ctx.shot, ctx.how, ctx.gathered = task, shot, how, (rendered.light, rendered.distance)
        ctx.flags = flags_here()
        needs_pose, needs_background = ctx.needs_input_grad[3:5]
        ctx.save_for_backward(
            vertices if needs_pose else None, pose, pixels[3] if needs_background and task.channels else None
        )
        return pixels

    @staticmethod
    @once_differentiable
    @tried_twice
    def backward(ctx: Any, *by_image: Any) -> Any:
        """Go through the crossings again with the image's derivatives."""
        task, backend, shot = ctx.task, ctx.task.backend, ctx.shot
        vertices, pose, optical_depth = ctx.saved_tensors
        needs_vertices, needs_pose, needs_background, needs_limits, needs_lines = ctx.needs_input_grad[2:7]
        needs_knots = task.content == "scalar" and any(ctx.needs_input_grad[-2:])
        wanted = Wanted(needs_vertices or needs_pose, needs_limits, needs_lines, needs_knots)
        derivatives = [None if part is None or not part.numel() else backend.floats(part) for part in by_image]
        with with_flags(ctx.flags), backend.exclusive(task.deterministic):
            light, distance = ctx.gathered
            image = ImageAdjoint(Pixels(*derivatives), ctx.how, light, distance, task.threshold == 0.0)
            gradients = render_adjoint(shot.tracer, image, task.mesh.num_vertices, wanted, task.deterministic)
            geometry, parts = gradient_tensors(task, gradients, pose, vertices)
        by_background = None
        if needs_background and optical_depth is not None and by_image[0] is not None:
            by_background = (torch.exp(-optical_depth)[..., None] * by_image[0]).reshape(-1, task.channels).sum(0)
        asked = (part if needed else None for part, needed in zip(parts, ctx.needs_input_grad[7:], strict=True))
        positions = geometry.vertices if needs_vertices else None
        return None, None, positions, geometry.pose, by_background, geometry.limits, geometry.lines, *asked


@dataclass(frozen=True)
class Shot:
    """What is rendered, ready to be.

    Attributes:
        tracer: Finds the crossings.
        shape: Of the image or bundle (...), of N rays.
        shift: (N,) how far kernels' origins are from the rays' true ones; None where they are these.
        unit: Unit of length of kernels, in world units.
    """

    tracer: Tracer
    shape: tuple[int, ...]
    shift: Any | None
    unit: float


@dataclass(frozen=True)
class GeometryGradients:
    """Derivatives by (V, 3) vertices, their (4, 4) pose, (N, 2) limits and (N, 6) lines; None for those not wanted."""

    vertices: torch.Tensor | None
    pose: torch.Tensor | None
    limits: torch.Tensor | None
    lines: torch.Tensor | None


def gradient_tensors(
    task: RenderTask, gradients: Gradients, pose: torch.Tensor | None, vertices: torch.Tensor | None
) -> tuple[GeometryGradients, list[torch.Tensor | None]]:
    """Derivatives in the caller's order and space, by geometry and by all parts of the content.

    Args:
        task: What was rendered.
        gradients: What kernels found, in the order of memory and the space of the rays.
        pose: (4, 4) transform to that space; None where vertices are in it.
        vertices: (V, 3) in front of the pose; None where no gradient by the pose is wanted.
    """
    backend, tables = task.backend, MemoryOrder.of(task.mesh).tables(task.backend)
    has_channels = task.content == "vertex" and not task.has_features
    transform = None if pose is None else backend.floats(pose)
    at_vertices = GradientSource(
        backend,
        tables.vertices,
        gradients.vertices,
        transform,
        gradients.field,
        task.channels if has_channels else 0,
    )
    at_cells = GradientSource(backend, tables.cells, None, None, gradients.cells, task.channels)
    positions, channels, values = _collected(at_vertices, task.mesh.num_vertices)
    _, cell_channels, cell_densities = _collected(at_cells, task.mesh.num_cells)
    geometry = GeometryGradients(
        positions,
        None if vertices is None else _by_pose(task, gradients, vertices),
        None if gradients.limits is None else backend.tensor(gradients.limits, -1, 2),
        None if gradients.lines is None else backend.tensor(gradients.lines, -1, 6),
    )
    if task.content == "cell":
        return geometry, [cell_channels, cell_densities]
    parts = [cell_channels] if task.has_features else [channels] if has_channels else []
    parts.append(values)
    if task.content == "scalar" and gradients.knots is None:
        parts += [None, None]
    elif task.content == "scalar":
        by_knot = backend.tensor(gradients.knots, -1, KNOT_RECORD)
        parts += [by_knot[:, 0], by_knot[:, 1:5]]
    return geometry, parts


def _collected(source: GradientSource, count: int) -> tuple[torch.Tensor | None, ...]:
    """Derivatives by (M, 3) positions, (M, C) channels and (M,) values; None for those not wanted."""
    if source.vectors is None and source.records is None:
        return None, None, None
    positions, channels, values = replayed(collect, source, few_lengths(count))
    backend, width = source.backend, source.channels
    return (
        None if positions is None else backend.tensor(positions, -1, 3)[:count],
        None if channels is None else backend.tensor(channels)[: count * width].view(count, width),
        None if values is None else backend.tensor(values)[:count],
    )


def _by_pose(task: RenderTask, gradients: Gradients, vertices: torch.Tensor) -> torch.Tensor:
    """(4, 4) gradient by the pose that (V, 3) vertices have been transformed by."""
    order = MemoryOrder.of(task.mesh).vertices
    seen = task.backend.tensor(gradients.vertices, -1, 4)[: order.shape[0], :3]
    columns = vertices.index_select(0, order).unbind(1)
    by_rotation = torch.stack([_sum(seen * column[:, None]) for column in columns], dim=1)
    return torch.nn.functional.pad(torch.cat((by_rotation, _sum(seen)[:, None]), 1), (0, 0, 0, 1))


def _sum(rows: torch.Tensor) -> torch.Tensor:
    """(3,) sum of (V, 3), which does not tell in which order the vertices lie: that is chosen while a process runs."""
    return rows.sum(0) if rows.device.type == "mps" else rows.sum(0, dtype=torch.float64).to(rows.dtype)
