"""Paths around things: turntables, and ellipses through the middle of a capture's cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from difftetvr.capture.camera_paths.spline import require_frames
from difftetvr.capture.camera_set import CameraSet
from difftetvr.capture.viewing import Floats, pose_of
from difftetvr.errors import CameraError
from difftetvr.rendering.cameras.pinhole import Camera

_REACH = 90.0  # per cent of the cameras that lie within the ellipse along each of its axes


def turntable(camera: Camera, frames: int, center: Sequence[float], up: Sequence[float]) -> list[Camera]:
    """A camera that goes once around an axis, as if what it sees stood on a turntable.

    Args:
        camera: Where it begins.
        frames: Number of cameras, >= 1; the last one stands one step before the first.
        center: (3,) a point of the axis, in world space.
        up: (3,) direction of the axis, of any length but 0. The camera goes around it counter-clockwise, seen from its
            tip.

    Returns:
        The cameras, all of the same intrinsics.

    Raises:
        CameraError: No frame is asked for, or the axis has no direction.
    """
    require_frames(frames)
    axis, middle = np.asarray(up, dtype=np.float64), np.asarray(center, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if not (np.isfinite(length) and length > 0.0 and np.isfinite(middle).all()):
        raise CameraError("The axis of the turntable is no direction; give an up vector other than 0.")
    angles = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    pose = pose_of(camera)
    path = []
    for turn in Rotation.from_rotvec(angles[:, None] * axis / length).as_matrix():
        # The world turned back under a camera that stands still looks as it does to a camera that goes around.
        back = np.eye(4)
        back[:3, :3], back[:3, 3] = turn.T, middle - turn.T @ middle
        path.append(camera.with_pose(torch.from_numpy(pose @ back)))
    return path


def ellipse(cameras: CameraSet, frames: int) -> list[Camera]:
    """A closed path through the space where the cameras of a capture are, which looks at what these look at.

    The ellipse lies in the plane of the two main axes of the cameras' positions, around their mean, and reaches as far
    as nine in ten of them do; so it goes around a scene that was looked at from all sides, and stays on the side of one
    that was not. Intrinsics are those of the capture's typical camera.

    Args:
        cameras: Those of the capture.
        frames: Number of cameras, >= 1; the last one stands one step before the first.

    Raises:
        CameraError: No frame is asked for, or the cameras all are in one place.
    """
    require_frames(frames)
    typical, focus, up = cameras.typical, cameras.focus, cameras.up
    places = _ellipse(cameras, frames)
    if places is None:
        raise CameraError(f"The cameras of '{cameras.name}' all are in one place, so no ellipse goes through them.")
    fov_y = 2.0 * float(np.arctan(0.5 * typical.height / typical.fy))
    path = []
    for place in places:
        view = Camera.look_at(place.tolist(), focus.tolist(), up.tolist(), fov_y, typical.width, typical.height)
        lens = (typical.fx, typical.fy, typical.cx, typical.cy)
        path.append(Camera(view.world_to_camera, *lens, typical.width, typical.height))
    return path


def _ellipse(cameras: CameraSet, frames: int) -> Floats | None:
    """(N, 3) places on the ellipse; None if there is none."""
    center = cameras.positions.mean(0)
    offsets = cameras.positions - center
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    axes = axes[:2]
    if len(axes) < 2:
        return None
    reach = np.percentile(np.abs(offsets @ axes.T), _REACH, axis=0)
    if not reach.any():
        return None
    # Counter-clockwise as a turntable's camera, seen from above, so that both kinds of films run the same way.
    if np.cross(*axes) @ cameras.up < 0.0:
        axes[1] *= -1.0
    angles = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    rounds = np.stack([np.cos(angles), np.sin(angles)], axis=1) * reach
    return np.asarray(center + rounds @ axes)
