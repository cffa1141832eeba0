"""Bundles of rays: the pinhole path's images, the reference's values and derivatives, and no ray lost."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from oracle.oracle import render_oracle
from rendering.bundles import INSIDE, OUTSIDE, assert_same, flat, random_rays, scene
from torch import Tensor

import difftetvr as dtv
from difftetvr.errors import CameraError, DiffTetError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, Rays, ScalarField, render

TRACERS = ("marching", "linked-list")


def single_ray_camera(origin: Tensor, direction: Tensor) -> Camera:
    """A camera of one pixel, whose ray is a given one; differentiable."""
    d = direction / direction.norm()
    a = torch.linalg.cross(d, torch.eye(3, dtype=d.dtype)[int(d.detach().abs().argmin())])
    a = a / a.norm()
    rotation = torch.stack([a, torch.linalg.cross(d, a), d])
    pose = torch.cat([rotation, -(rotation @ origin)[:, None]], dim=1)
    return Camera(torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])]), 1.0, 1.0, 0.5, 0.5, 1, 1)


# ---------------------------------------------------------------------------------------- as the pinhole path has it


@pytest.mark.parametrize("renderer", TRACERS)
@pytest.mark.parametrize("camera", [OUTSIDE, INSIDE], ids=["outside", "inside"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-9)])
def test_the_rays_of_a_camera_see_its_image(renderer: str, camera: Camera, dtype: torch.dtype, tolerance: float):
    mesh, field = scene(dtype)
    options: dict[str, Any] = {"renderer": renderer, "background": (0.1, 0.2, 0.3)}
    assert_same(render(mesh, field, camera.rays(), **options), render(mesh, field, camera, **options), tolerance)
    clip = {"clip_plane": (0.3, -1.0, 0.2, 0.4), **options}
    assert_same(render(mesh, field, camera.rays(), **clip), render(mesh, field, camera, **clip), tolerance)
    cells = Field(field.color[mesh.tets.long()].mean(1), field.density[mesh.tets.long()].mean(1))
    assert_same(render(mesh, cells, camera.rays(), **options), render(mesh, cells, camera, **options), tolerance)


@pytest.mark.parametrize("renderer", TRACERS)
def test_scalars_and_thresholds(renderer: str) -> None:
    mesh, field = scene()
    function = dtv.TransferFunction([0.0, 0.3, 0.3, 1.0], [0.0, 0.2, 0.9, 0.4], torch.rand(4, 3))
    scalars = ScalarField(field.density, function, attenuation=5.0)
    for camera in (OUTSIDE, INSIDE):
        options = {"renderer": renderer, "transmittance_threshold": 0.05}
        assert_same(render(mesh, scalars, camera.rays(), **options), render(mesh, scalars, camera, **options), 2e-6)


def test_rays_know_whether_they_start_at_one_point() -> None:
    """Of all sources with one, without a look at values, which would have to come from the device."""
    pose = OUTSIDE.world_to_camera
    lens = dtv.LensCamera(pose, 20.0, 20.0, 11.5, 9.5, 23, 19, coefficients=[-0.2, 0.05])
    source = dtv.Detector(torch.zeros(3), [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], 7, 6, source=OUTSIDE.position)
    learnt = Camera(pose, *(torch.tensor(v, requires_grad=True) for v in (20.0, 20.0, 11.5, 9.5)), 23, 19)
    for camera in (OUTSIDE, lens, learnt, dtv.PanoramicCamera(pose, 8, 4), source):
        rays = camera.rays()
        for same in (rays, rays.to(dtype=torch.float64), rays.relative_to((0.0, 0.0, 0.0))):
            torch.testing.assert_close(same.eye, OUTSIDE.position)
        torch.testing.assert_close(rays.relative_to((1.0, 2.0, 3.0)).eye, OUTSIDE.position - torch.arange(1.0, 4.0))
    parallel = dtv.ParallelCamera(pose, 0.1, 7, 6)
    assert parallel.rays().eye is None and Rays(torch.zeros(0, 3), [0.0, 0.0, 1.0]).eye is None
    # Equal ones that are several, too, are found to be equal where that is needed.
    assert Rays(torch.ones(4, 3), torch.rand(4, 3) + 0.1).eye is None


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (4.2e5, 5.4e6, 300.0)])
@pytest.mark.parametrize("away", [0.0, 1e3, 1e6])
def test_far_origins_lose_nothing_in_float32(offset: tuple[float, ...], away: float) -> None:
    """Rays count from near the mesh, whose own origin may be far, too."""
    mesh, field = scene()
    origins, directions = random_rays(64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    origins = origins - 4.0 * directions  # all outside
    expected = render(mesh, field, Rays(origins, directions))
    shift = torch.tensor(offset, dtype=torch.float64)
    moved = TetMesh(mesh.vertices + shift, mesh.tets).to(dtype=torch.float32)
    image = render(moved, field.to(dtype=torch.float32), Rays(origins + shift - away * directions, directions))
    assert image.color.dtype == torch.float32
    assert float((image.color - expected.color).abs().max()) < 2e-5
    seen = expected.alpha > 0.05
    depth = (image.depth.double() - expected.depth - away)[seen]
    assert float(depth.abs().max()) < 1e-5 + 1e-6 * away


# ------------------------------------------------------------------------------------------- as the reference has it


@pytest.mark.parametrize("renderer", TRACERS)
def test_values_and_derivatives_are_those_of_the_reference(renderer: str) -> None:
    mesh, field = scene()
    origins, directions = (part.requires_grad_() for part in random_rays(24))
    image = render(mesh, field, Rays(origins, directions), renderer=renderer)
    cameras = [single_ray_camera(o, d) for o, d in zip(origins, directions, strict=True)]
    truths = [render_oracle(mesh.vertices, mesh.tets, field.color, field.density, camera) for camera in cameras]
    names = ("color", "alpha", "depth")
    expected = torch.cat([torch.stack([getattr(t, name) for t in truths]).reshape(-1) for name in names])
    found = torch.cat([getattr(image, name).reshape(-1) for name in names])
    assert float((found - expected).detach().abs().max()) < 1e-9
    weights = torch.randn(len(found), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    leaves = (origins, directions)
    ours, theirs = (torch.autograd.grad((weights * values).sum(), leaves) for values in (found, expected))
    for one, other in zip(ours, theirs, strict=True):
        assert float((one - other).norm() / other.norm()) < 1e-7


@pytest.mark.parametrize("renderer", TRACERS)
def test_derivatives_by_finite_differences(renderer: str) -> None:
    mesh, field = scene(size=2)
    origins, directions = random_rays(8)
    near, far = torch.zeros(8, dtype=torch.float64), torch.full((8,), 9.0, dtype=torch.float64)
    near[::2], far[::3] = 0.31, 0.8

    def image(origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, vertices: Tensor) -> Tensor:
        return flat(
            render(mesh.with_vertices(vertices), field, Rays(origins, directions, near, far), renderer=renderer)
        )

    leaves = [part.clone().requires_grad_() for part in (origins, directions, near, far, mesh.vertices)]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12)


# ------------------------------------------------------------------------------------------------------ none is lost


def hollow(size: int) -> tuple[TetMesh, Tensor]:
    """A cube without some boxes of it, which rays enter several times, and the boxes, (B, 2, 3)."""
    mesh = TetMesh.grid((size, size, size))
    boxes = torch.tensor([[[1, 1, 1], [3, 2, 3]], [[4, 0, 2], [5, 6, 4]], [[2, 3, 4], [3, 5, 6]]]) / size
    centers = mesh.vertices[mesh.tets.long()].mean(1)
    inside = ((centers[:, None] > boxes[:, 0]) & (centers[:, None] < boxes[:, 1])).all(-1).any(1)
    return TetMesh(mesh.vertices, mesh.tets[~inside]), boxes


def chord(origins: Tensor, directions: Tensor, boxes: Tensor) -> Tensor:
    """(R, B) lengths of rays in boxes, float64."""
    with_sign = torch.where(directions == 0, 1e-300, directions)
    ends = (boxes[None] - origins[:, None, None]) / with_sign[:, None, None]
    near, far = ends.amin(2).amax(-1).clamp(min=0.0), ends.amax(2).amin(-1)
    return (far - near).clamp(min=0.0)


def nasty_rays(mesh: TetMesh, count: int) -> tuple[Tensor, Tensor]:
    """Rays from anywhere, from vertices, faces and edges, along axes and diagonals, through vertices and edges."""
    generator = torch.Generator().manual_seed(11)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    pick = lambda: mesh.tets[torch.randint(mesh.num_cells, (count,), generator=generator)].long()  # noqa: E731
    corners = mesh.vertices[pick()]
    places = [
        rand(count, 3) * 3.0 - 1.0,
        corners[:, 0],
        corners[:, :2].mean(1),
        corners[:, :3].mean(1),
        corners.mean(1),
        torch.tensor([0.5, 0.5, -2.0]) + torch.round(6.0 * rand(count, 3)) / 6.0,
    ]
    targets = mesh.vertices[pick()]
    axes = torch.eye(3)[torch.randint(3, (count,), generator=generator)] * (2.0 * (rand(count, 1) > 0.5) - 1.0)
    signs = torch.sign(rand(count, 3) - 0.5)
    pairs = []
    for place in places:
        ways = [rand(count, 3) - place, targets[:, 0] - place, targets[:, :2].mean(1) - place, axes, signs]
        pairs += [(place, way) for way in ways]
    origins, directions = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    moving = directions.abs().amax(1) > 1e-3
    return origins[moving], directions[moving]


@pytest.mark.parametrize(
    ("renderer", "count"),
    [("marching", 400), ("linked-list", 400), pytest.param("marching", 350_000, marks=pytest.mark.slow)],
)
def test_no_ray_is_lost(renderer: str, count: int) -> None:
    """Thirty kinds of rays, ``count`` of each."""
    mesh, boxes = hollow(6)
    origins, directions = nasty_rays(mesh, count)
    field = Field(torch.zeros(mesh.num_vertices, 0), torch.ones(mesh.num_vertices))
    depths = [
        render(mesh, field, Rays(o, d), renderer=renderer).optical_depth
        for o, d in zip(origins.split(1 << 20), directions.split(1 << 20), strict=True)
    ]
    unit = torch.nn.functional.normalize(directions.double(), dim=1)
    cube = torch.tensor([[[0.0] * 3, [1.0] * 3]], dtype=torch.float64)
    expected = chord(origins.double(), unit, cube)[:, 0] - chord(origins.double(), unit, boxes.double()).sum(1)
    wrong = (torch.cat(depths).double() - expected).abs()
    # Rays that run in a plane of a box see both or neither side of it; the boundary itself has no side. Along a box
    # that a ray grazes, its rounding is multiplied by the length that it stays near.
    slid = in_a_plane(origins, directions)
    steepest = torch.where(unit == 0, 1.0, unit.abs()).amin(1)
    assert float((wrong * steepest)[~slid].max()) < 1e-6
    assert int((~slid).sum()) > 20 * count


def in_a_plane(origins: Tensor, directions: Tensor) -> Tensor:
    """(R,) whether a ray runs in one of the planes that boxes may have sides in, but for rounding."""
    flat = directions.abs() < 1e-6
    on_grid = (6.0 * origins - torch.round(6.0 * origins)).abs() < 1e-5
    return (flat & on_grid).any(1)


@pytest.mark.parametrize("renderer", ["marching", "linked-list"])
def test_no_ray_is_lost_in_float64_where_float32_was_first(renderer: str) -> None:
    """Meshes of both precisions share a topology, and what is kept with it; rays pass a billionth from the sides."""
    grid = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    mesh = grid.with_vertices((grid.vertices + 1.0) / 3.0)
    field = Field(torch.ones(mesh.num_vertices, 3).double(), torch.ones(mesh.num_vertices).double())
    render(mesh.to(dtype=torch.float32), field.to(dtype=torch.float32), Rays(*random_rays(4)), renderer=renderer)
    low, high = (1.0 + 1e-9) / 3.0, (2.0 - 1e-9) / 3.0
    origins = torch.tensor([[x, y, -1.0] for x in (low, 0.4, high) for y in (low, 0.6, high)], dtype=torch.float64)
    seen = render(mesh, field, Rays(origins, torch.tensor([0.0, 0.0, 1.0]).double()), renderer=renderer)
    torch.testing.assert_close(seen.optical_depth, torch.full((9,), 1.0 / 3.0).double())


@given(seed=st.integers(0, 2**31), cut=st.floats(0.0, 3.0))
@examples(20)
def test_what_is_before_and_behind_a_distance_adds_up(seed: int, cut: float) -> None:
    mesh, field = scene()
    generator = torch.Generator().manual_seed(seed)
    origins = 3.0 * torch.rand(40, 3, generator=generator, dtype=torch.float64) - 1.0
    directions = torch.rand(40, 3, generator=generator, dtype=torch.float64) - origins
    whole = render(mesh, field, Rays(origins, directions))
    front, rear = (render(mesh, field, Rays(origins, directions, *ends)) for ends in ((0.0, cut), (cut, math.inf)))
    total = front.color + torch.exp(-front.optical_depth)[:, None] * rear.color
    assert float((whole.color - total).abs().max()) < 1e-10
    assert float((whole.optical_depth - front.optical_depth - rear.optical_depth).abs().max()) < 1e-10


def test_lines_see_what_is_behind_their_origins() -> None:
    mesh, field = scene()
    origins, directions = random_rays(32)
    line = render(mesh, field, Rays(origins, directions, -math.inf))
    back, ahead = (render(mesh, field, Rays(origins, sign * directions)) for sign in (-1.0, 1.0))
    assert float((line.optical_depth - back.optical_depth - ahead.optical_depth).abs().max()) < 1e-10


# ----------------------------------------------------------------------------------------------- shapes and mistakes


@pytest.mark.parametrize("shape", [(), (0,), (1,), (3,), (2, 0, 4), (2, 5, 3), (6, 7), (2, 70, 66)])
def test_shapes_are_kept(shape: tuple[int, ...]) -> None:
    mesh, field = scene(channels=2)
    count = math.prod(shape)
    origins, directions = random_rays(max(count, 2))
    rays = Rays(origins[:count].reshape(*shape, 3), directions[:count].reshape(*shape, 3))
    image = render(mesh, field, rays)
    assert image.color.shape == (*shape, 2)
    assert image.alpha.shape == image.depth.shape == image.optical_depth.shape == shape
    single = render(mesh, field, Rays(origins[:count], directions[:count]))
    assert float((flat(image) - flat(single)).abs().sum()) < 1e-9


def test_one_origin_serves_all_directions() -> None:
    mesh, field = scene()
    _, directions = random_rays(9)
    one = Rays([0.5, 0.4, 0.3], directions, far=torch.full((9,), 0.5))
    assert one.shape == (9,)
    assert_same(render(mesh, field, one), render(mesh, field, Rays(one.origins.clone(), directions, 0.0, 0.5)), 1e-12)
    assert torch.allclose(one.at(2.0), one.origins + 2.0 * torch.nn.functional.normalize(directions, dim=1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.rand(4, 3), torch.zeros(4, 3)), r"Ray 0 has the direction .*not 0"),
        ((torch.rand(2, 2, 3), torch.full((2, 2, 3), math.nan)), r"Ray \(0, 0\) has the direction"),
        ((torch.full((4, 3), math.inf), torch.rand(4, 3)), "Ray 0 has the origin"),
        ((torch.rand(4, 2), torch.rand(4, 3)), r"origins have shape \(4, 2\)"),
        ((torch.rand(4, 3), torch.rand(5, 3)), "do not fit together"),
        ((torch.rand(4, 3), torch.rand(4, 3), 2.0, 1.0), "Ray 0 is looked at from 2.0 to 1.0"),
        ((torch.rand(4, 3), torch.rand(4, 3), math.nan), "Ray 0 is looked at from nan"),
        ((torch.rand(4, 3), torch.rand(4, 3), 1e39), "Ray 0 is looked at from inf to inf"),
        ((torch.rand(4, 3), torch.rand(4, 3), torch.zeros(3)), "do not fit together"),
        ((torch.rand(4, 3), "forwards"), "directions is 'forwards'"),
    ],
)
def test_mistakes_get_one_sentence(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(CameraError, match=message) as error:
        Rays(*arguments)
    assert "\n" not in str(error.value)


def test_numbers_are_compared_in_the_precision_of_rays() -> None:
    bundle = Rays(torch.rand(4, 3), torch.rand(4, 3), near=1.0000000001, far=1.0)
    assert torch.equal(*bundle.ends) and Rays(torch.rand(4, 3), torch.rand(4, 3), 0.0, 1e39).ends[1].isinf().all()


def test_rays_have_no_common_order_of_cells() -> None:
    mesh, field = scene()
    with pytest.raises(DiffTetError, match="'projected' needs one order"):
        render(mesh, field, OUTSIDE.rays(), renderer="projected")
