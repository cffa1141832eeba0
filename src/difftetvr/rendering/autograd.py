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
from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.kernels.adjoint import Gradients, ImageAdjoint, Wanted, render_adjoint
from difftetvr.rendering.kernels.composition import Composition, Pixels
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.kernels.layout import CellSource, GradientSource, VertexSource, collect
from difftetvr.rendering.search.memory_order import MemoryOrder, OrderedMesh
from difftetvr.rendering.tracers.aim import Aim
from difftetvr.rendering.tracers.linked_list import LinkedList
from difftetvr.rendering.tracers.marching import Marching
from difftetvr.rendering.tracers.projected import Projected
from difftetvr.rendering.traversal.bundle import BundleRays
from difftetvr.rendering.traversal.crossing import Tracer, View
from difftetvr.rendering.traversal.rays import KernelRays
from difftetvr.rendering.traversal.transfer import Transfer
from difftetvr.rendering.upload import LaidOut, Upload

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

    def upload(self, vertices: torch.Tensor, pose: torch.Tensor | None, parts: Sequence[torch.Tensor]) -> Upload:
        """What kernels are sent of a view.

        Args:
            vertices: (V, 3) in the space of the rays, or that of the mesh.
            pose: (4, 4) transform from the one to the other; None for the first.
            parts: What the volume holds, see :data:`Content`.
        """
        backend, order = self.backend, MemoryOrder.of(self.mesh)
        tables, is_vertex = order.tables(backend), self.content == "vertex"
        first, second = (None if part is None or not part.numel() else backend.floats(part) for part in parts[:2])
        cells = None
        if self.content == "cell":
            cells = CellSource(backend, tables.cells, second, first, self.channels)
        source = VertexSource(
            backend,
            tables.vertices,
            backend.floats(vertices),
            None if pose is None else backend.floats(pose),
            {"vertex": second, "cell": None, "scalar": first}[self.content],
            is_vertex,
            first if is_vertex else None,
            self.channels if is_vertex else 0,
        )
        return Upload(self.mesh, order, tables, source, cells)

    def rays(self, lines: torch.Tensor | None) -> KernelRays:
        """The rays: a bundle of (N, 6) origins and unit directions, or those of the camera."""
        if lines is not None:
            return BundleRays.of(self.backend, lines, self.order)
        assert self.camera is not None
        return self.camera.kernel_rays(self.backend)

    def tracer(
        self, upload: Upload, laid_out: LaidOut, limits: torch.Tensor | None, rays: KernelRays, parts: Any
    ) -> Tracer:
        """What crosses a mesh that is laid out.

        Args:
            upload: The mesh.
            laid_out: The same, in memory.
            limits: (N, 2) distances between which each ray is looked at; None for all in front of its origin.
            rays: The rays.
            parts: What the volume holds, see :data:`Content`.
        """
        backend = self.backend
        view = View(
            backend,
            rays,
            self.optics,
            self.channels,
            laid_out.records,
            laid_out.cells,
            Transfer.of(backend, parts[1], parts[2]) if self.content == "scalar" else None,
            backend.opaque(self.threshold),
            None if limits is None else backend.floats(limits),
            backend.lanes(rays.lane_count),
        )
        stride, extent = upload.vertices.stride, laid_out.device_extent
        ordered = OrderedMesh(backend, upload.order, upload.tables, laid_out.records, stride, extent)
        scene = upload.scene(laid_out.records, rays)
        tracer: Tracer = TRACERS[self.renderer].of(Aim(view, scene, ordered, self.mesh, laid_out.entries))
        return tracer


class RenderFunction(torch.autograd.Function):
    """From vertices, pose, background, limits, rays and content to an image.

    The outputs are (N, C) channels, (N,) opacity, expected distance and optical depth. The inputs that may require
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
            channels = backend.tensor(image.color)[: shot.count * task.channels].view(shot.count, task.channels)
            pixels = channels, *(backend.tensor(part) for part in (image.alpha, image.depth, image.optical_depth))
        ctx.set_materialize_grads(False)
        ctx.task, ctx.shot, ctx.how, ctx.gathered = task, shot, how, (rendered.light, rendered.distance)
        needs_pose, needs_background = ctx.needs_input_grad[3:5]
        ctx.save_for_backward(
            vertices if needs_pose else None, pose, pixels[3] if needs_background and task.channels else None
        )
        return pixels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *by_image: Any) -> Any:
        """Go through the crossings again with the image's derivatives."""
        task, backend, shot = ctx.task, ctx.task.backend, ctx.shot
        vertices, pose, optical_depth = ctx.saved_tensors
        needs_vertices, needs_pose, needs_background, needs_limits, needs_lines = ctx.needs_input_grad[2:7]
        wanted = Wanted(needs_vertices or needs_pose, needs_limits, needs_lines)
        derivatives = [None if part is None or not part.numel() else backend.floats(part) for part in by_image]
        with backend.exclusive(one_thread=task.deterministic):
            image = ImageAdjoint(Pixels(*derivatives), ctx.how, *ctx.gathered)
            gradients = render_adjoint(shot.tracer, image, task.mesh.num_vertices, wanted)
            positions, channels, values = _collected(task, gradients, pose)
            by_pose = _by_pose(task, gradients, vertices) if needs_pose else None
            limits = backend.tensor(gradients.limits, -1, 2) if needs_limits else None
            lines = backend.tensor(gradients.lines, -1, 6) if needs_lines else None
            parts = [channels, values]
            if gradients.transfer is not None:
                table = backend.tensor(gradients.transfer.values).reshape(-1, 4)
                parts = [values, backend.tensor(gradients.transfer.knots), table]
        by_background = None
        if needs_background and optical_depth is not None and by_image[0] is not None:
            by_background = (torch.exp(-optical_depth)[:, None] * by_image[0]).sum(0)
        asked = (part if needed else None for part, needed in zip(parts, ctx.needs_input_grad[7:], strict=True))
        return None, None, positions if needs_vertices else None, by_pose, by_background, limits, lines, *asked


@dataclass(frozen=True)
class Shot:
    """What is rendered, ready to be.

    Attributes:
        tracer: Finds the crossings.
        count: Number of rays N.
        shift: (N,) how far kernels' origins are from the rays' true ones; None where they are these.
        unit: Unit of length of kernels, in world units.
    """

    tracer: Tracer
    count: int
    shift: Any | None
    unit: float


def _collected(task: RenderTask, gradients: Gradients, pose: torch.Tensor | None) -> tuple[Any, Any, Any]:
    """Gradients in the caller's order: (V, 3) by positions, None if not wanted, (M, C) by channels, (M,) by values."""
    backend, tables = task.backend, MemoryOrder.of(task.mesh).tables(task.backend)
    transform = None if pose is None else backend.floats(pose)
    channels = 0 if task.content == "scalar" else task.channels
    vertices, cells = task.mesh.num_vertices, task.mesh.num_cells
    if task.content == "cell":
        positions, _, _ = _collect(
            GradientSource(backend, tables.vertices, gradients.vertices, transform, None, 0), vertices
        )
        source, count = GradientSource(backend, tables.cells, None, None, gradients.field, channels), cells
        _, by_channel, by_value = _collect(source, count)
    else:
        source = GradientSource(backend, tables.vertices, gradients.vertices, transform, gradients.field, channels)
        positions, by_channel, by_value = _collect(source, vertices)
        count = vertices
    return (
        None if positions is None else backend.tensor(positions, -1, 3)[:vertices],
        backend.tensor(by_channel)[: count * channels].reshape(count, channels),
        backend.tensor(by_value)[:count],
    )


def _collect(source: GradientSource, count: int) -> tuple[Any, Any, Any]:
    if source.vectors is None and source.records is None:
        return None, None, None
    gradients: tuple[Any, Any, Any] = replayed(collect, source, few_lengths(count))
    return gradients


def _by_pose(task: RenderTask, gradients: Gradients, vertices: torch.Tensor) -> torch.Tensor:
    """(4, 4) gradient by the pose that (V, 3) vertices have been transformed by."""
    order = MemoryOrder.of(task.mesh).vertices
    seen = task.backend.tensor(gradients.vertices, -1, 4)[: order.shape[0], :3]
    columns = vertices.index_select(0, order).unbind(1)
    by_rotation = torch.stack([(seen * column[:, None]).sum(0) for column in columns], dim=1)
    return torch.nn.functional.pad(torch.cat((by_rotation, seen.sum(0)[:, None]), 1), (0, 0, 0, 1))
