"""Rendering as a PyTorch operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend
from difftetvr.memory import tried_twice
from difftetvr.mesh import TetMesh
from difftetvr.optics import OpticalModel
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.flags import flags_here, with_flags
from difftetvr.rendering.kernels.adjoint import ImageAdjoint, Wanted, render_adjoint
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.tracers.linked_list import LinkedList
from difftetvr.rendering.tracers.marching import Marching
from difftetvr.rendering.tracers.projected import Projected
from difftetvr.rendering.traversal.bundle import BundleRays
from difftetvr.rendering.traversal.crossing import Tracer, View, vertex_records
from difftetvr.rendering.traversal.rays import KernelRays
from difftetvr.rendering.traversal.records import Records
from difftetvr.rendering.traversal.transfer import Transfer

Content = Literal["vertex", "cell", "scalar"]
"""What a volume holds: (V, C) channels and (V,) densities on vertices, (T, C) and (T,) on cells, or (V,) scalars, (K,)
knots and (K, 4) densities and colours of their transfer function."""

TRACERS: dict[str, Any] = {"marching": Marching, "linked-list": LinkedList, "projected": Projected}
"""How crossings are found and ordered, by the name of the renderer."""


@dataclass(frozen=True)
class RenderTask:
    """What a view needs besides tensors that may require gradients.

    Attributes:
        backend: Where kernels run.
        mesh: The mesh, for its topology.
        camera: The camera whose rays are traced; None for a bundle of rays.
        order: (N,) int32 number of the ray that each lane of a bundle has; None for rays as they are numbered.
        optics: Optical model of one cell.
        content: What the volume holds.
        channels: Number of channels C that are seen.
        threshold: Transmittance at or below which rays stop.
        deterministic: Whether sums over rays have a fixed order.
        renderer: How crossings are found.
    """

    backend: Backend
    mesh: TetMesh
    camera: Camera | None
    order: torch.Tensor | None
    optics: OpticalModel
    content: Content
    channels: int
    threshold: float
    deterministic: bool
    renderer: str = "marching"

    def tracer(
        self,
        vertices: torch.Tensor,
        limits: torch.Tensor | None,
        lines: torch.Tensor | None,
        parts: Sequence[torch.Tensor],
    ) -> Tracer:
        """Upload a view.

        Args:
            vertices: (V, 3) in camera space, or that of the rays.
            limits: (N, 2) distances between which each ray is looked at; None for all in front of its origin.
            lines: (N, 6) origins and unit directions of a bundle of rays; None for those of the camera.
            parts: What the volume holds, see :data:`Content`.
        """
        backend = self.backend
        cells = transfer = None
        if self.content == "vertex":
            color, density = (backend.floats(part) for part in parts)
            records = vertex_records(backend, backend.floats(vertices), density, color, self.channels)
        elif self.content == "cell":
            color, density = parts
            records = _with_fourth(backend, vertices, vertices.new_zeros(vertices.shape[0]))
            cells = backend.floats(Records(self.channels).pack(color, density))
        else:
            scalar, knots, values = parts
            records = _with_fourth(backend, vertices, scalar)
            transfer = Transfer.of(backend, knots, values)
        view = View(
            backend,
            self._rays(lines),
            self.optics,
            self.channels,
            records,
            cells,
            transfer,
            backend.opaque(self.threshold),
            None if limits is None else backend.floats(limits),
        )
        tracer: Tracer = TRACERS[self.renderer].of(view, self.mesh, vertices)
        return tracer

    def _rays(self, lines: torch.Tensor | None) -> KernelRays:
        if lines is not None:
            return BundleRays.of(self.backend, lines, self.order)
        assert self.camera is not None
        return self.camera.kernel_rays(self.backend)


def _with_fourth(backend: Backend, vertices: torch.Tensor, values: torch.Tensor) -> Any:
    """Flat (V, 4) records of positions and one value each."""
    return backend.floats(torch.cat([vertices, values[:, None]], dim=1))


class RenderFunction(torch.autograd.Function):
    """From vertices, limits, rays and content to (N, width) records of channels and optical depth, (N,) distance.

    The inputs are those of :meth:`RenderTask.tracer`.
    """

    @staticmethod
    def forward(ctx: Any, task: RenderTask, vertices: Any, limits: Any, lines: Any, *parts: Any) -> Any:
        """Render; keeps only the image and, while gradients are wanted, the uploaded view."""
        with task.backend.exclusive():
            tracer = task.tracer(vertices, limits, lines, parts)
            light, distance = render_forward(tracer)
            image = task.backend.tensor(light, -1, tracer.view.records.width), task.backend.tensor(distance)
        ctx.set_materialize_grads(False)
        ctx.task, ctx.tracer, ctx.flags = task, tracer, flags_here()
        ctx.vertex_count, ctx.part_size = vertices.shape[0], parts[0].shape[0]
        ctx.save_for_backward(*image)
        return image

    @staticmethod
    @once_differentiable
    @tried_twice
    def backward(ctx: Any, g_light: Any, g_distance: Any) -> Any:
        """Go through the crossings again with the image's derivatives."""
        backend = ctx.task.backend
        light, distance = ctx.saved_tensors
        wanted = Wanted(*ctx.needs_input_grad[1:4])
        with with_flags(ctx.flags), backend.exclusive(one_thread=ctx.task.deterministic):
            image = ImageAdjoint(
                backend.floats(torch.zeros_like(light) if g_light is None else g_light),
                None if g_distance is None else backend.floats(g_distance),
                backend.floats(light),
                backend.floats(distance),
            )
            gradients = render_adjoint(ctx.tracer, image, ctx.vertex_count, wanted)
            vertices = (
                backend.tensor(gradients.vertices).reshape(-1, 4)[: ctx.vertex_count, :3] if wanted.vertices else None
            )
            limits = backend.tensor(gradients.limits, -1, 2) if wanted.limits else None
            lines = backend.tensor(gradients.lines, -1, 6) if wanted.lines else None
            field = backend.tensor(gradients.field)
            parts: tuple[torch.Tensor, ...]
            if gradients.transfer is None:
                records = ctx.tracer.view.records
                parts = records.unpack(field.reshape(-1, records.width)[: ctx.part_size])
            else:
                values = backend.tensor(gradients.transfer.values).reshape(-1, 4)
                parts = field[: ctx.part_size], backend.tensor(gradients.transfer.knots), values
        asked = (part if needed else None for part, needed in zip(parts, ctx.needs_input_grad[4:], strict=True))
        return None, vertices, limits, lines, *asked
