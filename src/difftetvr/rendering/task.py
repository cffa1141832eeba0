"""What is rendered, and how it is brought to kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.optics import OpticalModel
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.kernels.layout import CellSource, VertexSource
from difftetvr.rendering.prepared_rays import PreparedRays
from difftetvr.rendering.search.bundle_hits import Stretches
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.search.plan import SearchPlan
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
    optics: OpticalModel
    content: Content
    channels: int
    threshold: float
    deterministic: bool
    renderer: str = "marching"
    has_features: bool = False

    def upload(self, vertices: torch.Tensor, pose: torch.Tensor | None, parts: Sequence[torch.Tensor]) -> Upload:
        """What kernels are sent of a view.

        Args:
            vertices: (V, 3) in the space of the rays, or that of the mesh.
            pose: (4, 4) transform from the one to the other; None for the first.
            parts: What the volume holds, see :data:`Content`.
        """
        backend, order = self.backend, MemoryOrder.of(self.mesh)
        tables = order.tables(backend)
        # Arrays without elements are left out: fields may have no channels.
        arrays = [backend.floats(part) if part.numel() else None for part in parts]
        cells = channels = value = None
        if self.content == "cell":
            cells = CellSource(backend, tables.cells, arrays[1], arrays[0], self.channels)
        elif self.has_features:
            value = arrays[1]
            if self.channels:
                cells = CellSource(backend, tables.cells, None, arrays[0], self.channels)
        elif self.content == "vertex":
            channels, value = arrays
        else:
            value = arrays[0]
        source = VertexSource(
            backend,
            tables.vertices,
            backend.floats(vertices),
            None if pose is None else backend.floats(pose),
            value,
            self.content == "vertex",
            channels,
            self.channels if channels is not None else 0,
        )
        return Upload(self.mesh, order, tables, source, cells)

    def rays(self, bundle: PreparedRays | None) -> KernelRays:
        """The rays: those of a bundle, or of the camera."""
        if bundle is not None:
            return BundleRays.of(self.backend, bundle.counted.lines, bundle.order)
        assert self.camera is not None
        return self.camera.kernel_rays(self.backend)

    def plan(self, rays: KernelRays, bundle: PreparedRays | None, ends: Any | None) -> SearchPlan | None:
        """What the tracer has to know of the rays first.

        Args:
            rays: The rays.
            bundle: The same, where they are not a camera's.
            ends: Flat (N, 2) distances between which each ray is looked at; None for all of it.
        """
        backend, stretches = self.backend, None
        if not rays.count:
            return None
        if bundle is not None:
            stretches = Stretches.of(backend, rays.lane_count, ends, bundle.sees_all, bundle.begins_at_point)
        plan: SearchPlan | None = TRACERS[self.renderer].plan(backend, self.mesh, rays, stretches)
        return plan

    def tracer(self, upload: Upload, laid_out: LaidOut, ends: Any | None, rays: KernelRays, parts: Any) -> Tracer:
        """What crosses a mesh that is laid out.

        Args:
            upload: The mesh.
            laid_out: The same, in memory.
            ends: Flat (N, 2) distances between which each ray is looked at; None for all in front of its origin.
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
            self.content == "cell",
            Transfer.of(backend, parts[-2], parts[-1]) if self.content == "scalar" else None,
            backend.constant(float(self.threshold)),
            ends,
            backend.lanes(rays.lane_count),
        )
        aim = Aim(view, upload.scene(laid_out.records, rays), self.mesh, laid_out.found)
        tracer: Tracer = TRACERS[self.renderer].of(aim)
        return tracer
