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
from difftetvr.rendering.kernels.adjoint import ImageAdjoint, render_adjoint
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.kernels.gradients import Gradients, Wanted
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
knots and (K, 4) densities and colours of their transfer function. Features are (T, C) channels of cells: they come
before these, instead of the channels of vertices or of the transfer function."""

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
        has_features: Whether channels are those of cells, while the density is not.
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
    has_features: bool = False

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
        if self.has_features:
            features, *parts = parts
            if self.channels:
                cells = backend.floats(Records(self.channels).pack(features, features.new_zeros(len(features))))
        if self.content == "vertex" and self.has_features:
            records = _with_fourth(backend, vertices, parts[0])
        elif self.content == "vertex":
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
            self.content == "cell",
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
        ctx.task, ctx.tracer = task, tracer
        ctx.save_for_backward(*image)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_light: Any, g_distance: Any) -> Any:
        """Go through the crossings again with the image's derivatives."""
        backend = ctx.task.backend
        light, distance = ctx.saved_tensors
        wanted = Wanted(*ctx.needs_input_grad[1:4])
        with backend.exclusive(one_thread=ctx.task.deterministic):
            image = ImageAdjoint(
                backend.floats(torch.zeros_like(light) if g_light is None else g_light),
                None if g_distance is None else backend.floats(g_distance),
                backend.floats(light),
                backend.floats(distance),
            )
            gradients = render_adjoint(ctx.tracer, image, ctx.task.mesh.num_vertices, wanted)
            geometry, parts = gradient_tensors(ctx.task, gradients)
        asked = (part if needed else None for part, needed in zip(parts, ctx.needs_input_grad[4:], strict=True))
        return None, *geometry, *asked


def gradient_tensors(
    task: RenderTask, gradients: Gradients
) -> tuple[tuple[torch.Tensor | None, ...], list[torch.Tensor | None]]:
    """Derivatives by vertices, limits and lines, None for those not wanted, and by all parts of the content."""
    backend, records, count = task.backend, Records(task.channels), task.mesh.num_vertices
    vertices = None if gradients.vertices is None else backend.tensor(gradients.vertices, -1, 4)[:count, :3]
    limits = None if gradients.limits is None else backend.tensor(gradients.limits, -1, 2)
    lines = None if gradients.lines is None else backend.tensor(gradients.lines, -1, 6)
    parts: list[torch.Tensor | None] = []
    if gradients.cells is not None:
        parts += records.unpack(backend.tensor(gradients.cells, -1, records.width)[: task.mesh.num_cells])
    if task.has_features:
        parts = parts[:1] or [None]
    if task.content == "vertex" and not task.has_features:
        parts += records.unpack(backend.tensor(gradients.field, -1, records.width)[:count])
    elif task.content != "cell":
        parts.append(backend.tensor(gradients.field)[:count])
    if gradients.transfer is not None:
        transfer = gradients.transfer
        parts += [backend.tensor(transfer.knots), backend.tensor(transfer.values, -1, 4)]
    return (vertices, limits, lines), parts
