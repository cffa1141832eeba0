"""Fields of any number of channels: each is what it would be alone, in every renderer."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor

from difftetvr.errors import DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, render
from difftetvr.rendering.preparation import RENDERERS

CAMERA = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=13, height=11)


def scene(channels: int, per_cell: bool = False, size: int = 3) -> tuple[TetMesh, Field]:
    """A mesh in float64 with channels of either sign."""
    generator = torch.Generator().manual_seed(5)
    mesh = TetMesh.grid((size, size, size), dtype=torch.float64)
    count = mesh.num_cells if per_cell else mesh.num_vertices
    density = 4.0 * torch.rand(count, generator=generator, dtype=torch.float64)
    color = torch.randn(count, channels, generator=generator, dtype=torch.float64)
    return mesh, Field(color, density, "cell" if per_cell else "vertex")


@pytest.mark.parametrize(
    ("channels", "renderer", "per_cell"),
    [
        *itertools.product((0, 1, 5), RENDERERS, (False, True)),
        *((64, renderer, renderer != "marching") for renderer in RENDERERS),
    ],
)
def test_each_channel_is_what_it_is_in_a_field_of_three(channels: int, renderer: str, per_cell: bool) -> None:
    mesh, field = scene(channels, per_cell)
    behind = torch.linspace(-1.0, 1.0, channels, dtype=torch.float64)
    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, field.color, field.density, behind)]
    vertices, color, density, background = leaves
    image = render(
        mesh.with_vertices(vertices), Field(color, density, field.location), CAMERA, background, renderer=renderer
    )
    assert image.color.shape == (11, 13, channels)
    weights = torch.randn(11, 13, channels, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours = torch.autograd.grad((weights * image.color).sum() + image.optical_depth.sum(), leaves, allow_unused=True)
    theirs = [torch.zeros_like(leaf) for leaf in leaves]
    for first in range(0, channels, 3):
        part = slice(first, min(first + 3, channels))
        missing = 3 - (part.stop - part.start)
        pad = lambda values: torch.nn.functional.pad(values, (0, missing))  # noqa: B023, E731
        triple = render(
            mesh.with_vertices(vertices),
            Field(pad(color[:, part]), density, field.location),
            CAMERA,
            pad(background[part]),
            renderer=renderer,
        )
        assert float((triple.color[..., : 3 - missing] - image.color[..., part]).detach().abs().max()) < 1e-12
        loss = (pad(weights[..., part]) * triple.color).sum()
        found = torch.autograd.grad(loss, leaves)
        theirs = [total + one for total, one in zip(theirs, found, strict=True)]
    white = Field(torch.ones(len(field), 3, dtype=torch.float64), density, field.location)
    depth = render(mesh.with_vertices(vertices), white, CAMERA, renderer=renderer).optical_depth
    assert float((depth - image.optical_depth).detach().abs().max()) < 1e-12
    for place, part in zip((0, 2), torch.autograd.grad(depth.sum(), (vertices, density)), strict=True):
        theirs[place] = theirs[place] + part
    for one, other in zip(ours, theirs, strict=True):
        if one is not None and one.numel():
            assert float((one - other).abs().max()) < 1e-9 * max(1.0, float(other.abs().max()))


@pytest.mark.parametrize("channels", [1, 5])
def test_derivatives_by_finite_differences(channels: int) -> None:
    mesh, field = scene(channels, size=2)
    small = CAMERA.with_size(4, 3)

    def image(vertices: Tensor, color: Tensor, density: Tensor) -> Tensor:
        seen = render(mesh.with_vertices(vertices), Field(color, density), small, clip_plane=(0.3, -1.0, 0.2, 0.4))
        values = torch.cat([seen.color.reshape(-1), seen.depth.reshape(-1)])
        # Six random sums, whose derivatives are sooner found than those of each value.
        return torch.randn(6, len(values), generator=torch.Generator().manual_seed(4), dtype=torch.float64) @ values

    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, field.color, field.density)]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"background": (0.0, 0.0, 0.0)}, "give one finite number for each of 2 channels"),
        ({"background": 0.5}, "give one finite number for each of 2 channels"),
    ],
)
def test_backgrounds_have_as_many_channels(change: dict[str, Any], message: str) -> None:
    mesh, field = scene(2)
    with pytest.raises(DiffTetError, match=message):
        render(mesh, field, CAMERA, **change)


def test_more_channels_than_kernels_carry_are_refused() -> None:
    with pytest.raises(MeshError, match="up to 64 channels"):
        Field(torch.zeros(4, 65), torch.zeros(4))
    with pytest.raises(MeshError, match=r"harmonics have shape .* and its color \(4, 5\)"):
        Field(torch.zeros(4, 5), torch.zeros(4), harmonics=torch.zeros(4, 3, 3))
