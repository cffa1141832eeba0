"""Rendering as a PyTorch operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.optics import OpticalModel
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.kernels.adjoint import ImageAdjoint, Wanted, render_adjoint
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.tracers.linked_list import LinkedList
from difftetvr.rendering.tracers.marching import Marching
from difftetvr.rendering.tracers.projected import Projected
from difftetvr.rendering.traversal.crossing import Tracer, View, vertex_records
from difftetvr.rendering.traversal.transfer import Transfer

Content = Literal["vertex", "cell", "scalar"]
"""What a volume holds: (V, 3) colours and (V,) densities on vertices, (T, 3) and (T,) on cells, or (V,) scalars, (K,)
knots and (K, 4) densities and colours of their transfer function."""

TRACERS: dict[str, Any] = {"marching": Marching, "linked-list": LinkedList, "projected": Projected}
"""How crossings are found and ordered, by the name of the renderer."""


@dataclass(frozen=True)
class RenderTask:
    """What a view needs besides tensors that may require gradients."""

    backend: Backend
    mesh: TetMesh
    camera: Camera
    optics: OpticalModel
    content: Content
    threshold: float
    deterministic: bool
    renderer: str = "marching"

    def tracer(self, vertices: torch.Tensor, limits: torch.Tensor | None, parts: Sequence[torch.Tensor]) -> Tracer:
        """Upload a view.

        Args:
            vertices: (V, 3) in camera space.
            limits: (H, W, 2) distances between which each ray is looked at; None for all in front of the camera.
            parts: What the volume holds, see :data:`Content`.
        """
        backend = self.backend
        cells = transfer = None
        if self.content == "vertex":
            color, density = parts
            records = vertex_records(backend, *(backend.floats(part) for part in (vertices, density, color)))
        elif self.content == "cell":
            color, density = parts
            records = _with_fourth(backend, vertices, vertices.new_zeros(vertices.shape[0]))
            cells = backend.floats(torch.cat([color, density[:, None]], dim=1))
        else:
            scalar, knots, values = parts
            records = _with_fourth(backend, vertices, scalar)
            transfer = Transfer.of(backend, knots, values)
        view = View(
            backend,
            self.camera,
            self.optics,
            records,
            cells,
            transfer,
            backend.opaque(self.threshold),
            None if limits is None else backend.floats(limits),
        )
        tracer: Tracer = TRACERS[self.renderer].of(view, self.mesh, vertices)
        return tracer


def _with_fourth(backend: Backend, vertices: torch.Tensor, values: torch.Tensor) -> Any:
    """Flat (V, 4) records of positions and one value each."""
    return backend.floats(torch.cat([vertices, values[:, None]], dim=1))


class RenderFunction(torch.autograd.Function):
    """From vertices in camera space, limits and content to (H, W, 4) radiance and optical depth, (H, W) distance.

    The inputs are those of :meth:`RenderTask.tracer`.
    """

    @staticmethod
    def forward(ctx: Any, task: RenderTask, vertices: Any, limits: Any, *parts: Any) -> Any:
        """Render; keeps only the image and, while gradients are wanted, the uploaded view."""
        size = (task.camera.height, task.camera.width)
        with task.backend.exclusive():
            tracer = task.tracer(vertices, limits, parts)
            light, distance = render_forward(tracer)
            image = task.backend.tensor(light, *size, 4), task.backend.tensor(distance, *size)
        ctx.set_materialize_grads(False)
        ctx.task, ctx.tracer = task, tracer
        ctx.vertex_count, ctx.part_size = vertices.shape[0], parts[0].shape[0]
        ctx.save_for_backward(*image)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_light: Any, g_distance: Any) -> Any:
        """Go through the crossings again with the image's derivatives."""
        backend = ctx.task.backend
        light, distance = ctx.saved_tensors
        needs_vertices, needs_limits = ctx.needs_input_grad[1:3]
        with backend.exclusive(one_thread=ctx.task.deterministic):
            image = ImageAdjoint(
                backend.floats(torch.zeros_like(light) if g_light is None else g_light),
                None if g_distance is None else backend.floats(g_distance),
                backend.floats(light),
                backend.floats(distance),
            )
            gradients = render_adjoint(ctx.tracer, image, ctx.vertex_count, Wanted(needs_vertices, needs_limits))
            vertices = (
                backend.tensor(gradients.vertices).reshape(-1, 4)[: ctx.vertex_count, :3] if needs_vertices else None
            )
            limits = backend.tensor(gradients.limits, *distance.shape, 2) if needs_limits else None
            parts: tuple[torch.Tensor, ...]
            if gradients.transfer is None:
                field = backend.tensor(gradients.field).reshape(-1, 4)[: ctx.part_size]
                parts = field[:, :3], field[:, 3]
            else:
                values = backend.tensor(gradients.transfer.values).reshape(-1, 4)
                parts = (
                    backend.tensor(gradients.field)[: ctx.part_size],
                    backend.tensor(gradients.transfer.knots),
                    values,
                )
        wanted = (part if needed else None for part, needed in zip(parts, ctx.needs_input_grad[3:], strict=True))
        return None, vertices, limits, *wanted
