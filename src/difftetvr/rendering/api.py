"""``render``: from a mesh, its field and a camera to an image, differentiable in all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.backend import backend_for, eager, require_own_threads
from difftetvr.errors import DiffTetError, MeshError, shown
from difftetvr.inputs import as_number, as_reals, require_type
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import ConstantPerCell, ExactLinear, OpticalModel
from difftetvr.rendering.autograd import TRACERS, Content, RenderFunction, RenderTask
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.clip_plane import clip_limits
from difftetvr.rendering.scalar_field import ScalarField

RENDERERS = tuple(TRACERS)
_REMOTE = 64.0  # distances of sizes of the mesh from which float32 loses more than the tests allow it
_KNOW_FLOAT64 = ("cpu", "cuda")
_SMALL = 1e-6  # within this and its inverse, coordinates are left as they are


@dataclass(frozen=True)
class RenderedImage:
    """An image of a tetrahedral volume.

    Attributes:
        color: (H, W, 3) premultiplied radiance, linear RGB, composited over the background.
        alpha: (H, W) opacity in [0, 1]: one minus the transmittance of the whole ray.
        depth: (H, W) expected distance from the camera at which light is absorbed, in world units; 0 where alpha is 0.
        optical_depth: (H, W) integral of the density along the ray: what a tomograph measures. That of the whole ray,
            also behind the last light; with a transmittance threshold, only to where the ray stops.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    optical_depth: torch.Tensor


@eager
def render(
    mesh: TetMesh,
    field: Field | ScalarField,
    camera: Camera,
    background: torch.Tensor | tuple[float, float, float] | None = None,
    renderer: str = "marching",
    optics: OpticalModel | None = None,
    transmittance_threshold: float = 0.0,
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> RenderedImage:
    """Render a tetrahedral mesh by emission and absorption (article section 3, solved exactly).

    Differentiable once in ``mesh.vertices``, the field's tensors (those of its transfer function, too),
    ``camera.world_to_camera``, ``background`` and ``clip_plane``, as far as these require gradients. Runs on the device
    and at the precision of ``mesh.vertices``.

    Args:
        mesh: Tetrahedral mesh; its vertices' device and dtype (float32 or float64) decide where and how to render.
        field: Colour and density per vertex (linear inside each cell) or per cell (constant); or scalars likewise, with
            a transfer function.
        camera: Pinhole camera, inside or outside of the mesh.
        background: (3,) linear RGB behind the volume; black if None.
        renderer: How crossings are found and ordered. ``"marching"`` walks from cell to cell; ``"linked-list"`` sorts
            the crossings of each pixel; ``"projected"`` sorts the cells once for the whole view, which also renders
            loose cells, but warns (`OrderWarning`) where no exact order is certain. All use the same optics.
        optics: Optical model of one cell; exact integration of the linear field if None.
        transmittance_threshold: Rays stop once their transmittance is at or below this value, in [0, 1), and with them
            what they integrate; 0 stops none.
        deterministic: Whether gradients are the same in every run to the last bit: the backward pass then runs on one
            thread. CPU only. Images always are.
        clip_plane: (4,) a, b, c, d: only what lies in the half-space a x + b y + c z + d >= 0 of the world is seen.

    Returns:
        The image, on the device of ``mesh.vertices``.

    Raises:
        MeshError: The field does not fit the mesh, or holds a negative density or a value that is not finite.
        DiffTetError: An argument is of the wrong kind or out of range.
        BackendError: No back end runs on the device of the vertices, or this process was forked after its parent had
            rendered.
    """
    view = prepare_view(mesh, field, camera, optics, transmittance_threshold, deterministic, renderer)
    behind = as_background(background, mesh.vertices)
    limits = view.limits(clip_plane)
    light, distance = RenderFunction.apply(view.task, view.vertices, limits, *view.parts)
    dtype = mesh.vertices.dtype
    return compose(light.to(dtype), _times(distance, view.unit).to(dtype), behind)


@dataclass(frozen=True)
class PreparedView:
    """A view as kernels take it.

    Attributes:
        task: What it needs besides tensors that may require gradients.
        vertices: (V, 3) in camera space, in a unit in which products neither vanish nor overflow.
        parts: What the volume holds, see :data:`difftetvr.rendering.autograd.Content`; densities are in that unit.
        unit: The unit, in world units.
    """

    task: RenderTask
    vertices: torch.Tensor
    parts: tuple[torch.Tensor, ...]
    unit: float

    def limits(self, clip_plane: Any) -> torch.Tensor | None:
        """What :func:`difftetvr.rendering.clip_plane.clip_limits` says of a plane, in that unit; None without one."""
        if clip_plane is None:
            return None
        return clip_limits(clip_plane, self.task.camera, self.vertices, self.task.mesh.origin) / self.unit


def prepare_view(
    mesh: TetMesh,
    field: Field | ScalarField,
    camera: Camera,
    optics: OpticalModel | None,
    transmittance_threshold: float,
    deterministic: bool,
    renderer: str = "marching",
) -> PreparedView:
    """Check a view's inputs and bring them into camera space; arguments and errors are those of :func:`render`."""
    _require_kinds(mesh, field, camera, optics)
    if not isinstance(renderer, str) or renderer not in RENDERERS:
        raise DiffTetError(f"There is no renderer {shown(renderer)}; choose one of {', '.join(RENDERERS)}.")
    require_type(deterministic, bool, "deterministic", "pass True or False", DiffTetError)
    transmittance_threshold = as_number(transmittance_threshold, "transmittance_threshold", DiffTetError)
    if not 0.0 <= transmittance_threshold < 1.0:
        raise DiffTetError(f"transmittance_threshold is {transmittance_threshold}; it must lie in [0, 1).")
    require_own_threads()  # here already, since in a copy of a process torch may hang, too
    camera = camera.relative_to(mesh.origin)
    content, parts = _content(mesh, field, camera)
    for tensor in parts:
        if tensor.device != mesh.vertices.device:
            raise MeshError(
                f"The field is on '{tensor.device}', the mesh on '{mesh.vertices.device}'; move one of them."
            )
    positions = _camera_space(mesh, camera)
    backend = backend_for(positions)
    parts = tuple(part.to(backend.dtype) for part in parts)
    if content != "scalar":
        Field(parts[0], parts[1], content).validate(mesh)
    if optics is None:
        optics = ConstantPerCell() if content == "cell" else ExactLinear()
    task = RenderTask(backend, mesh, camera, optics, content, transmittance_threshold, deterministic, renderer)
    vertices, unit = _unit_of_length(positions, mesh)
    if unit != 1.0 and content == "scalar":
        parts = *parts[:2], torch.cat((_by_unit(parts[2][:, :1], unit), parts[2][:, 1:]), dim=1)
    elif unit != 1.0:
        parts = parts[0], _by_unit(parts[1], unit)
    return PreparedView(task, vertices, parts, unit)


def _camera_space(mesh: TetMesh, camera: Camera) -> torch.Tensor:
    """(V, 3) vertices in camera space, in float64 where float32 would blur what the camera sees.

    A narrow view from far away sees differences of positions that are much smaller than their distance. Where only the
    transform cancels, as for a mesh far from the origin that the camera is near to, its result is float32 again.
    """
    vertices = mesh.vertices
    rounded = camera.to_camera_space(vertices)
    if vertices.dtype != torch.float32 or vertices.device.type not in _KNOW_FLOAT64:
        return rounded
    seen = rounded.detach()
    nearest, farthest = (float(z) for z in torch.aminmax(seen[:, 2]))
    if nearest > _REMOTE * (farthest - nearest):
        low, high = torch.aminmax(seen, dim=0)
        if nearest > _REMOTE * float((high - low).max()):
            return camera.to_camera_space(vertices.double())
    shift = float(camera.world_to_camera.detach()[:3, 3].abs().max())
    if shift > _REMOTE * max(abs(nearest), abs(farthest)):
        return camera.to_camera_space(vertices.double()).float()
    return rounded


def _require_kinds(mesh: Any, field: Any, camera: Any, optics: Any) -> None:
    """Refuse arguments of the wrong kind, those first that come in batches elsewhere."""
    require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", DiffTetError)
    require_type(field, (Field, ScalarField), "field", "pass one difftetvr.Field or ScalarField", DiffTetError)
    require_type(camera, Camera, "camera", "pass one difftetvr.Camera, and render each view by itself", DiffTetError)
    has_model = not isinstance(optics, type) and all(callable(getattr(optics, n, None)) for n in ("weights", "adjoint"))
    if not (optics is None or has_model):
        raise DiffTetError(f"optics is {shown(optics)}; pass a model, such as difftetvr.optics.ExactLinear().")


def _content(mesh: TetMesh, field: Field | ScalarField, camera: Camera) -> tuple[Content, tuple[torch.Tensor, ...]]:
    """What the volume holds, and its tensors as they are."""
    location = field.location_on(mesh)
    if isinstance(field, ScalarField):
        if location == "vertex":
            return "scalar", (field.normalised(), *field.knots(mesh.vertices))
        field = field.as_field()
    if field.harmonics is not None:
        field.validate(mesh)
        field = field.seen_from(mesh, camera.position)
    return location, (field.color, field.density)


def as_background(background: Any, like: torch.Tensor) -> torch.Tensor | None:
    """(3,) linear RGB in the precision and on the device of a tensor; None stays None.

    Raises:
        DiffTetError: These are not three finite numbers.
    """
    if background is None:
        return None
    advice = "give a tuple or tensor"
    behind = as_reals(background, "background", DiffTetError, like.dtype, advice).to(like)
    if behind.shape != (3,) or not bool(torch.isfinite(behind.detach()).all()):
        raise DiffTetError(f"background is {shown(background)}; give three finite linear RGB components.")
    return behind


def _unit_of_length(vertices: torch.Tensor, mesh: TetMesh) -> tuple[torch.Tensor, float]:
    """Camera-space vertices in a unit in which float32 products of them neither vanish nor overflow, and that unit.

    The unit is a power of two, so nothing is rounded, and 1 for all meshes of common sizes.
    """
    low, high = torch.aminmax(vertices.detach())
    largest = max(-float(low), float(high))
    if not math.isfinite(largest):
        bad = torch.nonzero(~torch.isfinite(mesh.vertices.detach()).all(dim=1)).flatten().tolist()
        where = f"Vertex {bad[0]} of the mesh" if bad else "A vertex, seen from the camera,"
        raise MeshError(f"{where} is not finite; check what moved it.")
    if largest == 0.0 or _SMALL < largest < 1.0 / _SMALL:
        return vertices, 1.0
    unit = 2.0 ** math.frexp(largest)[1]
    return vertices / unit, unit


def _by_unit(density: torch.Tensor, unit: float) -> torch.Tensor:
    """Densities per unit of length; beyond what the precision holds they are as great as it allows, never infinite."""
    return (density * unit).clamp(max=torch.finfo(density.dtype).max)


def _times(values: torch.Tensor, unit: float) -> torch.Tensor:
    return values if unit == 1.0 else values * unit


def compose(light: torch.Tensor, distance: torch.Tensor, behind: torch.Tensor | None) -> RenderedImage:
    """The image that a kernel's output stands for.

    Args:
        light: (H, W, 4) premultiplied radiance and optical depth.
        distance: (H, W) integral of the distance in world units.
        behind: (3,) linear RGB behind the volume; black if None.
    """
    color, optical_depth = light[..., :3], light[..., 3]
    if behind is not None:
        color = color + torch.exp(-optical_depth)[..., None] * behind
    alpha = -torch.expm1(-optical_depth)
    visible = alpha > 0
    depth = torch.where(visible, distance / torch.where(visible, alpha, 1.0), 0.0)
    return RenderedImage(color, alpha, depth, optical_depth)
