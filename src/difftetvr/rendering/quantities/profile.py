"""Optical depth at distances along rays and the reverse, as PyTorch operations."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from difftetvr.memory import tried_twice
from difftetvr.rendering.autograd import gradient_tensors
from difftetvr.rendering.kernels.flags import flags_here, with_flags
from difftetvr.rendering.kernels.gradients import Wanted
from difftetvr.rendering.kernels.profile import Table, Weighed, ask_depths, ask_distances, depths_adjoint
from difftetvr.rendering.preparation import PreparedView
from difftetvr.rendering.task import RenderTask
from difftetvr.rendering.traversal.crossing import Tracer


def depths_at(view: PreparedView, limits: torch.Tensor | None, distances: torch.Tensor) -> torch.Tensor:
    """Optical depths of a view from where its rays begin to distances along them; differentiable.

    Args:
        view: The view, without channels.
        limits: (N, 2) distances between which each ray is looked at; None for all in front of its origin.
        distances: (N, K) distances in the unit of the view, in any order; none beyond the limits.

    Returns:
        (N, K).
    """
    return _profile(False, view, limits, distances)


def distances_at(view: PreparedView, limits: torch.Tensor | None, depths: torch.Tensor) -> torch.Tensor:
    """Distances at which the rays of a view reach optical depths; differentiable.

    Args:
        view: The view, without channels.
        limits: (N, 2) distances between which each ray is looked at; None for all in front of its origin.
        depths: (N, K) optical depths greater than 0, in any order.

    Returns:
        (N, K) in the unit of the view; infinite where they are not reached.
    """
    return _profile(True, view, limits, depths)


def _profile(
    is_inverse: bool, view: PreparedView, limits: torch.Tensor | None, questions: torch.Tensor
) -> torch.Tensor:
    ascending, order = questions.to(view.task.backend.dtype).sort(dim=1)
    with view.task.backend.exclusive():
        tracer = view.tracer(None if limits is None else view.task.backend.floats(limits))
    answers: torch.Tensor = _ProfileFunction.apply(
        view.task, tracer, is_inverse, view.vertices, view.pose, limits, view.lines, ascending, *view.parts
    )
    return answers.gather(1, order.argsort(dim=1))


class _ProfileFunction(torch.autograd.Function):
    """From vertices, pose, limits, rays, (N, K) ascending questions and content to (N, K) answers.

    By the theorem of implicit functions a distance t(depth) has the derivatives of the depth there, divided by minus
    the density, and one over it by the depth itself.
    """

    @staticmethod
    def forward(ctx: Any, task: RenderTask, tracer: Tracer, is_inverse: bool, *tensors: Any) -> Any:
        """Walk once; keeps, while gradients are wanted, the tracer and what was found."""
        backend, (vertices, pose, _, _, questions, *_) = task.backend, tensors
        with backend.exclusive():
            ask = ask_distances if is_inverse else ask_depths
            found = ask(tracer, _table(backend, questions), math.prod(questions.shape))
            answers, density = (backend.tensor(part, *questions.shape) for part in (found.values, found.density))
        ctx.task, ctx.tracer, ctx.is_inverse = task, tracer, is_inverse
        ctx.flags = flags_here()
        needs_pose = ctx.needs_input_grad[4]
        ctx.save_for_backward(answers if is_inverse else questions, density, pose, vertices if needs_pose else None)
        return answers

    @staticmethod
    @once_differentiable
    @tried_twice
    def backward(ctx: Any, g_answers: Any) -> Any:
        """Walk once more with the derivatives by the optical depths."""
        task, backend = ctx.task, ctx.task.backend
        distances, density, pose, vertices = ctx.saved_tensors
        if ctx.is_inverse:
            questions = torch.where(density > 0, g_answers / density, 0.0)
            weights = -questions
        else:
            questions, weights = g_answers * density, g_answers
        needs_vertices, needs_pose, needs_limits, needs_lines, _, *needs_parts = ctx.needs_input_grad[3:]
        needs_knots = task.content == "scalar" and any(needs_parts[-2:])
        wanted = Wanted(needs_vertices or needs_pose, needs_limits, needs_lines, needs_knots)
        if not (wanted.vertices or wanted.limits or wanted.lines or any(needs_parts)):
            return *(None for _ in range(7)), questions, *(None for _ in needs_parts)
        ahead = weights.flip(1).cumsum(1).flip(1)
        with with_flags(ctx.flags), backend.exclusive(task.deterministic):
            depths = Weighed(*(_table(backend, values) for values in (distances, weights, ahead)))
            gradients = depths_adjoint(ctx.tracer, depths, task.mesh.num_vertices, wanted, task.deterministic)
            geometry, parts = gradient_tensors(task, gradients, pose, vertices)
        asked = (part if needed else None for part, needed in zip(parts, needs_parts, strict=True))
        positions = geometry.vertices if needs_vertices else None
        return None, None, None, positions, geometry.pose, geometry.limits, geometry.lines, questions, *asked


def _table(backend: Any, values: torch.Tensor) -> Table:
    return Table(backend.floats(values), backend.opaque_uint(values.shape[1]))
