"""Where cameras see points: the inverse of where their rays go, also for what lies beside the image or behind."""

from __future__ import annotations

import math

import pytest
import torch

from difftetvr.errors import CameraError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, LensCamera, render

POSE = Camera.look_at(torch.tensor([2.0, 1.7, 1.4]).double(), (0.5, 0.5, 0.5)).world_to_camera.double()
LEFT, _, RIGHT = torch.linalg.svd(POSE[:3, :3])
POSE[:3, :3] = LEFT @ RIGHT  # a rotation in float64, too
SIZE = (60, 40)
NUMBERS = (POSE, 40.0, 38.0, 29.0, 21.0, *SIZE)
COEFFICIENTS = {
    "opencv": [-0.3, 0.08, 0.01, -0.02, 0.003, 0.01, 0.02, 0.003, 0.01, 0.005, -0.01, 0.004],
    "fisheye": [0.1, -0.05, 0.01, 0.002],
    "thin-prism-fisheye": [0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003],
}


def camera_of(model: str, coefficients: list[float] | None = None) -> LensCamera:
    values = torch.tensor(COEFFICIENTS[model] if coefficients is None else coefficients, dtype=torch.float64)
    return LensCamera(*NUMBERS, model=model, coefficients=values)


CAMERAS = {"pinhole": Camera(*NUMBERS), **{model: camera_of(model) for model in COEFFICIENTS}}


def in_world(seen: torch.Tensor) -> torch.Tensor:
    """(N, 3) world-space points of (N, 3) ones in camera space."""
    return (seen - POSE[:3, 3]) @ POSE[:3, :3]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_on_rays_are_seen_in_their_pixels(camera: Camera, dtype: torch.dtype) -> None:
    rays = camera.rays()
    distances = 0.5 + 3.0 * torch.rand(rays.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pixels, enlarged = camera.project(rays.at(distances).reshape(-1, 3).to(dtype))
    assert pixels.dtype == enlarged.dtype == dtype and bool((enlarged > 0).all())
    columns, rows = torch.meshgrid(*(torch.arange(count) + 0.5 for count in SIZE), indexing="xy")
    expected = torch.stack([columns, rows], dim=-1).reshape(-1, 2).to(dtype)
    torch.testing.assert_close(pixels, expected, rtol=0.0, atol=1e-8 if dtype == torch.float64 else 2e-4)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_steps_are_enlarged_as_it_says(camera: Camera) -> None:
    """By the most of all steps across the line of sight, but for what an oblique one loses or gains."""
    directions = camera.ray_directions().reshape(-1, 3)[::37]
    places, step = 2.0 * directions, 1e-5
    _, enlarged = camera.project(in_world(places))
    most = torch.zeros(len(places), dtype=torch.float64)
    one = torch.nn.functional.normalize(torch.linalg.cross(directions, directions.roll(1, dims=1)), dim=1)
    other = torch.linalg.cross(directions, one)
    for turn in torch.linspace(0.0, math.pi, 16).tolist():
        way = math.cos(turn) * one + math.sin(turn) * other
        ends = [camera.project(in_world(places + sign * step * way))[0] for sign in (0.5, -0.5)]
        most = torch.maximum(most, ((ends[0] - ends[1]) / step).abs().amax(dim=1))
    assert float((enlarged / most).min()) > 0.7 and float((enlarged / most).max()) < 1.6


def test_what_is_behind_is_not_seen_but_by_fisheyes() -> None:
    beside, behind, straight_behind = ([1.0, 0.2, 1e-6], [1.0, 0.2, -0.5], [0.0, 0.0, -1.0])
    places = in_world(torch.tensor([beside, behind, straight_behind], dtype=torch.float64))
    for camera in (CAMERAS["pinhole"], CAMERAS["opencv"]):
        assert (camera.project(places)[1] > 0).tolist() == [True, False, False]
    fisheye = camera_of("fisheye", [0.0])
    pixels, enlarged = fisheye.project(places)
    assert bool((enlarged > 0).all()) and float((pixels[2] - pixels.new_tensor([29.0, 21.0])).norm()) > 100.0
    theta = math.pi - math.atan2(math.hypot(1.0, 0.2), 0.5)
    assert float(pixels[1, 0]) == pytest.approx(40.0 * theta / math.hypot(1.0, 0.2) + 29.0)


@pytest.mark.parametrize(("model", "coefficients"), [("opencv", [-0.3, 0.02]), ("fisheye", [-0.2, 0.0])])
def test_what_lies_beside_the_image_is_seen_beside_it(model: str, coefficients: list[float]) -> None:
    """Where the formula itself would fold it back into the image."""
    camera = camera_of(model, coefficients)
    angles = torch.linspace(0.0, math.pi / 2 if model == "opencv" else math.pi, 400, dtype=torch.float64)[1:-1]
    turn = torch.linspace(0.0, 6.0, len(angles), dtype=torch.float64)
    across = torch.sin(angles)
    places = torch.stack([across * torch.cos(turn), across * torch.sin(turn), torch.cos(angles)], dim=-1)
    pixels, _ = camera.project(in_world(places))
    away = ((pixels - torch.tensor([29.0, 21.0])) / torch.tensor([40.0, 38.0])).norm(dim=-1)
    assert bool((away.diff() > 0).all())
    undistorted = torch.tan(angles) if model == "opencv" else angles
    formula = undistorted * (1.0 + coefficients[0] * undistorted**2 + coefficients[1] * undistorted**4)
    assert not bool((formula.diff() > 0).all())


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_derivatives_by_points_and_all_parameters(camera: Camera) -> None:
    places = torch.tensor([[0.4, 0.6, 0.5], [0.9, 0.1, 0.3], [0.5, 0.5, 0.52]], dtype=torch.float64)
    leaves = [places, torch.tensor(NUMBERS[1:5], dtype=torch.float64)]
    if isinstance(camera, LensCamera):
        leaves.append(camera.coefficients)

    def seen(places: torch.Tensor, pinhole: torch.Tensor, *coefficients: torch.Tensor) -> torch.Tensor:
        if not isinstance(camera, LensCamera):
            return Camera(POSE, *pinhole.unbind(), *SIZE).project(places)[0]
        lens = {"model": camera.model, "coefficients": coefficients[0]}
        return LensCamera(POSE, *pinhole.unbind(), *SIZE, **lens).project(places)[0]

    assert torch.autograd.gradcheck(seen, [leaf.clone().requires_grad_() for leaf in leaves], atol=1e-6)


def test_pixels_without_rays_spoil_no_derivatives() -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    field = Field(torch.rand(27, 3, dtype=torch.float64), torch.ones(27, dtype=torch.float64))
    coefficients = torch.tensor([-0.9, 0.0], dtype=torch.float64, requires_grad=True)
    camera = LensCamera(*NUMBERS, coefficients=coefficients)
    assert not bool(torch.isfinite(camera.ray_directions().detach()).all())
    render(mesh, field, camera).color.sum().backward()
    assert coefficients.grad is not None and bool(torch.isfinite(coefficients.grad).all())
    assert float(coefficients.grad.abs().max()) > 0.0


def test_directions_may_be_changed_without_harm() -> None:
    """They are computed once for all cameras with one lens."""
    camera = camera_of("opencv")
    before = camera.ray_directions()
    camera.ray_directions().zero_()
    assert torch.equal(camera_of("opencv").ray_directions(), before)


@pytest.mark.parametrize("points", [torch.zeros(3), torch.zeros(2, 3, dtype=torch.int64), [[0.0, 0.0, 0.0]]])
def test_points_must_be_some(points: object) -> None:
    with pytest.raises(CameraError, match=r"The points are .*; pass a tensor of shape \(N, 3\)"):
        CAMERAS["opencv"].project(points)  # type: ignore[arg-type]
