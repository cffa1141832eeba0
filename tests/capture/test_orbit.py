"""Camera orbits: where cameras stand, what they look at, and which way is up."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from difftetvr.capture import fibonacci_orbit, random_orbit
from difftetvr.errors import CameraError, CaptureError


@pytest.mark.parametrize("orbit", [fibonacci_orbit, random_orbit])
def test_cameras_stand_on_the_sphere_and_look_at_the_target(orbit) -> None:
    target = torch.tensor([0.3, -0.2, 0.1])
    cameras = orbit(50, target.tolist(), 2.0, 0.8, 40, 30)
    for camera in cameras:
        assert (camera.width, camera.height) == (40, 30)
        assert camera.fy == pytest.approx(15 / math.tan(0.4))
        torch.testing.assert_close((camera.position - target).norm(), torch.tensor(2.0))
        torch.testing.assert_close(
            camera.to_camera_space(target[None])[0], torch.tensor([0.0, 0.0, 2.0]), atol=1e-6, rtol=0
        )
        # Up in the world is up in the image: negative y.
        above = camera.to_camera_space((target + torch.tensor([0.0, 0.0, 0.1]))[None])[0]
        assert above[1] < 0 and abs(above[0]) < 1e-6


def test_fibonacci_cameras_are_spread_evenly() -> None:
    positions = torch.stack([camera.position for camera in fibonacci_orbit(80)])
    distances = torch.cdist(positions, positions) + 10 * torch.eye(80)
    nearest = distances.min(dim=1).values / 1.2
    # The densest possible packing of 80 points reaches about 0.41; random points come as close as 0.02.
    assert nearest.min() > 0.28
    assert positions.mean(dim=0).norm() < 0.02


def test_random_orbits_follow_their_seed() -> None:
    first, again, other = random_orbit(5, seed=1), random_orbit(5, seed=1), random_orbit(5, seed=2)
    assert all(torch.equal(a.world_to_camera, b.world_to_camera) for a, b in zip(first, again))
    assert not torch.equal(first[0].world_to_camera, other[0].world_to_camera)


def test_a_single_camera_and_poles(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(fibonacci_orbit(1)) == 1
    # From the poles themselves z is no upward direction any more.
    poles = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    monkeypatch.setattr("difftetvr.capture.orbit._on_sphere", lambda z, angle: poles)
    for camera, side in zip(fibonacci_orbit(2), (1.2, -1.2)):
        torch.testing.assert_close(camera.position, torch.tensor([0.0, 0.0, side]))
        torch.testing.assert_close(camera.world_to_camera[1, :3], torch.tensor([0.0, -1.0, 0.0]))


def test_invalid_orbits() -> None:
    with pytest.raises(CaptureError, match="views is 0"):
        fibonacci_orbit(0)
    with pytest.raises(CaptureError, match="radius"):
        random_orbit(3, radius=0.0)
    with pytest.raises(CaptureError, match="seed"):
        random_orbit(3, seed=-1)
    with pytest.raises(CameraError):
        fibonacci_orbit(3, fov_y=4.0)
