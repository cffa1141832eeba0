"""Smooth paths through given cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from difftetvr.capture.camera_set import CameraSet
from difftetvr.capture.viewing import Floats, pose_of, positions_of
from difftetvr.errors import CameraError, shown
from difftetvr.rendering.cameras.pinhole import Camera

_SAMPLES = 64  # of the path between two cameras, to measure its length by
_WRAPPED = 4  # cameras that a closed path runs through once more at either end: beyond, none is felt
_LEAST_STEP = 1e-9  # between cameras that are not the same, in the size of the path and in radians


def interpolated(cameras: Sequence[Camera], frames: int, loop: bool = False) -> list[Camera]:
    """Cameras along a path through given ones, evenly spaced.

    Rotations are the spline of unit quaternions with a continuous angular acceleration
    (`scipy.spatial.transform.RotationSpline`). Focal lengths, principal points, what each camera looks at and how far
    that is are cubic splines, and the position follows from these and the rotation: between cameras around an object
    the path goes around it, and not through. What a camera looks at is the point of its optical axis next to where all
    of these meet; where they do not meet in front of all cameras, it is the camera's own position. All this is over a
    centripetal parameter, the square root of the distance, in which turning counts as moving does: such splines make no
    loops where cameras are close to each other. All frames have the size of the first camera.

    Args:
        cameras: K >= 1 cameras to run through, in this order; repeated ones count once.
        frames: Number of cameras to return, >= 1. The first one is that of ``cameras``, and the last one the last,
            unless the path is closed.
        loop: Whether the path returns to its first camera; then the frame before that is the last.

    Raises:
        CameraError: There is no camera, or no frame is asked for.
    """
    if not cameras or not all(isinstance(camera, Camera) for camera in cameras):
        raise CameraError(f"The cameras of the path are {shown(cameras)}; pass a list of one or more Camera.")
    require_frames(frames)
    keys = _Keys.of(cameras).without_repetitions()
    if len(keys.positions) == 1:
        return [keys.camera(0)] * frames
    if loop:
        keys = keys.wrapped()
    begin, end = (_WRAPPED, len(keys.positions) - _WRAPPED - 1) if loop else (0, len(keys.positions) - 1)
    times = np.concatenate([[0.0], np.sqrt(keys.steps()).cumsum()])
    curves = CubicSpline(times, keys.numbers, bc_type="natural")
    turns = RotationSpline(times, Rotation.from_matrix(keys.rotations))
    # What is passed between two frames is the same everywhere: the film neither hurries nor lingers.
    fine = np.interp(np.linspace(begin, end, _SAMPLES * (end - begin) + 1), np.arange(len(times)), times)
    passed = np.concatenate([[0.0], keys.resampled(curves(fine), turns(fine).as_matrix()).steps().cumsum()])
    when = np.interp(np.linspace(0.0, passed[-1], frames, endpoint=not loop), passed, fine)
    path = keys.resampled(curves(when), turns(when).as_matrix())
    return [path.camera(frame) for frame in range(frames)]


def require_frames(frames: int) -> None:
    """Refuse a film without a frame.

    Raises:
        CameraError: There are fewer than one.
    """
    if frames < 1:
        raise CameraError(f"The number of frames is {shown(frames)}; give at least one.")


class _Keys:
    """Cameras as numbers: rotations (K, 3, 3) camera-to-world, and the other (K, 8).

    These are the point that is looked at, its distance, and fx, fy, cx, cy in heights of the image.

    Distances are told in ``size``, the extent of all of them.
    """

    def __init__(self, rotations: Floats, numbers: Floats, shape: tuple[int, int], size: float) -> None:
        self.rotations, self.numbers, self.shape, self.size = rotations, numbers, shape, size

    @staticmethod
    def of(cameras: Sequence[Camera]) -> _Keys:
        positions = positions_of(cameras)
        rotations = np.stack([pose_of(camera)[:3, :3].T for camera in cameras])
        lens = np.array([(c.fx, c.fy, c.cx - 0.5 * c.width, c.cy - 0.5 * c.height) for c in cameras])
        heights = np.array([camera.height for camera in cameras], dtype=np.float64)
        size = float(np.ptp(positions, axis=0).max()) or 1.0
        focus = CameraSet(list(cameras), torch.zeros(len(cameras), dtype=torch.bool), "path").focus
        distance = ((focus - positions) * rotations[:, :, 2]).sum(1, keepdims=True)
        distance = distance if (distance > 0.0).all() else np.zeros_like(distance)
        numbers = np.concatenate([positions + distance * rotations[:, :, 2], distance, lens / heights[:, None]], axis=1)
        return _Keys(rotations, numbers, (cameras[0].width, cameras[0].height), size)

    @property
    def positions(self) -> Floats:
        """(K, 3) where the cameras are."""
        return np.asarray(self.numbers[:, :3] - self.numbers[:, 3:4] * self.rotations[:, :, 2])

    def steps(self) -> Floats:
        """(K - 1,) from each camera to the next: its distance in the size of the path, and its angle in radians."""
        moved = np.linalg.norm(np.diff(self.positions, axis=0), axis=1) / self.size
        turned = Rotation.from_matrix(self.rotations)
        return np.asarray(moved + (turned[:-1].inv() * turned[1:]).magnitude())

    def without_repetitions(self) -> _Keys:
        kept = np.concatenate([[True], self.steps() > _LEAST_STEP]) if len(self.positions) > 1 else np.array([True])
        return self.resampled(self.numbers[kept], self.rotations[kept])

    def wrapped(self) -> _Keys:
        """The same once more around the seam; a last camera that repeats the first is left out."""
        count = len(self.positions)
        pair = [count - 1, 0]
        closes = self.resampled(self.numbers[pair], self.rotations[pair]).steps()[0] <= _LEAST_STEP
        count -= int(closes and count > 1)
        rows = np.arange(-_WRAPPED, count + _WRAPPED + 1) % count
        return self.resampled(self.numbers[rows], self.rotations[rows])

    def resampled(self, numbers: Floats, rotations: Floats) -> _Keys:
        """Other cameras of the same film."""
        return _Keys(rotations, numbers, self.shape, self.size)

    def camera(self, index: int) -> Camera:
        width, height = self.shape
        pose = np.eye(4)
        pose[:3, :3] = self.rotations[index].T
        pose[:3, 3] = -pose[:3, :3] @ self.positions[index]
        fx, fy, cx, cy = (height * self.numbers[index, 4:]).tolist()
        return Camera(torch.from_numpy(pose), fx, fy, cx + 0.5 * width, cy + 0.5 * height, width, height)
