"""Every kernel gives on a GPU what it gives on the CPU: images and their gradients, models by hats, statistics of rays.

``make test-cuda-emulated`` runs these where there is no GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import ConstantPerCell, OpticalModel, SubSegments, TransferFunction
from difftetvr.rendering import Camera, PanoramicCamera, Rays, ScalarField, render
from difftetvr.rendering.gauss_newton import model_image
from difftetvr.rendering.inspection import inspect_rays

pytestmark = pytest.mark.gpu

OUTSIDE = Camera.look_at((2.6, 1.7, 1.2), (0.1, 0.0, 0.05), fov_y=0.9, width=26, height=22)
INSIDE = Camera.look_at((0.1, 0.05, 0.02), (1.0, 0.3, 0.2), fov_y=1.2, width=26, height=22)
CAMERAS = {"outside": OUTSIDE, "inside": INSIDE}
TOLERANCES = {torch.float32: 1e-4, torch.float64: 1e-11}  # of instructions that a GPU approximates and fuses

DTYPES = pytest.mark.parametrize("dtype", TOLERANCES, ids=["float32", "float64"])
WHERE = pytest.mark.parametrize("where", CAMERAS)


def random(shape: Sequence[int], seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def irregular_mesh(dtype: torch.dtype) -> TetMesh:
    """Cells of many shapes and sizes, without the slivers that magnify rounding."""
    grid = TetMesh.grid((4, 3, 4), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    return grid.with_vertices(grid.vertices + 0.2 * (random(grid.vertices.shape, 1) - 0.5)).to(dtype=dtype)


def assert_same(make: Callable[[str], list[Tensor]], dtype: torch.dtype) -> None:
    """What is made on both devices agrees, and is something."""
    on_cpu, on_gpu = make("cpu"), make("cuda")
    assert len(on_cpu) == len(on_gpu) > 0
    for place, (one, other) in enumerate(zip(on_cpu, on_gpu)):
        assert other.device.type == "cuda" and one.dtype == other.dtype
        one, other = one.detach().double(), other.detach().cpu().double()
        assert torch.equal(one.isnan(), other.isnan())
        one, other = one.nan_to_num(), other.nan_to_num()
        assert float(one.norm()) > 0, place
        assert float((one - other).norm()) <= TOLERANCES[dtype] * float(one.norm()), place


@dataclass(frozen=True)
class Scene:
    """What is rendered, and by which of its parts the image is differentiated."""

    content: str = "vertex"
    channels: int = 3
    camera: Camera = OUTSIDE
    moves: bool = True
    clip_plane: tuple[float, ...] | None = None
    optics: OpticalModel | None = None
    rays: str | None = None
    by_color_alone: bool = False

    def outputs(self, device: str, dtype: torch.dtype, renderer: str) -> list[Tensor]:
        """The image, and the gradients of a random linear function of it."""
        mesh = irregular_mesh(dtype).to(device)
        leaves = [mesh.vertices.clone().requires_grad_()] if self.moves else []
        mesh = mesh.with_vertices(leaves[0]) if self.moves else mesh
        field = self._field(mesh, leaves)
        options: dict[str, Any] = {"renderer": renderer, "optics": self.optics}
        if self.clip_plane is not None:
            leaves.append(torch.tensor(self.clip_plane, dtype=dtype, device=device, requires_grad=True))
            options["clip_plane"] = leaves[-1]
        if self.channels == 3:
            options["background"] = (0.2, 0.3, 0.4)
        image = render(mesh, field, self._rays(leaves, dtype, device), **options)
        outputs = [image.color] if self.by_color_alone else [image.alpha, image.depth, image.optical_depth]
        outputs += [image.color] if self.channels and not self.by_color_alone else []
        loss = sum((random(o.shape, k).to(o) * o).sum() for k, o in enumerate(outputs))
        assert isinstance(loss, Tensor)
        return [*outputs, *torch.autograd.grad(loss, leaves)]

    def _field(self, mesh: TetMesh, leaves: list[Tensor]) -> Field | ScalarField:
        like = mesh.vertices.detach()
        count = mesh.num_cells if self.content == "cell" else mesh.num_vertices
        density = 3.0 * random((count,), 3).to(like)
        if self.content != "scalar":
            color = random((count, self.channels), 2).to(like)
            leaves += [part.requires_grad_() for part in ((color, density) if self.channels else (density,))]
            return Field(color, density, self.content)
        default = TransferFunction.default()
        parts = [part.to(like).clone() for part in (default.scalar, default.opacity, default.color)]
        scalar = density / 3.0
        leaves += [part.requires_grad_() for part in (scalar, *parts)]
        return ScalarField(scalar, TransferFunction(*parts), 4.0, (0.0, 1.0))

    def _rays(self, leaves: list[Tensor], dtype: torch.dtype, device: str) -> Any:
        if self.rays is None:
            return self.camera
        if self.rays == "panorama":
            return PanoramicCamera.look_at((0.1, 0.05, 0.02), (1.0, 0.3, 0.2), width=32, height=16)
        origins = 2.0 * (random((150, 3), 4) - 0.5)
        origins[:75] *= 2.0  # half of them start outside
        targets = 1.2 * (random((150, 3), 5) - 0.5)
        pair = [part.to(device, dtype).requires_grad_() for part in (origins, targets - origins)]
        leaves += pair
        return Rays(*pair, near=-0.5, far=2.0)


SCENES = {
    "vertices": Scene(),
    "vertices, by colour": Scene(moves=False, by_color_alone=True),
    "from inside": Scene(camera=INSIDE),
    "cells": Scene("cell"),
    "cells, from inside": Scene("cell", camera=INSIDE),
    "scalars": Scene("scalar"),
    "clipped": Scene(clip_plane=(1.0, 0.2, 0.1, 0.1)),
    "density alone": Scene(channels=0),
    "many channels": Scene(channels=6),
    "sub-segments": Scene(optics=SubSegments(4)),
    "constant": Scene(optics=ConstantPerCell()),
}
BUNDLES = {
    "bundle": Scene(rays="bundle"),
    "bundle through cells": Scene("cell", rays="bundle"),
    "bundle through scalars": Scene("scalar", rays="bundle"),
    "panorama": Scene(rays="panorama"),
}


@DTYPES
@pytest.mark.parametrize("renderer", ["marching", "linked-list", "projected"])
@pytest.mark.parametrize("name", SCENES)
def test_images_and_gradients(name: str, renderer: str, dtype: torch.dtype) -> None:
    assert_same(lambda device: SCENES[name].outputs(device, dtype, renderer), dtype)


@DTYPES
@pytest.mark.parametrize("renderer", ["marching", "linked-list"])
@pytest.mark.parametrize("name", BUNDLES)
def test_rays_of_their_own(name: str, renderer: str, dtype: torch.dtype) -> None:
    assert_same(lambda device: BUNDLES[name].outputs(device, dtype, renderer), dtype)


@DTYPES
@WHERE
def test_models_by_hats(where: str, dtype: torch.dtype) -> None:
    def model(device: str) -> list[Tensor]:
        mesh = irregular_mesh(dtype).to(device)
        color, density = random((mesh.num_vertices, 3), 2), 3.0 * random((mesh.num_vertices,), 3)
        field = Field(color.to(device, dtype), density.to(device, dtype))
        truth = random((22, 26, 3), 4).to(device, dtype)
        found = model_image(mesh, field, CAMERAS[where], truth, background=(0.2, 0.3, 0.4))
        hats = (found.vertices, found.edges, found.faces)
        return [part for hat in hats for part in (hat.gradient, hat.emission, hat.coupling, hat.absorption, hat.weight)]

    assert_same(model, dtype)


@DTYPES
@WHERE
@pytest.mark.parametrize("renderer", ["marching", "linked-list", "projected"])
def test_statistics_of_rays(where: str, renderer: str, dtype: torch.dtype) -> None:
    def statistics(device: str) -> list[Tensor]:
        found = inspect_rays(irregular_mesh(dtype).to(device), CAMERAS[where], renderer)
        return [found.depth_complexity, found.worst_quality]

    assert_same(statistics, dtype)
