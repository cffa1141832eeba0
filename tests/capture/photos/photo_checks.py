"""What the tests of all photo formats ask of a capture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from capture.photos.photo_scene import CENTER, COLOR, POINTS, RADIUS, picture, project

from difftetvr.capture import Capture
from difftetvr.rendering.cameras.pinhole import Camera


def seen_at(camera: Camera, points: np.ndarray = POINTS) -> np.ndarray:
    """(P, 2) pixels where a camera sees points."""
    local = camera.to_camera_space(torch.from_numpy(points)).numpy()
    return local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def check_views(capture: Capture, poses: Sequence[np.ndarray]) -> None:
    """Cameras see known points at known pixels, where the images show the ball."""
    assert len(capture.cameras) == len(poses)
    for view, pose in enumerate(poses):
        np.testing.assert_allclose(seen_at(capture.cameras[view]), project(pose), atol=1e-3)
        ball = torch.from_numpy(picture(pose)[..., 3] > 0)
        assert torch.allclose(capture.images[view][ball], torch.tensor(COLOR / 255, dtype=torch.float32))


def check_bounds(capture: Capture, slack: float = 0.35) -> None:
    """The box holds the ball, and little else."""
    lower, upper = capture.bounds.numpy()
    assert (lower <= CENTER - RADIUS + 0.03).all() and (lower >= CENTER - (1 + slack) * RADIUS).all()
    assert (upper >= CENTER + RADIUS - 0.03).all() and (upper <= CENTER + (1 + slack) * RADIUS).all()


def check_sentence(error: BaseException) -> None:
    text = str(error)
    assert text.endswith(".") and "\n" not in text and "Traceback" not in text
