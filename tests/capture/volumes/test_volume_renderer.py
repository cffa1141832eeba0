"""The ray-marching kernel against a float64 reference, closed forms, and itself without its shortcuts."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from difftetvr import TransferFunction
from difftetvr.capture import Volume, VolumeCapture, VolumeRenderer, fibonacci_orbit
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.pinhole import Camera

sys.path.append(str(Path(__file__).parent))
import volume_reference as reference

TOOTH, TOOTH_FUNCTION = VolumeCapture().load_volume()


def random_scene(seed: int, knots: int = 6) -> tuple[Volume, TransferFunction]:
    random = np.random.default_rng(seed)
    values = random.random((7, 11, 6))
    # Most of the range is transparent, so that there is space to skip.
    opacity = np.where(random.random(knots) < 0.5, 0.0, random.random(knots))
    function = TransferFunction(np.sort(random.random(knots)), opacity, random.random((knots, 3)))
    return Volume(values, spacing=(1.0, 0.7, 1.3)), function


def psnr(image: torch.Tensor, other: torch.Tensor) -> float:
    return -10.0 * math.log10(float(((image.double() - other.double()) ** 2).mean()))


def assert_equals_reference(
    volume: Volume, function: TransferFunction, camera: Camera, dtype: torch.dtype, tolerance: float
) -> None:
    images, alphas = VolumeRenderer(volume, function, 25.0, 300.0, "cpu", dtype).render([camera])
    image, alpha = reference.render(volume, function, 25.0, camera, 300.0)
    np.testing.assert_allclose(images[0], image, atol=tolerance)
    np.testing.assert_allclose(alphas[0], alpha, atol=tolerance)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-5), (torch.float64, 2e-6)])
@pytest.mark.parametrize("view", [0, 3, 7])
def test_tooth_equals_reference(view: int, dtype: torch.dtype, tolerance: float) -> None:
    camera = fibonacci_orbit(8, width=18, height=14)[view]
    assert_equals_reference(TOOTH, TOOTH_FUNCTION, camera, dtype, tolerance)


@pytest.mark.parametrize("knots", [1, 2, 3, 9, 17])
def test_random_scenes_equal_reference(knots: int) -> None:
    # Few pixels see a step of 1 / 300 whose count rounds differently in the two programs; float64 avoids it.
    for seed in range(2):
        volume, function = random_scene(10 * knots + seed, knots)
        camera = fibonacci_orbit(5, width=9, height=7)[seed + 1]
        assert_equals_reference(volume, function, camera, torch.float64, 2e-6)


@pytest.mark.parametrize(
    "eye, target",
    [
        ((0.0, 0.0, 1.2), (0, 0, 0)),
        ((1.2, 0.0, 0.0), (0, 0, 0)),
        ((0.0, -1.2, 0.0), (0, 0, 0)),
        ((0.1, 0.05, -0.1), (1, 0, 0)),  # inside the box
        ((-0.5, 0.0, 0.0), (1, 0, 0)),  # on a side
        ((0.0, 0.5, -1.2), (0, 0.5, 0)),  # looking along an edge plane
        ((0.0, 0.0, 2.0), (0, 0, 3)),  # looking away
    ],
)
def test_axis_aligned_inside_and_outside_rays(eye: tuple, target: tuple) -> None:
    random = np.random.default_rng(4)
    volume = Volume(random.random((9, 9, 9)))
    function = TransferFunction([0, 0.5, 1], [0, 0.1, 1], np.eye(3))
    up = (0.0, 1.0, 0.0) if eye[2] != target[2] else (0.0, 0.0, 1.0)
    # Odd sizes: the central rays run exactly along an axis, two of their directions' components are 0.
    assert_equals_reference(volume, function, Camera.look_at(eye, target, up, 0.9, 9, 7), torch.float64, 2e-6)


@pytest.mark.parametrize("opacity, attenuation", [(0.01, 25.0), (0.5, 25.0), (1.0, 3000.0), (0.0, 25.0), (1.0, 1e-4)])
def test_homogeneous_cube_in_closed_form(opacity: float, attenuation: float) -> None:
    volume = Volume(np.full((4, 4, 4), 0.5))
    function = TransferFunction([0.0, 1.0], [opacity, opacity], [[1.0, 0.5, 0.25]] * 2)
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 0.1, 5, 5)
    images, alphas = VolumeRenderer(volume, function, attenuation).render([camera])
    length = 1.0 / camera.ray_directions()[..., 2]
    expected = 1.0 - torch.exp(-opacity * attenuation * length)
    torch.testing.assert_close(alphas[0].double(), expected, atol=2e-6, rtol=0)
    torch.testing.assert_close(images[0, ..., 1].double(), 0.5 * expected, atol=2e-6, rtol=0)
    if attenuation < 1:
        torch.testing.assert_close(images[0, ..., 0].double(), expected, atol=0, rtol=1e-4)


def test_scalar_at_the_far_corner_is_reached() -> None:
    values = np.zeros((3, 3, 3))
    values[2, 2, 2] = 1.0
    function = TransferFunction([0.0, 1.0], [0.0, 1.0], np.ones((2, 3)))
    _, alphas = VolumeRenderer(Volume(values), function, 25.0).render(
        [Camera.look_at((1, 1, 1), (0, 0, 0), fov_y=0.5, width=9, height=9)]
    )
    assert alphas[0, 4, 4] > 0.5


def test_2500_steps_per_unit_have_converged() -> None:
    cameras = [c.with_size(64, 64) for c in fibonacci_orbit(3)]
    images, _ = VolumeRenderer(TOOTH, TOOTH_FUNCTION, 25.0).render(cameras)
    finer, _ = VolumeRenderer(TOOTH, TOOTH_FUNCTION, 25.0, 6000.0).render(cameras)
    assert psnr(images, finer) > 92.0
    assert images.max() > 0.5


def test_skipping_empty_space_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [(TOOTH, TOOTH_FUNCTION), *(random_scene(seed) for seed in range(4))]
    cameras = fibonacci_orbit(5, width=24, height=24)
    skipped = [VolumeRenderer(*scene, 25.0, 500.0).render(cameras)[0] for scene in scenes]
    monkeypatch.setattr(TransferFunction, "is_transparent", lambda self, lower, upper: np.zeros(lower.shape, bool))
    for scene, image in zip(scenes, skipped):
        torch.testing.assert_close(VolumeRenderer(*scene, 25.0, 500.0).render(cameras)[0], image, atol=1e-6, rtol=0)


def test_wholly_transparent_volume_is_black() -> None:
    function = TransferFunction([0.0, 1.0], [0.0, 0.0], np.ones((2, 3)))
    images, alphas = VolumeRenderer(TOOTH, function, 25.0).render(fibonacci_orbit(3, width=16, height=16))
    assert not images.any() and not alphas.any()


def test_views_do_not_depend_on_how_they_are_batched(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = fibonacci_orbit(7, width=20, height=12)
    renderer = VolumeRenderer(TOOTH, TOOTH_FUNCTION, 25.0, 500.0)
    together, _ = renderer.render(cameras)
    seen = []
    monkeypatch.setattr("difftetvr.capture.volumes.volume_renderer._MAX_RAYS", 500)
    in_pairs, _ = renderer.render(cameras, progress=lambda done, total: seen.append((done, total)))
    assert torch.equal(together, in_pairs)
    assert seen == [(2, 7), (4, 7), (6, 7), (7, 7)]
    for index in (0, 4):
        assert torch.equal(renderer.render([cameras[index]])[0][0], together[index])


def test_invalid_settings() -> None:
    for arguments, message in [((-1.0,), "attenuation"), ((25.0, 0.0), "steps"), ((25.0, float("inf")), "steps")]:
        with pytest.raises(CaptureError, match=message):
            VolumeRenderer(TOOTH, TOOTH_FUNCTION, *arguments)
    renderer = VolumeRenderer(TOOTH, TOOTH_FUNCTION, 25.0)
    with pytest.raises(CaptureError, match="image size"):
        renderer.render([])
    with pytest.raises(CaptureError, match="image size"):
        renderer.render([fibonacci_orbit(1)[0], fibonacci_orbit(1, width=64)[0]])


@pytest.mark.gpu
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 5e-5), (torch.float64, 1e-12)])
def test_a_gpu_sees_what_the_cpu_sees(dtype: torch.dtype, tolerance: float) -> None:
    cameras = fibonacci_orbit(3, width=22, height=18)
    on_cpu, on_gpu = (
        VolumeRenderer(TOOTH, TOOTH_FUNCTION, 25.0, 300.0, device, dtype).render(cameras) for device in ("cpu", "cuda")
    )
    for one, other in zip(on_cpu, on_gpu, strict=True):
        assert float(one.max()) > 0.1
        np.testing.assert_allclose(other.cpu(), one, rtol=0.0, atol=tolerance)
