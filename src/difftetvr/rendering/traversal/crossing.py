"""Crossings of cells by rays, and what renderers and optics agree on (Dr.Jit).

A renderer, here a *tracer*, answers which cells each ray crosses, in which order, from where to where. A *kernel*
answers what a crossing does: it gathers light (``forward``) or derivatives (``adjoint``). Every kernel runs in every
tracer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.optics import OpticalModel
from difftetvr.rendering.traversal.rays import Frame, KernelRays, Lanes
from difftetvr.rendering.traversal.records import Records, gather_values, packets_of
from difftetvr.rendering.traversal.transfer import Transfer
from difftetvr.rendering.traversal.walk import Corner, Exit, Face, find_exit, interpolate, make_face


@dataclass
class View:
    """What kernels read of a mesh with its field, seen along some rays, as flat Dr.Jit arrays.

    Attributes:
        backend: Array types.
        rays: The rays.
        optics: Optical model of one cell.
        channels: Number of channels C that are seen.
        vertices: Vertex records: (V, 4) x, y, z and the density or scalar, 0 if cells hold the density; or x, y, z,
            density, then the channels in whole packets of four, so that for RGB one cache line holds all of a vertex.
        cells: Records of channels and density of cells, see :class:`difftetvr.rendering.traversal.records.Records`;
            None where channels, if any, are those of vertices or of a transfer function.
        has_cell_density: Whether the density is that of cells, too.
        transfer: Transfer function of the vertices' scalars, None where vertices or cells have densities.
        threshold: Transmittance at or below which light counts as gone, as a device value.
        limits: (N, 2) distances between which each ray is looked at, None for all in front of its origin.
        lane: The numbers of all lanes.
    """

    backend: Backend
    rays: KernelRays
    optics: OpticalModel
    channels: int
    vertices: Any
    cells: Any | None
    has_cell_density: bool
    transfer: Transfer | None
    threshold: Any
    limits: Any | None
    lane: Any

    @property
    def records(self) -> Records:
        """Layout of what a ray gathers, and of what a vertex or cell holds."""
        return Records(self.channels)

    @property
    def lanes(self) -> Lanes:
        """All rays, one a lane."""
        return self.rays.of_lanes(self.lane)

    @property
    def has_vertex_channels(self) -> bool:
        """Whether channels are those of vertices, which rays gather as they drop them."""
        return self.channels > 0 and self.cells is None and self.transfer is None


@dataclass
class Step:
    """One crossing of a cell: the faces it enters and leaves through, and the interpolated values there."""

    cell: Any
    face: Face
    apex: Corner
    exit: Exit
    next_face: Face
    entry: list[Any]
    leaving: list[Any]

    @staticmethod
    def through(cell: Any, face: Face, entry: list[Any], apex: Corner) -> Step:
        """The crossing that enters a cell through a face, where the values are ``entry``."""
        way_out = find_exit(face, apex)
        next_face = way_out.face(face, apex)
        return Step(cell, face, apex, way_out, next_face, entry, interpolate(next_face))


class Kernel(Protocol):
    """What is done at crossings. A ray's state is a PyTree."""

    def start(self) -> Any:
        """State of the rays before their first crossing."""

    def read(self, vertex: Any, active: Any) -> Corner:
        """A vertex as the ray sees it."""

    def visit(self, step: Step, ray: Any) -> Any:
        """Cross a cell; the corners that stay are those of the next step's entry face. Returns the new state."""

    def goes_on(self, ray: Any) -> Any:
        """Whether a ray has something to gather from the cells that are still ahead of it."""

    def leave(self, face: Face, ray: Any, active: Any) -> Any:
        """Finish what the corners carry at a face with no next step behind it. Returns the new state."""

    def finish(self, ray: Any) -> None:
        """Store what is to be kept of the rays."""


class Tracer(Protocol):
    """Finds the crossings of all rays of a view and orders them front to back."""

    view: View
    starts_inside: bool
    """Whether some crossings begin behind the camera and must be clipped there."""

    def trace(self, make_kernel: Callable[[Lanes], Kernel]) -> None:
        """Run a kernel on all crossings."""

    def on_lanes(self, lane: Any) -> Tracer | None:
        """The same for the rays of some lanes; None for tracers that launch more than one kernel for all rays."""


def cross_cell(kernel: Kernel, cell: Any, vertices: list[Any], ray: Any, active: Any) -> Any:
    """One crossing on its own, that shares no corner with the one before or behind it.

    Args:
        kernel: What to do.
        cell: The cell.
        vertices: Corners of the face through which the ray enters, counter-clockwise in its plane, and the apex.
        ray: State of the rays.
        active: Mask.

    Returns:
        The new state.
    """
    corners = [kernel.read(vertex, active) for vertex in vertices]
    face = make_face(corners[:3])
    step = Step.through(cell, face, interpolate(face), corners[3])
    ray = kernel.visit(step, ray)
    return kernel.leave(step.next_face, ray, active)


def read_vertex(view: View, vertex: Any, active: Any) -> tuple[Any, list[Any]]:
    """A vertex's position record and its attribute: density, a scalar, or none where cells hold the density."""
    stride = 1 + packets_of(view.channels) if view.has_vertex_channels else 1
    position = dr.gather(view.backend.Float4, view.vertices, stride * vertex if stride > 1 else vertex, active)
    return position, [] if view.has_cell_density else [position[3]]


def read_channels(view: View, vertex: Any, active: Any) -> list[Any]:
    """A vertex's channels."""
    first = (1 + packets_of(view.channels)) * vertex + 1
    return gather_values(view.backend, view.vertices, first, view.channels, active)


def corner_of(frame: Frame, vertex: Any, record: Any, values: list[Any], adjoints: int) -> Corner:
    """A vertex record as a ray sees it, with ``adjoints`` accumulators at zero."""
    a, b, t = frame.project(record[0], record[1], record[2])
    zero = type(a)(0)
    return Corner(vertex, a, b, [t, *values], [zero for _ in range(adjoints)])


def inverse_length(t0: Any, t1: Any) -> Any:
    """One over the length of a crossing, 1 where rounding leaves none."""
    return 1.0 / dr.select(t1 > t0, t1 - t0, 1.0)


@dataclass
class Span:
    """The part of each ray that is looked at, from distance ``near`` to ``far``; no end where ``far`` is None."""

    near: Any
    far: Any | None

    @staticmethod
    def of(tracer: Tracer, rays: Lanes) -> Span | None:
        """What the view asks for; None where nothing has to be clipped."""
        view = tracer.view
        if view.limits is not None:
            limits = dr.gather(view.backend.Float2, view.limits, rays.pixel, rays.valid)
            return Span(limits[0], limits[1])
        return Span(view.backend.Float(0), None) if tracer.starts_inside else None

    def clip(self, t0: Any, t1: Any) -> Clip:
        """The part of a crossing from t0 to t1 that lies in the span.

        An end of the span that is exactly at a face decides there, and does so in one of the face's cells alone.
        """
        inverse = inverse_length(t0, t1)
        at_near = t0 <= self.near
        first = dr.select(at_near, dr.fmin((self.near - t0) * inverse, 1.0), 0.0)
        first = dr.select(t1 <= self.near, 1.0, first)
        if self.far is None:
            return Clip(first, type(first)(1), at_near, dr.zeros(dr.mask_t(first)))
        at_far = t1 >= self.far
        last = dr.select(at_far, dr.fmax((self.far - t0) * inverse, 0.0), 1.0)
        return Clip(first, dr.fmax(last, first), at_near, at_far)


@dataclass
class Clip:
    """The part of a crossing from x = ``first`` to ``last`` in [0, 1], and whether the span's ends decide it."""

    first: Any
    last: Any
    at_near: Any
    at_far: Any

    def start(self, entry: list[Any], leaving: list[Any]) -> list[Any]:
        """Values where the part starts; exactly those where it ends if it is none."""
        begins = self.first < 1.0
        return [dr.select(begins, dr.fma(self.first, v1 - v0, v0), v1) for v0, v1 in zip(entry, leaving, strict=True)]

    def end(self, entry: list[Any], leaving: list[Any]) -> list[Any]:
        """Values where the part ends."""
        return [
            dr.select(self.at_far, dr.fma(self.last, v1 - v0, v0), v1) for v0, v1 in zip(entry, leaving, strict=True)
        ]

    def unclipped(self, at_start: Any, at_end: Any) -> tuple[Any, Any]:
        """Weights of the crossing's own ends from those of the part's: the transpose of :meth:`start`, :meth:`end`."""
        last = dr.select(self.at_far, self.last, 1.0)
        entry = dr.fma(1.0 - self.first, at_start, (1.0 - last) * at_end)
        return entry, dr.fma(self.first, at_start, last * at_end)
