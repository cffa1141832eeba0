"""Models of lenses: they are those of OpenCV, COLMAP, nerfstudio and Project Aria, and have derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from difftetvr.errors import CameraError
from difftetvr.rendering import LensCamera

SIZE, INTRINSICS = (320, 240), (300.0, 280.0, 161.0, 118.0)
TWELVE = [0.1, -0.05, 0.01, 0.02, 0.003, 0.01, 0.02, 0.003, 0.01, 0.005, -0.01, 0.004]


def on_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]


def by_angle(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u, v = on_plane(points)
    radius = np.hypot(u, v)
    scale = np.where(radius > 1e-12, np.arctan(radius) / np.maximum(radius, 1e-12), 1.0)
    return scale * u, scale * v


def opencv(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """The model of cv::projectPoints, written down from its manual."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *tilt = coefficients + [0.0] * (12 - len(coefficients))
    x, y = on_plane(points)
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2
    down = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
    seen = np.stack([across, down], axis=-1)
    return tilted(seen, *tilt) if tilt else seen


def tilted(points: np.ndarray, tau_x: float, tau_y: float) -> np.ndarray:
    """The equation of the same manual for tilted sensors."""
    about_x = np.array([[1, 0, 0], [0, np.cos(tau_x), np.sin(tau_x)], [0, -np.sin(tau_x), np.cos(tau_x)]])
    about_y = np.array([[np.cos(tau_y), 0, -np.sin(tau_y)], [0, 1, 0], [np.sin(tau_y), 0, np.cos(tau_y)]])
    turn = about_y @ about_x
    plane = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]]) @ turn
    seen = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ plane.T
    return seen[:, :2] / seen[:, 2:]


def nerfstudio(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """The formula of radial_and_tangential_undistort in nerfstudio's camera_utils.py."""
    k1, k2, k3, k4, p1, p2 = coefficients
    x, y = on_plane(points)
    r = x * x + y * y
    d = 1.0 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    return np.stack([d * x + 2 * p1 * x * y + p2 * (r + 2 * x * x), d * y + 2 * p2 * x * y + p1 * (r + 2 * y * y)], -1)


def field_of_view(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """COLMAP's FOVCameraModel, written down from the article of Devernay and Faugeras."""
    (omega,) = coefficients
    u, v = on_plane(points)
    radius = np.hypot(u, v)
    seen = np.arctan(2.0 * radius * np.tan(0.5 * omega)) / omega
    return (seen / radius)[:, None] * np.stack([u, v], axis=-1)


def division(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """COLMAP's DivisionCameraModel: (x, y, 1 + k (x^2 + y^2)) is along (u, v, 1)."""
    (k,) = coefficients
    u, v = on_plane(points)
    radius = np.hypot(u, v)
    # The root of k r s^2 - s + r = 0 that is r where k is 0.
    seen = np.array([min(np.roots([k * r, -1.0, r]).real, key=abs) for r in radius])
    return (seen / radius)[:, None] * np.stack([u, v], axis=-1)


def unified(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """COLMAP's EUCMCameraModel, written down from the article of Khomutenko et al."""
    alpha, beta = coefficients
    x, y, z = points.T
    distance = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1.0 - alpha) * z
    return np.stack([x, y], axis=-1) / distance[:, None]


def fisheye624(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """COLMAP's RadTanThinPrismFisheyeModel, written down from the documentation of Project Aria."""
    k, (p0, p1), s = coefficients[:6], coefficients[6:8], coefficients[8:]
    u, v = by_angle(points)
    square = u * u + v * v
    radial = 1.0 + sum(factor * square ** (order + 1) for order, factor in enumerate(k))
    x, y = radial * u, radial * v
    r2 = x * x + y * y
    across = x + 2 * (p0 * x + p1 * y) * x + p0 * r2 + s[0] * r2 + s[1] * r2**2
    down = y + 2 * (p0 * x + p1 * y) * y + p1 * r2 + s[2] * r2 + s[3] * r2**2
    return np.stack([across, down], axis=-1)


def opencv_fisheye(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """The model of cv::fisheye::projectPoints, written down from its manual."""
    k1, k2, k3, k4 = coefficients
    a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r = np.hypot(a, b)
    theta = np.arctan(r)
    distorted = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    scale = np.where(r > 1e-12, distorted / np.maximum(r, 1e-12), 1.0)
    return np.stack([scale * a, scale * b], axis=-1)


def colmap_thin_prism(points: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """COLMAP's ThinPrismFisheyeCameraModel, written down from its documentation."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients
    u, v = by_angle(points)
    r2 = u * u + v * v
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2
    dv = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2
    return np.stack([u + du, v + dv], axis=-1)


MODELS: dict[str, tuple[str, Callable[[np.ndarray, list[float]], np.ndarray], list[float]]] = {
    "radial": ("opencv", opencv, TWELVE[:2]),
    "tangential": ("opencv", opencv, TWELVE[:5]),
    "rational": ("opencv", opencv, TWELVE[:8]),
    "thin prism": ("opencv", opencv, TWELVE),
    "tilted sensor": ("opencv", opencv, [*TWELVE, 0.1, -0.15]),
    "nerfstudio": ("nerfstudio", nerfstudio, [0.1, -0.05, 0.02, -0.03, 0.01, 0.02]),
    "field of view": ("fov", field_of_view, [0.9]),
    "narrow field of view": ("fov", field_of_view, [1e-3]),
    "barrel by division": ("division", division, [-0.3]),
    "pincushion by division": ("division", division, [0.2]),
    "unified": ("eucm", unified, [0.6, 1.1]),
    "unified, nearly parabolic": ("eucm", unified, [0.4, 0.7]),
    "fisheye": ("fisheye", opencv_fisheye, [0.1, -0.05, 0.01, 0.02]),
    "thin prism of a fisheye": ("thin-prism-fisheye", colmap_thin_prism, TWELVE[:8]),
    "Fisheye624": ("rad-tan-thin-prism-fisheye", fisheye624, [*TWELVE[:5], -0.02, *TWELVE[6:]]),
}


@pytest.mark.parametrize("name", MODELS)
def test_rays_of_pixels_are_projected_to_them_by_the_models_as_documented(name: str) -> None:
    model, project, coefficients = MODELS[name]
    values = torch.tensor(coefficients, dtype=torch.float64)
    camera = LensCamera(torch.eye(4), *INTRINSICS, *SIZE, model=model, coefficients=values)
    points = camera.ray_directions().reshape(-1, 3)
    seen = project(points.numpy(), coefficients) * INTRINSICS[:2] + INTRINSICS[2:]
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    np.testing.assert_allclose(seen, np.stack([columns, rows], -1).reshape(-1, 2), atol=1e-6)
    np.testing.assert_allclose(camera.project(3.0 * points)[0], seen, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_by_coefficients(name: str) -> None:
    """Of where rays go, and of where points are seen."""
    model, _, coefficients = MODELS[name]
    points = torch.tensor([[0.3, -0.2, 1.0], [-0.4, 0.1, 1.2], [1e-4, 0.0, 1.0]], dtype=torch.float64)

    def both(values: torch.Tensor, pinhole: torch.Tensor) -> torch.Tensor:
        camera = LensCamera(torch.eye(4).double(), *pinhole.unbind(), 5, 4, model=model, coefficients=values)
        return torch.cat([camera.ray_directions().reshape(-1), camera.project(points)[0].reshape(-1)])

    leaves = [torch.tensor(part, dtype=torch.float64).requires_grad_() for part in (coefficients, [5.0, 5.5, 2.4, 1.9])]
    assert torch.autograd.gradcheck(both, leaves, eps=1e-6, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize(
    ("model", "coefficient", "farthest"),
    [
        ("fov", 1.2, 0.5 * np.pi / 1.2),  # where the arctangent ends
        ("division", 0.4, 1.0 / np.sqrt(0.4)),  # where the image folds
        ("division", -0.5, np.sqrt(2.0)),  # the limit of what is seen far out
    ],
)
def test_radii_up_to_the_greatest_are_found_and_none_beyond(model: str, coefficient: float, farthest: float) -> None:
    camera = LensCamera(torch.eye(4), 100.0, 100.0, 200.0, 1.0, 400, 2, model=model, coefficients=[coefficient])
    radii = ((torch.arange(400) + 0.5 - 200.0) / 100.0).hypot(torch.tensor(0.005))
    np.testing.assert_array_equal(torch.isfinite(camera.ray_directions()[0]).all(-1), radii < farthest)


def test_no_distortion_is_none() -> None:
    """Each with 0 for coefficients, or near to it where the formula has no limit of its own."""
    plain = LensCamera(torch.eye(4), *INTRINSICS, *SIZE).ray_directions()
    for model, zeros in {"fov": [0.0], "division": [0.0], "eucm": [0.0, 1.0], "nerfstudio": [0.0] * 6}.items():
        lens = LensCamera(torch.eye(4), *INTRINSICS, *SIZE, model=model, coefficients=zeros)
        torch.testing.assert_close(lens.ray_directions(), plain, rtol=0.0, atol=1e-12)
    equidistant = LensCamera(torch.eye(4), *INTRINSICS, *SIZE, model="fisheye", coefficients=torch.zeros(0))
    zeros = LensCamera(torch.eye(4), *INTRINSICS, *SIZE, model="fisheye", coefficients=torch.zeros(4))
    assert torch.equal(equidistant.ray_directions(), zeros.ray_directions())


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("eucm", [0.6, 1.2]), ("fov", [1.2]), ("division", [-0.8]), ("fisheye", [-0.05]), ("opencv", [-0.3, 0.02])],
)
def test_rays_to_the_rim_of_a_lens_that_ends_inside_the_image_are_projected_to_their_pixels(
    model: str, coefficients: list[float]
) -> None:
    values = torch.tensor(coefficients, dtype=torch.float64)
    camera = LensCamera(torch.eye(4), 75.0, 75.0, 120.0, 90.0, 240, 180, model=model, coefficients=values)
    directions = camera.ray_directions()
    known = torch.isfinite(directions).all(-1)
    rows, columns = torch.nonzero(known).T
    assert 0 < len(rows) < known.numel()
    expected = torch.stack([columns, rows], 1) + 0.5
    torch.testing.assert_close(camera.project(directions[known])[0], expected.double(), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("omega", [math.pi, -math.pi, 4.0])
def test_fields_of_view_of_half_a_turn_and_more_are_refused(omega: float) -> None:
    with pytest.raises(CameraError, match="must lie between -pi and pi"):
        LensCamera(torch.eye(4), *INTRINSICS, *SIZE, model="fov", coefficients=[omega])
