"""The integral of density along whole rays, however little light is left, and what densities beyond all bounds do."""

from __future__ import annotations

import pytest
import torch
from oracle.oracle import barycentric_functions, find_crossings, pixel_directions
from oracle.scenes import SCENES

from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import ConstantPerCell, ExactLinear, OpticalModel, SubSegments, TransferFunction
from difftetvr.rendering import Camera, ScalarField, render

RENDERERS = ("marching", "linked-list", "projected")
ALONG_X = Camera.look_at((-1.0, 0.45, 0.55), (0.5, 0.45, 0.55), fov_y=0.01, width=3, height=3)
CONTENTS = ("vertex", "cell", "scalar")


def box(dtype: torch.dtype, cells: int = 6) -> TetMesh:
    return TetMesh.grid((cells, 1, 1), dtype=dtype)


def content_of(mesh: TetMesh, content: str, density: torch.Tensor) -> Field | ScalarField:
    """White matter of one density, held in different ways."""
    count = mesh.num_cells if content == "cell" else mesh.num_vertices
    if content != "scalar":
        white = torch.ones(count, 3, dtype=density.dtype)
        return Field(white, density.expand(count), content)  # type: ignore[arg-type]
    opacity = (density / density.detach()).expand(3)
    function = TransferFunction([0.0, 0.4, 1.0], opacity, [[1.0, 1.0, 1.0]] * 3)
    return ScalarField(torch.linspace(0, 1, count, dtype=density.dtype), function, float(density.detach()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize(
    "renderer", ["marching", *(pytest.param(name, marks=pytest.mark.slow) for name in RENDERERS[1:])]
)
def test_a_line_integral_does_not_end_where_no_light_is_left(renderer: str, content: str, dtype: torch.dtype) -> None:
    """A length of 1 through a density: that density, with a derivative of 1, also where exp(-density) is 0."""
    mesh = box(dtype)
    for value in (50.0, 1000.0):
        density = torch.tensor(value, dtype=dtype, requires_grad=True)
        image = render(mesh, content_of(mesh, content, density), ALONG_X, renderer=renderer)
        assert float(image.optical_depth.detach()[1, 1]) == pytest.approx(value, rel=1e-4)
        (gradient,) = torch.autograd.grad(image.optical_depth[1, 1], density)
        assert float(gradient) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.filterwarnings("ignore::difftetvr.rendering.OrderWarning")  # sums have no order
@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_line_integral_is_linear_in_the_density(renderer: str) -> None:
    """On a mesh of random cells, against the lengths of its crossings, thin and opaque, with the same derivatives."""
    scene = SCENES["porous"]()
    mesh = TetMesh(scene.vertices, scene.tets)
    pose = scene.camera.world_to_camera.double()
    points = scene.vertices.double() @ pose[:3, :3].T + pose[:3, 3]
    offset, slope = barycentric_functions(points[scene.tets.long()])
    directions = pixel_directions(scene.camera)
    crossings = find_crossings(offset, slope, directions)
    rate = (slope[crossings.cell] * directions[crossings.ray, None]).sum(-1)
    near, far = (
        (-offset[crossings.cell] / rate).gather(1, side[:, None])[:, 0] for side in (crossings.enter, crossings.leave)
    )
    at_middle = offset[crossings.cell] + rate * (0.5 * (near + far))[:, None]
    shape = (scene.camera.height, scene.camera.width)
    for factor in (1.0, 1e4):
        density = (factor * scene.density).float().requires_grad_()
        lengths = (far - near)[:, None] * at_middle * density.detach().double()[scene.tets.long()][crossings.cell]
        expected = torch.zeros(len(directions), dtype=torch.float64).index_add(0, crossings.ray, lengths.sum(1))
        image = render(mesh, Field(scene.color.float(), density), scene.camera, renderer=renderer)
        assert torch.allclose(
            image.optical_depth.detach().double(), expected.reshape(shape), rtol=1e-4, atol=1e-4 * factor
        )
        (gradient,) = torch.autograd.grad(image.optical_depth.sum(), density)
        by_corner = torch.zeros(len(density), dtype=torch.float64)
        corners = scene.tets.long()[crossings.cell]
        by_corner.index_add_(0, corners.flatten(), ((far - near)[:, None] * at_middle).flatten())
        assert torch.allclose(gradient.double(), by_corner, rtol=1e-3, atol=1e-3 * float(by_corner.max()))


@pytest.mark.parametrize("renderer", RENDERERS)
def test_rays_stop_at_a_threshold(renderer: str) -> None:
    """And their line integral with them."""
    mesh = box(torch.float32, 50)
    field = content_of(mesh, "vertex", torch.tensor(1000.0))
    image = render(mesh, field, ALONG_X, renderer=renderer, transmittance_threshold=1e-4)
    assert 9.2 < float(image.optical_depth[1, 1]) < 100.0
    assert float(image.color[1, 1, 0]) == pytest.approx(1.0, abs=2e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opaque_matter_keeps_the_derivatives_of_its_colours(dtype: torch.dtype) -> None:
    """Walking on behind the last light adds nothing to them: those of hidden colours are exactly 0."""
    mesh = box(dtype, 12)
    color = torch.rand(mesh.num_vertices, 3, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
    density = torch.full((mesh.num_vertices,), 3e4, dtype=dtype, requires_grad=True)
    vertices = mesh.vertices.clone().requires_grad_()
    image = render(mesh.with_vertices(vertices), Field(color, density), ALONG_X, background=(0.5, 0.5, 0.5))
    loss = image.color.sum() + image.depth.sum() + image.alpha.sum()
    alone = torch.autograd.grad(loss, (color, density, vertices), retain_graph=True)
    both = torch.autograd.grad(loss + image.optical_depth.sum(), (color, density, vertices))
    line = torch.autograd.grad(
        render(mesh.with_vertices(vertices), Field(color, density), ALONG_X).optical_depth.sum(), (density, vertices)
    )
    hidden = mesh.vertices[:, 0] > 0.2
    assert all(bool(torch.isfinite(gradient).all()) for gradient in (*alone, *both))
    assert not alone[0][hidden].any() and not alone[1][hidden].any()
    assert torch.equal(both[0], alone[0])
    scale = float(line[0].abs().max())
    assert torch.allclose(both[1], alone[1] + line[0], atol=1e-5 * scale)
    assert torch.allclose(both[2], alone[2] + line[1], atol=1e-4 * float(line[1].abs().max()))


@pytest.mark.parametrize(
    ("optics", "content"),
    [(ExactLinear(), "vertex"), (ConstantPerCell(), "cell"), (SubSegments(4), "vertex"), (ExactLinear(), "scalar")],
)
def test_densities_beyond_all_bounds_are_opaque(optics: OpticalModel, content: str) -> None:
    """Products that overflow make no NaN: what is seen is the surface, as at a density that is just opaque."""
    for scale, largest in ((100.0, 3e38), (1e9, 1e37)):
        mesh = TetMesh.grid((2, 1, 1), upper=(scale, scale, scale))
        pose = ALONG_X.world_to_camera.clone()
        pose[:3, 3] *= scale
        images = []
        for value in (1e9 / scale, largest):
            density = torch.tensor(value, requires_grad=True)
            field = content_of(mesh, content, density)
            image = render(mesh, field, ALONG_X.with_pose(pose), optics=optics)
            (gradient,) = torch.autograd.grad(image.color.sum() + image.depth.sum() / scale, density)
            assert torch.isfinite(gradient)
            images.append(image)
        assert torch.allclose(images[0].color, images[1].color, atol=1e-5)
        assert torch.allclose(images[0].depth, images[1].depth, rtol=1e-5)
        assert bool((images[1].alpha == images[0].alpha).all())
