"""Pictures on which nothing is seen, and why: an empty picture without a word looks like a fault."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from difftetvr.capture.volumes.value_range import range_text
from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, ScalarField
from difftetvr.rendering.api import RenderedImage
from difftetvr.rendering.inspection import inspect_rays

_LEAST_SIZE, _MOST_SIZE = 1e-150, 1e150  # of meshes, so that squares of lengths are numbers

# What would be stored as 0 in every picture of 8 bits.
_LEAST_SEEN = 0.5 / 255.0


def why_blank(
    mesh: TetMesh,
    field: Field | ScalarField,
    camera: Camera,
    image: RenderedImage,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    renderer: str = "marching",
    clip_plane: Sequence[float] | None = None,
) -> str | None:
    """Why an image shows nothing but its background, and what to change: a sentence; None where there is more on it.

    Args:
        mesh: What was rendered, and so are the next two.
        field: What it holds.
        camera: From where it was seen.
        image: What came of it.
        background: Linear RGB behind the mesh.
        renderer: How crossings were found.
        clip_plane: (4,) of the half-space that was seen; None for all.
    """
    if float(image.alpha.max()) >= _LEAST_SEEN:
        behind = torch.tensor(background).to(image.color)
        if float((image.color - behind).abs().max()) >= _LEAST_SEEN:
            return None
        return "The picture shows nothing: what it shows has the colour of the background; choose another --background."
    reason = (
        _of_content(field)
        or _of_place(mesh, camera, renderer, clip_plane)
        or "what is seen of the mesh lets all light through; raise its density (--attenuation) or show another part"
    )
    return f"The picture shows nothing: {reason}."


def _of_content(field: Field | ScalarField) -> str | None:
    """Why nothing of a mesh can be seen, from wherever."""
    if isinstance(field, Field):
        is_empty = not bool((field.density > 0).any())
        return "the density of the mesh is 0 everywhere; show another model" if is_empty else None
    if field.attenuation == 0:
        return "the attenuation is 0; give a greater --attenuation"
    low, high = (float(value) for value in torch.aminmax(field.normalised().detach()))
    if not bool(field.transfer_function.is_transparent(np.array([low]), np.array([high]))[0]):
        return None
    found = range_text(tuple(float(value) for value in torch.aminmax(field.scalar.detach())))  # type: ignore[arg-type]
    if field.value_range is not None and (high < 0.0 or low > 1.0):
        side = "below" if high < 0.0 else "above"
        return (
            f"the scalars, {found}, all lie {side} the range {range_text(field.value_range)}, where the transfer "
            "function is transparent; change --value-range"
        )
    return f"the transfer function is transparent for the scalars, {found}; change --transfer-function or --value-range"


def _of_place(mesh: TetMesh, camera: Camera, renderer: str, clip_plane: Sequence[float] | None) -> str | None:
    """Why no ray meets what is left of a mesh."""
    if clip_plane is not None:
        plane = torch.tensor([*clip_plane], dtype=torch.float64)
        heights = mesh.vertices.detach().double().cpu() @ plane[:3] + plane[3]
        if float(heights.max()) <= 0.0:
            return "the clip plane cuts all of the mesh away; change --clip"
    if float(camera.to_camera_space(mesh.vertices.detach().double())[:, 2].max()) <= 0.0:
        return "the mesh lies behind the camera; change --eye or --target"
    if not _is_met(mesh, camera, renderer, None):
        return "the camera looks past the mesh; change --eye, --target or --fov"
    if clip_plane is not None and not _is_met(mesh, camera, renderer, clip_plane):
        return "the clip plane cuts away what the camera sees; change --clip"
    return None


def _is_met(mesh: TetMesh, camera: Camera, renderer: str, clip_plane: Sequence[float] | None) -> bool:
    return bool(inspect_rays(mesh, camera, renderer, clip_plane).depth_complexity.any())


def require_drawable(size: float, what: str) -> None:
    """Checks that pictures of a mesh can be computed at all.

    Args:
        size: Its longest side.
        what: What to call it.

    Raises:
        MeshError: It is too small or too large.
    """
    if not _LEAST_SIZE < size < _MOST_SIZE:
        raise MeshError(f"{what} is {size:.3g} across, of which no picture can be computed; scale its positions.")
