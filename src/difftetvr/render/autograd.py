"""Rendering as a PyTorch operation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.optics import OpticalModel
from difftetvr.render.adjoint import ImageAdjoint, Wanted, render_adjoint
from difftetvr.render.camera import Camera
from difftetvr.render.crossing import Tracer, View, vertex_records
from difftetvr.render.forward import render_forward
from difftetvr.render.linked_list import LinkedList
from difftetvr.render.marching import Marching
from difftetvr.render.projected import Projected

TRACERS: dict[str, Any] = {"marching": Marching, "linked-list": LinkedList, "projected": Projected}
"""How crossings are found and ordered, by the name of the renderer."""


@dataclass(frozen=True)
class RenderTask:
    """What a view needs besides tensors that may require gradients."""

    backend: Backend
    mesh: TetMesh
    camera: Camera
    optics: OpticalModel
    per_cell: bool
    threshold: float
    deterministic: bool
    renderer: str = "marching"

    def tracer(
        self, vertices: torch.Tensor, color: torch.Tensor, density: torch.Tensor, limits: torch.Tensor | None = None
    ) -> Tracer:
        """Upload a view.

        Args:
            vertices: (V, 3) in camera space.
            color: (N, 3) of vertices or cells.
            density: (N,) likewise.
            limits: (H, W, 2) distances between which each ray is looked at; None for all in front of the camera.
        """
        backend = self.backend
        if self.per_cell:
            records = backend.floats(torch.cat([vertices, vertices.new_zeros(vertices.shape[0], 1)], dim=1))
            cells = backend.floats(torch.cat([color, density[:, None]], dim=1))
        else:
            records = vertex_records(backend, *(backend.floats(part) for part in (vertices, density, color)))
            cells = None
        view = View(
            backend,
            self.camera,
            self.optics,
            records,
            cells,
            backend.opaque(self.threshold),
            None if limits is None else backend.floats(limits),
        )
        tracer: Tracer = TRACERS[self.renderer].of(view, self.mesh, vertices)
        return tracer


class RenderFunction(torch.autograd.Function):
    """(V, 3) camera-space vertices, colours, densities, limits to (H, W, 4) radiance and optical depth, (H, W) distance.

    Colours, densities and limits are those of :meth:`RenderTask.tracer`.
    """

    @staticmethod
    def forward(ctx: Any, task: RenderTask, vertices: Any, color: Any, density: Any, limits: Any) -> Any:
        """Render; keeps only the image and, while gradients are wanted, the uploaded view."""
        size = (task.camera.height, task.camera.width)
        with task.backend.exclusive():
            tracer = task.tracer(vertices, color, density, limits)
            light, distance = render_forward(tracer)
            image = task.backend.tensor(light, *size, 4), task.backend.tensor(distance, *size)
        ctx.set_materialize_grads(False)
        ctx.task, ctx.tracer = task, tracer
        ctx.vertex_count, ctx.field_count = vertices.shape[0], density.shape[0]
        ctx.save_for_backward(*image)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_light: Any, g_distance: Any) -> Any:
        """Go through the crossings again with the image's derivatives."""
        backend = ctx.task.backend
        light, distance = ctx.saved_tensors
        needs_vertices, needs_color, needs_density, needs_limits = ctx.needs_input_grad[1:]
        with backend.exclusive(one_thread=ctx.task.deterministic):
            image = ImageAdjoint(
                backend.floats(torch.zeros_like(light) if g_light is None else g_light),
                None if g_distance is None else backend.floats(g_distance),
                backend.floats(light),
                backend.floats(distance),
            )
            wanted = Wanted(needs_vertices, needs_limits)
            gradients = render_adjoint(ctx.tracer, image, ctx.vertex_count, wanted)
            field = backend.tensor(gradients.field).reshape(-1, 4)[: ctx.field_count]
            vertices = backend.tensor(gradients.vertices).reshape(-1, 4)[:, :3] if needs_vertices else None
            limits = backend.tensor(gradients.limits, *distance.shape, 2) if needs_limits else None
        if vertices is not None:
            vertices = vertices[: ctx.vertex_count]
        return None, vertices, field[:, :3] if needs_color else None, field[:, 3] if needs_density else None, limits
