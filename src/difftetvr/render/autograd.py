"""The marching renderer as a PyTorch operation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.optics import OpticalModel
from difftetvr.render.adjoint import ImageAdjoint, render_adjoint
from difftetvr.render.camera import Camera
from difftetvr.render.entry import find_entries
from difftetvr.render.marching import MarchingScene, render_forward, vertex_records
from difftetvr.render.walk import walk_table


@dataclass(frozen=True)
class MarchingTask:
    """What a view needs besides tensors that may require gradients."""

    backend: Backend
    mesh: TetMesh
    camera: Camera
    optics: OpticalModel
    per_cell: bool
    threshold: float
    deterministic: bool

    def scene(self, vertices: torch.Tensor, color: torch.Tensor, density: torch.Tensor) -> MarchingScene:
        """Upload a view: (V, 3) vertices in camera space, (N, 3) colours and (N,) densities of vertices or cells."""
        backend = self.backend
        if self.per_cell:
            records = backend.floats(torch.cat([vertices, vertices.new_zeros(vertices.shape[0], 1)], dim=1))
            cells = backend.floats(torch.cat([color, density[:, None]], dim=1))
        else:
            records = vertex_records(backend, *(backend.floats(part) for part in (vertices, density, color)))
            cells = None
        return MarchingScene(
            backend,
            self.camera,
            self.optics,
            records,
            cells,
            backend.uints(walk_table(self.mesh)),
            find_entries(backend, self.mesh, vertices, self.camera),
            backend.opaque(self.threshold),
        )


class MarchingFunction(torch.autograd.Function):
    """(V, 3) camera-space vertices, colours, densities to (H, W, 4) radiance and optical depth, (H, W) distance."""

    @staticmethod
    def forward(ctx: Any, task: MarchingTask, vertices: Any, color: Any, density: Any) -> Any:
        """Render; keeps only the image and, while gradients are wanted, the uploaded scene."""
        size = (task.camera.height, task.camera.width)
        with task.backend.exclusive():
            scene = task.scene(vertices, color, density)
            light, distance = render_forward(scene)
            image = task.backend.tensor(light, *size, 4), task.backend.tensor(distance, *size)
        ctx.set_materialize_grads(False)
        ctx.task, ctx.scene = task, scene
        ctx.vertex_count, ctx.field_count = vertices.shape[0], density.shape[0]
        ctx.save_for_backward(*image)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_light: Any, g_distance: Any) -> Any:
        """Walk again with the image's derivatives."""
        backend = ctx.task.backend
        light, distance = ctx.saved_tensors
        needs_vertices, needs_color, needs_density = ctx.needs_input_grad[1:]
        with backend.exclusive(one_thread=ctx.task.deterministic):
            image = ImageAdjoint(
                backend.floats(torch.zeros_like(light) if g_light is None else g_light),
                None if g_distance is None else backend.floats(g_distance),
                backend.floats(light),
                backend.floats(distance),
            )
            gradients = render_adjoint(ctx.scene, image, ctx.vertex_count, needs_vertices)
            field = backend.tensor(gradients.field).reshape(-1, 4)[: ctx.field_count]
            vertices = backend.tensor(gradients.vertices).reshape(-1, 4)[:, :3] if needs_vertices else None
        if vertices is not None:
            vertices = vertices[: ctx.vertex_count]
        return None, vertices, field[:, :3] if needs_color else None, field[:, 3] if needs_density else None
