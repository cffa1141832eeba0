"""Ends of rays that lie exactly on faces, and walks that end with what is looked at."""

from __future__ import annotations

from typing import Any

import drjit as dr
import pytest
import torch
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Rays, render
from difftetvr.rendering.cell_features import CellFeatures
from difftetvr.rendering.kernels.segments import SegmentKernel
from difftetvr.rendering.preparation import ViewOptions, prepare_view

RENDERERS = ("marching", "linked-list")
FACES = [0.0, 0.25, 0.5, 0.75, 1.0]


def layers(per_cell: bool = False) -> tuple[TetMesh, Field]:
    """A grid whose density rises along z: from 1 to 2, or by layers of cells."""
    mesh = TetMesh.grid((4, 4, 4), dtype=torch.float64)
    heights = mesh.vertices[:, 2]
    if per_cell:
        heights = torch.floor(4.0 * heights[mesh.tets.long()].mean(1)) / 4.0
    return mesh, Field(heights.new_zeros(len(heights), 0), 1.0 + heights)


def along_z(near: Any, far: Any) -> Rays:
    return Rays([[0.4, 0.37, 0.0]], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), near, far)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("height", FACES)
def test_ends_exactly_on_a_face_have_derivatives(height: float, renderer: str) -> None:
    """Linear density knows no faces: the derivative by an end is the density there."""
    mesh, field = layers()
    near, far = (torch.tensor(height, dtype=torch.float64, requires_grad=True) for _ in range(2))
    before = render(mesh, field, along_z(-1.0, far), renderer=renderer).optical_depth
    behind = render(mesh, field, along_z(near, 2.0), renderer=renderer).optical_depth
    assert float(before.detach()) == pytest.approx(height + 0.5 * height**2)
    assert float((before + behind).detach()) == pytest.approx(1.5)
    # Outside of the mesh there is no density: at its ends a derivative is that towards its inside, or 0.
    if height > 0.0:
        assert float(torch.autograd.grad(before, far)[0]) == pytest.approx(1.0 + height)
    if height < 1.0:
        assert float(torch.autograd.grad(behind, near)[0]) == pytest.approx(-1.0 - height)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("height", FACES[1:-1])
def test_ends_on_a_face_between_constant_cells_belong_to_one_of_them(height: float, renderer: str) -> None:
    mesh, field = layers(per_cell=True)
    near, far = (torch.tensor(height, dtype=torch.float64, requires_grad=True) for _ in range(2))
    before = render(mesh, field, along_z(-1.0, far), renderer=renderer).optical_depth
    behind = render(mesh, field, along_z(near, 2.0), renderer=renderer).optical_depth
    assert float(torch.autograd.grad(before, far)[0]) == pytest.approx(1.0 + height - 0.25)
    assert float(torch.autograd.grad(behind, near)[0]) == pytest.approx(-1.0 - height)


def test_a_clip_plane_in_a_plane_of_faces_has_derivatives() -> None:
    mesh, field = layers()
    offset = torch.tensor(-0.5, dtype=torch.float64, requires_grad=True)
    zero = offset.detach() * 0.0
    plane = torch.stack([zero, zero, zero + 1.0, offset])
    rays = along_z(-1.0, 2.0)
    (gradient,) = torch.autograd.grad(render(mesh, field, rays, clip_plane=plane).optical_depth, offset)
    assert float(gradient) == pytest.approx(1.5)


class _Visits(SegmentKernel):
    """Counts the cells that a ray comes across."""

    def __init__(self, tracer: Any, rays: Any, count: Any) -> None:
        super().__init__(tracer, rays)
        self.count = count

    def start(self) -> Any:
        return dr.zeros(self.view.backend.UInt, dr.width(self.rays.pixel))

    def pass_segment(self, entry: list[Any], leaving: list[Any], ray: Any) -> Any:
        return ray + 1

    def goes_on(self, ray: Any) -> Any:
        return dr.mask_t(ray)(True)

    def finish(self, ray: Any) -> None:
        dr.scatter(self.count, ray, self.rays.pixel, self.rays.valid)


def visits(mesh: TetMesh, rays: Rays) -> Tensor:
    """(N,) how many cells rays come across."""
    density = torch.ones(mesh.num_vertices, dtype=mesh.vertices.dtype)
    medium = CellFeatures(mesh.vertices.new_zeros(mesh.num_cells, 0), Field(density[:, None], density))
    view = prepare_view(mesh, medium, rays, ViewOptions())
    tracer = view.tracer(view.ends)
    count = dr.zeros(view.task.backend.UInt, len(rays.origins))
    tracer.trace(lambda lanes: _Visits(tracer, lanes, count))
    return view.task.backend.tensor(view.task.backend.Int(count))


def test_walks_end_where_a_ray_does() -> None:
    """So that many sections of a ray cost what one ray costs, but for finding where they begin."""
    mesh = TetMesh.grid((12, 12, 12))
    begin = torch.linspace(0.0, 0.9, 10)
    origins = torch.tensor([[0.4137, 0.3721, 0.0]]).expand(10, 3)
    directions = torch.tensor([[0.01, 0.02, 1.0]]).expand(10, 3)
    whole = int(visits(mesh, Rays(origins[:1], directions[:1]))[0])
    sections = visits(mesh, Rays(origins, directions, begin, begin + 0.1))
    assert int(sections.min()) >= 1
    assert whole <= int(sections.sum()) <= whole + 10
