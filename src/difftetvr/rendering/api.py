"""``render``: from a mesh, its field and a camera or rays to an image, differentiable in all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, overload

import torch

from difftetvr.errors import DiffTetError, shown
from difftetvr.inputs import as_reals, handed_over
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import OpticalModel
from difftetvr.recording import eager
from difftetvr.rendering.autograd import RenderFunction
from difftetvr.rendering.cell_features import CellFeatures
from difftetvr.rendering.preparation import ViewOptions, as_rays, is_plain, prepare_view
from difftetvr.rendering.rays import Rays, RaySource, are_one
from difftetvr.rendering.scalar_field import ScalarField

_HALF, _OPAQUE = math.log(2.0), 1e3
"""Optical depths of opacity 1/2, and at which the transmittance is 0 in every precision."""

_MOST_VIEWPOINTS = 1024
"""Each has colours of all vertices of its own, which are kept for the backward pass."""


@dataclass(frozen=True)
class RenderedImage:
    """An image of a tetrahedral volume, (H, W); or what a bundle of rays of some other shape (...) sees.

    Attributes:
        color: (H, W, C) premultiplied channels composited over the background: of an RGB field, linear radiance.
        alpha: (H, W) opacity in [0, 1]: one minus the transmittance of the whole ray.
        depth: (H, W) expected distance from the ray's origin at which light is absorbed, in world units; 0 where alpha
            is 0.
        optical_depth: (H, W) integral of the density along the ray: what a tomograph measures. That of the whole ray,
            also behind the last light; with a transmittance threshold, only to where the ray stops.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    optical_depth: torch.Tensor

    @property
    def entropy(self) -> torch.Tensor:
        """(H, W) entropy of the opacity, -a ln a - (1 - a) ln (1 - a) in nats, from 0 for clear or opaque rays to ln 2.

        From the optical depth, so that it is accurate near both ends. Its derivative by the optical depth, which grows
        without bound towards clear rays, is 0 at them.
        """
        is_clear = self.optical_depth <= 0
        depth = torch.where(is_clear, 1.0, self.optical_depth).clamp(max=_OPAQUE)
        thin, thick = depth.clamp(max=_HALF), depth.clamp(min=_HALF)
        log_alpha = torch.where(depth < _HALF, torch.log(-torch.expm1(-thin)), torch.log1p(-torch.exp(-thick)))
        return torch.where(is_clear, 0.0, depth * torch.exp(-depth) + torch.expm1(-depth) * log_alpha)

    def __getitem__(self, index: Any) -> RenderedImage:
        """Part of the image, by an index of (H, W) or (...)."""
        return RenderedImage(self.color[index], self.alpha[index], self.depth[index], self.optical_depth[index])

    def reshaped(self, *shape: int) -> RenderedImage:
        """The same image in another shape (...)."""
        rest = (part.reshape(shape) for part in (self.alpha, self.depth, self.optical_depth))
        return RenderedImage(self.color.reshape(*shape, self.color.shape[-1]), *rest)


@overload
def render(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays,
    background: torch.Tensor | tuple[float, ...] | None = None,
    renderer: str = "marching",
    optics: OpticalModel | None = None,
    transmittance_threshold: float = 0.0,
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> RenderedImage: ...


@overload
def render(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: Sequence[RaySource],
    background: torch.Tensor | tuple[float, ...] | None = None,
    renderer: str = "marching",
    optics: OpticalModel | None = None,
    transmittance_threshold: float = 0.0,
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> RenderedImage | tuple[RenderedImage, ...]: ...


@eager
@tried_twice
def render(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays | Sequence[RaySource],
    background: torch.Tensor | tuple[float, ...] | None = None,
    renderer: str = "marching",
    optics: OpticalModel | None = None,
    transmittance_threshold: float = 0.0,
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> RenderedImage | tuple[RenderedImage, ...]:
    """Render a tetrahedral mesh by emission and absorption (article section 3, solved exactly).

    Differentiable once in ``mesh.vertices``, the field's tensors (those of its transfer function, too), all tensors of
    the camera or the rays, ``background`` and ``clip_plane``, as far as these require gradients. Runs on the device and
    at the precision of ``mesh.vertices``.

    Args:
        mesh: Tetrahedral mesh; its vertices' device and dtype (float32 or float64) decide where and how to render.
        field: Channels and density per vertex (linear inside each cell) or per cell (constant); or scalars likewise,
            with a transfer function; or channels per cell over the density of either (`CellFeatures`).
        camera: A camera, inside or outside of the mesh; any bundle of rays; or cameras, which are rendered together. A
            field with harmonics is rendered once for each point where rays start, or direction if those are fewer.
        background: (C,) channels behind the volume, linear RGB for colours; 0 if None.
        renderer: How crossings are found and ordered. ``"marching"`` walks from cell to cell; ``"linked-list"`` sorts
            the crossings of each pixel; ``"projected"`` sorts the cells once for the whole view of a pinhole camera,
            which also renders loose cells, but warns (`OrderWarning`) where no exact order is certain. All use the same
            optics.
        optics: Optical model of one cell; exact integration of the linear field if None.
        transmittance_threshold: Rays stop once their transmittance is at or below this value, in [0, 1), and with them
            what they integrate; 0 stops none.
        deterministic: Whether gradients are the same in every run to the last bit, as images always are. CPU only: the
            backward pass then runs on at most four threads, with ``marching``, else on one.
        clip_plane: (4,) a, b, c, d: only what lies in the half-space a x + b y + c z + d >= 0 of the world is seen.

    Returns:
        The image, on the device of ``mesh.vertices``. Of several cameras of one size (B, H, W) images; of several sizes
        a tuple of images.

    Raises:
        MeshError: The field does not fit the mesh, or holds a negative density or a value that is not finite.
        DiffTetError: An argument is of the wrong kind or out of range.
        BackendError: No back end runs on the device of the vertices, or this process was forked after its parent had
            rendered.
    """
    options = ViewOptions(optics, transmittance_threshold, deterministic, renderer)
    is_directional = getattr(field, "harmonics", None) is not None

    def one(view: RaySource | Rays) -> RenderedImage:
        def look(part: RaySource | Rays, is_parallel: bool = False) -> RenderedImage:
            how = replace(options, is_parallel=is_parallel) if is_parallel else options
            return _render(mesh, field, part, background, how, clip_plane)

        return _of_viewpoints(look, view) if is_directional else look(view)

    if not isinstance(camera, Sequence):
        return one(camera)
    cameras = checked_cameras(camera)
    # One after the other where each view has its own colours, or its own order of cells.
    if renderer == "projected" or is_directional:
        return _together([one(view) for view in cameras])
    bundles = [as_rays(view) for view in cameras]
    shapes = [tuple(bundle.shape) for bundle in bundles]
    if len(set(shapes)) == 1:
        return one(Rays.stacked(bundles))
    image, begin, parts = one(Rays.joined(bundles)), 0, []
    for shape in shapes:
        end = begin + math.prod(shape)
        parts.append(image[begin:end].reshaped(*shape))
        begin = end
    return tuple(parts)


def _of_viewpoints(one: Callable[..., RenderedImage], camera: Any) -> RenderedImage:
    """What a camera or rays see of colours that depend on the direction: apart for all points from where they look.

    Raises:
        DiffTetError: These are too many.
    """
    if is_plain(camera) or not isinstance(camera, (Rays, RaySource)) or isinstance(camera, type):
        return one(camera)
    rays = as_rays(camera)
    if rays.eye is not None or are_one(rays.origins.reshape(-1, 3)):
        return one(rays)
    parts, are_parallel = rays.by_viewpoint()
    if len(parts) < 2:
        return one(rays)
    if len(parts) > _MOST_VIEWPOINTS:
        raise DiffTetError(
            f"The field's colours depend on the direction (harmonics), and the rays start at {len(parts):,} points and "
            f"go in no fewer directions; pass rays from {_MOST_VIEWPOINTS:,} points at most, or a field without "
            "harmonics."
        )
    images = [one(part, are_parallel) for _, part in parts]
    place = torch.argsort(torch.cat([place for place, _ in parts])).to(images[0].alpha.device)
    names = [field.name for field in fields(RenderedImage)]
    joined = RenderedImage(*(torch.cat([getattr(image, name) for image in images]) for name in names))
    return joined[place].reshaped(*rays.shape)


def checked_cameras(cameras: Sequence[Any]) -> list[RaySource]:
    """Several cameras, or what a caller gave as such.

    Raises:
        DiffTetError: There are none, or one of them is no camera.
    """
    if not cameras or not all(isinstance(c, RaySource) and not isinstance(c, type) for c in cameras):
        raise DiffTetError(
            f"camera is {shown(cameras)}; pass a difftetvr.Camera, a list of cameras, or difftetvr.Rays."
        )
    return list(cameras)


def _together(images: Sequence[RenderedImage]) -> RenderedImage | tuple[RenderedImage, ...]:
    """Images of one size as one, others as they are."""
    if len({image.alpha.shape for image in images}) > 1:
        return tuple(images)
    names = [field.name for field in fields(RenderedImage)]
    return RenderedImage(*(torch.stack([getattr(image, name) for image in images]) for name in names))


def _render(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays,
    background: torch.Tensor | tuple[float, ...] | None,
    options: ViewOptions,
    clip_plane: Sequence[float] | torch.Tensor | None,
) -> RenderedImage:
    view = prepare_view(mesh, field, camera, options, clip_plane)
    behind = as_background(background, mesh.vertices, view.task.channels)
    if 0 in view.shape:
        empty = view.empty(view.shape)
        return RenderedImage(empty[..., None].expand(*view.shape, view.task.channels), empty, empty, empty)
    with view.task.backend.exclusive():
        shot = view.shot()
    tensors = view.vertices, view.pose, behind, view.followed, view.lines, *view.parts
    pixels = RenderFunction.apply(view.task, shot, *tensors)
    if view.task.backend.dtype != mesh.vertices.dtype:
        pixels = tuple(part.to(mesh.vertices.dtype) for part in pixels)
    image = RenderedImage(*pixels)
    if view.viewpoint is not None:
        assert isinstance(field, Field)

        def image_of(other: Field) -> torch.Tensor:
            return _render(mesh, other, camera, None, options, clip_plane).color.reshape(-1, len(other.color[0]))

        seen = view.viewpoint.with_derivatives_of_rays(image.color, mesh, field, image_of)
        image = replace(image, color=seen)
    return image


def as_background(background: Any, like: torch.Tensor, channels: int = 3) -> torch.Tensor | None:
    """(C,) channels in the precision and on the device of a tensor; None stays None.

    Raises:
        DiffTetError: These are not so many finite numbers.
    """
    if background is None:
        return None
    advice = "give a tuple or tensor"
    # Looked at where it comes from, which is the host as a rule: no GPU is waited for.
    behind = as_reals(background, "background", DiffTetError, like.dtype, advice).to(like.dtype)
    if behind.shape != (channels,) or not bool(torch.isfinite(behind.detach()).all()):
        wanted = "three finite linear RGB components" if channels == 3 else f"one finite number for each of {channels}"
        raise DiffTetError(f"background is {shown(background)}; give {wanted}{'' if channels == 3 else ' channels'}.")
    return handed_over(behind, like)
