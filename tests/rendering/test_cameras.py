"""Cameras of all kinds: where pixels look, and derivatives by everything that says so."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from difftetvr.errors import CameraError, DiffTetError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, Detector, LensCamera, PanoramicCamera, ParallelCamera, RenderedImage, render

POSE = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5)).world_to_camera.double()
INTRINSICS = [9.0, 8.0, 3.4, 3.1]
COEFFICIENTS = {
    ("opencv", 2): [0.1, -0.05],
    ("opencv", 5): [0.1, -0.05, 0.01, 0.02, 0.003],
    ("opencv", 8): [0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003],
    ("opencv", 12): [0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003, 0.01, 0.005, -0.01, 0.004],
    ("fisheye", 4): [0.1, -0.05, 0.01, 0.02],
    ("thin-prism-fisheye", 8): [0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003],
}


def scene() -> tuple[TetMesh, Field]:
    generator = torch.Generator().manual_seed(5)
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    color, density = (
        torch.rand(mesh.num_vertices, count, generator=generator, dtype=torch.float64) for count in (3, 1)
    )
    return mesh, Field(color, 4.0 * density[:, 0])


def turned(turn: Tensor, move: Tensor) -> Tensor:
    """The pose after a small rotation and a translation; differentiable."""
    zero = torch.zeros_like(turn[0])
    generator = torch.stack([zero, -turn[2], turn[1], turn[2], zero, -turn[0], -turn[1], turn[0], zero]).reshape(3, 3)
    rotation = torch.matrix_exp(generator) @ POSE[:3, :3]
    pose = torch.cat([rotation, (POSE[:3, 3] + move)[:, None]], dim=1)
    return torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def vectors(*rows: list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


NOTHING = torch.zeros(3, dtype=torch.float64)
CENTERS, SOURCES = vectors([-1, -1, -0.8], [-1.2, 0.3, 0.2]), vectors([2, 1.7, 1.4], [2.2, 0.7, 0.9])
STEPS = vectors([0.1, -0.2, 0.0], [0.01, 0.0, 0.3])
CAMERAS: dict[str, tuple[Callable[..., object], list[Tensor]]] = {
    "pinhole": (
        lambda k, turn, move: Camera(turned(turn, move), *k.unbind(), 7, 6),
        [torch.tensor(INTRINSICS, dtype=torch.float64), NOTHING, NOTHING],
    ),
    "parallel": (
        lambda size, turn, move: ParallelCamera(turned(turn, move), size, 7, 6),
        [torch.tensor([0.25, 0.3], dtype=torch.float64), NOTHING, NOTHING],
    ),
    "panoramic": (lambda turn, move: PanoramicCamera(turned(turn, move), 13, 7), [NOTHING, NOTHING]),
    "detector of a source": (
        lambda c, u, v, s: Detector(c, u, v, 7, 6, source=s),
        [CENTERS, STEPS[0], STEPS.flip(0), SOURCES],
    ),
    "detector of parallel rays": (
        lambda c, u, v, d: Detector(c, u, v, 7, 6, direction=d),
        [CENTERS, STEPS[0], STEPS[1], SOURCES],
    ),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_derivatives_by_all_parameters(kind: str) -> None:
    check_derivatives(*CAMERAS[kind])


@pytest.mark.parametrize(("model", "count"), COEFFICIENTS)
def test_derivatives_by_all_parameters_of_a_lens(model: str, count: int) -> None:
    values = [torch.tensor(part, dtype=torch.float64) for part in (INTRINSICS, COEFFICIENTS[model, count])]
    check_derivatives(
        lambda k, c, turn: LensCamera(turned(turn, NOTHING), *k.unbind(), 7, 6, model=model, coefficients=c),
        [*values, NOTHING],
    )


def mixed(values: Tensor) -> Tensor:
    """Six random sums of all values, whose derivatives are sooner found than those of each."""
    return torch.randn(6, len(values), generator=torch.Generator().manual_seed(4), dtype=torch.float64) @ values


def check_derivatives(make: Callable[..., object], parameters: list[Tensor]) -> None:
    mesh, field = scene()

    def image(*leaves: Tensor) -> Tensor:
        seen = render(mesh, field, make(*leaves))
        return mixed(torch.cat([seen.color.reshape(-1), seen.alpha.reshape(-1), seen.depth.reshape(-1)]))

    leaves = [part.clone().requires_grad_() for part in parameters]
    assert float(image(*leaves).detach().abs().max()) > 0.1
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5, rtol=1e-3)


# --------------------------------------------------------------------------------------------------- where they look


def test_a_lens_without_distortion_is_a_pinhole() -> None:
    mesh, field = scene()
    plain, lens = (kind(POSE, *INTRINSICS, 7, 6) for kind in (Camera, LensCamera))
    assert float((render(mesh, field, plain).color - render(mesh, field, lens).color).abs().max()) < 1e-6


def test_pixels_that_a_lens_cannot_have_made_see_nothing() -> None:
    mesh, field = scene()
    camera = LensCamera(POSE, 5.0, 5.0, 3.5, 3.0, 7, 6, model="opencv", coefficients=[-0.9, 0.0])
    known = torch.isfinite(camera.ray_directions()).all(-1)
    assert 0 < int(known.sum()) < 42
    assert float(render(mesh, field, camera).alpha[~known].abs().max()) == 0.0


def test_a_parallel_camera_is_a_pinhole_from_far_away() -> None:
    mesh, field = scene()
    eye, target = torch.tensor([3.0, 2.0, 1.5], dtype=torch.float64), torch.full((3,), 0.5, dtype=torch.float64)
    parallel = ParallelCamera.look_at(eye, target, extent=2.0, width=20, height=16)
    away = 1e5 * (eye - target) / (eye - target).norm()
    pinhole = Camera.look_at(target + away, target, fov_y=2.0 * math.atan(1e-5), width=20, height=16)
    one, other = render(mesh, field, parallel), render(mesh, field, pinhole)
    assert float((one.color - other.color).abs().max()) < 1e-4
    seen = one.alpha > 0.05
    assert float((one.depth - other.depth + 1e5 - float((eye - target).norm()))[seen].abs().max()) < 5e-3


def test_a_panorama_is_made_of_all_directions() -> None:
    """Its pixels see what narrow pinholes see that look there."""
    mesh, field = scene()
    eye = (0.4, 0.6, 0.55)
    panorama = PanoramicCamera.look_at(eye, (1.0, 0.6, 0.55), width=8, height=4)
    image = render(mesh, field, panorama)
    for column, row in ((0, 0), (3, 1), (4, 2), (7, 3), (5, 1)):
        longitude, latitude = ((column + 0.5) / 8 - 0.5) * 2 * math.pi, ((row + 0.5) / 4 - 0.5) * math.pi
        # Forward is +x and right is -y of the world, down is -z.
        way = (math.cos(longitude) * math.cos(latitude), -math.sin(longitude) * math.cos(latitude), -math.sin(latitude))
        camera = Camera.look_at(eye, [e + w for e, w in zip(eye, way, strict=True)], fov_y=0.1, width=1, height=1)
        assert float((image.color[row, column] - render(mesh, field, camera).color[0, 0]).abs().max()) < 1e-5


def test_a_detector_of_a_source_is_a_pinhole() -> None:
    mesh, field = scene()
    camera = Camera(POSE, 9.0, 9.0, 3.5, 3.0, 7, 6)
    right, down, forward = POSE[:3, :3]
    detector = Detector(camera.position + 18.0 * forward, 2.0 * right, 2.0 * down, 7, 6, source=camera.position)
    one, other = render(mesh, field, camera), render(mesh, field, detector)
    assert float((one.optical_depth - other.optical_depth).abs().max()) < 1e-6
    assert float((one.depth - other.depth).abs().max()) < 1e-6


def test_a_detector_inside_sees_as_far_as_itself() -> None:
    mesh, _ = scene()
    field = Field(torch.zeros(mesh.num_vertices, 0, dtype=torch.float64), torch.ones(mesh.num_vertices).double())
    step = vectors([0.01, 0, 0], [0, 0.01, 0])
    detector = Detector(vectors([0.5, 0.5, 0.25])[0], step[0], step[1], 3, 3, source=vectors([0.5, 0.5, 1.0])[0])
    assert torch.allclose(render(mesh, field, detector).optical_depth, torch.tensor(0.75).double(), atol=1e-3)


# ------------------------------------------------------------------------------------------------------- many at once


def test_cameras_of_one_size_are_stacked_and_others_are_not() -> None:
    mesh, field = scene()
    small, other = Camera(POSE, *INTRINSICS, 7, 6), Camera.look_at((-1.0, 0.3, 0.2), (0.5, 0.5, 0.5), width=7, height=6)
    large = PanoramicCamera.look_at((0.5, 0.4, 0.3), (1.0, 0.4, 0.3), width=16, height=8)
    both = render(mesh, field, [small, other])
    assert isinstance(both, RenderedImage)
    assert both.color.shape == (2, 6, 7, 3)
    for image, camera in zip((both[0], both[1]), (small, other), strict=True):
        assert float((image.color - render(mesh, field, camera).color).abs().max()) < 1e-6
    several = render(mesh, field, [small, large], background=(0.5, 0.5, 0.5))
    assert isinstance(several, tuple)
    for image, camera in zip(several, (small, large), strict=True):
        alone = render(mesh, field, camera, background=(0.5, 0.5, 0.5))
        assert image.color.shape == alone.color.shape
        assert float((image.color - alone.color).abs().max()) < 1e-6


def test_gradients_of_a_batch_are_the_sum_of_those_of_its_views() -> None:
    mesh, field = scene()
    cameras = [Camera.look_at((2.0, 1.7, 1.4 - z), (0.5, 0.5, 0.5), width=9, height=8) for z in (0.0, 1.0, 2.0)]

    def gradient(views: list[Camera]) -> Tensor:
        vertices = mesh.vertices.clone().requires_grad_()
        images = render(mesh.with_vertices(vertices), field, views)
        assert isinstance(images, RenderedImage)
        (result,) = torch.autograd.grad(images.color.square().sum(), vertices)
        return result

    total = sum(gradient([camera]) for camera in cameras)
    assert float((gradient(cameras) - total).abs().max()) < 1e-9


def test_projected_cells_are_ordered_for_each_view() -> None:
    mesh, field = scene()
    cameras = [Camera.look_at((2.0, 1.7, 1.4 - z), (0.5, 0.5, 0.5), width=9, height=8) for z in (0.0, 2.0)]
    one, other = (render(mesh, field, cameras, renderer=name) for name in ("projected", "marching"))
    assert isinstance(one, RenderedImage)
    assert isinstance(other, RenderedImage)
    assert float((one.color - other.color).abs().max()) < 1e-6


# ------------------------------------------------------------------------------------------------------------ mistakes


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LensCamera(POSE, *INTRINSICS, 7, 6, model="fish"), "no lens model 'fish'"),
        (lambda: LensCamera(POSE, *INTRINSICS, 7, 6, coefficients=torch.zeros(3)), "3 coefficients; .* 2 or 4 or 5"),
        (lambda: LensCamera(POSE, *INTRINSICS, 7, 6, coefficients=[math.nan, 0.0]), "not finite"),
        (lambda: LensCamera(POSE, -1.0, 1.0, 0.0, 0.0, 7, 6), "must be greater than 0"),
        (lambda: ParallelCamera(POSE, 0.0, 7, 6), "pixel_size is"),
        (lambda: ParallelCamera(POSE, 1.0, 7, 6, math.nan), "near is nan"),
        (lambda: ParallelCamera(2.0 * POSE, 1.0, 7, 6), "no rigid transform"),
        (lambda: PanoramicCamera(POSE, 0, 6), "width is 0"),
        (lambda: Detector(NOTHING, NOTHING, NOTHING, 7, 6), "either a source or a direction"),
        (lambda: Detector(NOTHING, NOTHING, NOTHING, 7, 6, NOTHING, NOTHING), "either a source or a direction"),
        (lambda: Detector(CENTERS, vectors([1, 0, 0]).expand(3, 3), NOTHING, 7, 6, NOTHING), "for 2, 3 views"),
        (lambda: Detector(vectors([math.inf, 0, 0]), NOTHING, NOTHING, 7, 6, NOTHING), "center is .*finite vectors"),
        (lambda: Camera(POSE, *INTRINSICS, 7, 6, intrinsics=torch.ones(3)), r"intrinsics have shape \(3,\)"),
        (lambda: Camera(POSE, torch.ones(2, requires_grad=True), *INTRINSICS[1:], 7, 6), r"fx has the shape \(2,\)"),
    ],
)
def test_mistakes_get_one_sentence(make: Callable[[], object], message: str) -> None:
    with pytest.raises(CameraError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


class Silent:
    """Looks like a camera, and makes no rays."""

    def rays(self) -> None:
        return None


class Wrong(Silent):
    rays = 3  # type: ignore[assignment]


@pytest.mark.parametrize("camera", [Silent(), [Silent(), Silent()], Wrong()])
def test_cameras_that_make_no_rays(camera: object) -> None:
    with pytest.raises(DiffTetError, match=r"What the camera's rays\(\) returns is .*; return difftetvr.Rays"):
        render(*scene(), camera)  # type: ignore[call-overload]


@pytest.mark.parametrize("camera", [[], [Camera], Camera, "front", [Camera.look_at((1.0, 0, 0), (0, 0, 0)), None]])
def test_what_is_no_camera_is_refused(camera: object) -> None:
    mesh, field = scene()
    with pytest.raises(DiffTetError, match=r"camera is .*; pass a difftetvr\.Camera, a list of cameras, or"):
        render(mesh, field, camera)  # type: ignore[call-overload]


@pytest.mark.parametrize("kind", ["pinhole", "lens"])
def test_rays_of_some_pixels_are_those_of_all(kind: str) -> None:
    pose = POSE.clone().requires_grad_()
    camera = Camera(pose, *INTRINSICS, 7, 6)
    if kind == "lens":
        # So strong that its formulas fold back: what lies at the rim it cannot have made.
        camera = LensCamera(pose, *INTRINSICS, 7, 6, model="opencv", coefficients=torch.tensor([-2.0, 0.0]))
    pixels = torch.tensor([0, 23, 23, 41, 8])
    found, expected = camera.rays_of(pixels), camera.rays().some(pixels)
    for name in ("origins", "directions"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    assert torch.equal(found.ends[1], expected.ends[1]) and bool((found.ends[1] == 0).any()) == (kind == "lens")
    gradients = [torch.autograd.grad((r.directions * r.origins).sum(), pose)[0] for r in (found, expected)]
    torch.testing.assert_close(*gradients)
    for wrong in ([0, 1], torch.tensor([0.0]), torch.tensor([[0]])):
        with pytest.raises(CameraError, match=r"The pixels are .*; pass integers of shape \(N,\)"):
            camera.rays_of(wrong)  # type: ignore[arg-type]
    for wrong in (torch.tensor([3, 42]), torch.tensor([-1])):
        with pytest.raises(CameraError, match=r"Pixels go from -?\d+ to -?\d+; this image has 0 to 41\."):
            camera.rays_of(wrong)
