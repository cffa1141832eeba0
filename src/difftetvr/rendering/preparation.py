"""From what callers pass to what kernels take: checks, the space of the rays, precision and units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import torch

from difftetvr.backend import backend_for, require_own_threads
from difftetvr.errors import DiffTetError, MeshError, shown
from difftetvr.inputs import as_number, handed_over, require_type
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import ConstantPerCell, ExactLinear, OpticalModel
from difftetvr.rendering.autograd import Shot
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.cell_features import CellFeatures
from difftetvr.rendering.clip_plane import clip_limits
from difftetvr.rendering.kernels.layout import LARGEST
from difftetvr.rendering.prepared_rays import GivenBundle, PreparedRays
from difftetvr.rendering.rays import Rays, RaySource
from difftetvr.rendering.scalar_field import ScalarField
from difftetvr.rendering.task import TRACERS, Content, RenderTask
from difftetvr.rendering.traversal.crossing import Tracer
from difftetvr.rendering.traversal.rays import KernelRays
from difftetvr.rendering.upload import Extent, LaidOut, Upload, lay_out
from difftetvr.rendering.viewpoints import Viewpoint

RENDERERS = tuple(TRACERS)
CAMERAS = "pass a difftetvr.Camera, a list of cameras, or difftetvr.Rays"
_REMOTE = 64.0  # distances of sizes of the mesh from which float32 loses more than the tests allow it
_SMALL = 1 / LARGEST  # between these, coordinates are left as they are


@dataclass(frozen=True)
class ViewOptions:
    """How a view is rendered; see :func:`difftetvr.render`.

    Attributes:
        is_parallel: Whether colours that depend on the direction are those of parallel rays also where rays share the
            point where they start, as a single one does.
    """

    optics: OpticalModel | None = None
    transmittance_threshold: float = 0.0
    deterministic: bool = False
    renderer: str = "marching"
    is_parallel: bool = False


@dataclass(frozen=True)
class PreparedView:
    """A view as kernels take it.

    Attributes:
        task: What it needs besides tensors that may require gradients.
        shape: Of the image or bundle; N is the number of its rays.
        vertices: (V, 3) in a unit in which products neither vanish nor overflow.
        pose: (4, 4) transform from their space to that of the rays; None where these are the same.
        parts: What the volume holds, see :data:`difftetvr.rendering.task.Content`; densities are in that unit.
        unit: The unit, in world units.
        bundle: The rays, where they are not a camera's.
        ends: Flat (N, 2) distances in that unit between which rays are looked at, in kernels' memory; None for all in
            front of their origins.
        followed: The same as a tensor; None where autograd need not follow it.
        rays: The rays as kernels read them.
        upload: What was sent to kernels.
        laid_out: What they made of it.
        viewpoint: What colours were seen from that depend on the direction; None where they do not.
    """

    task: RenderTask
    shape: tuple[int, ...]
    vertices: torch.Tensor
    pose: torch.Tensor | None
    parts: tuple[torch.Tensor, ...]
    unit: float
    bundle: PreparedRays | None
    ends: Any | None
    followed: torch.Tensor | None
    rays: KernelRays
    upload: Upload
    laid_out: LaidOut
    viewpoint: Viewpoint | None = None

    def tracer(self, ends: Any | None) -> Tracer:
        """What crosses the mesh along the rays between flat (N, 2) ends, which may be others than the view's."""
        return self.task.tracer(self.upload, self.laid_out, ends, self.rays, self.parts)

    def shot(self) -> Shot:
        """The view, ready to be rendered."""
        shift = None if self.bundle is None else self.bundle.counted.shift
        return Shot(self.tracer(self.ends), self.shape, shift, self.unit)

    def empty(self, shape: tuple[int, ...]) -> torch.Tensor:
        """What there is to see of no rays, in the precision of the mesh; autograd knows what it is no part of."""
        tensors = (self.vertices, *self.parts, *(() if self.lines is None else (self.lines,)))
        nothing = sum((tensor.reshape(-1)[:0].sum() for tensor in tensors), self.vertices.new_zeros(()))
        return nothing.to(self.task.mesh.vertices.dtype).expand(shape)

    @property
    def lines(self) -> torch.Tensor | None:
        """(N, 6) origins and unit directions of the rays, in that unit; None where autograd need not follow them."""
        return None if self.bundle is None else self.bundle.lines

    @property
    def limits(self) -> torch.Tensor | None:
        """(N, 2) distances in that unit between which rays are looked at; None for all in front of their origins."""
        if self.followed is not None or self.ends is None:
            return self.followed
        return self.task.backend.tensor(self.ends, -1, 2)

    @property
    def shift(self) -> torch.Tensor | None:
        """(N,) how far kernels' origins are from the rays' true ones, in world units; None where they are these."""
        return None if self.bundle is None else self.task.backend.at(None).tensor(self.bundle.counted.shift)


def prepare_view(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays,
    options: ViewOptions,
    clip_plane: Any = None,
) -> PreparedView:
    """Check a view's inputs and bring them to kernels; arguments and errors are those of :func:`difftetvr.render`."""
    options = _checked(mesh, field, camera, options)
    require_own_threads()  # here already, since in a copy of a process torch may hang, too
    source = camera.relative_to(mesh.origin) if is_plain(camera) else as_rays(camera)
    given, (field, viewpoint) = field, _seen(mesh, field, source, options.is_parallel)
    content, parts = _content(mesh, field)
    for tensor in parts:
        if tensor.device != mesh.vertices.device:
            raise MeshError(
                f"The field is on '{tensor.device}', the mesh on '{mesh.vertices.device}'; move one of them."
            )
    passed: _Passed
    if isinstance(source, Camera):
        shape: tuple[int, ...] = (source.height, source.width)
        clip = None if clip_plane is None else clip_limits(clip_plane, source, mesh.vertices, mesh.origin)
        pose = handed_over(source.world_to_camera, mesh.vertices)
        passed = _Passed(mesh.vertices, pose, parts, 1.0, None, clip)
    else:
        shape = tuple(source.shape)
        passed = _Passed(mesh.vertices, None, parts, 1.0, GivenBundle.of(source, mesh, clip_plane), None)
    has_features = isinstance(field, CellFeatures) and content != "cell"
    task = RenderTask(
        backend_for(mesh.vertices),
        mesh,
        source if isinstance(source, Camera) else None,
        options.optics or (ConstantPerCell() if content == "cell" else ExactLinear()),
        content,
        3 if content == "scalar" and not has_features else parts[0].shape[1],
        options.transmittance_threshold,
        options.deterministic,
        options.renderer,
        has_features,
    )
    if task.renderer == "marching":
        mesh.topology.cell_adjacency  # noqa: B018  refuses loose cells, which have none
    view = _laid_out(task, shape, passed)
    if not _is_common(view):
        if not view.laid_out.extent.is_sound and not isinstance(given, ScalarField):
            given.validate(mesh)
        task, passed = _uncommon(task, passed)
        view = _laid_out(task, shape, passed)
    return view if viewpoint is None else replace(view, viewpoint=viewpoint)


@dataclass(frozen=True)
class _Passed:
    """What is passed to kernels, see :class:`PreparedView`; a bundle and (H, W, 2) ends of a camera's rays as given."""

    vertices: torch.Tensor
    pose: torch.Tensor | None
    parts: tuple[torch.Tensor, ...]
    unit: float
    bundle: GivenBundle | None
    clip: torch.Tensor | None


def _laid_out(task: RenderTask, shape: tuple[int, ...], passed: _Passed) -> PreparedView:
    backend, bundle = task.backend, None
    parts = tuple(part.to(backend.dtype) for part in passed.parts)
    followed = None if passed.clip is None else passed.clip.reshape(-1, 2).to(backend.dtype) / passed.unit
    ends = None if followed is None else backend.floats(followed)
    with backend.exclusive():
        if passed.bundle is not None:
            bundle = PreparedRays.of(passed.bundle, task.mesh, backend, passed.unit)
            followed, ends = bundle.limits, bundle.ends
        rays: Any = task.rays(bundle)
        upload = task.upload(passed.vertices, passed.pose, parts)
        laid_out = lay_out(upload, rays, task.plan(rays, bundle, ends))
    if laid_out.sees_all:
        followed = ends = None
    passed_on = passed.vertices, passed.pose, parts, passed.unit
    return PreparedView(task, shape, *passed_on, bundle, ends, followed, rays, upload, laid_out)


def _is_common(view: PreparedView) -> bool:
    """Whether a view can be rendered as it is: all is finite, neither huge nor tiny nor far away for its precision."""
    extent, task = view.laid_out.extent, view.task
    is_sized = extent.largest == 0.0 or _SMALL < extent.largest < LARGEST
    if not (extent.is_sound and is_sized):
        return False
    return task.camera is None or not _is_blurred(extent, view.vertices)


def _uncommon(task: RenderTask, passed: _Passed) -> tuple[RenderTask, _Passed]:
    """The same view in float64 or another unit, where that helps.

    Raises:
        MeshError: Nothing helps.
    """
    mesh = task.mesh
    positions = mesh.vertices if task.camera is None else _camera_space(mesh, task.camera)
    parts = tuple(part.to(positions.dtype) for part in passed.parts)
    if task.content != "scalar":
        color = parts[1].new_zeros(len(parts[1]), 0) if task.has_features else parts[0]
        Field(color, parts[1], task.content).validate(mesh)
    vertices, unit = _unit_of_length(positions, mesh)
    task = replace(task, backend=backend_for(vertices))
    parts = _parts_by_unit(task.content, parts, unit)
    return task, replace(passed, vertices=vertices, pose=None, parts=parts, unit=unit)


def _checked(mesh: Any, field: Any, camera: Any, options: ViewOptions) -> ViewOptions:
    """Refuse arguments of the wrong kind, those first that come in batches elsewhere."""
    require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", DiffTetError)
    fields = (Field, ScalarField, CellFeatures)
    require_type(field, fields, "field", "pass one difftetvr.Field, ScalarField or CellFeatures", DiffTetError)
    # The protocol is slow to ask.
    if type(camera) is not Camera and (isinstance(camera, type) or not isinstance(camera, (Rays, RaySource))):
        raise DiffTetError(f"camera is {shown(camera)}; {CAMERAS}.")
    optics, renderer = options.optics, options.renderer
    has_model = not isinstance(optics, type) and all(callable(getattr(optics, n, None)) for n in ("weights", "adjoint"))
    if not (optics is None or has_model):
        raise DiffTetError(f"optics is {shown(optics)}; pass a model, such as difftetvr.optics.ExactLinear().")
    if not isinstance(renderer, str) or renderer not in RENDERERS:
        raise DiffTetError(f"There is no renderer {shown(renderer)}; choose one of {', '.join(RENDERERS)}.")
    if renderer == "projected" and not is_plain(camera):
        raise DiffTetError(
            "The renderer 'projected' needs one order of cells for the whole view, and knows it for pinhole cameras "
            "alone, whose intrinsics require no gradient; choose marching or linked-list."
        )
    require_type(options.deterministic, bool, "deterministic", "pass True or False", DiffTetError)
    threshold = as_number(options.transmittance_threshold, "transmittance_threshold", DiffTetError)
    if not 0.0 <= threshold < 1.0:
        raise DiffTetError(f"transmittance_threshold is {threshold}; it must lie in [0, 1).")
    return replace(options, transmittance_threshold=threshold)


def is_plain(camera: RaySource | Rays) -> TypeGuard[Camera]:
    """Whether it is a camera that can be rasterised, and whose rays need no gradients but by the pose."""
    return type(camera) is Camera and camera.intrinsics is None


def as_rays(camera: RaySource | Rays) -> Rays:
    """The rays of a camera, or what are rays.

    Raises:
        DiffTetError: It makes no rays.
    """
    if isinstance(camera, Rays):
        return camera
    make: Any = camera.rays
    rays: Rays = make() if callable(make) else make
    require_type(rays, Rays, "What the camera's rays() returns", "return difftetvr.Rays", DiffTetError)
    return rays


def _seen(
    mesh: TetMesh, field: Field | ScalarField | CellFeatures, camera: Camera | Rays, is_parallel: bool
) -> tuple[Field | ScalarField | CellFeatures, Viewpoint | None]:
    """A field without harmonics, as it is seen from a camera or along rays, and from where that is."""
    if not isinstance(field, Field) or field.harmonics is None:
        return field, None
    viewpoint = Viewpoint.of(mesh, camera, is_parallel)
    return viewpoint.seen(field, mesh), viewpoint


def _content(mesh: TetMesh, field: Field | ScalarField | CellFeatures) -> tuple[Content, tuple[torch.Tensor, ...]]:
    """What the volume holds, and its tensors as they are."""
    location = field.location_on(mesh)
    if isinstance(field, CellFeatures):
        content, medium = _content(mesh, field.without_colours())
        return content, (field.features, *(medium if content == "scalar" else medium[1:]))
    if isinstance(field, ScalarField):
        if location == "vertex":
            return "scalar", (field.normalised(), *field.knots(mesh.vertices))
        field = field.as_field()
    return location, (field.color, field.density)


def _camera_space(mesh: TetMesh, camera: Camera) -> torch.Tensor:
    """(V, 3) vertices in camera space, in float64 where float32 would blur what the camera sees.

    A narrow view from far away sees differences of positions that are much smaller than their distance. Where only the
    transform cancels, as for a mesh far from the origin that the camera is near to, its result is float32 again.
    """
    vertices = mesh.vertices
    rounded = camera.to_camera_space(vertices)
    low, high = torch.aminmax(rounded.detach(), dim=0)
    shift = max(abs(row[3]) for row in camera.world_to_camera.tolist()[:3])
    extent = Extent(tuple(low.tolist()), tuple(high.tolist()), True, shift)
    if not _is_blurred(extent, vertices):
        return rounded
    exact = camera.to_camera_space(vertices.double())
    return exact if _is_remote(extent) else exact.float()


def _is_blurred(extent: Extent, vertices: torch.Tensor) -> bool:
    """Whether float32 does not resolve what a camera sees of vertices of some extent, and float64 is there."""
    if backend_for(vertices).at(None).dtype == vertices.dtype:
        return False
    if _is_remote(extent):
        return True
    return extent.shift > _REMOTE * max(abs(extent.low[2]), abs(extent.high[2]))


def _is_remote(extent: Extent) -> bool:
    nearest, size = extent.low[2], max(high - low for low, high in zip(extent.low, extent.high, strict=True))
    return nearest > _REMOTE * size


def _unit_of_length(vertices: torch.Tensor, mesh: TetMesh) -> tuple[torch.Tensor, float]:
    """Vertices in a unit in which float32 products of them neither vanish nor overflow, and that unit.

    The unit is a power of two, so nothing is rounded, and 1 for all meshes of common sizes.
    """
    low, high = torch.aminmax(vertices.detach())
    largest = max(-float(low), float(high))
    if not math.isfinite(largest):
        bad = torch.nonzero(~torch.isfinite(mesh.vertices.detach()).all(dim=1)).flatten().tolist()
        where = f"Vertex {bad[0]} of the mesh" if bad else "A vertex, seen from the camera,"
        raise MeshError(f"{where} is not finite; check what moved it.")
    if largest == 0.0 or _SMALL < largest < LARGEST:
        return vertices, 1.0
    unit = 2.0 ** math.frexp(largest)[1]
    return vertices / unit, unit


def _parts_by_unit(content: Content, parts: tuple[torch.Tensor, ...], unit: float) -> tuple[torch.Tensor, ...]:
    """The content with densities per unit of length."""
    if unit == 1.0:
        return parts
    if content == "scalar":
        return (*parts[:-1], torch.cat((_by_unit(parts[-1][:, :1], unit), parts[-1][:, 1:]), dim=1))
    return parts[0], _by_unit(parts[1], unit)


def _by_unit(density: torch.Tensor, unit: float) -> torch.Tensor:
    """Densities per unit of length; beyond what the precision holds they are as great as it allows, never infinite."""
    return (density * unit).clamp(max=torch.finfo(density.dtype).max)
